"""Shards of a batch: every run takes each n-th clip, and all write into one folder."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

from vggtjax.errors import InputError, one_line
from vggtjax.storage.writing import locked_folder

_MOST = 1_000_000
_PREFIX = ".vggtjax-shard-"
SETTLING = 120.0  # seconds that a shard waits for others, which start at the same time
T = TypeVar("T")


class Shard(NamedTuple):
    """The clips number - 1, number - 1 + of, number - 1 + 2 of, ... of a batch."""

    number: int  # from 1
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def share(self, clips: Mapping[str, T]) -> dict[str, T]:
        """Return the clips of the shard, in their order."""
        names = list(clips)[self.number - 1 :: self.of]
        return {name: clips[name] for name in names}


def parse_shard(text: str) -> Shard:
    """Return the shard that words such as 3/16 name; raises InputError for others."""
    match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text, re.ASCII)
    shard = Shard(*map(int, match.groups())) if match else Shard(0, 0)
    if not 1 <= shard.number <= shard.of <= _MOST:
        raise InputError(f"shard is {one_line(text, 40)!r}; expected K/N with K from 1 to N, such as 3/16")
    return shard


@contextmanager
def running(out: Path, shard: Shard | None) -> Iterator[None]:
    """Hold a shard of a batch while it runs, or all of them.

    Raises OutputError where another run writes the shard, or, for a whole batch, any shard.
    """
    pattern = f"{_PREFIX}*" if shard is None else f"{_PREFIX}{shard.number}-of-{shard.of}"
    folders = sorted(out.glob(pattern)) if shard is None else [out / pattern]
    try:
        with ExitStack() as stack:
            for folder in folders:
                name = folder.name.removeprefix(_PREFIX).replace("-of-", "/")
                stack.enter_context(locked_folder(folder, f"shard {name} of the batch"))
            yield
    finally:
        for folder in folders:
            with suppress(OSError):  # another run of the shard has begun
                folder.rmdir()
