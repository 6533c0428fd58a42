"""One side of a comparison: a process that holds a model and runs one or both passes on request.

python -m benchmarks.worker ours WEIGHTS [bfloat16], or python -m benchmarks.worker peer WEIGHTS CHECKOUT [mapped]
[bfloat16]: blocks in bfloat16 here, autocast there. Then a line of JSON on standard input for every run: {"work":
"pass", "vggt4d" or "4dvggt-d", "frames", "height", "width", "keep": a file for the outputs or null, "mask": a file with
the mask of the second pass, or null}.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.shared.seeded import seeded_images
from vggtjax.config import DA3, vggt_1b
from vggtjax.research.parity.public_code import add_checkout, build, give_weights, read_weights
from vggtjax.storage.memory import process_bytes
from vggtjax.storage.process import core_count

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # as the network's, without its imports
_REFERENCE = {"float32": "chosen", "bfloat16": "first"}  # three digits can choose another frame

Outputs = dict[str, np.ndarray]
Run = Callable[[str, np.ndarray, np.ndarray | None], Outputs]  # work, images [S, 3, H, W] in [0, 1], mask [S, H, W]


def ours(weights: Path, dtype: str) -> Run:
    """Return this library's passes: a plain one, or a whole method."""
    from vggtjax.storage.process import keep_freed_memory

    keep_freed_memory()
    import jax
    import jax.numpy as jnp

    from vggtjax import decode_pose, forward, infer, load_model
    from vggtjax.method.mask import dynamic_tokens

    model = load_model(weights, compute_dtype=None if dtype == "float32" else dtype)
    compiled: dict[tuple, Any] = {}

    def call(function, *arrays, **options):
        key = (function, *(x.shape for x in arrays), *options.items())
        if key not in compiled:
            lowered = jax.jit(function, static_argnames=("config", "compute_dtype", *options)).lower(
                model.params, arrays[0], model.config, *arrays[1:], compute_dtype=dtype, **options
            )
            compiled[key] = lowered.compile()
        return jax.block_until_ready(compiled[key](model.params, *arrays))

    def masked(params, images, config, mask, compute_dtype):
        tokens = dynamic_tokens(mask, config.patch_size)
        masking = {"dynamic_tokens": tokens, "suppress": "drop"}
        return forward(params, images, config, outputs=("camera",), compute_dtype=compute_dtype, **masking)

    def run(work: str, images: np.ndarray, mask: np.ndarray | None) -> Outputs:
        x = jnp.asarray(images.transpose(0, 2, 3, 1)[None])
        if mask is not None:
            return {"pose_encoding": np.asarray(call(masked, x, jnp.asarray(mask)[None]).pose_encoding[0])}
        if work == "pass":
            made = call(forward, x, outputs=("camera", "depth"), reference=_REFERENCE[dtype])
            poses = made.pose_encoding
            if model.config.row.direct_cameras:  # which the public code gives as matrices
                poses = decode_pose(poses, (x.shape[2], x.shape[3]))[0]
            return _outputs(poses, made.depth, made.depth_confidence)
        assembly, passes = call(infer, x, method=work)
        first = passes.first
        if work == "vggt4d":  # the public code's outputs
            return {"saliency": np.asarray(passes.saliency[0]), "mask": np.asarray(passes.dynamic_mask[0])} | _outputs(
                first.pose_encoding, first.depth, first.depth_confidence
            )
        return _outputs(assembly.camera_from_world, assembly.depth, assembly.confidence)

    return run


def peer(weights: Path, checkout: Path, *, mapped: bool, dtype: str) -> Run:
    """Return the passes of the public PyTorch code, from a checkout: VGGT's, or stages 1 and 2 of VGGT4D.

    The plain pass runs the same heads as ours and no others; VGGT4D runs its own model and its own functions, with
    the CPU in place of CUDA. The weights of all heads are loaded as by `from_pretrained`; with `mapped` they are mapped
    as ours, and for a plain pass only those of its heads. In bfloat16 all of it runs under PyTorch's autocast.
    """
    add_checkout(checkout)
    import torch
    from safetensors.torch import load_model

    torch.set_num_threads(core_count())
    models: dict[str, Any] = {}

    def model_for(work: str) -> Any:
        if work not in models:
            models.clear()
            plain = work == "pass"
            config = replace(vggt_1b(), heads=("camera", "depth")) if plain and mapped else vggt_1b()
            model = build("vggt" if plain else "vggt4d", config)
            if mapped:
                give_weights(model, read_weights(weights, weights.name))
            else:
                load_model(model, weights)
            models[work] = model
        return models[work]

    def one_pass(images: np.ndarray) -> Outputs:
        model, x = model_for("pass"), torch.from_numpy(images)[None]
        tokens, start = model.aggregator(x)[:2]
        pose = model.camera_head(tokens)[-1]
        depth, confidence = model.depth_head(tokens, images=x, patch_start_idx=start)
        return _outputs(pose.float().numpy(), depth.float().numpy()[..., 0], confidence.float().numpy())

    def two_passes(images: np.ndarray, mask: np.ndarray | None) -> Outputs:
        from vggt4d.masks import dynamic_mask as maps  # pyright: ignore[reportMissingImports]
        from vggt4d.utils.model_utils import organize_qk_dict  # pyright: ignore[reportMissingImports]

        model, x = model_for("vggt4d"), torch.from_numpy(images)
        (S, _, H, W), to = images.shape, torch.Tensor.to

        def stays(tensor, *where, **options):
            return tensor if where == ("cuda",) else to(tensor, *where, **options)

        if mask is not None:
            return {"pose_encoding": model(x, dyn_masks=torch.from_numpy(mask))[0]["pose_enc"][0].numpy()}
        first, qk, features, tokens = model(x)
        del tokens
        qk = organize_qk_dict(qk, S)
        with mock.patch.object(torch.Tensor, "to", stays):
            saliency = maps.extract_dyn_map(qk, x)
        features = features.reshape(S, H // 14, W // 14, -1)
        clustered, _ = maps.cluster_attention_maps(features, saliency)
        pixels = torch.nn.functional.interpolate(clustered[:, None], size=(H, W), mode="bilinear")[:, 0]
        found = pixels > maps.adaptive_multiotsu_variance(pixels.numpy())
        model(x, dyn_masks=found)
        made = _outputs(first["pose_enc"].numpy(), first["depth"].numpy()[..., 0], first["depth_conf"].numpy())
        return {"saliency": saliency.numpy(), "mask": found.numpy()} | made

    def run(work: str, images: np.ndarray, mask: np.ndarray | None) -> Outputs:
        autocast = torch.autocast("cpu", torch.bfloat16, enabled=dtype == "bfloat16")
        with torch.inference_mode(), autocast:
            return one_pass(images) if work == "pass" else two_passes(images, mask)

    return run


def da3_peer(weights: Path, checkout: Path, dtype: str) -> Run:
    """Return a pass of the public code of Depth Anything 3: a folder with its package and what that imports."""
    sys.path.insert(0, str(checkout))
    import torch
    from depth_anything_3.cfg import create_object, load_config  # pyright: ignore[reportMissingImports]
    from safetensors.torch import load_file

    torch.set_num_threads(core_count())
    tensors = {name.removeprefix("model."): value for name, value in load_file(weights).items()}
    width = tensors["backbone.pretrained.camera_token"].shape[-1]
    name = next(name for name, config in DA3.items() if config.embed_dim == width)
    model = create_object(load_config(str(checkout / f"depth_anything_3/configs/{name}.yaml"))).eval()
    model.load_state_dict(tensors, strict=False)
    strategy = {"chosen": "saddle_balanced"}.get(_REFERENCE[dtype], _REFERENCE[dtype])
    mean, std = (torch.tensor(values).reshape(3, 1, 1) for values in (IMAGE_MEAN, IMAGE_STD))

    def run(work: str, images: np.ndarray, mask: np.ndarray | None) -> Outputs:
        del work, mask
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=dtype == "bfloat16"):
            made = model((torch.from_numpy(images)[None] - mean) / std, ref_view_strategy=strategy)
        return _outputs(made.extrinsics.numpy()[:, :, :3], made.depth.numpy(), made.depth_conf.numpy())

    return run


def _outputs(pose, depth, confidence) -> Outputs:
    names = ("pose_encoding", "depth", "confidence")
    return {
        name: np.asarray(value[0], np.float32) for name, value in zip(names, (pose, depth, confidence), strict=True)
    }


class PeakMemory:
    """Sample the peak memory of the process inside the context; `own` excludes mapped files. Both are 0 if unknown."""

    def __enter__(self) -> PeakMemory:
        self.total = self.own = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.total = max(self.total, process_bytes("VmRSS") or 0)
            self.own = max(self.own, process_bytes("RssAnon") or 0)
            if self._done.wait(0.02):
                return


def disk_reads() -> int:
    """Return how often this process has read a page from a disk, such as evicted pages of mapped weights."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_majflt


def main(side: str, weights: str, *rest: str) -> None:
    """Load a model, report it, and run passes until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # other prints must not mix with answers
    dtype = "bfloat16" if "bfloat16" in rest else "float32"
    if side == "ours":
        run = ours(Path(weights), dtype)
    elif (Path(rest[0]) / "depth_anything_3").exists():
        run = da3_peer(Path(weights), Path(rest[0]), dtype)
    else:
        run = peer(Path(weights), Path(rest[0]), mapped="mapped" in rest[1:], dtype=dtype)
    answers.write('{"ready": true}\n')
    answers.flush()
    for line in sys.stdin:
        task = json.loads(line)
        images = seeded_images(task["frames"], task["height"], task["width"])
        mask = np.load(task["mask"])["mask"] if task["mask"] else None
        reads, began = disk_reads(), time.perf_counter()
        with PeakMemory() as peak:
            outputs = run(task["work"], images, mask)
        seconds = time.perf_counter() - began
        if task["keep"]:
            np.savez(task["keep"], allow_pickle=False, **outputs)
        answer = {
            "seconds": seconds,
            "total": peak.total,
            "own": peak.own,
            "since start": process_bytes("VmHWM") or 0,
            "reads": disk_reads() - reads,
        }
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
