"""The public PyTorch code on given frames, in a process of its own: python -m vggtjax.research.parity.public_run TASK.

TASK is a JSON file with the fields of `Task`. The arrays go to the file `made`; standard output gets a line of JSON
with the fields of `Facts`. torch and jax never share a process, so that the memory of each is its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError, VggtjaxError, one_line
from vggtjax.research.parity.outputs import CAMERAS, MASKED, OUTPUTS, Arrays
from vggtjax.storage.memory import peak_bytes


@dataclass(frozen=True)
class Task:
    """What the process reads and writes."""

    checkout: str
    weights: str  # of PyTorch: a file, or the index of shards
    name: str  # of the model, for messages
    config: str  # of the model, JSON
    frames: str  # .npz: images [S, H, W, 3] in [0, 1], queries [Q, 2], mask [S, H, W]
    made: str  # .npz to write
    masked: bool  # also the pass in which keys of dynamic tokens are suppressed


@dataclass(frozen=True)
class Facts:
    """What the process tells of its run."""

    seconds: float  # of a plain pass, the second one
    peak: int | None  # bytes of the process
    torch: str
    device: str


def run_public(task: Task) -> tuple[Arrays, Facts]:
    """Run the public code in a process; return its outputs. Raises InputError with its last words where it fails."""
    file = Path(task.made).with_name("task.json")
    file.write_text(json.dumps(asdict(task)))
    command = [sys.executable, "-m", "vggtjax.research.parity.public_run", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode < 0:
        raise InputError(
            f"the public code in {task.checkout} was ended by signal {-done.returncode}, as a system does that is "
            "short of memory; take fewer frames (--frames)"
        )
    if done.returncode:
        words = [line for line in done.stderr.splitlines() if line.strip()] or [f"exit code {done.returncode}"]
        raise InputError(
            f"the public code in {task.checkout} stopped: {one_line(words[-1])}; install what it "
            "needs into this environment, or mend the checkout"
        )
    with np.load(task.made, allow_pickle=False) as arrays:
        return dict(arrays), Facts(**json.loads(done.stdout.splitlines()[-1]))


def _run(task: Task) -> Facts:
    import torch

    from vggtjax.research.parity.public_code import add_checkout, build, give_weights, read_weights

    add_checkout(Path(task.checkout))
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    torch.set_float32_matmul_precision("highest")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    config = VGGTConfig.from_json(task.config)
    weights = read_weights(Path(task.weights), task.name)
    with np.load(task.frames, allow_pickle=False) as frames:
        images = torch.from_numpy(frames["images"].transpose(0, 3, 1, 2).copy())[None].to(device)
        queries = torch.from_numpy(frames["queries"])[None].to(device)
        mask = torch.from_numpy(frames["mask"])[None].to(device)

    def network(package: str) -> Any:
        model = build(package, config)
        give_weights(model, weights)
        return model.to(device)

    with torch.inference_mode():
        model = network("vggt")
        model(images, query_points=queries)  # the first pass prepares kernels
        if device == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        made = _arrays(model(images, query_points=queries), images.shape[-2:])
        seconds = time.perf_counter() - began
        del model
        if task.masked:
            made |= _arrays(network("vggt4d")(images, dyn_masks=mask)[0], images.shape[-2:], MASKED)
    np.savez(task.made, allow_pickle=False, **made)
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    return Facts(seconds, peak_bytes(), torch.__version__, name)


def _arrays(made: dict[str, Any], size: Sequence[int], prefix: str = "") -> Arrays:
    """Return the outputs of the public code by our names, and its cameras."""
    from vggt.utils.pose_enc import pose_encoding_to_extri_intri  # pyright: ignore[reportMissingImports]

    arrays = {name: made[output.public] for name, output in OUTPUTS.items() if output.public in made}
    if "depth" in arrays:
        arrays["depth"] = arrays["depth"][..., 0]
    if "pose_encoding" in arrays:
        arrays[CAMERAS] = pose_encoding_to_extri_intri(arrays["pose_encoding"], tuple(size))[0]
    return {prefix + name: tensor[0].float().cpu().numpy() for name, tensor in arrays.items()}


def main(file: str) -> int:
    """Run the task of a file; return the exit code, 0 or 2."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # other prints must not mix with the answer
    try:
        facts = _run(Task(**json.loads(Path(file).read_text())))
    except VggtjaxError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    answers.write(f"{json.dumps(asdict(facts))}\n")
    answers.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
