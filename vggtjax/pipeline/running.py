"""How a reconstruction runs: what changes no number but for rounding."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from vggtjax.options import Options
from vggtjax.progress import OnStage, no_stage


@dataclass(frozen=True)
class Running:
    """How a clip is run. Results are the same to rounding.

    Attributes:
        devices: share the frames among so many devices, each with a copy of the weights. With several processes
            (`jax.distributed`) every one makes the same call and gets the whole result.
        pad_frames: pad the clip to one of a few lengths, so that clips of similar length share compiled programs. Not
            for clips with tracks.
        keep_passes: keep both passes on the result, as `.passes`.
        is_part: the caller makes a result of its own of this one, which keeps the dynamic mask that its steps used,
            also of a method that makes none, and does not name its source.
        on_stage: called with the name of each stage, returns a context in which the stage runs; None for none.
    """

    devices: int = 1
    pad_frames: bool = False
    keep_passes: bool = False
    is_part: bool = False
    on_stage: OnStage | None = None

    @property
    def stage(self) -> OnStage:
        """`on_stage`, or empty contexts."""
        return self.on_stage or no_stage


def changed(options: Options, running: Running, changes: dict[str, Any]) -> tuple[Options, Running]:
    """Return both with other values, by the names of their fields. Raises TypeError for an unknown name."""
    names = [field.name for field in dataclasses.fields(Running)]
    own = {name: value for name, value in changes.items() if name in names}
    others = {name: value for name, value in changes.items() if name not in names}
    expected = [*(field.name for field in dataclasses.fields(Options)), *names]
    if unknown := sorted(changes.keys() - set(expected)):
        raise TypeError(f"no option is named {' or '.join(unknown)}; expected some of {expected}")
    return options.changed(**others), dataclasses.replace(running, **own)
