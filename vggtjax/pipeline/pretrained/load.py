"""Models by path or name; PyTorch weights are converted once and kept."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import get_args

from converters.files import weight_files
from converters.locate import Weights, locate
from converters.torch_to_flax import convert_weights
from vggtjax.config import ComputeDType, VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError, check_choice
from vggtjax.network.checkpoint import VERSION, DType, LoadedDType, Model, is_checkpoint, read_model
from vggtjax.pipeline.pretrained.embedded import demo_model
from vggtjax.progress import Progress
from vggtjax.storage.cache import cache_folder

logger = logging.getLogger(__name__)


def load_model(
    name_or_path: str | Path,
    *,
    config: VGGTConfig | None = None,
    dtype: LoadedDType | None = None,
    compute_dtype: str | None = None,
    progress: Progress | None = None,
) -> Model:
    """Load a model by path or name.

    PyTorch weights are converted once, into the folder that VGGTJAX_CACHE names, else into the user's cache; later
    calls load the conversion unless the source changed. On a CPU the parameters stay in the file, which is mapped into
    memory: the file may be replaced, but not written in place, while the model is in use.

    Args:
        name_or_path: "demo" (the small model in the package), a checkpoint of this library, PyTorch weights
            (.safetensors, index or folder of shards, .pt, .pth), or a hub id such as "facebook/VGGT-1B", at the commit
            that was its newest on the first use, unless it ends in "@" and another of 40 hexadecimal letters.
        config: the configuration of PyTorch weights; None for published ones. A checkpoint of this library contains its
            own. Weights that lack heads, as VGGT's trainer writes them, give a model without these heads.
        dtype: of the parameters; None for the types in the checkpoint, and float32 for PyTorch weights. "int8" rounds
            the kernels of the blocks to 8 bits as they are read: an approximation (docs/research-notes).
        compute_dtype: type in which the blocks will be computed: "bfloat16" reads what they multiply in bfloat16, with
            equal results there and half the memory.
        progress: called during a conversion with the number of steps done and the total.

    Raises:
        CheckpointError: the weights are missing, cannot be read, do not fit the configuration, or are not what the hub
            declared.
        MissingExtraError: the weights need torch or huggingface_hub, which is not installed.
    """
    model = load_weights(name_or_path, config=config, dtype=dtype, compute_dtype=compute_dtype, progress=progress)
    if config is not None and dataclasses.replace(config, heads=model.heads) != model.config:
        raise CheckpointError(f"{name_or_path} has another configuration than the argument config; omit config")
    return model


def load_weights(
    name_or_path: str | Path,
    *,
    config: VGGTConfig | None = None,
    dtype: LoadedDType | None = None,
    compute_dtype: str | None = None,
    progress: Progress | None = None,
) -> Model:
    """Load a model as `load_model` does, but accept a checkpoint of this library with another configuration."""
    if dtype is not None:
        check_choice("dtype", dtype, get_args(LoadedDType))
    if compute_dtype is not None:
        check_choice("compute_dtype", compute_dtype, get_args(ComputeDType))
    if not isinstance(name_or_path, str | os.PathLike):
        raise CheckpointError(
            f"the model is named by a {type(name_or_path).__name__}; expected a path or a name, such as 'demo'"
        )
    if str(name_or_path) == "demo":
        return demo_model(dtype or "float32", compute_dtype)
    weights = locate(name_or_path)
    path = weights.path
    if not is_checkpoint(path):
        stored = "float32" if dtype in (None, "int8") else dtype
        path = _converted(weights, config, stored, progress)
    return read_model(path, dtype=dtype, compute_dtype=compute_dtype)


def _converted(weights: Weights, config: VGGTConfig | None, dtype: DType, progress: Progress | None) -> Path:
    """Return the conversion of PyTorch weights in the cache; convert them if it is missing or damaged."""
    path = weights.path
    try:
        stats = [(file.resolve(), file.stat()) for file in weight_files(path)]
    except OSError as error:
        reason = f"{error.filename}: {error.strerror}; copy or download {path} again"
        raise CheckpointError(f"cannot read {reason}") from error
    sizes = (config or vggt_1b()).to_json()  # the file tells which published model it is
    facts = [VERSION, dtype, sizes, *(f"{file} {stat.st_size} {stat.st_mtime_ns}" for file, stat in stats)]
    key = hashlib.sha256("\n".join(facts).encode("utf-8", "surrogateescape")).hexdigest()[:16]
    destination = cache_folder() / f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', weights.name)[:80]}-{key}.safetensors"
    if not _is_whole(destination):
        convert_weights(weights, destination, dtype=dtype, config=config, with_its_heads=True, progress=progress)
        logger.info("converted %s to %s, once", path, destination)
    logger.info("loading %s", destination)
    return destination


def _is_whole(path: Path) -> bool:
    with suppress(CheckpointError):
        return is_checkpoint(path)
    return False
