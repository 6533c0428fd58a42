"""A generated static scene seen at the centres of patches: depths, cameras, and exact matches."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.shared import generated
from vggtjax.cameras import Cameras
from vggtjax.method.matching.matches import Matches, frame_pairs, patch_centres
from vggtjax.training.scenes import SceneConfig

PATCH, GRID = 8, (6, 6)


class StaticWorld:
    """Depths, cameras, and where every patch is in the other frames."""

    def __init__(self, frames=6):
        height, width = (side * PATCH for side in GRID)
        clip = generated.clips(SceneConfig(height=height, width=width, frames=frames, dynamic=0.0), 1)
        depth = np.asarray(clip.depth[0], np.float64)
        middle = slice(PATCH // 2 - 1, PATCH // 2 + 1)
        S, h, w = len(depth), *GRID
        cells = depth.reshape(S, h, PATCH, w, PATCH)[:, :, middle, :, middle]
        self.depth = cells.mean(axis=(2, 4)).reshape(S, -1)
        self.poses = np.asarray(clip.camera_from_world[0], np.float64)
        self.K = np.asarray(clip.intrinsics[0], np.float64) / PATCH
        self.K[:, 2, 2] = 1
        self.pairs = frame_pairs(S)
        pixels = np.concatenate([patch_centres(GRID), np.ones((h * w, 1))], axis=1)
        points = np.einsum("sij,pj->spi", np.linalg.inv(self.K), pixels) * self.depth[..., None]
        world = np.einsum("sji,spj->spi", self.poses[:, :, :3], points - self.poses[:, None, :, 3])
        other = self.poses[self.pairs.others]
        seen = np.einsum("smij,spj->smpi", other[..., :3], world) + other[:, :, None, :, 3]
        flat = np.einsum("smij,smpj->smpi", self.K[self.pairs.others], seen)
        self.matched = flat[..., :2] / flat[..., 2:]
        inside = ((self.matched > 0) & (self.matched < (w, h))).all(axis=-1) & (seen[..., 2] > 0.1)
        self.weight = (inside & self.pairs.exist[..., None]).astype(np.float32)

    def disturbed(self):
        """Return other depths, and cameras turned by some degrees and moved by some tenths of the median depth."""
        generator = np.random.default_rng(0)
        depth = self.depth * np.exp(generator.normal(0, 0.05, self.depth.shape))
        poses = self.poses.copy()
        poses[1:] = Rotation.from_rotvec(generator.normal(0, 0.02, (5, 3))).as_matrix() @ poses[1:]
        poses[1:, :, 3] += generator.normal(0, 0.02, (5, 3)) * np.median(depth)
        return depth.astype(np.float32), poses.astype(np.float32)

    def matches(self, moves: np.ndarray | None = None) -> Matches:
        """Return sure matches. Patches that move, [S, P], are seen elsewhere, about a patch further for each frame."""
        generator = np.random.default_rng(1)
        matched = self.matched
        if moves is not None:
            direction = generator.normal(size=(len(moves), 1, moves.shape[1], 2))
            steps = np.array(self.pairs.offsets)[None, :, None, None]
            matched = matched + np.where(moves[:, None, :, None], direction * steps, 0)
        return Matches(*(x.astype(np.float32) for x in (matched, self.weight, 0 * self.weight)))

    @property
    def cameras(self) -> Cameras:
        """The true cameras, with intrinsics in patches."""
        return Cameras(self.poses.astype(np.float32), self.K.astype(np.float32))
