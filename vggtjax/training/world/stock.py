"""What is drawn of a folder of assets: shapes by kind, surfaces, and tints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from vggtjax.training.world.assets import Assets, Shape
from vggtjax.training.world.meshes import Mesh, Surface, of_shape
from vggtjax.training.world.motion import turned

T = TypeVar("T")

SMALL, _VEHICLE = 2.7, 13.0  # metres: largest extent of furniture, of vehicles
_FLAT = 3.6  # metres: largest height of vehicles


def walkers(assets: Assets) -> list[Shape]:
    """Return the shapes with a gait."""
    return [shape for shape in assets.shapes.values() if shape.rate]


def vehicles(assets: Assets) -> list[Shape]:
    """Return the shapes of the size of vehicles: longer than furniture, lower than houses, longer than high."""
    return [
        shape
        for shape in still_shapes(assets)
        if min(shape.extent) > 1.2 and SMALL < max(shape.extent) < _VEHICLE
        if shape.extent[2] < min(_FLAT, max(shape.extent) / 1.3)
    ]


def furniture(assets: Assets) -> list[Shape]:
    """Return the shapes that fit into a room."""
    return [s for s in still_shapes(assets) if max(s.extent) < SMALL]


def standing(shape: Shape, x: float, y: float, z: float, heading: float, gain, pose: int = 0) -> Mesh:
    """Return a shape at rest at a place."""
    return of_shape(shape, gain, pose).moved(turned(np.array([heading, 0, 0])), np.array([x, y, z]))


def tint(generator: np.random.Generator, spread: float = 0.25) -> tuple[float, float, float]:
    """Return random gains of the three channels."""
    gains = generator.uniform(0.75, 1.25) * (1 + generator.uniform(-spread, spread, 3))
    return float(gains[0]), float(gains[1]), float(gains[2])


def surface(generator: np.random.Generator, assets: Assets, row: str, low: float, high: float) -> Surface:
    """Return a material of a row of MATERIALS, or now and then any, repeated `low` to `high` times a metre."""
    row = "any" if generator.random() < 0.15 else row
    repeat = np.exp(generator.uniform(np.log(low), np.log(high)))
    turn = generator.choice([0.0, np.pi / 2, generator.uniform(0, 2 * np.pi)], p=[0.5, 0.3, 0.2])
    return Surface(int(generator.choice(assets.materials[row])), repeat, tint(generator), turn)


def still_shapes(assets: Assets) -> list[Shape]:
    """Return the shapes without a gait."""
    return [shape for shape in assets.shapes.values() if not shape.rate]


def pick(generator: np.random.Generator, items: Sequence[T]) -> T:
    """Return one of the items, each as likely as another."""
    return items[int(generator.integers(len(items)))]
