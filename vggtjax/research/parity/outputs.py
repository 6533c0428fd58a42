"""What both sides give, by which names, and how far apart they may be. Does not import jax or torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vggtjax.errors import InputError

TOLERANCE = 1e-4  # float32, of an array's standard deviation; measured: 1e-6 (poses) to 3e-5 (points)
MASKED = "masked: "  # before the outputs of the pass in which the keys of dynamic tokens are suppressed
CAMERAS = "cameras"  # camera_from_world, decoded from the pose encoding

Arrays = dict[str, np.ndarray]


class Output(NamedTuple):
    """A field of `Predictions`: its name in the public code, and a tolerance in its own unit, None: of its spread."""

    public: str
    most: float | None = None


OUTPUTS = {
    "pose_encoding": Output("pose_enc"),
    "depth": Output("depth"),
    "depth_confidence": Output("depth_conf"),
    "world_points": Output("world_points"),
    "world_points_confidence": Output("world_points_conf"),
    "tracks": Output("track", 2e-3),  # pixels
    "track_visibility": Output("vis", 2e-4),
    "track_confidence": Output("conf", 2e-4),
}


class Parity(NamedTuple):
    """How far an output of ours is from the public code's."""

    name: str
    spreads: float  # largest difference in standard deviations of the public code's array
    largest: float  # largest absolute difference
    tolerance: str
    holds: bool


def parities(own: Arrays, public: Arrays, tolerance: float = TOLERANCE) -> list[Parity]:
    """Compare every array of the public code with ours. Raises InputError for other names or shapes."""
    if own.keys() != public.keys():
        lacking = sorted(own.keys() ^ public.keys())
        raise InputError(f"the public code and this library differ in their outputs: {', '.join(lacking)}")
    return [_parity(name, own[name], array, tolerance) for name, array in public.items()]


def _parity(name: str, own: np.ndarray, public: np.ndarray, tolerance: float) -> Parity:
    if own.shape != public.shape:
        raise InputError(f"the public code gives {name} of shape {public.shape}; expected {own.shape}, as ours")
    largest, spread = (float(value) for value in (np.abs(own - public).max(), public.std()))
    spreads = largest / spread if spread else np.inf * largest if largest else 0.0
    output = OUTPUTS.get(name.removeprefix(MASKED))
    most = output.most if output else None
    holds = spreads <= tolerance if most is None else largest <= most  # False for NaN
    return Parity(name, spreads, largest, f"{tolerance:.0e} std" if most is None else f"{most:.0e} absolute", holds)
