"""Arguments of a reconstruction that have a class of their own."""

from __future__ import annotations

from typing import Any

from vggtjax.clips.queries import Queries
from vggtjax.errors import InputError, one_line
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.running import Running

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
