"""Halves of generated walks joined by `extend`, beside one run over all frames and two runs joined by their cameras."""

from __future__ import annotations

import logging
import sys

import numpy as np
from jaxtyping import Float

from benchmarks.held_out import held_out_truth
from vggtjax.cameras import align, checked_centres, umeyama_sim3
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.pipeline.run import reconstruct
from vggtjax.pipeline.windows.extend import extend as extended
from vggtjax.pipeline.windows.overlap import Places
from vggtjax.pipeline.windows.plan import Extending
from vggtjax.pipeline.windows.run import tools_of
from vggtjax.storage.markdown import markdown_table
from vggtjax.training.scenes import SceneConfig

_SHARED = 4  # frames that the two runs share, whose cameras join them


def extend(*, model: str = "demo", clips: int = 16, frames: int = 24, side: int = 96, seed: int = 0) -> None:
    """Print path errors of three ways to reconstruct a walk, and whether frames of another scene are refused.

    The error is the root mean square distance of the camera centres from the truth after Sim(3), in median depths.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        clips: held-out generated scenes with movers, at least 2.
        frames: of a walk, an even number.
        side: of the frames, in pixels.
        seed: of the scenes.
    """
    if clips < 2 or frames % 2 or frames < 12:
        raise InputError(f"clips is {clips} and frames is {frames}; expected at least 2, and an even number from 12 on")
    logging.disable(logging.WARNING)
    network, half = load_model(model), frames // 2
    scenes = held_out_truth("dynamic", clips, SceneConfig(height=side, width=side, frames=frames), seed=seed)
    images, options, errors, refused = in_bytes(scenes.images), Options(), [], 0
    patches = tools_of(network).patches
    own, others = [], []  # the largest overlap of a frame of the second half, and of one of another scene
    how = Extending(prefix="new_")
    for number in range(clips):
        truth = scenes.clip(number)
        first, whole, late = (
            reconstruct(network, images[number][part], options=options)
            for part in (slice(0, half), slice(0, frames), slice(half - _SHARED, frames))
        )
        both = extended(network, first, images[number][half:], extending=how, options=options)
        shared = (
            checked_centres(poses) for poses in (late.camera_from_world[:_SHARED], first.camera_from_world[-_SHARED:])
        )
        joined = align(late.camera_from_world[_SHARED:], umeyama_sim3(*shared, allow_line=True))
        by_cameras = np.concatenate([first.camera_from_world, joined])
        errors.append(
            [_path_error(poses, truth) for poses in (whole.camera_from_world, both.camera_from_world, by_cameras)]
        )
        known, columns = patches(first.images / np.float32(255))
        for found, scene in ((own, number), (others, (number + 1) % clips)):
            new, _ = patches(images[scene][half:] / np.float32(255))
            found.append(Places.of(known, columns).overlaps(new).max())
        try:
            extended(network, first, images[(number + 1) % clips][half:], extending=how, options=options)
        except InputError:
            refused += 1
        sys.stderr.write(f"{number + 1} of {clips}: {np.round(errors[-1], 4).tolist()}\n")
    means = np.mean(errors, axis=0)
    names = ("one run over all frames", "extend", f"two runs joined by {_SHARED} cameras")
    rows = [[name, f"{mean:.4f}", f"{mean / means[0]:.2f}"] for name, mean in zip(names, means, strict=True)]
    table = markdown_table(["path error, median depths", "mean", "compared with one run"], rows)
    told = f"{refused} of {clips} clips of another scene are refused; the best overlap of a clip is at least "
    told += f"{min(own):.2f} in its own scene, and at most {max(others):.2f} in another"
    sys.stdout.write(f"{table}\n{told}\n")


def _path_error(camera_from_world: Float[np.ndarray, "S 3 4"], truth: Truth) -> float:
    found, true = checked_centres(camera_from_world), checked_centres(truth.camera_from_world)
    away = np.linalg.norm(umeyama_sim3(found, true, allow_line=True).apply(found) - true, axis=1)
    return float(np.sqrt((away**2).mean()) / np.median(truth.depth[truth.depth > 0]))
