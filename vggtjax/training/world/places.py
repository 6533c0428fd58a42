"""Places where nothing moves yet: a room, a street, a landscape, with things at rest, light and sky."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vggtjax.training.world.assets import Assets, Shape
from vggtjax.training.world.casting import Light
from vggtjax.training.world.meshes import Mesh, Surface, boulder, box, picture, pillar, relief
from vggtjax.training.world.motion import turned
from vggtjax.training.world.stock import (
    SMALL,
    furniture,
    pick,
    standing,
    still_shapes,
    surface,
    tint,
    vehicles,
    walkers,
)
from vggtjax.training.world.tables import Top, cupboard, table

_LOW = 1.1  # metres: the largest height of a top that is looked down at

Spot = tuple[float, float, float]  # x, y, heading


class Place(NamedTuple):
    """A place and where in it things can be."""

    still: list[Mesh]
    height: Callable[[np.ndarray, np.ndarray], np.ndarray]  # of the ground at x, y
    spot: Callable[[np.random.Generator], Spot]  # for what stands
    lane: Callable[[np.random.Generator, bool], Spot]  # for what moves; True for vehicles
    reach: tuple[float, float]  # range of the distance from the camera to its subject, metres
    low: np.ndarray  # corners of where the camera may be, x and y
    high: np.ndarray
    ceiling: float  # largest height of the camera above the ground
    light: Light
    panorama: np.ndarray
    indoors: bool
    tops: tuple[Top, ...] = ()  # of tables and low cupboards

    def ground(self, x: float, y: float) -> float:
        """Return the height of the ground at a point."""
        return float(self.height(np.array(x), np.array(y)))


def make_place(generator: np.random.Generator, assets: Assets, kind: str, clutter: float) -> Place:
    """Return a random place of a kind; `clutter` scales the number of things in it."""
    return _PLACES[kind](generator, assets, clutter)


def _sun(generator: np.random.Generator) -> Light:
    azimuth, elevation = generator.uniform(0, 2 * np.pi), np.deg2rad(generator.uniform(15, 75))
    direction = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    ambient = generator.uniform(0.35, 0.95)  # from a clear day to an overcast one
    return Light(direction, False, ambient, 1 + 0.15 * np.array([1, 0.3, -0.7]) * generator.uniform(-0.5, 1))


def _scatter(
    generator: np.random.Generator, assets: Assets, place: Place, shapes: list[Shape], count: int
) -> list[Mesh]:
    """Return things at rest on the ground: given shapes, people and animals that stand, boxes and boulders."""
    made = []
    for _ in range(count):
        x, y, heading = place.spot(generator)
        z = place.ground(x, y)
        draw = generator.random()
        if draw < 0.62:
            shape = pick(generator, shapes or still_shapes(assets))
            made.append(standing(shape, x, y, z, heading, tint(generator, 0.12)))
        elif draw < 0.72 and walkers(assets):  # of the kinds that move in other clips
            shape = pick(generator, walkers(assets))
            pose = int(generator.integers(len(shape.vertices)))
            made.append(standing(shape, x, y, z, heading, tint(generator, 0.12), pose))
        else:
            size = np.exp(generator.uniform(np.log(0.15), np.log(1.0), 3))
            look = surface(generator, assets, "any", 0.5, 3)
            solid = box(size, look) if draw < 0.9 else boulder(generator, size, 0.25, look)
            made.append(solid.moved(turned(np.array([heading, 0, 0])), np.array([x, y, z])))
    return made


def _room(generator: np.random.Generator, assets: Assets, clutter: float) -> Place:
    half = np.exp(generator.uniform(np.log(1.6), np.log(5.5), 2))
    tall = generator.uniform(2.2, 3.6)
    (w, d), lamp = half, generator.uniform(-0.6, 0.6, 2) * half
    corners = np.array([[-w, -d], [w, -d], [w, d], [-w, d]])
    floor = surface(generator, assets, "floor", 0.4, 1.5)
    made = [relief(np.linspace(-w, w, 5), np.linspace(-d, d, 5), np.zeros((5, 5)), floor)]
    ceiling = surface(generator, assets, "ceiling", 0.3, 1.0)
    made.append(relief(np.linspace(-w, w, 3), np.linspace(-d, d, 3), np.full((3, 3), tall), ceiling))
    common = surface(generator, assets, "wall", 0.3, 1.5)
    for index in range(4):
        a, b = (np.append(corner, 0.0) for corner in (corners[index], corners[(index + 1) % 4]))
        look = common if generator.random() < 0.7 else surface(generator, assets, "wall", 0.3, 1.5)
        wall = picture(a, b - a, [0, 0, tall], look)
        scale = look.repeat * np.array([np.linalg.norm(b - a), tall])
        made.append(wall._replace(uv=(wall.uv * scale).astype(np.float32)))
        inward = np.array([-(b - a)[1], (b - a)[0], 0]) / np.linalg.norm(b - a)
        for _ in range(int(generator.integers(0, 4))):  # pictures, posters, windows
            share, rise = generator.uniform(0.05, 0.7), generator.uniform(0.1, 0.6) * tall
            size = generator.uniform(0.3, 1.6), generator.uniform(0.3, 1.2)
            size = min(size[0], (0.97 - share) * np.linalg.norm(b - a)), min(size[1], 0.97 * tall - rise)
            at = a + share * (b - a) + np.array([0, 0, rise]) + 0.02 * inward
            look = Surface(int(generator.choice(assets.materials["picture"])), gain=tint(generator, 0.1))
            made.append(picture(at, size[0] * (b - a) / np.linalg.norm(b - a), [0, 0, size[1]], look))

    def spot(draw: np.random.Generator) -> Spot:
        if draw.random() < 0.55:  # along a wall
            index, share = int(draw.integers(4)), draw.uniform(0.08, 0.92)
            a, b = corners[index], corners[(index + 1) % 4]
            x, y = (a + share * (b - a)) * (1 - 0.45 / half)
            return x, y, index * np.pi / 2 + np.pi  # its back to the wall
        x, y = draw.uniform(-0.8, 0.8, 2) * half
        return x, y, draw.uniform(0, 2 * np.pi)

    def lane(draw: np.random.Generator, _: bool) -> Spot:
        x, y = draw.uniform(-0.6, 0.6, 2) * half
        return x, y, draw.uniform(0, 2 * np.pi)

    tops = []
    for _ in range(round(clutter * generator.uniform(0, 1.5 + w * d / 5))):
        x, y, heading = lane(generator, False) if generator.random() < 0.6 else spot(generator)
        parts, top = table(generator, assets, [x, y, 0], heading)
        made, tops = made + parts, [*tops, top]
    for _ in range(round(clutter * generator.uniform(0, 4))):
        index, share = int(generator.integers(4)), generator.uniform(0.1, 0.9)
        a, b = corners[index], corners[(index + 1) % 4]
        x, y = (a + share * (b - a)) * (1 - 0.32 / half)
        parts, top = cupboard(generator, assets, [x, y, 0], index * np.pi / 2 + np.pi)
        made, tops = made + parts, [*tops, top] if top.middle[2] < _LOW else tops
    ambient, colour = generator.uniform(0.4, 0.85), 1 + generator.uniform(-0.1, 0.1, 3)
    light = Light(np.array([*lamp, 0.92 * tall]), True, ambient, colour)
    reach, inside = (0.8, float(1.4 * max(half))), 0.88 * half
    sky, eye = pick(generator, assets.panoramas), 0.85 * tall
    place = Place(made, lambda x, y: 0.0 * x, spot, lane, reach, -inside, inside, eye, light, sky, True, tuple(tops))
    count = round(clutter * generator.uniform(2, 3 + 3.5 * w * d / 4))
    made += _scatter(generator, assets, place, furniture(assets), count)
    return place


def _street(generator: np.random.Generator, assets: Assets, clutter: float) -> Place:
    length, road, pavement = generator.uniform(30, 60), generator.uniform(2.8, 6), generator.uniform(1.5, 5)
    edge = road + pavement
    bump, lean = generator.uniform(0, 0.25), generator.uniform(-0.04, 0.04)
    wave = generator.uniform(8, 25), generator.uniform(0, 6.3)

    def height(x, y):
        kerb = 0.14 / (1 + np.exp(-np.clip((np.abs(y) - road) / 0.05, -30, 30)))
        return kerb + lean * x + bump * np.sin(x / wave[0] * 6.3 + wave[1])

    xs = np.linspace(-length, length, 81)
    inner, outer = road * np.linspace(-1, 1, 5), np.array([road, road + 0.1, edge, edge + 8])
    side = surface(generator, assets, "pavement", 0.3, 1.2)
    made = [relief(xs, inner, height(*np.meshgrid(xs, inner)), surface(generator, assets, "road", 0.15, 0.6))]
    made += [relief(xs, ys, height(*np.meshgrid(xs, ys)), side) for ys in (-outer[::-1], outer)]
    if generator.random() < 0.5:  # the line in the middle
        line = surface(generator, assets, "ceiling", 0.5, 1)._replace(gain=(1.6, 1.6, 1.5))
        for x in np.arange(-length, length, 6.0):
            lifted = height(*np.meshgrid([x, x + 3], [0, 0])) + 0.012
            made.append(relief(np.array([x, x + 3]), np.array([-0.07, 0.07]), lifted, line))
    for sign in (-1, 1):
        x = -length + generator.uniform(0, 5)
        far = edge + (generator.uniform(3, 15) if generator.random() < 0.3 else generator.uniform(0, 1))
        while x < length:
            wide, tall, deep = generator.uniform(4, 16), generator.uniform(3.5, 18), generator.uniform(5, 10)
            if generator.random() < 0.85:
                made += _house(generator, assets, x, sign * (far + deep / 2), sign, (wide, deep, tall))
            x += wide + (0 if generator.random() < 0.6 else generator.uniform(0.5, 8))

    def spot(draw: np.random.Generator) -> Spot:
        x = draw.uniform(-0.6, 0.6) * length
        return x, draw.choice([-1, 1]) * draw.uniform(road + 0.3, edge), draw.uniform(0, 2 * np.pi)

    def lane(draw: np.random.Generator, driven: bool) -> Spot:
        x, forth = draw.uniform(-0.35, 0.35) * length, draw.random() < 0.5
        if driven:
            return x, (-0.5 if forth else 0.5) * road, 0.0 if forth else np.pi
        y = draw.choice([-1, 1]) * draw.uniform(0.6 * road, edge)
        across = draw.random() < 0.25
        return x, y, (draw.uniform(0, 2 * np.pi) if across else (0.0 if forth else np.pi))

    high, sky = np.array([0.6 * length, edge]), pick(generator, assets.panoramas)
    place = Place(made, height, spot, lane, (2.0, 18.0), -high, high, 3.5, _sun(generator), sky, False)
    poles = [s for s in still_shapes(assets) if SMALL < s.extent[2] < 10 and max(s.extent[:2]) < 2.5]
    things = poles + [s for s in furniture(assets) if s.extent[2] > 0.3]
    made += _scatter(generator, assets, place, things, round(clutter * generator.uniform(3, 18)))
    for sign in (-1, 1):  # parked where others drive
        for x in np.arange(-0.8 * length, 0.8 * length, 6.5):
            if vehicles(assets) and generator.random() < 0.35 * clutter:
                y, x = sign * (road - 1.1), x + generator.uniform(-0.8, 0.8)
                heading = (np.pi / 2 if sign > 0 else -np.pi / 2) + generator.uniform(-0.05, 0.05)
                shape = pick(generator, vehicles(assets))
                made.append(standing(shape, x, y, place.ground(x, y), heading, tint(generator)))
    for _ in range(int(clutter * generator.uniform(0, 9))):
        x, y, _heading = spot(generator)
        made += _tree(generator, assets, x, y, place.ground(x, y), generator.uniform(3, 8))
    return place


def _landscape(generator: np.random.Generator, assets: Assets, clutter: float) -> Place:
    size, relief_height = generator.uniform(40, 100), np.exp(generator.uniform(np.log(0.3), np.log(7)))
    waves = [
        (generator.standard_normal(2) * k * 2 * np.pi / size, generator.uniform(0, 6.3), relief_height / k**1.1)
        for k in (0.7, 1, 1.5, 2.5, 4, 6, 9, 14)
    ]

    def height(x, y):
        hills = sum(a * np.sin(k[0] * x + k[1] * y + p) for k, p, a in waves)
        away = np.hypot(x, y) / size
        return (
            0.35 * hills * np.minimum(0.15 + 2.5 * away, 1.5) + relief_height * 2.2 * np.maximum(away - 0.5, 0) ** 1.5
        )

    xs = np.sinh(np.linspace(-2.2, 2.2, 91)) / np.sinh(2.2) * size  # finer near the middle
    made = [relief(xs, xs, height(*np.meshgrid(xs, xs)), surface(generator, assets, "ground", 0.1, 0.7))]
    if generator.random() < 0.6:  # a path or a field of another ground
        a, b = np.sort(generator.uniform(-8, 8, 2))
        part, rows = xs[np.abs(xs) < 40], np.linspace(a, b + 1, 9)
        lifted = height(*np.meshgrid(part, rows)) + 0.02
        made.append(relief(part, rows, lifted, surface(generator, assets, "road", 0.15, 0.7)))

    def spot(draw: np.random.Generator) -> Spot:
        radius, angle = draw.uniform(0, 1) ** 0.8 * 0.4 * size, draw.uniform(0, 2 * np.pi)
        return radius * np.cos(angle), radius * np.sin(angle), draw.uniform(0, 2 * np.pi)

    def lane(draw: np.random.Generator, _: bool) -> Spot:
        x, y = draw.uniform(-5, 5, 2)
        return x, y, draw.uniform(0, 2 * np.pi)

    limit, sky = np.array([0.25, 0.25]) * size, pick(generator, assets.panoramas)
    place = Place(made, height, spot, lane, (1.5, 16.0), -limit, limit, 3.5, _sun(generator), sky, False)
    houses = [s for s in still_shapes(assets) if max(s.extent) > 4]
    made += _scatter(generator, assets, place, furniture(assets) + houses, round(clutter * generator.uniform(1, 10)))
    for _ in range(int(clutter * generator.uniform(2, 22))):
        x, y, heading = spot(generator)
        z = place.ground(x, y)
        if generator.random() < 0.6:
            made += _tree(generator, assets, x, y, z, generator.uniform(1.5, 10))
        else:
            extent = np.exp(generator.uniform(np.log(0.2), np.log(3.0))) * generator.uniform(0.6, 1.4, 3)
            rock = boulder(generator, extent, 0.3, surface(generator, assets, "rock", 0.3, 1.2))
            made.append(rock.moved(turned(np.array([heading, 0, 0])), np.array([x, y, z])))
    return place


def _house(generator: np.random.Generator, assets: Assets, x: float, y: float, sign: int, size) -> list[Mesh]:
    """Return a building from x on: a box whose front shows a facade, windows or a wall with pictures of windows."""
    wide, deep, tall = size
    wall = surface(generator, assets, "facade" if generator.random() < 0.4 else "wall", 0.1, 0.6)
    made = [box(size, wall).moved(np.eye(3), np.array([x + wide / 2, y, -0.5]))]
    front = y - sign * (deep / 2 + 0.03)
    across = np.array([-sign * 1.0, 0, 0])
    start = x if sign < 0 else x + wide
    storey, rows = generator.uniform(2.6, 3.6), generator.integers(1, 6)
    window = surface(generator, assets, "picture" if generator.random() < 0.5 else "any", 1, 1)
    width, height = generator.uniform(0.7, 1.8), generator.uniform(0.9, 2.0)
    step = width + generator.uniform(0.5, 2.5)
    for row in range(min(rows, int(tall / storey))):
        for column in range(int((wide - 0.6) / step)):
            at = np.array([start, front, row * storey + 0.9]) + across * (0.5 + column * step)
            look = window._replace(gain=tint(generator))
            made.append(picture(at, across * width, [0, 0, min(height, storey - 1)], look))
    return made


def _tree(generator: np.random.Generator, assets: Assets, x: float, y: float, z: float, tall: float) -> list[Mesh]:
    """Return a trunk and crowns."""
    at, leaves = np.array([x, y, z]), surface(generator, assets, "leaves", 0.4, 1.5)
    trunk = pillar(0.02 * tall + 0.05, 0.6 * tall, surface(generator, assets, "bark", 0.5, 2))
    made = [trunk.moved(np.eye(3), at)]
    for _ in range(int(generator.integers(1, 5))):
        size = tall * generator.uniform(0.25, 0.6) * generator.uniform(0.7, 1.3, 3)
        aside = np.append(0.15 * tall * generator.uniform(-1, 1, 2), tall * generator.uniform(0.5, 0.9))
        made.append(boulder(generator, size, 0.6, leaves).moved(np.eye(3), at + aside))
    return made


_PLACES = {"room": _room, "street": _street, "landscape": _landscape}
