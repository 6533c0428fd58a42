"""The models that the app offers: those named at its start, one of them in memory. Imports jax late."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vggtjax.errors import InputError, check_choice
from vggtjax.progress import OnStage, Progress

if TYPE_CHECKING:
    from vggtjax.checkpoint import Model

DEMO = "demo"


class Models:
    """Models by the names that users see: "demo", a hub id, or a file's name without its folder."""

    def __init__(self, given: Sequence[str]) -> None:
        """Take what `load_model` takes. Raises InputError for two models of one name."""
        self._given: dict[str, str] = {}
        for name in dict.fromkeys((*given, DEMO)):
            shown = Path(name).name if Path(name).exists() else name
            if shown in self._given:
                raise InputError(f"two models are named {shown}: {self._given[shown]} and {name}; rename one of them")
            self._given[shown] = name
        self._loaded: tuple[str, Model] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names to choose from; the first is the default, the embedded model is always the last or the only one."""
        return tuple(self._given)

    def check(self, on_stage: OnStage) -> None:
        """Load every model once, the default last: broken weights and downloads are met before the first job."""
        for name in reversed(self.names):
            with on_stage(f"load {name}") as progress:
                self.get(name, progress)

    def get(self, name: str, progress: Progress | None = None) -> Model:
        """Return a model by its shown name. Raises InputError for another name, CheckpointError for broken weights."""
        from vggtjax.pretrained.load import load_model

        check_choice("model", name, self.names)
        if self._loaded is None or self._loaded[0] != name:
            self._loaded = None  # the memory of the last one is free before the next one is read
            self._loaded = name, load_model(self._given[name], progress=progress)
        return self._loaded[1]
