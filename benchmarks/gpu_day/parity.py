"""The tiny model against the public code's numbers, in both types of the blocks."""

from __future__ import annotations

import json
from functools import partial

import jax
import numpy as np

from benchmarks.gpu_day.lines import Lines
from benchmarks.suite.cases import Size
from tests.shared.golden import BFLOAT16, FORWARD, GOLDEN, OUTPUTS, TOLERANCE, GoldenPass, golden_params, spread_error
from tests.shared.seeded import seeded_images
from vggtjax.method.cues import GramCues
from vggtjax.network.model import forward

_MOTION = 1e-4  # absolute, of maps in [0, 1]


def parity(size: Size, lines: Lines) -> None:
    """Compare poses, depth and points of the plain pass and of the masked ones, and the motion cues in float32."""
    small = size == "tiny"
    for name in FORWARD[:1] if small else FORWARD:
        golden = GoldenPass(name)
        for dtype in ("float32", "bfloat16"):
            for kind in ("plain",) if small else ("plain", "drop", "zero"):
                _compare(golden, name, kind, dtype, lines)
    if not small:
        _motion(lines)


def _compare(golden: GoldenPass, name: str, kind: str, dtype: str, lines: Lines) -> None:
    masking = {} if kind == "plain" else {"suppress": kind, "dynamic_tokens": golden.tokens}
    points = kind == "plain" and name == "frames4" and dtype == "float32"
    outputs = ("camera", "depth", *["points"] * points)
    run = partial(forward, config=golden.config, outputs=outputs, compute_dtype=dtype, **masking)
    made = jax.jit(run)(golden.params, golden.images)
    for field, key in OUTPUTS.items():
        if (value := getattr(made, field)) is not None:
            error = spread_error(value, golden.arrays[f"{kind}/{key}"])
            most = TOLERANCE if dtype == "float32" else BFLOAT16[key]
            row = {"case": name, "pass": kind, "output": field.replace("_", " ")}
            title = f"{dtype}: largest error in standard deviations of the public code's numbers"
            lines.row(title, **row, error=error, at_most=most, holds=error <= most)


def _motion(lines: Lines) -> None:
    with np.load(GOLDEN / "motion.npz") as arrays:
        meta = json.loads(str(arrays["meta"]))
        images = seeded_images(meta["frames"], meta["height"], meta["width"], meta["seed"]).transpose(0, 2, 3, 1)[None]
        golden = GoldenPass("single").config
        for gram in ("dot", "cosine"):
            cues = GramCues(golden.motion, golden.depth, gram)
            run = partial(forward, config=golden, cues=cues, outputs=())
            sums = jax.jit(run)(golden_params(meta["seed"]), images).cue_sums
            saliency = arrays[f"{gram}/saliency"]
            error = float(np.abs(np.asarray(cues.saliency(sums)).reshape(saliency.shape) - saliency).max())
            title = "float32: largest error of the motion saliency, which is in [0, 1]"
            lines.row(title, gram=gram, error=error, at_most=_MOTION, holds=error <= _MOTION)
