"""How `vggtjax reconstruct` runs a clip: together or in windows, and once more in a smaller way without memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.masks import load_masks
from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.clips.queries import parse_queries
from vggtjax.clips.shots import looks_of
from vggtjax.clips.sources import open_source
from vggtjax.errors import DeviceMemoryError, one_line
from vggtjax.interface.commands.clip_options import GivenInputs
from vggtjax.interface.commands.report import Report
from vggtjax.method.fusion.family import FusionParams
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.batch.recipe import ClipRecipe
from vggtjax.pipeline.known.stated import disagreement, focal_stated
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.windows.choice import choose_windows, smaller_size, smaller_window
from vggtjax.pipeline.windows.frames import count_frames
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.pipeline.windows.run import LongRun, reconstruct_long
from vggtjax.pipeline.windows.store import discard, unfinished_cut
from vggtjax.results.disk import announce, forecast_bytes
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import RunFacts


class OneClip:
    """A clip, and how it is read, run and written."""

    def __init__(
        self,
        report: Report,
        frames: str | Sequence[str],  # as the user named them
        model: Model,
        fusion: FusionParams | None,
        recipe: ClipRecipe,
        given: GivenInputs,
        out: Path,
        source: Source | None = None,  # of these frames, where it is open: what is odd about it is said once
    ) -> None:
        self._report = report
        self._source = open_source(frames, undistort=recipe.undistort) if source is None else source
        self._model, self._fusion, self._recipe, self._given, self._out = model, fusion, recipe, given, out
        self._fitter = recipe.framing.fitter(model.config)

    def run(self, windows: Windows) -> Reconstruction:
        """Reconstruct the clip and write the result; where the memory runs out, once more in a smaller way.

        Args:
            windows: how the clip is cut; without a window that is chosen by the memory that is free.

        Raises DeviceMemoryError where the clip is predicted not to fit, or does not fit in the smaller way either.
        """
        windows, count = self.cut(windows)
        try:
            return self._run(windows, count)
        except MemoryError as error:  # of the host or of the device
            reason = one_line(str(error)) or "out of memory"
        # Outside of the handler: the error holds the arrays that did not fit.
        smaller = None
        if count is not None:
            smaller = smaller_window(windows.window or 0)
        elif not self._recipe.needs_all_frames:
            smaller = smaller_window(count_frames(self._source, self._recipe.sampling))
        if smaller is not None:
            self._report.note(f"{reason}; running once more, in windows of {smaller.window} frames")
            return self._run(smaller, count_frames(self._source, self._recipe.sampling))
        fitter = smaller_size(self._fitter)
        if fitter is None or count is not None:
            raise DeviceMemoryError(reason)
        self._report.note(f"{reason}; running once more, at --size {fitter.size}")
        self._fitter = fitter
        return self._run(windows, None)

    def cut(self, windows: Windows) -> tuple[Windows, int | None]:
        """Return the windows of the clip and its number of frames; None for a clip that is run as a whole.

        Raises DeviceMemoryError where what is run together is predicted not to fit.
        """
        count, needs_all = None, self._recipe.needs_all_frames
        begun = unfinished_cut(self._out) if windows.window is None and not needs_all else None
        if begun is not None:
            windows = Windows(*begun)
            text = "holds an interrupted run in windows, which is resumed; --window 0 runs all frames together"
            self._report.note(f"{self._out} {text}")
        if windows.window:
            count = self._counted(windows)
        if self._recipe.unchecked:
            return windows, count
        with self._report.stage("check memory"):
            choice = choose_windows(
                self._model,
                self._source,
                self._recipe.sampling,
                self._fitter,
                window=None if count is None else windows.window,
                method=self._recipe.options.method,
                devices=self._recipe.devices,
            )
        if choice is None:
            return windows, count
        if windows.window is None and choice.is_cut and not needs_all:
            self._report.note(f"{choice.sentence}; --window 0 runs all together")
            return choice.windows, choice.frames
        if choice.cannot_fit:
            raise choice.refusal(cuts=not needs_all)
        if needs_all:
            verb = "needs" if len(needs_all) == 1 else "need"
            why = f"but {' and '.join(needs_all)} {verb} all frames at once: they are run together"
            self._report.note(f"{choice.sizes}, {why}")
        else:
            again = "if memory runs out, the clip is run once more, in smaller windows or at a smaller size"
            self._report.note(f"{choice.sizes}: that may not be enough; {again}")
        return windows, count

    def _counted(self, windows: Windows) -> int | None:
        """Return the number of frames of a clip that is cut; None for one that is no longer than a window."""
        with self._report.stage("count frames"):
            count = count_frames(self._source, self._recipe.sampling)
        if not windows.cuts(count):
            text = f"the clip has {count} frames, no more than a window of {windows.window}: all are run together"
            self._report.note(text)
            return None
        self._report.note(f"{count} frames in windows of {windows.window} that share at least {windows.shared}")
        return count

    def _run(self, windows: Windows, count: int | None) -> Reconstruction:
        if count is None:
            return self._together()
        recipe, given = self._recipe, self._given
        plan = LongRun(count, recipe.sampling, self._fitter, recipe.saving, given.tracks, self._report.stage)
        masks = False if given.no_masks else given.masks
        how: dict[str, Any] = {"options": recipe.options, "long_run": plan, "fusion": self._fusion, "masks": masks}
        return reconstruct_long(self._model, self._source, self._out, windows, **how)

    def _together(self) -> Reconstruction:
        """Reconstruct all frames at once, and write the result."""
        recipe, given, saving = self._recipe, self._given, self._recipe.saving
        with self._report.stage("load clip") as progress:
            clip = read_clip(self._source, recipe.sampling, self._fitter, progress)
            announce(self._out, forecast_bytes(clip.images.shape[:3], clip.source_size, saving))
            masks = False if given.no_masks else None if given.masks is None else load_masks(given.masks, clip)
            queries = None if given.tracks is None else parse_queries(given.tracks, clip)
        if all(look.is_blank for look in looks_of(clip.images, clip.valid_box)):
            self._report.note("all frames are of one colour: nothing can be seen in them, and the result says nothing")
        stated = focal_stated(clip)
        lens = "" if stated is None else f"; the camera states {stated.words}, {stated.pixels:.4g} pixels"
        self._report.note(_taken(clip, self._source.total(Sampling())) + lens)
        result = reconstruct(
            self._model,
            clip,
            options=recipe.options,
            size=self._fitter.size,
            masks=masks,
            tracks=queries,
            fusion=self._fusion,
            known=recipe.known,
            devices=recipe.devices,
            on_stage=self._report.stage,
        )
        if stated is not None and recipe.known.intrinsics is None and (words := disagreement(stated, result)):
            self._report.note(words)
        with self._report.stage("write") as progress:
            pictures = clip.pictures() if saving.resolution == "original" else None
            facts = RunFacts(self._report.seconds)
            result.save(self._out, saving=saving, pictures=pictures, progress=progress, facts=facts)
        discard(self._out)
        return result


def _taken(clip: Clip, available: int | None) -> str:
    """Say which frames were taken, and at which size."""
    count, height, width = clip.images.shape[:3]
    source_height, source_width = clip.source_size[0]
    frames = f"{count}" if available in (None, count) else f"{count} of {available}"
    lenses = clip.source.lenses_undone if isinstance(clip.source, CaptureFrames) else ""
    undone = f", undistorted ({lenses})" if lenses else ""
    text = f"{frames} frames of {source_width} x {source_height} pixels{undone}, fitted to {width} x {height}"
    if clip.sampling.max_frames == count and available is not None and clip.sampling.start + count < available:
        spread = -(-(available - clip.sampling.start) // count)
        if clip.sampling.step < spread and clip.sampling.fps is None:
            text += f"; --stride {spread} spreads them over the whole source"
    return text
