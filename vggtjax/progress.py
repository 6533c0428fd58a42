"""How long work reports its progress: two callables that callers give."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

Progress = Callable[[int, int | None], object]
"""Called with the number of steps done, and of all steps (None while unknown)."""

OnStage = Callable[[str], AbstractContextManager[Progress | None]]
"""Called with the name of each stage; returns a context that the stage runs in, and in it the stage's `Progress`."""


def no_progress(done: int, total: int | None) -> None:
    """Do nothing: a `Progress`."""


def no_stage(name: str) -> AbstractContextManager[None]:
    """Return an empty context: an `OnStage`."""
    return nullcontext()
