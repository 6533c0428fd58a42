"""How `vggtjax reconstruct` runs a clip: together or in windows, and once more in a smaller way without memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vggtjax.checkpoint import Model
from vggtjax.clips.clip import Clip, read_clip
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.queries import parse_queries
from vggtjax.commands.clip_options import GivenInputs
from vggtjax.commands.report import Report
from vggtjax.errors import DeviceMemoryError, one_line
from vggtjax.known.options import KnownGeometry
from vggtjax.media.sampling import Sampling, Source
from vggtjax.method.fusion_family import FusionParams
from vggtjax.options import Options
from vggtjax.pipeline.run import reconstruct
from vggtjax.reconstruction import Reconstruction
from vggtjax.results.disk import announce, forecast_bytes
from vggtjax.results.report import RunFacts
from vggtjax.results.saving import Saving
from vggtjax.windows.choice import Choice, choose_windows, smaller_size, smaller_window
from vggtjax.windows.frames import count_frames
from vggtjax.windows.plan import Windows
from vggtjax.windows.run import LongRun, reconstruct_long
from vggtjax.windows.store import discard, unfinished_cut

_TOGETHER = Windows(0)


@dataclass(frozen=True, kw_only=True)
class OneClip:
    """A clip, and how it is read, run and written."""

    report: Report
    frames: str | Sequence[str]  # as the user named them
    source: Source
    sampling: Sampling
    fitter: Fitter
    model: Model
    fusion: FusionParams | None
    options: Options
    devices: int
    known: GivenInputs
    geometry: KnownGeometry
    out: Path
    saving: Saving

    def run(self, windows: Windows, *, unchecked: bool = False) -> Reconstruction:
        """Reconstruct the clip and write the result; where the memory runs out, once more in a smaller way.

        Args:
            windows: how the clip is cut; without a window that is chosen by the memory that is free.
            unchecked: do not compare the needed memory with what is free.

        Raises DeviceMemoryError where the clip is predicted not to fit, or does not fit in the smaller way either.
        """
        windows, count = self.cut(windows, unchecked=unchecked)
        try:
            return self._run(windows, count)
        except MemoryError as error:  # of the host or of the device
            reason = one_line(str(error)) or "out of memory"
        # Outside of the handler: the error holds the arrays that did not fit.
        smaller = None if self._at_once else smaller_window(count_frames(self.source, self.sampling))
        if count is not None:
            smaller = smaller_window(windows.window or 0)
        if smaller is not None:
            self.report.note(f"{reason}; running once more, in windows of {smaller.window} frames")
            return self._run(smaller, count_frames(self.source, self.sampling))
        fitter = smaller_size(self.fitter)
        if fitter is None or count is not None:
            raise DeviceMemoryError(reason)
        self.report.note(f"{reason}; running once more, at --size {fitter.size}")
        return dataclasses.replace(self, fitter=fitter)._run(windows, None)

    def cut(self, windows: Windows, *, unchecked: bool = False) -> tuple[Windows, int | None]:
        """Return the windows of the clip and its number of frames; None for a clip that is run as a whole.

        Raises DeviceMemoryError where what is run together is predicted not to fit.
        """
        count = None
        begun = unfinished_cut(self.out) if windows.window is None and not self._at_once else None
        if begun is not None:
            windows = Windows(*begun)
            text = "holds a run in windows that was stopped: it goes on; --window 0 runs all frames together"
            self.report.note(f"{self.out} {text}")
        if windows.window:
            count = self._counted(windows)
        if unchecked:
            return windows, count
        with self.report.stage("check memory"):
            choice = choose_windows(
                self.model,
                self.source,
                self.sampling,
                self.fitter,
                window=None if count is None else windows.window,
                method=self.options.method,
                devices=self.devices,
            )
        if choice is None:
            return windows, count
        if windows.window is None and choice.is_cut and not self._at_once:
            self.report.note(f"{choice.sentence}; --window 0 runs all together")
            return choice.windows, choice.frames
        self._check(choice)
        return windows, count

    @property
    def _at_once(self) -> list[str]:
        """The options that need all frames together."""
        needs = {
            "--devices": self.devices > 1,
            "known cameras or lengths": self.geometry,
            "--refine-cameras": self.options.refine_cameras,
        }
        return [name for name, given in needs.items() if given]

    def _check(self, choice: Choice) -> None:
        """Raise DeviceMemoryError for a clip that cannot fit; say so for one that may not."""
        if choice.cannot_fit:
            raise choice.refusal(cuts=not self._at_once)
        if self._at_once:
            verb = "needs" if len(self._at_once) == 1 else "need"
            why = f"but {' and '.join(self._at_once)} {verb} all frames at once: they are run together"
            self.report.note(f"{choice.sizes}, {why}")
        else:
            self.report.note(f"{choice.sizes}: that may not be enough")

    def _counted(self, windows: Windows) -> int | None:
        """Return the number of frames of a clip that is cut; None for one that is no longer than a window."""
        with self.report.stage("count frames"):
            count = count_frames(self.source, self.sampling)
        if not windows.cuts(count):
            text = f"the clip has {count} frames, no more than a window of {windows.window}: all are run together"
            self.report.note(text)
            return None
        self.report.note(f"{count} frames in windows of {windows.window} that share at least {windows.shared}")
        return count

    def _run(self, windows: Windows, count: int | None) -> Reconstruction:
        if count is None:
            return self._together()
        plan = LongRun(windows, count, self.sampling, self.fitter, self.saving, tracks=self.known.tracks)
        plan = plan._replace(on_stage=self.report.stage)
        return reconstruct_long(
            self.model,
            self.frames,
            self.out,
            windows,
            options=self.options,
            long_run=plan,
            fusion=self.fusion,
            masks=False if self.known.no_masks else self.known.masks,
        )

    def _together(self) -> Reconstruction:
        """Reconstruct all frames at once, and write the result."""
        with self.report.stage("load clip") as progress:
            clip = read_clip(self.source, self.sampling, self.fitter, progress)
            announce(self.out, forecast_bytes(clip.images.shape[:3], clip.source_size, self.saving))
            masks = self.known.masks_of(clip)
            queries = None if self.known.tracks is None else parse_queries(self.known.tracks, clip)
        self.report.note(_taken(clip, self.source.total(Sampling())))
        result = reconstruct(
            self.model,
            clip,
            options=self.options,
            size=self.fitter.size,
            masks=masks,
            tracks=queries,
            fusion=self.fusion,
            known=self.geometry,
            devices=self.devices,
            on_stage=self.report.stage,
        )
        with self.report.stage("write") as progress:
            pictures = clip.pictures() if self.saving.resolution == "original" else None
            facts = RunFacts(self.report.seconds)
            result.save(self.out, saving=self.saving, pictures=pictures, progress=progress, facts=facts)
        discard(self.out)
        return result


def _taken(clip: Clip, available: int | None) -> str:
    """Say which frames were taken, and at which size."""
    count, height, width = clip.images.shape[:3]
    source_height, source_width = clip.source_size[0]
    frames = f"{count}" if available in (None, count) else f"{count} of {available}"
    text = f"{frames} frames of {source_width} x {source_height} pixels, fitted to {width} x {height}"
    if clip.sampling.max_frames == count and available is not None and clip.sampling.start + count < available:
        spread = -(-(available - clip.sampling.start) // count)
        if clip.sampling.step < spread and clip.sampling.fps is None:
            text += f"; --stride {spread} spreads them over the whole source"
    return text
