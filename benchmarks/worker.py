"""One side of a comparison: a process that holds a model and runs a pass whenever it is told to.

python -m benchmarks.worker ours WEIGHTS, or python -m benchmarks.worker peer WEIGHTS CHECKOUT; then a line of JSON on
standard input for every run: {"frames", "height", "width", "keep": a file for the outputs, or null}.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.seeded import seeded_images

Outputs = dict[str, np.ndarray]
Run = Callable[[np.ndarray], Outputs]  # images [S, 3, H, W] in [0, 1] -> pose encoding, depth, confidence


def ours(weights: Path) -> Run:
    """Return a plain pass of this library: cameras and depth."""
    from vggtjax.host_memory import keep_freed_memory

    keep_freed_memory()
    import jax
    import jax.numpy as jnp

    from vggtjax import forward, load_model

    model = load_model(weights)
    compiled: dict[tuple[int, ...], Any] = {}

    def run(images: np.ndarray) -> Outputs:
        x = jnp.asarray(images.transpose(0, 2, 3, 1)[None])
        if x.shape not in compiled:
            lowered = jax.jit(forward, static_argnames=("config", "outputs")).lower(
                model.params, x, model.config, outputs=("camera", "depth")
            )
            compiled[x.shape] = lowered.compile()
        made = jax.block_until_ready(compiled[x.shape](model.params, x))
        return {
            "pose_encoding": np.asarray(made.pose_encoding[0]),
            "depth": np.asarray(made.depth[0]),
            "confidence": np.asarray(made.depth_confidence[0]),
        }

    return run


def peer(weights: Path, checkout: Path) -> Run:
    """Return a plain pass of the public PyTorch code of VGGT, from a checkout: the same heads, no others."""
    sys.path.insert(0, str(checkout))
    import torch
    from safetensors.torch import load_file

    torch.set_num_threads(os.cpu_count() or 1)
    from vggt.models.vggt import VGGT  # pyright: ignore[reportMissingImports]: the user's checkout

    model = VGGT(enable_point=False, enable_track=False)
    names = set(model.state_dict())
    tensors = {name: value for name, value in load_file(weights).items() if name in names}
    model.load_state_dict(tensors, assign=True, strict=True)
    del tensors
    model.eval()

    def run(images: np.ndarray) -> Outputs:
        with torch.inference_mode():
            x = torch.from_numpy(images)[None]
            tokens, start = model.aggregator(x)[:2]
            pose = model.camera_head(tokens)[-1]
            depth, confidence = model.depth_head(tokens, images=x, patch_start_idx=start)
        return {
            "pose_encoding": pose[0].numpy(),
            "depth": depth[0, ..., 0].numpy(),
            "confidence": confidence[0].numpy(),
        }

    return run


def main(side: str, weights: str, *rest: str) -> None:
    """Load a model, say so, and run passes until standard input ends."""
    run = ours(Path(weights)) if side == "ours" else peer(Path(weights), Path(rest[0]))
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever else is printed is no answer
    answers.write('{"ready": true}\n')
    answers.flush()
    for line in sys.stdin:
        task = json.loads(line)
        images = seeded_images(task["frames"], task["height"], task["width"])
        began = time.perf_counter()
        outputs = run(images)
        seconds = time.perf_counter() - began
        if task["keep"]:
            np.savez(task["keep"], allow_pickle=False, **outputs)
        answers.write(json.dumps({"seconds": seconds, "peak": peak_bytes()}) + "\n")
        answers.flush()


def peak_bytes() -> int:
    """Return the most memory that this process has had, with the weights that it has mapped or read."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) * 1024
    return 0


if __name__ == "__main__":
    main(*sys.argv[1:])
