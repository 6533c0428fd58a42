"""Effects of the second pass on the cameras: python -m benchmarks second-pass.

Every dynamic scene has a frozen twin: the same room, camera and textures, with its movers standing still. Plain passes
over both measure the cost of motion. The second pass measures the total effect of suppression on the moving scene, and
its effect without motion on the frozen scene. Another scene's mask measures the effect of losing arbitrary keys;
compared with the frozen scene's own mask it tells whether the movers' keys are worth more.
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
    twins = {"moving": moving, "frozen": frozen}
    runs: dict[tuple[str, str, int], tuple[SyntheticClip, Any]] = {}
    for scene, clips in twins.items():
        runs[scene, "none", 0] = (clips, None)
    for count in pairs:
        for scene, clips in twins.items():
            runs[scene, "true", count] = (clips, clips.dynamic_mask)
            runs[scene, "another scene's", count] = (clips, np.roll(clips.dynamic_mask, 1, axis=0))
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
        mean, spread = _difference(values, errors[scene, "none", 0])
        changes = [f"{a:+.{n}f} ± {b:.{n}f}" if pairs else "" for a, b, n in zip(mean, spread, (2, 4), strict=True)]
        rotation, centre = values.mean(axis=0)
        table.add_row(scene, mask, str(pairs or "-"), f"{rotation:.2f}°", changes[0], f"{centre:.4f}", changes[1])
    moving, frozen = errors["moving", "none", 0], errors["frozen", "none", 0]
    lines = [f"cost of motion in the plain pass: {_apart(moving, frozen)}"]
    for pairs in sorted({pairs for _, _, pairs in errors if pairs}):
        own, lent = errors["frozen", "true", pairs], errors["frozen", "another scene's", pairs]
        lines.append(f"frozen, {pairs} pairs, the movers' keys against another scene's mask: {_apart(own, lent)}")
    table.caption = "\n".join([*lines, "centres in median depths; standard errors over scenes"])
    return table


def _apart(errors: np.ndarray, others: np.ndarray) -> str:
    """Return by how much errors are larger than others, as text."""
    mean, spread = _difference(errors, others)
    return f"rotation {mean[0]:+.2f} ± {spread[0]:.2f} degrees, centres {mean[1]:+.4f} ± {spread[1]:.4f}"


def _difference(errors: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much errors [scenes, 2] are larger than others: the mean over scenes, and its standard error."""
    difference = errors - others
    return difference.mean(axis=0), difference.std(axis=0, ddof=1) / len(difference) ** 0.5
