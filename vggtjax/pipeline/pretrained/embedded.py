"""Input of `vggtjax demo`, files of the package: a model, a clip with its truth, and a measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vggtjax.clips.truth import Truth
from vggtjax.errors import CheckpointError, ClipError
from vggtjax.network.checkpoint import LoadedDType, Model, read_model

MODEL = Path(__file__).with_name("model.safetensors")
CLIP = MODEL.with_name("clip.npz")
SECOND_PASS = MODEL.with_name("second_pass.json")  # what the second pass changes over many such clips
NOTE = "small demonstration model, trained on generated scenes; not for real footage"
UNTRAINED_HEADS = ("points", "tracks")
NEAREST = np.float32(1e-3)  # metres
STEP = 5e-4  # of the logarithm of depth, stored in 16 bits


def demo_model(dtype: LoadedDType = "float32", compute_dtype: str | None = None) -> Model:
    """Return the embedded model, trained on generated static scenes; arguments as those of `read_model`.

    docs/research-notes/embedded-model.md has its training and accuracy. Raises CheckpointError if the file is missing.
    """
    if not MODEL.is_file():
        raise CheckpointError(f"the embedded model {MODEL} is missing; install vggtjax again")
    return read_model(MODEL, dtype=dtype, compute_dtype=compute_dtype)


def demo_clip(path: Path = CLIP) -> Truth:
    """Return the embedded clip with its truth: a generated dynamic scene, not used in training.

    Raises ClipError if the file is missing.
    """
    if not path.is_file():
        raise ClipError(f"the embedded clip {path} is missing; install vggtjax again")
    with np.load(path, allow_pickle=False) as stored:
        depth = NEAREST * np.exp(stored["log_depth"].astype(np.float32) * np.float32(STEP))
        mask = np.unpackbits(stored["dynamic_mask"], count=depth.size).astype(bool).reshape(depth.shape)
        images = stored["images"].astype(np.float32) / 255
        return Truth(images, depth, mask, stored["camera_from_world"], stored["intrinsics"])
