"""Put a trained model, a held-out clip and what the second pass changes into the package, for `vggtjax demo`."""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

import jax
import numpy as np
from rich.console import Console
from scipy.stats import rankdata

from benchmarks import summaries
from benchmarks.held_out import held_out_truth
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.network.backbone import resized
from vggtjax.network.checkpoint import numpy_dtype, save_model
from vggtjax.pipeline.pretrained.embedded import (
    CLIP,
    MODEL,
    NEAREST,
    NOTE,
    SECOND_PASS,
    STEP,
    UNTRAINED_HEADS,
)
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.research.evaluation.ladder import LadderRow, MaskSource, ladder
from vggtjax.research.evaluation.ladder_words import CAMERA_SCORES, Change, SecondPass, write_second_pass
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig
from vggtjax.training.scenes.held_out import MOVERS

MOST_MODEL_BYTES = 24 << 20
MOST_CLIP_BYTES = 1 << 20
SCENE_SEED = 100  # of held-out dynamic scenes; the clip is one of them; no evaluation uses this seed


def embed(
    model: str,
    /,
    *,
    frames: int = 16,
    scenes: int = 45,
    image_size: int | None = None,
    height: int | None = None,
    assets: Path | None = None,
) -> None:
    """Write the model, in bfloat16, a held-out dynamic clip, and what the second pass changes over such clips.

    The clip is a typical one of `scenes`. Scenes are ranked by the rotation error and by the centres' error of the
    first pass, and the middle third by the sum of ranks is kept. These are ranked by how the second pass, with mined
    masks, changes the two errors, and the one with the median sum of ranks is taken. So the demo shows neither the best
    nor the worst of the model and of the method.

    Args:
        model: a .safetensors written by `vggtjax train` or `vggtjax calibrate-cues`.
        frames: of the clip.
        scenes: number of held-out scenes that the clip is chosen from, at least 3; three times an odd number has one in
            the very middle.
        image_size: side in pixels that the model was last trained at, which becomes its own and the clip's; the
            model's own by default.
        height: of the clip in pixels, a multiple of the model's patch size; `image_size` by default.
        assets: folder of textures, photographs and objects: the clip is a world of its test split instead of a room,
            one without sky in which as much moves as in rooms.
    """
    loaded = load_model(model)
    side = image_size or loaded.config.image_size
    high, patch = side if height is None else height, loaded.config.patch_size
    if not 0 < high <= side or high % patch:
        raise InputError(f"height is {high}; expected a multiple of the patch size {patch}, at most {side}")
    config = SceneConfig(height=high, width=side, frames=frames, samples=3)
    truth = held_out_truth("dynamic", scenes, config, seed=SCENE_SEED, assets=assets)
    if assets is not None:  # rooms are chosen when they are drawn
        truth = _fit_to_show(truth)
    network = dataclasses.replace(loaded.config, image_size=side)
    params = {**loaded.params, "backbone": resized(loaded.params["backbone"], loaded.config, network.grid_size)}
    params = jax.tree.map(lambda leaf: np.asarray(leaf).astype(numpy_dtype("bfloat16")), params)
    with staging(MODEL.parent) as staged:
        made = {path: staged / path.name for path in (MODEL, CLIP, SECOND_PASS)}
        save_model(made[MODEL], params, network, name="demo", note=NOTE, untrained_heads=UNTRAINED_HEADS)
        rows = _known(
            ladder(load_model(made[MODEL]), truth, methods=("vggt", "4dvggt-d"), masks=("mined", "matches", "true"))
        )
        write_second_pass(made[SECOND_PASS], second_pass_over(rows))
        scene = _typical_scene(rows)
        write_demo_clip(made[CLIP], truth.clip(scene))
        for path, most in ((MODEL, MOST_MODEL_BYTES), (CLIP, MOST_CLIP_BYTES)):
            if (size := made[path].stat().st_size) > most:
                raise InputError(f"{path.name} has {size} bytes; at most {most} go into the package")
        for path, new in made.items():
            new.replace(path)
    console = Console()
    console.print(
        f"scene {scene} of {len(truth.depth)} has typical errors of the cameras, and a typical change of them"
    )
    for path in (MODEL, CLIP):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        console.print(f"{path}  {path.stat().st_size} bytes  sha256 {digest}", soft_wrap=True)


def _known(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows of clips in which every row has errors of the cameras. Raises InputError below three clips."""
    unknown = {row.clip for row in rows if None in [getattr(row, name) for name in CAMERA_SCORES]}
    known = [row for row in rows if row.clip not in unknown]
    if (clips := len({row.clip for row in known})) < 3:
        raise InputError(f"{clips} scenes have errors of their cameras in every pass; ask for more scenes")
    return known


def second_pass_over(rows: Sequence[LadderRow]) -> SecondPass:
    """Return what 4dvggt-d changes in the cameras' errors over clips, compared with vggt; every row has them."""
    second = {
        summary.mask_source: _shares(summary.changes)
        for summary in summaries.summarise([rows], CAMERA_SCORES)
        if summary.method == "4dvggt-d"
    }
    sources: tuple[MaskSource, ...] = get_args(MaskSource)
    clips = len({row.clip for row in rows})
    return SecondPass(clips, {source: second[source] for source in sources if source in second})


def write_demo_clip(path: Path, truth: Truth) -> None:
    """Write a clip for `demo_clip`: colours in 8 bits, depth in 16 bits, the mask in 1 bit."""
    steps = np.log(np.maximum(truth.depth, NEAREST) / NEAREST) / STEP
    content = io.BytesIO()
    np.savez_compressed(
        content,
        images=in_bytes(truth.images),
        log_depth=np.rint(np.minimum(steps, 65535)).astype(np.uint16),
        dynamic_mask=np.packbits(truth.dynamic_mask),
        camera_from_world=truth.camera_from_world.astype(np.float32),
        intrinsics=truth.intrinsics.astype(np.float32),
    )
    with writing(path) as temporary:
        temporary.write_bytes(content.getvalue())


def _shares(changes: Mapping[str, summaries.Change]) -> dict[str, Change]:
    """Return changes and their standard errors as shares of the first pass's mean error."""
    return {
        name: Change(change.mean / change.plain, (change.error or 0) / change.plain) for name, change in changes.items()
    }


def _fit_to_show(truth: Truth) -> Truth:
    """Return the clips whose depth is known everywhere, and in which as much moves as in held-out rooms."""
    moving = truth.dynamic_mask.mean(axis=(1, 2, 3))
    fit = (truth.depth > 0).all(axis=(1, 2, 3)) & (moving >= MOVERS[0]) & (moving <= MOVERS[1])
    if not fit.any():
        raise InputError(f"none of {len(fit)} scenes has things that move and no sky; ask for more scenes")
    return truth.clip(fit)


def _typical_scene(rows: Sequence[LadderRow]) -> int:
    """Return the median clip by change, of the middle third by the errors of the first pass."""
    first, second = (
        {
            row.clip: [getattr(row, name) for name in CAMERA_SCORES]
            for row in rows
            if (row.method, row.mask_source) == each
        }
        for each in (("vggt", None), ("4dvggt-d", "mined"))
    )
    clips, third = np.array([*first]), len(first) // 3
    before, after = (np.array([errors[clip] for clip in clips]) for errors in (first, second))
    middle = _by_ranks(before)[third : len(clips) - third]
    return int(clips[middle[_by_ranks((after - before)[middle])[len(middle) // 2]]])


def _by_ranks(values: np.ndarray) -> np.ndarray:
    """Return the indices of rows in the order of the sums of their ranks in each column."""
    return np.argsort(rankdata(values, axis=0).sum(axis=1), kind="stable")
