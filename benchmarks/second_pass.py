"""Effects of the second pass on the cameras: python -m benchmarks second-pass.

Every dynamic scene has a frozen twin: the same room, camera and textures, with its movers standing still. Plain passes
over both measure the cost of motion. The second pass measures the total effect of suppression on the moving scene, its
effect without motion on the frozen scene, and the effect of an arbitrary mask with another scene's mask.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.method.mask import dynamic_tokens
from vggtjax.network.model import forward
from vggtjax.network.pose import decode_pose
from vggtjax.pretrained.load import load_model
from vggtjax.scenes import SceneConfig, SyntheticClip, held_out_scenes

_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs"))
_AT_ONCE = 4


def second_pass(
    *,
    model: str = "demo",
    scenes: int = 64,
    frames: int = 12,
    seed: int = 0,
    size: int | None = None,
    pairs: tuple[int, ...] = (1, 2, 3, 5),
    suppress: Literal["zero", "drop"] = "zero",
) -> None:
    """Measure errors of the cameras on moving scenes and on their frozen twins, with and without suppressed keys.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        scenes: number of held-out dynamic scenes, at least two.
        frames: frames of a scene.
        seed: another seed draws other scenes.
        size: side of the frames in pixels; the model's own by default.
        pairs: numbers of pairs in which keys are suppressed.
        suppress: how keys are suppressed.
    """
    if scenes < 2:
        raise InputError(f"scenes is {scenes}; expected at least 2: each scene uses the mask of another")
    loaded = load_model(model)
    config = loaded.config
    side = size or config.image_size
    wanted = SceneConfig(height=side, width=side, frames=frames)
    console = Console()
    with console.status("scenes"):
        moving = held_out_scenes("dynamic", scenes, wanted, seed=seed)
        frozen = held_out_scenes("dynamic", scenes, dataclasses.replace(wanted, frozen=True), seed=seed)
    lent = np.roll(moving.dynamic_mask, 1, axis=0)
    runs: dict[tuple[str, str, int], tuple[SyntheticClip, Any]] = {}
    runs["moving", "none", 0], runs["frozen", "none", 0] = (moving, None), (frozen, None)
    for count in pairs:
        runs["moving", "true", count] = (moving, moving.dynamic_mask)
        runs["moving", "another scene's", count] = (moving, lent)
        runs["frozen", "true", count] = (frozen, frozen.dynamic_mask)
    errors = {}
    for name, (clips, mask) in track(runs.items(), description="passes", console=console):
        poses = []
        for start in range(0, scenes, _AT_ONCE):
            some = np.minimum(np.arange(start, start + _AT_ONCE), scenes - 1)
            tokens = None if mask is None else dynamic_tokens(jnp.asarray(mask[some]), config.patch_size)
            images = jnp.asarray(clips.images[some], jnp.float32)
            made = _forward(
                loaded.params, images, config, dynamic_tokens=tokens, suppress=suppress,
                mask_pairs=name[2], outputs=("camera",),
            )  # fmt: skip
            poses.append(np.asarray(decode_pose(jnp.asarray(made.pose_encoding), (side, side))[0]))
        found = np.concatenate(poses)[:scenes]
        depth = np.median(clips.depth.reshape(scenes, -1), axis=1)
        errors[name] = np.array(
            [
                [rotation_error(one, true), centre_error(one, true) / unit]
                for one, true, unit in zip(found, clips.camera_from_world, depth, strict=True)
            ]
        )
    console.print(_table(errors, suppress))


def _table(errors: dict[tuple[str, str, int], np.ndarray], suppress: str) -> Table:
    table = Table(title=f"keys: {suppress}; means over {len(next(iter(errors.values())))} scenes", box=None)
    for heading in ("scene", "mask", "pairs"):
        table.add_column(heading)
    for heading in ("rotation", "against plain", "centres", "against plain"):
        table.add_column(heading, justify="right")
    for (scene, mask, pairs), values in errors.items():
        change = values - errors[scene, "none", 0]
        mean, spread = change.mean(axis=0), change.std(axis=0, ddof=1) / len(change) ** 0.5
        changes = [f"{a:+.{n}f} ± {b:.{n}f}" if pairs else "" for a, b, n in zip(mean, spread, (2, 4), strict=True)]
        rotation, centre = values.mean(axis=0)
        table.add_row(scene, mask, str(pairs or "-"), f"{rotation:.2f}°", changes[0], f"{centre:.4f}", changes[1])
    difference = errors["moving", "none", 0] - errors["frozen", "none", 0]
    mean, spread = difference.mean(axis=0), difference.std(axis=0, ddof=1) / len(difference) ** 0.5
    table.caption = (
        f"cost of motion in the plain pass: rotation {mean[0]:+.2f} ± {spread[0]:.2f} degrees, centres {mean[1]:+.4f} "
        f"± {spread[1]:.4f} median depths (standard errors over scenes)"
    )
    return table
