"""What a machine of a cluster does: one clip after another. Does not import jax before it is needed."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from vggtjax.clips.fetched import Fetched
from vggtjax.errors import VggtjaxError, one_line
from vggtjax.pipeline.batch.destination import Destination, has_changed
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipOutcome, failed
from vggtjax.storage.versions import running_versions

Load = Callable[[], tuple[Any, Any]]  # of a model, and a fitted rule of fusion or None


class Worker:
    """An actor: one model, and clips by name. Ray starts its process anew where it ends, and calls `run` once more."""

    def __init__(self, load: Load, recipe: BatchRecipe, out: Destination, folder: str, threads: int | None) -> None:
        """`folder` is where relative paths start, `threads` are for computing on a CPU; None for all."""
        self._load, self._recipe, self._out, self._folder, self._threads = load, recipe, out, folder, threads
        self._work: Any = None
        self._fetched, self._warning = Fetched(), ""

    def ready(self) -> tuple[str, dict[str, Any], str]:
        """Load the model; return which code runs, the settings, and what is to be said."""
        self._begin()
        return running_versions(), self._work.settings, self._warning

    def run(self, name: str, source: str) -> ClipOutcome:
        """Do a clip, unless its result is there."""
        try:
            self._begin()
            there = self._out.has(name)
            if there and not has_changed(self._out, name, source):
                return ClipOutcome(name, "kept")
            outcome = self._work.run(name, self._fetched.local(name, source))
            return outcome.of_changed() if there else outcome
        except Exception as error:  # a fault of this program, too, costs one clip and not the batch
            known = isinstance(error, VggtjaxError | MemoryError)
            return failed(name, error if known else RuntimeError(f"{type(error).__name__}: {one_line(str(error))}"))
        finally:
            self._fetched.drop(name)

    def _begin(self) -> None:
        """Load the model, unless it is there."""
        from vggtjax.pipeline.batch.clip_work import ClipWork

        if self._work is None:
            with suppress(OSError):  # a machine without the folder: relative paths are not found
                os.chdir(self._folder)
            if self._threads is not None:
                os.environ.setdefault("NPROC", str(self._threads))  # XLA asks for it when jax begins
            model, fusion = self._load()
            self._warning, self._work = model.warning, ClipWork(model, fusion, self._recipe, self._out)
