"""What moves in a place, and the camera that films it."""

from __future__ import annotations

from dataclasses import asdict
from typing import NamedTuple

import numpy as np

from vggtjax.training.world.assets import Assets
from vggtjax.training.world.config import Cameras, Movers, Places, WorldConfig
from vggtjax.training.world.meshes import Mesh, Surface, boulder, box, cutout, of_shape
from vggtjax.training.world.motion import STEPS, Actor, CameraPath, wander
from vggtjax.training.world.places import Place
from vggtjax.training.world.stock import furniture, pick, surface, tint, vehicles, walkers

_FACING = np.pi / 2  # shapes look along -y; a heading of 0 is along x
_GAIT = {"run": 3.2, "gallop": 5.5}  # metres a second; others walk
_WALK = 1.3
_HELD = 0.5  # metres: largest extent of what moves over a table
_AT_A_TABLE = (0.25, 2.2)  # metres, in the plane: range of the distance from the camera to the point that it films


class Filmed(NamedTuple):
    """The camera of a clip and its lens."""

    path: CameraPath
    half_angle: float  # of the field of view along the longer side, radians


def choose(generator: np.random.Generator, weights: Places | Cameras | Movers) -> str:
    """Return the name of a field, drawn by its weight."""
    shares = np.array(list(asdict(weights).values()))
    return str(generator.choice(list(asdict(weights)), p=shares / shares.sum()))


def draw_actors(
    generator: np.random.Generator, assets: Assets, place: Place, config: WorldConfig, seconds: float
) -> list[Actor]:
    """Return one to four things that move, which may enter and leave the picture."""
    count = 1 + int(generator.choice(4, p=[0.45, 0.3, 0.15, 0.1]))
    return [_actor(generator, assets, place, config, seconds) for _ in range(count)]


def draw_camera(
    generator: np.random.Generator, place: Place, actors: list[Actor], config: WorldConfig, seconds: float
) -> Filmed:
    """Return a hand-held camera that films one of the actors, or a point of the place."""
    kind = choose(generator, config.cameras)
    kind = "walk" if kind == "follow" and not actors else kind
    middle = STEPS // 2
    subject, reach = np.zeros((STEPS, 3)), place.reach
    if actors and (kind == "follow" or generator.random() < 0.8):
        actor = pick(generator, actors)
        subject, size = actor.place, float(np.ptp(actor.poses[0], axis=0).max())
        target = subject[middle] + [0, 0, generator.uniform(0.2, 0.8) * min(size, 1.6)]
        reach = min(reach[0], 0.3 + 2 * size), min(reach[1], 0.6 + 12 * size)
    elif place.tops and generator.random() < config.tabletop:
        target, reach = pick(generator, place.tops).point(generator), _AT_A_TABLE
    else:
        x, y, _ = place.spot(generator)
        target = np.array([x, y, place.ground(x, y) + generator.uniform(0.2, 1.6)])
    distance = np.exp(generator.uniform(*np.log(reach)))
    angle = generator.uniform(0, 2 * np.pi)
    start = np.clip(target[:2] + distance * np.array([np.cos(angle), np.sin(angle)]), place.low, place.high)
    eye = min(np.exp(generator.normal(np.log(1.45), 0.28)), place.ceiling)
    centre = np.array([*start, place.ground(*start) + eye])
    away = centre - target
    distance = max(float(np.linalg.norm(away)), 0.3)
    share = np.linspace(-0.5, 0.5, STEPS)[:, None]
    amount = config.motion * generator.uniform(0.1, 1.0)
    centres, targets = np.tile(centre, (STEPS, 1)), np.tile(target, (STEPS, 1))
    side = np.cross([0, 0, 1.0], away / distance)
    if kind == "walk":  # forward, backward or aside, at up to 2 metres a second and 0.7 of the distance
        length = min(0.7 * distance, 2.0 * seconds) * amount
        mix = generator.normal(size=2) * [1.0, 0.8]
        centres = centres + share * length * (mix[0] * -away / distance + mix[1] * side) * [1, 1, 0.15] / np.hypot(*mix)
        targets = targets + share * generator.uniform(0, 0.7) * (centres[-1] - centres[0])
    elif kind == "orbit":
        angles = share * np.deg2rad(70) * amount * generator.choice([-1, 1])
        zoom = 1 + share * generator.uniform(-0.4, 0.4) * amount
        centres = targets + _spun(np.tile(away, (STEPS, 1)), angles) * zoom
    elif kind == "follow":
        centres = centres + (subject - subject[middle]) * generator.uniform(0.6, 1.05)
        targets = targets + (subject - subject[middle]) * generator.uniform(0.8, 1.1)
    if kind == "turn" or (kind == "walk" and generator.random() < 0.3):
        sweep = share * np.deg2rad(85 if kind == "turn" else 40) * amount * generator.choice([-1, 1])
        targets = centres + _spun(targets - centres, sweep)
    hand = 0.15 if kind == "still" else generator.uniform(0.3, 1.6)
    sway = wander(generator, 0.012 * hand * config.shake, seconds, 0.3, 4.0, 3)
    bob = wander(generator, 0.012 * hand * config.shake, seconds, 1.4, 2.4, 1) * (kind in ("walk", "follow"))
    centres = centres + sway + bob * [0, 0, 1]
    targets = targets + wander(generator, 0.06 * distance * hand * amount, seconds, 0.1, 0.5, 3)
    shake = wander(generator, np.deg2rad(0.6) * hand * config.shake, seconds, 0.4, 5.0, 3)
    shake[:, 0] += np.deg2rad(generator.normal(0, 4))
    shake[:, 2] += np.deg2rad(generator.normal(0, 3 if generator.random() < 0.85 else 15))
    half_angle = np.deg2rad(generator.uniform(*config.field_of_view)) / 2
    return Filmed(CameraPath(seconds, centres, targets, shake), float(half_angle))


def _spun(vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return vectors [N, 3], each turned about z by its angle [N, 1]."""
    c, s = np.cos(angles[:, 0]), np.sin(angles[:, 0])
    x, y, z = vectors.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _actor(generator: np.random.Generator, assets: Assets, place: Place, config: WorldConfig, seconds: float) -> Actor:
    """Return a mover of a kind that is drawn; where the folder has none of it, one that it has."""
    kind = choose(generator, config.movers)
    kind = "thing" if (kind == "walker" and not walkers(assets)) else kind
    kind = "thing" if kind == "vehicle" and (place.indoors or not vehicles(assets)) else kind
    return _KINDS[kind](generator, assets, place, config, seconds)


def _walker(generator: np.random.Generator, assets: Assets, place: Place, _: WorldConfig, seconds: float) -> Actor:
    name, shape = pick(generator, [item for item in assets.shapes.items() if item[1].rate])
    pace = generator.uniform(0.7, 1.3)
    speed = pace * next((value for gait, value in _GAIT.items() if gait in name), _WALK)
    speed = 0.0 if generator.random() < 0.12 else speed  # on the spot
    mesh, size = of_shape(shape, tint(generator, 0.15)), generator.uniform(0.8, 1.15)
    ground = _on_ground(generator, place, seconds, speed, generator.normal(0, 0.5), driven=False)
    return _made(generator, mesh, shape.vertices * np.asarray(size, np.float32), shape.rate * pace, seconds, *ground)


def _vehicle(generator: np.random.Generator, assets: Assets, place: Place, _: WorldConfig, seconds: float) -> Actor:
    shape = pick(generator, vehicles(assets))
    speed = np.exp(generator.uniform(np.log(0.8), np.log(12)))
    ground = _on_ground(generator, place, seconds, speed, generator.normal(0, 0.08), driven=True)
    return _made(generator, of_shape(shape, tint(generator)), shape.vertices, 0.0, seconds, *ground)


def _thing(generator: np.random.Generator, assets: Assets, place: Place, config: WorldConfig, seconds: float) -> Actor:
    """Return a rigid thing that slides, hops, hovers or tumbles, on the ground or, small and slow, over a table."""
    draw, shapes, top = generator.random(), furniture(assets), None
    if place.tops and generator.random() < config.tabletop:
        top = pick(generator, place.tops)
        shapes = [shape for shape in shapes if max(shape.extent) < _HELD]
    if draw < 0.5 and shapes:
        mesh = of_shape(pick(generator, shapes), tint(generator))
    else:
        low, high = (0.05, _HELD) if top else (0.15, 1.2)
        size = np.exp(generator.uniform(np.log(low), np.log(high), 3))
        look = surface(generator, assets, "any", 0.5, 3)
        mesh = box(size, look) if draw < 0.75 else boulder(generator, size, 0.2, look)
    speed = np.exp(generator.uniform(np.log(0.05), np.log(0.6 if top else 3)))
    path, turn = _on_ground(generator, place, seconds, speed, generator.normal(0, 1.0), driven=False)
    if top:
        path = top.within(path - path[STEPS // 2] + top.point(generator))
    if generator.random() < 0.6:
        hop = np.abs(wander(generator, generator.uniform(0.05, 0.6), seconds, 0.3, 1.2, 1))
        path = path + (generator.uniform(0.2, 1.2) + hop) * [0, 0, 0.3 if top else 1]
        turn = turn + wander(generator, generator.uniform(0.1, 1.5), seconds, 0.1, 0.8, 3)
    return _made(generator, mesh, mesh.vertices[None], 0.0, seconds, path, turn)


def _cutout(generator: np.random.Generator, assets: Assets, place: Place, _: WorldConfig, seconds: float) -> Actor:
    """Return an upright piece of a photograph that slides and turns a little."""
    look = Surface(int(generator.choice(assets.materials["picture"])), gain=tint(generator, 0.1))
    width, height = generator.uniform(0.4, 2.0, 2)
    mesh = cutout(generator, width, height, look)
    speed = np.exp(generator.uniform(np.log(0.1), np.log(3)))
    path = _on_ground(generator, place, seconds, speed, 0.0, driven=False)[0]
    path = path + np.array([0, 0, generator.uniform(0, 0.8)]) + wander(generator, 0.1, seconds, 0.3, 1.5, 3)
    turn = [generator.uniform(0, 2 * np.pi), 0, 0] + wander(generator, 0.1, seconds, 0.2, 0.8, 3) * [1, 0.05, 0.05]
    return _made(generator, mesh, mesh.vertices[None], 0.0, seconds, path, turn)


_KINDS = {"walker": _walker, "vehicle": _vehicle, "thing": _thing, "cutout": _cutout}


def _made(generator, mesh: Mesh, poses: np.ndarray, rate: float, seconds: float, path, turn) -> Actor:
    return Actor(mesh, np.asarray(poses, np.float32), rate, generator.uniform(0, len(poses)), seconds, path, turn)


def _on_ground(
    generator: np.random.Generator, place: Place, seconds: float, speed: float, bend: float, *, driven: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return places [N, 3] and turns [N, 3] of a way over the ground that passes a lane near the middle of the clip.

    `bend` is how much the heading turns, in radians a second.
    """
    x, y, heading = place.lane(generator, driven)
    times = np.linspace(0, seconds, STEPS) - seconds * generator.uniform(0.2, 0.8)
    headings = heading + bend * times
    step = np.gradient(times)[:, None] * speed * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    way = np.cumsum(step, axis=0)
    way = np.array([x, y]) + way - way[np.abs(times).argmin()]
    if place.indoors:
        way = np.clip(way, place.low, place.high)
    ground = place.height(way[:, 0], way[:, 1])
    turn = np.stack([headings + _FACING, 0 * headings, 0 * headings], axis=-1)
    return np.concatenate([way, ground[:, None]], axis=-1), turn
