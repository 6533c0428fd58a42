"""Cases of one reader in a process of their own, which reports each case before and after it.

A reader that brings down the interpreter, hangs in C or takes all memory ends this process and nothing else.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import resource
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

from tests.fuzz.cases import Reader, Sample, scratch_folder

_MOST_BYTES = 8 * 2**30  # of address space beyond what the process has before its first case


@contextmanager
def running(reader: Reader, first: int, count: int, keep: Path | None) -> Iterator[Connection]:
    """Yield the reports of `count` cases from the seed `first` on; the process ends with the context.

    A report is (seed, None) before a case and (seed, its outcome) after it.

    The files of found cases go into the folder `keep`, if there is one.
    """
    fork = multiprocessing.get_context("fork")  # imports take longer than hundreds of cases
    receiver, sender = fork.Pipe(duplex=False)
    with scratch_folder() as folder:  # here: a process that is killed removes nothing
        process = fork.Process(target=_run, args=(reader, first, count, keep, sender, folder), daemon=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of jax, which has started nothing here
            process.start()
        sender.close()
        try:
            yield receiver
        finally:
            process.kill()
            process.join()
            receiver.close()


def _run(reader: Reader, first: int, count: int, keep: Path | None, sender: Connection, folder: Path) -> None:
    logging.disable(logging.CRITICAL)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):  # libraries in C print what they think of a file
        os.dup2(nowhere, stream.fileno())
    sample = Sample(reader, folder)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + _MOST_BYTES, size + _MOST_BYTES))
    for seed in range(first, first + count):
        sender.send((seed, None))
        outcome = sample.run(seed)
        if outcome.kind == "found" and keep is not None:
            sample.keep(seed, keep / str(seed))
        sender.send((seed, outcome))
