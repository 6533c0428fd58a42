"""What each step of a run draws: its size, its frames, and the clips of worlds from a pool that grows."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vggtjax.training.data import IN_ORDER
from vggtjax.training.recipe import Phase, Recipe
from vggtjax.training.world.pool import ClipPool, Job, PoolClip

_FIRST = 16  # clips of each size in the pool of the first step
_WINDOW = 256  # of the newest clips of a size the clips of a step are drawn
_AHEAD = 24  # steps whose clips are rendered before they come
_STREAM, _CAMERAS = 1, 2  # of the draws of clips and of known cameras, beside those of sizes


logger = logging.getLogger(__name__)


class Draw(NamedTuple):
    """The clips of a step of worlds: their job, their numbers, and of each the frames, in their order."""

    job: int
    numbers: list[int]
    frames: list[np.ndarray]


def draw_shape(recipe: Recipe, step: int) -> tuple[int, Phase, int]:
    """Return the index of a step's phase, the phase with one of its sizes, and one of its numbers of frames.

    The draw depends on the data seed and the step alone.
    """
    index, phase = recipe.phase_at(step)
    generator = np.random.default_rng((recipe.data_seed, step))
    frames = int(generator.choice(phase.frames))
    return index, phase.of_size(int(generator.integers(len(phase.all_sizes)))), frames


def draws_cameras(recipe: Recipe, step: int) -> bool:
    """Return whether the network reads the true cameras in a step, by the data seed and the step alone."""
    generator = np.random.default_rng((recipe.data_seed, step, _CAMERAS))
    return generator.random() < recipe.phase_at(step)[1].known_cameras


class Worlds:
    """The clips of worlds that the steps of a run draw."""

    def __init__(self, recipe: Recipe, pool: ClipPool, jobs: list[Job]) -> None:
        self._recipe, self._pool, self._jobs, self._asked = recipe, pool, jobs, -1

    @property
    def total(self) -> int:
        """Number of clips that the pool has at the end of the run."""
        batch, steps = max(phase.batch for phase in self._recipe.stages), self._recipe.total_steps
        return sum(self._available(job, steps, batch) for job in self._jobs)

    def clips(self, step: int) -> PoolClip | None:
        """Return the clips of a step, or None for a step of scenes; those of the next steps are begun."""
        for later in range(max(step, self._asked + 1), min(step + _AHEAD, self._recipe.total_steps)):
            if (draw := self.draw(later)) is not None:
                self._pool.ask(draw.job, draw.numbers)
            self._asked = later
        draw = self.draw(step)
        return None if draw is None else self._pool.clips(*draw)

    def draw(self, step: int) -> Draw | None:
        """Return what a step draws; None for a step of scenes."""
        index, phase, frames = draw_shape(self._recipe, step)
        generator = np.random.default_rng((self._recipe.data_seed, step, _STREAM))
        if generator.random() >= phase.worlds:
            return None
        job = _job(self._recipe, index, phase)
        available = self._available(job, step, phase.batch)
        newest = min(available, max(_WINDOW, 2 * phase.batch))
        numbers = available - 1 - generator.choice(newest, phase.batch, replace=False)
        chosen = [_frames(generator, job.frames, frames) for _ in numbers]
        return Draw(self._jobs.index(job), numbers.tolist(), chosen)

    def _available(self, job: Job, step: int, batch: int) -> int:
        """Return how many clips of a job the pool has at a step: some at its start, then more with every step."""
        rendered, start = 0.0, 0
        for index, phase in enumerate(self._recipe.stages):
            sizes = [_job(self._recipe, index, phase.of_size(size)) for size in range(len(phase.all_sizes))]
            if phase.worlds and job in sizes:
                steps = min(max(step - start, 0), phase.steps)
                rendered += steps * phase.batch * phase.worlds / phase.reuse / len(sizes)
            start += phase.steps
        return max(_FIRST, 2 * batch) + int(rendered)


@contextmanager
def opened_worlds(recipe: Recipe, folder: Path, renderers: int = 1) -> Iterator[Worlds | None]:
    """Yield the worlds of a recipe, with a pool in `folder`; None for a recipe without worlds.

    Raises InputError where the recipe's assets are not a folder of assets.
    """
    phases = [(index, phase) for index, phase in enumerate(recipe.stages) if phase.worlds]
    jobs = [_job(recipe, index, phase.of_size(size)) for index, phase in phases for size in range(len(phase.all_sizes))]
    if not jobs:
        yield None
        return
    jobs = list(dict.fromkeys(jobs))
    with ClipPool(folder, jobs, renderers) as pool:
        worlds = Worlds(recipe, pool, jobs)
        logger.info("up to %d clips of worlds are rendered into %s, some 1 MB each", worlds.total, folder)
        yield worlds


def _job(recipe: Recipe, index: int, phase: Phase) -> Job:
    most = max(recipe.stages[index].frames)
    size = most, phase.height, phase.width, recipe.model.patch_size
    return Job(recipe.assets, phase.world, *size, recipe.data_seed)


def _frames(generator: np.random.Generator, available: int, count: int) -> np.ndarray:
    """Return frames of a clip, evenly apart, forward or backward in time; in half of the clips in random order."""
    apart = int(generator.integers(1, max((available - 1) // max(count - 1, 1), 1) + 1))
    first = int(generator.integers(0, available - apart * (count - 1)))
    frames = first + apart * np.arange(count)
    if generator.random() >= IN_ORDER:
        return generator.permutation(frames)
    return frames[::-1] if generator.random() < 0.5 else frames
