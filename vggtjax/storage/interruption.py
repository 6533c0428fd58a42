"""Ctrl-C: what is kept and how to go on, said within two seconds also while the main thread compiles or computes."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_PATIENCE = 1.5  # seconds for the main thread to end as usual
_SHOW_CURSOR = "\x1b[?25h"  # which a progress bar hides
_handled = threading.Event()
_notes: list[Callable[[], str]] = []  # of the work that is under way, the innermost last


@contextmanager
def kept(note: Callable[[], str]) -> Iterator[None]:
    """Have an interruption of the work inside say `note()`: what is kept, and how to go on."""
    _notes.append(note)
    try:
        yield
    except KeyboardInterrupt:
        raise  # the note stays, to be said
    except BaseException:
        _notes.remove(note)
        raise
    _notes.remove(note)


def message() -> str:
    """Return what is said of an interruption."""
    return "; ".join(["interrupted", *(note() for note in _notes[-1:])])


def handled() -> None:
    """Say that the program has taken Ctrl-C as its normal end, as a server does, and ends in its own time."""
    _handled.set()


def answer_at_once() -> None:
    """Have Ctrl-C end this process within two seconds, unless the program handles the signal in its own way.

    Python tells the main thread, which hears of it when compiled code returns; XLA compiles for a minute. So a thread
    waits for the signal, gives the main thread time to end or to call `handled`, and then ends the process as a kill
    would: files are written whole or not at all. A process that ignores Ctrl-C, as in a shell's background, still does.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return

    def notice(number: int, frame: FrameType | None) -> None:  # tells this handler from one of the program
        signal.default_int_handler(number, frame)

    def watch() -> None:
        while number := reader.recv(1):
            if number[0] == signal.SIGINT and signal.getsignal(signal.SIGINT) is notice:
                time.sleep(_PATIENCE)
                if not _handled.is_set():
                    leave(message())

    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.signal(signal.SIGINT, notice)
    signal.set_wakeup_fd(os.dup(writer.fileno()) if os.name == "posix" else writer.detach(), warn_on_full_buffer=False)
    threading.Thread(target=watch, name="interruption", daemon=True).start()


def leave(text: str | None = None) -> None:
    """Say why, unless that was said, and end the process without waiting for threads that compile."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is sys.stderr and text is not None:
                stream.write(f"{_SHOW_CURSOR if stream.isatty() else ''}vggtjax: {text}\n")
            stream.flush()
    os._exit(130)
