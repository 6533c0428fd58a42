"""A clip of a generated world: its pictures and their truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vggtjax.training.world.assets import Assets
from vggtjax.training.world.casting import FARTHEST, Moment, Stage, World, prepare
from vggtjax.training.world.config import WorldConfig
from vggtjax.training.world.meshes import join
from vggtjax.training.world.places import make_place
from vggtjax.training.world.sampling import Filmed, choose, draw_actors, draw_camera
from vggtjax.training.world.sensor import expose

_SAMPLES = 2  # rays of a pixel along each side
_PLACES, _CAMERAS = 8, 8  # most places that are made for a clip, and cameras that are tried in each
_LOOKS = 12  # frames that are looked at before a clip is filmed
_NEAREST, _CLOSEST = 0.25, 0.12  # metres: least median depth of a frame and least depth of its nearest twentieth
_MOST_MOVING, _MOST_SKY = 0.6, 0.6  # shares of the pixels
_LEAST_MOVING, _SPREAD = 0.01, 1.7  # of the pixels in some frame; of the 90th to the 10th percentile of depth there
_OPEN = 0.6  # largest share of a frame's time in which the shutter is open
_READ = 0.03  # largest seconds between the first and the last row of a rolling shutter
_MOST_ROLL = 2.0  # pixels by which the camera may turn meanwhile
GENERATOR = 5  # raised with every change that gives a seed another clip


class WorldClip(NamedTuple):
    """A clip and its truth. OpenCV cameras, metres; the world's z is up. Depth is 0 in the sky.

    Truth is that of a frame's time: the middle of its exposure, and the middle row of a rolling shutter.
    """

    images: UInt8[np.ndarray, "S H W 3"]
    depth: Float[np.ndarray, "S H W"]
    object_ids: UInt8[np.ndarray, "S H W"]  # 0 stands still, 255 is sky; what moves has its number from 1
    scene_flow: Float[np.ndarray, "S H W 3"]  # world axes: the pixel's point a frame later, minus the point
    tracks: Float[np.ndarray, "S P S 3"]  # of the points at each frame's patch centres: where they are at every frame
    camera_from_world: Float[np.ndarray, "S 3 4"]
    intrinsics: Float[np.ndarray, "3 3"]

    @property
    def dynamic_mask(self) -> Bool[np.ndarray, "S H W"]:
        """Pixels of what moves."""
        return (self.object_ids > 0) & (self.object_ids < 255)


def world_clip(
    assets: Assets, config: WorldConfig, seed: tuple[int, ...], *, frames: int, height: int, width: int, patch: int = 0
) -> WorldClip:
    """Return the clip of a seed; its tracks are those of patches of `patch` pixels, and empty for 0.

    Worlds are drawn until one can be filmed: nothing stands before the lens, and movers and sky leave something to see.
    """
    generator = np.random.default_rng(seed)
    seconds = float(np.exp(generator.uniform(*np.log(config.seconds))))
    times = np.linspace(0, seconds, frames)
    moving = generator.random() < config.dynamic
    stage = lens = None
    for _ in range(_PLACES):
        place = make_place(generator, assets, choose(generator, config.places), config.clutter)
        still, sky_turn = prepare(join(place.still)), generator.uniform(0, 2 * np.pi)
        for _ in range(_CAMERAS):
            actors = draw_actors(generator, assets, place, config, seconds) if moving else []
            stage = Stage(World(still, tuple(actors), place.light, place.panorama, sky_turn), assets.tiles)
            lens = _Lens(draw_camera(generator, place, actors, config, seconds), height, width)
            if _is_good(stage, lens, times[:: -(-frames // _LOOKS)], moving=moving):
                return _film(generator, stage, lens, config, times, patch)
    assert stage is not None
    assert lens is not None
    return _film(generator, stage, lens, config, times, patch)  # the last one, however poor


class _Lens:
    """The rays of a camera through its pixels."""

    def __init__(self, filmed: Filmed, height: int, width: int) -> None:
        self.path, self.height, self.width = filmed.path, height, width
        longer = max(height, width)
        self.focal = longer / 2 / np.tan(filmed.half_angle)
        y, x = np.mgrid[0:height, 0:width]
        self.corners = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1]])

    def rays(self, time: float, offset=(0.5, 0.5), every: int = 1, read: float = 0.0):
        """Return origins and directions [P, 3] of unit depth; rows are read over `read` seconds around the time."""
        corners = self.corners.reshape(self.height, self.width, 2)[::every, ::every]
        x = (corners[..., 0] + offset[0] - self.width / 2) / self.focal
        y = (corners[..., 1] + offset[1] - self.height / 2) / self.focal
        local = np.stack([x, y, np.ones_like(x)], axis=-1)
        if read:
            first, last = (self.path.pose(time + sign * read / 2) for sign in (-1, 1))
            share = np.linspace(0, 1, len(local))[:, None, None]
            direction = (1 - share) * (local @ first[0].T) + share * (local @ last[0].T)
            origin = np.broadcast_to((1 - share) * first[1] + share * last[1], direction.shape)
        else:
            rotation, centre = self.path.pose(time)
            direction = local @ rotation.T
            origin = np.broadcast_to(centre, direction.shape)
        return origin.reshape(-1, 3).astype(np.float32), direction.reshape(-1, 3).astype(np.float32)

    def roll(self, time: float, read: float) -> float:
        """Return by how many pixels in the middle of the picture the camera turns in `read` seconds around a time."""
        first, last = (self.path.pose(time + sign * read / 2)[0] for sign in (-1, 1))
        return self.focal * float(np.linalg.norm(first[:, 2] - last[:, 2]))

    def camera_from_world(self, time: float) -> Float[np.ndarray, "3 4"]:
        rotation, centre = self.path.pose(time)
        return np.concatenate([rotation.T, -(rotation.T @ centre)[:, None]], axis=-1)


def _is_good(stage: Stage, lens: _Lens, times, *, moving: bool) -> bool:
    """Return whether a clip is worth filming, by a few rays at some of its frames."""
    seen, spread = 0.0, 1.0
    for time in times:
        hits = Moment(stage, time).cast(*lens.rays(time, every=4))
        known = np.minimum(hits.distance, FARTHEST)
        if np.median(known) < _NEAREST or np.percentile(known, 5) < _CLOSEST:
            return False
        if (hits.actor > 0).mean() > _MOST_MOVING or (hits.distance >= FARTHEST).mean() > _MOST_SKY:
            return False
        seen = max(seen, float((hits.actor > 0).mean()))
        spread = max(spread, float(np.percentile(known, 90) / np.percentile(known, 10)))
    return spread > _SPREAD and (not moving or seen > _LEAST_MOVING)


def _film(generator, stage: Stage, lens: _Lens, config: WorldConfig, times: np.ndarray, patch: int) -> WorldClip:
    S, (H, W) = len(times), (lens.height, lens.width)
    step = float(times[1] - times[0]) if S > 1 else 1.0 / 30
    opened = min(generator.uniform(0.2, _OPEN) * step, 0.05) if generator.random() < config.blur else 0.0
    read = generator.uniform(0, min(_READ, step)) if generator.random() < config.rolling else 0.0
    read *= min(1, _MOST_ROLL / max(max(lens.roll(time, read) for time in times), 1e-9))
    moments = [Moment(stage, time) for time in times]
    after = [*moments[1:], Moment(stage, float(times[-1]) + step)]
    offsets = [((i + 0.5) / _SAMPLES, (j + 0.5) / _SAMPLES) for i in range(_SAMPLES) for j in range(_SAMPLES)]
    delays = generator.permutation((np.arange(len(offsets)) + 0.5) / len(offsets) - 0.5)
    centres = np.zeros((H, W), bool)
    if patch:
        centres[patch // 2 :: patch, patch // 2 :: patch] = True
    light, depth, ids, flow, tracks = [], [], [], [], []
    for index, time in enumerate(times):
        colour = np.zeros((H * W, 3), np.float32)
        for sample, offset in enumerate(offsets):
            delay = opened * delays[sample]
            moment = Moment(stage, time + delay) if opened and stage.world.actors else moments[index]
            rays = lens.rays(time + delay, offset, read=read)
            colour += moment.colours(moment.cast(*rays), *rays, 1 / lens.focal / _SAMPLES)
        light.append(colour.reshape(H, W, 3) / len(offsets))
        origin, direction = lens.rays(time)
        hits = moments[index].cast(origin, direction)
        known = hits.distance < FARTHEST
        point = origin + np.where(known, hits.distance, 0)[:, None].astype(np.float32) * direction
        depth.append(np.where(known, hits.distance, 0).reshape(H, W))
        ids.append(np.where(known, np.minimum(hits.actor, 254), 255).reshape(H, W))
        flow.append((stage.followed(point, hits, [after[index]])[0] - point).reshape(H, W, 3))
        chosen = centres.ravel()
        few = hits._replace(actor=hits.actor[chosen], face=hits.face[chosen], corners=hits.corners[chosen])
        tracks.append(stage.followed(point[chosen], few, moments).swapaxes(0, 1))
    return WorldClip(
        expose(generator, np.stack(light), config, float(times[-1])),
        np.stack(depth).astype(np.float32),
        np.stack(ids).astype(np.uint8),
        np.stack(flow).astype(np.float32),
        np.stack(tracks).astype(np.float32),
        np.stack([lens.camera_from_world(time) for time in times]).astype(np.float32),
        lens.intrinsics.astype(np.float32),
    )
