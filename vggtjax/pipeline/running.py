"""How a reconstruction runs: what changes no number but for rounding; and the classes of its arguments."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from vggtjax.clips.queries import Queries
from vggtjax.errors import InputError, one_line
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.pipeline.known.options import KnownGeometry
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


_KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    "model": ((Model,), "what load_model returned: reconstruct(model, clip)"),
    "options": ((Options,), 'Options(method="vggt"), or its fields by name: method="vggt"'),
    "running": ((Running,), "Running(devices=2), or its fields by name: devices=2"),
    "tracks": ((Queries, type(None)), 'the points that parse_queries("grid:10", clip) returns'),
    "known": ((KnownGeometry, type(None)), 'KnownGeometry(baseline="0,2,1.5")'),
}


def check_kinds(**arguments: Any) -> None:
    """Raise InputError for an argument of another class than its own, such as a clip in the model's place."""
    for name, value in arguments.items():
        kinds, expected = _KINDS[name]
        if not isinstance(value, kinds):
            kind = value.__name__ if isinstance(value, type) else f"{type(value).__name__} {one_line(repr(value), 50)}"
            raise InputError(f"{name} is {kind}; expected {expected}")
