"""How long work reports its progress: two callables that callers give."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

Progress = Callable[[int, int | None], object]
"""Called with the number of steps done, and of all steps (None while unknown)."""

OnStage = Callable[[str], AbstractContextManager[Progress | None]]
"""Called with the name of each stage; returns a context that the stage runs in, and in it the stage's `Progress`."""


def no_progress(done: int, total: int | None) -> None:
    """Do nothing: a `Progress`."""


def no_stage(name: str) -> AbstractContextManager[None]:
    """Return an empty context: an `OnStage`."""
    return nullcontext()


class StageSeconds:
    """How long stages take: `seconds` by name, of the stages that have ended; `stage` is an `OnStage`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def telling(self, on_stage: OnStage) -> OnStage:
        """Return an `OnStage` that times its stages and tells `on_stage` of them."""

        @contextmanager
        def stage(name: str) -> Iterator[Progress | None]:
            with self.stage(name), on_stage(name) as progress:
                yield progress

        return stage
