"""The work on one clip of a batch: load, reconstruct, write."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, one_line
from vggtjax.method.fusion.family import FusionParams
from vggtjax.method.fusion.file import fusion_digest
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.batch.destination import Destination
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipOutcome
from vggtjax.pipeline.devices import frames_mesh, replicate
from vggtjax.pipeline.known.intrinsics import known_values
from vggtjax.pipeline.memory import Load
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.windows.choice import choose_windows, smaller_window
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.pipeline.windows.run import LongRun, reconstruct_long
from vggtjax.progress import StageSeconds
from vggtjax.results.disk import forecast_bytes
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import RunFacts


class LongClip(NamedTuple):
    """A clip that is run in windows, and why."""

    windows: Windows
    frames: int
    reason: str


class ClipWork:
    """A model and a recipe, ready for one clip after another."""

    def __init__(self, model: Model, fusion: FusionParams | None, recipe: BatchRecipe, out: Destination) -> None:
        mesh = frames_mesh(recipe.devices)
        self._model, self._fusion, self._recipe, self._out = model, fusion, recipe, out
        self._placed = model  # with its weights on every device
        if mesh is not None:
            self._placed = dataclasses.replace(model, params=replicate(model.params, mesh))
        self._fitter: Fitter = recipe.framing.fitter(model.config)

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the results, as JSON values."""
        recipe = self._recipe
        return {
            "model": self._model.identity.to_json(),
            "mode": self._fitter.mode,
            "size": self._fitter.size,
            **dataclasses.asdict(recipe.sampling),
            "stride": recipe.sampling.step,
            **recipe.options.resolved(self._model.config.motion).to_json(),
            **dataclasses.asdict(recipe.saving),
            "only": None if recipe.saving.only is None else list(recipe.saving.only),
            "fusion": fusion_digest(self._fusion),
            **({"known": known_values(recipe.known)} if recipe.known else {}),
            "pad_frames": recipe.pad_frames,
            **({} if recipe.undistort else {"undistort": False}),
            **recipe.masks_setting(),
        }

    def long_clip(self, source: ClipSource, *, clips: int = 1) -> LongClip | None:
        """Return windows for a clip that does not fit in memory beside `clips` - 1 others; None for one that does.

        Raises DeviceMemoryError for a clip that cannot fit and cannot be cut.
        """
        recipe = self._recipe
        opened = open_source(source, undistort=recipe.undistort)
        if not recipe.unchecked:
            how: Load = {"method": recipe.options.method, "clips": clips, "devices": recipe.devices}
            choice = choose_windows(self._model, opened, recipe.sampling, self._fitter, **how)
            if choice is not None and choice.is_cut and not recipe.needs_all_frames:
                return LongClip(choice.windows, choice.frames, choice.sentence)
            if choice is not None and choice.cannot_fit:
                raise choice.refusal(cuts=False)
        return None

    def load(self, source: ClipSource) -> Clip:
        """Read a clip of this machine."""
        return read_clip(open_source(source, undistort=self._recipe.undistort), self._recipe.sampling, self._fitter)

    def run(self, name: str, source: ClipSource) -> ClipOutcome:
        """Do all the work on a clip of this machine."""
        clip = self.long_clip(source) or self.load(source)
        seconds = StageSeconds()
        result = clip if isinstance(clip, LongClip) else self.reconstruct_or_cut(name, clip, seconds)
        if isinstance(clip, LongClip) or isinstance(result, LongClip):
            del clip  # its frames are read again, window by window
            assert isinstance(result, LongClip)
            return self.run_long(name, source, result)
        return self.write(name, clip, result, seconds.seconds)

    def run_long(self, name: str, source: ClipSource, clip: LongClip) -> ClipOutcome:
        """Reconstruct a clip in windows, and write its result."""
        recipe = self._recipe
        plan = LongRun(clip.frames, recipe.sampling, self._fitter, recipe.saving)

        def run(folder: Path) -> None:
            how: dict[str, Any] = {"options": recipe.options, "long_run": plan, "fusion": self._fusion}
            how["masks"] = recipe.masks_of(name)
            if isinstance(how["masks"], np.ndarray):
                raise InputError(
                    f"masks of {name} is an array, and the clip is run in windows; give a folder of pictures"
                )
            opened = open_source(source, undistort=recipe.undistort)
            reconstruct_long(self._model, opened, folder, clip.windows, **how)

        self._out.write(name, run)
        return ClipOutcome(name, "done", clip.reason, clip.frames)

    def reconstruct(self, name: str, clip: Clip, seconds: StageSeconds) -> Reconstruction:
        """Reconstruct a clip, if there is space for its result."""
        saving = self._recipe.saving
        self._out.check_space(name, forecast_bytes(clip.images.shape[:3], clip.source_size, saving))
        return reconstruct(
            self._placed,
            clip,
            options=self._recipe.options,
            size=self._fitter.size,
            masks=self._recipe.masks_of(name),
            fusion=self._fusion,
            known=self._recipe.known,
            pad_frames=self._recipe.pad_frames,
            devices=self._recipe.devices,
            on_stage=seconds.stage,
        )

    def reconstruct_or_cut(self, name: str, clip: Clip, seconds: StageSeconds) -> Reconstruction | LongClip:
        """Reconstruct a clip; return smaller windows for one that finds no memory and may be cut."""
        try:
            return self.reconstruct(name, clip, seconds)
        except MemoryError as error:  # of the host or of the device
            windows = None if self._recipe.needs_all_frames else smaller_window(len(clip))
            if windows is None:
                raise
            reason = one_line(str(error)) or "out of memory"
        return LongClip(windows, len(clip), f"{reason}; run once more, in windows of {windows.window} frames")

    def write(self, name: str, clip: Clip, result: Reconstruction, seconds: Mapping[str, float]) -> ClipOutcome:
        """Write the result of a clip."""
        saving = self._recipe.saving

        def save(folder: Path) -> None:
            pictures = clip.pictures() if saving.resolution == "original" else None
            result.save(folder, saving=saving, pictures=pictures, facts=RunFacts(seconds))

        self._out.write(name, save)
        return ClipOutcome(name, "done", frames=len(clip))
