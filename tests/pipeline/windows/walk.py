"""A long generated walk with exact truth, and a double of the network that gives the truth in a gauge of its own."""

import functools

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from tests.shared.generated import QUICK, textures
from tests.shared.walks import closed_walk
from vggtjax.cameras import Similarity, align
from vggtjax.clips.clip import Clip
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.truth import Truth
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.pipeline.windows.run import LongRun, Tools
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import Saving
from vggtjax.training.scenes import SceneConfig, render, sample_scene

FRAMES = 60
SETTINGS = {"seed": 0}  # that decide the windows
CONFIG = SceneConfig(height=32, width=48, frames=FRAMES, dynamic=1.0, static_camera=0.0, noise=0.0)


@functools.cache
def walk() -> Truth:
    """Return a walk around a small room, as numpy."""

    def make(key, textures):
        scene_key, noise_key = jax.random.split(key)
        return render(closed_walk(sample_scene(scene_key, textures.tiles, CONFIG)), noise_key, textures, CONFIG)

    clip = jax.jit(make, compiler_options=QUICK)(jax.random.key(2), textures())
    return Truth(*(np.asarray(getattr(clip, name)) for name in Truth._fields))


def movers(share: float = 0.4) -> np.ndarray:
    """Return made-up movers [S, H, W]: a column that crosses the picture and fills this share of it."""
    width = CONFIG.width
    wide = round(share * width)
    left = (7 * np.arange(FRAMES)[:, None, None]) % (width - wide)
    columns = np.arange(width)
    return np.broadcast_to((columns >= left) & (columns < left + wide), (FRAMES, CONFIG.height, width)).copy()


def window_result(clip: Clip, seed: int, moving: np.ndarray, off: float = 0.0) -> Reconstruction:
    """Return the truth of a window's frames, in a world of its own; the depth of movers is `off` by a share."""
    truth = walk()
    frames = np.array([int(name) for name in clip.frame_names])
    generator = np.random.default_rng([seed, *frames])
    scale = float(np.exp(generator.normal()))
    gauge = Similarity(scale, Rotation.random(rng=generator).as_matrix(), 3 * generator.normal(size=3))
    moving = moving[frames]
    wrong = 1 + off * generator.uniform(0.5, 1) * np.where(generator.random() < 0.5, -1, 1)
    depth = gauge.scale * truth.depth[frames] * np.where(moving, wrong, 1)
    return Reconstruction(
        depth=depth.astype(np.float32),
        depth_confidence=np.ones(depth.shape, np.float32),
        saliency=None,
        dynamic_mask=moving,
        camera_from_world=align(truth.camera_from_world[frames], gauge).astype(np.float32),
        intrinsics=truth.intrinsics[frames],
        images=np.round(255 * clip.images).astype(np.uint8),
        frame_names=tuple(clip.frame_names),
        timestamps=clip.timestamps,
        method="vggt",
        model_name="truth",
        settings={},
        source_size=clip.source_size,
        source_scale=clip.source_scale,
        source_offset=clip.source_offset,
        valid_box=clip.valid_box,
    )


def windows_of(*, loops: bool = False) -> Windows:
    """Return how the walk is cut."""
    return Windows(16, 4, no_loops=not loops)


def plan_of() -> LongRun:
    """Return how the walk is read and written."""
    fitter = Fitter(size=CONFIG.width, patch=8)
    return LongRun(fitter=fitter, saving=Saving(only=("cameras", "depth")))


def tools_of(run) -> Tools:
    """Return tools that run a window as given, and take small pictures for features: frames of one place look alike."""
    small = lambda images: images[:, ::4, ::4].reshape(len(images), -1)  # noqa: E731
    return Tools(run, small, lambda images: (small(images)[:, None], 1))
