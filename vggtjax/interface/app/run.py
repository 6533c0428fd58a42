"""A request in, files out; and the models for it. Knows nothing of browsers, and imports jax late."""

from __future__ import annotations

import logging
import re
import secrets
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vggtjax.errors import InputError, VggtjaxError, check_choice
from vggtjax.interface.app.limits import Limits
from vggtjax.interface.app.uploads import checked_clip
from vggtjax.progress import OnStage, Progress
from vggtjax.storage.cache import cache_folder

if TYPE_CHECKING:
    from vggtjax.network.checkpoint import Model

DEMO = "demo"


class Runner:
    """Runs jobs within `limits`. `names` are the models as users see them, the default first; one is in memory."""

    def __init__(self, models: Sequence[str], limits: Limits) -> None:
        """Take models as `load_model` takes them. Raises InputError for two of one name."""
        self.limits, self.names = limits, dict[str, str]()
        for name in dict.fromkeys((*models, DEMO)):
            shown = Path(name).name if Path(name).exists() else name  # of a file, without its folder
            if (other := self.names.setdefault(shown, name)) != name:
                raise InputError(f"two models are named {shown}: {other} and {name}; rename one of them")
        files = [Path(name) for name in self.names.values() if Path(name).exists()]
        own = {folder for file in files for folder in (file.parent, file.absolute().parent)} - {Path()}
        self.folders = [Path.home(), cache_folder(), *own]  # of this machine, which an error could name
        self._loaded: tuple[str, Model] | None = None

    def model(self, name: str, progress: Progress | None = None) -> Model:
        """Return a model by its shown name. Raises InputError for another name, CheckpointError for broken weights."""
        from vggtjax.pipeline.pretrained.load import load_model

        check_choice("model", name, tuple(self.names))
        if self._loaded is None or self._loaded[0] != name:
            self._loaded = None  # the memory of the last one is free before the next one is read
            self._loaded = name, load_model(self.names[name], progress=progress)
        return self._loaded[1]

    def run(
        self, files: Sequence[Path], model: str, method: str, frames: int, fps: float, results: Path, on_stage: OnStage
    ) -> tuple[str, list[Path], list[Path]]:
        """Reconstruct a clip, without files the embedded one; return what `write_outputs` says of it.

        The files are checked before the model is loaded. Raises VggtjaxError, and what `on_stage` raises.
        """
        frames = max(1, frames)
        with on_stage("check the clip"):
            checked = checked_clip(files, frames, fps, self.limits) if files else None
        with on_stage("load model") as progress:
            loaded = self.model(model, progress)
        from vggtjax.clips.clip import load_clip, read_clip
        from vggtjax.clips.preprocessing import Framing
        from vggtjax.interface.app.outputs import write_outputs
        from vggtjax.pipeline.pretrained.embedded import NOTE, demo_clip
        from vggtjax.pipeline.run import reconstruct

        with on_stage("load clip") as progress:
            if checked is not None:
                clip = read_clip(*checked, Framing().fitter(loaded.config), progress)
            else:  # at its own size for the embedded model
                images = demo_clip().images[:frames]
                clip = load_clip(images, model=loaded, size=images.shape[2] if loaded.note == NOTE else None)
        result = reconstruct(  # padded: clips of similar length share compiled programs
            loaded, clip, size=clip.size, pad_frames=True, on_stage=on_stage, method=method, consistent_depth=True
        )
        stem = re.sub(r"[^A-Za-z0-9._-]+", "-", files[0].stem if files else "demo-clip")[:60].strip(".-") or "clip"
        return write_outputs(result, results / secrets.token_urlsafe(16) / f"{stem}-{method}", on_stage)


def sentence(error: Exception, folders: Iterable[Path]) -> str:
    """Return what a user reads of an error: of our own its sentence, without `folders` and others of this machine."""
    if isinstance(error, VggtjaxError):
        known = "|".join(re.escape(folder) for folder in sorted(map(str, folders), key=len, reverse=True))
        return re.sub(rf"(?<![\w:/])(?:(?:{known})/(?:[^\s/]+/)*|/(?:[^\s/]+/)+)", "", str(error))
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "this machine has too little memory for the job; choose fewer frames"
    logging.getLogger(__name__).error("a job failed", exc_info=error)
    return "the program failed; the person who runs this app finds the reason in its log"
