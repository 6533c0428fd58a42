"""Furniture of simple parts: tables and cupboards with things on them, and chairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vggtjax.training.world.assets import Assets
from vggtjax.training.world.meshes import Mesh, Surface, boulder, box, picture, pillar
from vggtjax.training.world.motion import turned
from vggtjax.training.world.stock import pick, standing, still_shapes, surface, tint

_ON_TOP = 0.45  # metres: largest extent of a shape that stands on a table
_LEG = 0.05  # metres
_SEAT = 0.57  # metres: the highest seat


class Top(NamedTuple):
    """The top of a table in the world: its middle, its two half axes, metres."""

    middle: np.ndarray  # [3]
    along: np.ndarray  # [3], half of the length
    across: np.ndarray  # [3], half of the depth

    def point(self, generator: np.random.Generator) -> np.ndarray:
        """Return a random point of the top."""
        a, b = generator.uniform(-0.65, 0.65, 2)  # within a round one, too
        return self.middle + a * self.along + b * self.across

    def within(self, path: np.ndarray) -> np.ndarray:
        """Return a path [N, 3] held over the top."""
        axes = np.stack([self.along, self.across])
        shares = (path - self.middle) @ (axes / (axes**2).sum(axis=1, keepdims=True)).T
        return self.middle + np.clip(shares, -1, 1) @ axes


def table(generator: np.random.Generator, assets: Assets, at, heading: float) -> tuple[list[Mesh], Top]:
    """Return a table on legs, on a foot or round, the things on it and chairs at it."""
    long, deep = np.exp(generator.uniform(np.log(0.6), np.log(2.6))), generator.uniform(0.45, 1.2)
    tall, thick = generator.uniform(0.4, 0.95), generator.uniform(0.02, 0.08)
    look, dark = _plain(generator, assets), _plain(generator, assets)
    half, legs = np.array([long, deep]) / 2, tall - thick
    is_round, stands_on_legs = generator.random() < 0.2, generator.random() < 0.8
    if is_round:
        half = np.full(2, min(half))
        made = [_at(pillar(half[0], thick, look), [0, 0, legs]), pillar(0.06, legs, dark)]
    elif stands_on_legs:
        made = [_at(box([long, deep, thick], look), [0, 0, legs]), *_legs(half, legs, dark)]
    else:
        made = [box([long, deep, tall], look)]
    made += _things(generator, assets, half, tall, 0.65 if is_round else 0.85)
    for _ in range(int(generator.integers(0, 5)) if stands_on_legs and tall > _SEAT else 0):
        side, share = generator.choice([-1, 1]), generator.uniform(-0.8, 0.8)
        place = np.array([share * half[0], side * (half[1] + generator.uniform(-0.1, 0.35)), 0])
        turn = np.pi * (side < 0) + generator.normal(0, 0.25)
        made += [mesh.moved(turned(np.array([turn, 0, 0])), place) for mesh in _chair(generator, dark)]
    return _placed(made, at, heading, half, [0, 0, tall])


def cupboard(generator: np.random.Generator, assets: Assets, at, heading: float) -> tuple[list[Mesh], Top]:
    """Return a chest or cupboard whose back is at y = 0.3, with things on it."""
    long, deep = np.exp(generator.uniform(np.log(0.5), np.log(2.2))), generator.uniform(0.3, 0.6)
    tall = np.exp(generator.uniform(np.log(0.5), np.log(2.2)))
    half, look = np.array([long, deep]) / 2, _plain(generator, assets)
    made = [box([long, deep, tall], look)]
    columns = int(generator.integers(1, 4))
    for column in range(columns):  # doors
        wide = long / columns
        corner = [-half[0] + (column + 0.04) * wide, -half[1] - 0.015, 0.05]
        made.append(picture(corner, [0.92 * wide, 0, 0], [0, 0, tall - 0.1], look._replace(gain=tint(generator, 0.05))))
    made = [_at(mesh, [0, 0.3 - half[1], 0]) for mesh in made + _things(generator, assets, half, tall)]
    return _placed(made, at, heading, half, [0, 0.3 - half[1], tall])


def _placed(made: list[Mesh], at, heading: float, half, middle) -> tuple[list[Mesh], Top]:
    rotation = turned(np.array([heading, 0, 0]))
    top = Top(np.add(at, rotation @ middle), rotation @ [half[0], 0, 0], rotation @ [0, half[1], 0])
    return [mesh.moved(rotation, np.asarray(at)) for mesh in made], top


def _plain(generator: np.random.Generator, assets: Assets) -> Surface:
    """Return the surface of furniture, light or dark."""
    look = surface(generator, assets, pick(generator, ("floor", "ceiling", "wall")), 0.3, 1.5)
    shade = generator.uniform(0.25, 1.1)
    return look._replace(gain=tuple(shade * gain for gain in look.gain))


def _at(mesh: Mesh, offset) -> Mesh:
    return mesh.moved(np.eye(3), np.asarray(offset))


def _legs(half, tall: float, look: Surface) -> list[Mesh]:
    inner = np.asarray(half) - _LEG
    return [_at(box([_LEG, _LEG, tall], look), [x * inner[0], y * inner[1], 0]) for x in (-1, 1) for y in (-1, 1)]


def _chair(generator: np.random.Generator, look: Surface) -> list[Mesh]:
    """Return a chair at the origin whose back is at positive y."""
    wide, seat, back = generator.uniform(0.38, 0.5), generator.uniform(0.42, 0.5), generator.uniform(0.3, 0.6)
    made = [_at(box([wide, wide, 0.05], look), [0, 0, seat]), *_legs([wide / 2, wide / 2], seat, look)]
    return [*made, _at(box([wide, 0.04, back], look), [0, wide / 2, seat])]


def _things(generator: np.random.Generator, assets: Assets, half, tall: float, share: float = 0.85) -> list[Mesh]:
    """Return things on a top of half axes `half` at a height, with their middles in a share of it."""
    made, shapes = [], [shape for shape in still_shapes(assets) if max(shape.extent) < _ON_TOP]
    for _ in range(int(generator.integers(0, 12))):
        x, y = generator.uniform(-share, share, 2) * half
        heading, draw = generator.uniform(0, 2 * np.pi), generator.random()
        if draw < 0.25 and shapes:
            made.append(standing(pick(generator, shapes), x, y, tall, heading, tint(generator, 0.12)))
            continue
        look = surface(generator, assets, "any", 0.5, 4)
        if draw < 0.55:
            thing = [box(np.exp(generator.uniform(np.log(0.04), np.log(0.4), 3)), look)]
        elif draw < 0.7:
            size = np.exp(generator.uniform(np.log(0.05), np.log(0.3), 3))
            thing = [_at(boulder(generator, size, 0.15, look), [0, 0, 0.45 * size[2]])]
        elif draw < 0.9:  # paper, a tray, a cloth
            (w, d), show = generator.uniform(0.1, 0.5, 2), int(generator.choice(assets.materials["picture"]))
            thing = [picture([-w / 2, -d / 2, 0.004], [w, 0, 0], [0, d, 0], Surface(show, gain=tint(generator, 0.1)))]
        else:  # a screen or a picture frame
            w, h = generator.uniform(0.25, 0.8), generator.uniform(0.2, 0.5)
            show = Surface(int(generator.choice(assets.materials["picture"])), gain=tint(generator, 0.1))
            thing = [
                box([w, 0.04, h], _plain(generator, assets)),
                picture([-w / 2, -0.03, 0], [w, 0, 0], [0, 0, h], show),
            ]
        rotation = turned(np.array([heading, 0, 0]))
        made += [mesh.moved(rotation, np.array([x, y, tall])) for mesh in thing]
    return made
