"""A model by its path or name; PyTorch weights are converted once and kept."""

from __future__ import annotations

import hashlib
import logging
import re
from pathlib import Path

from converters.files import weight_files
from converters.locate import Weights, locate
from converters.torch_to_flax import convert_weights
from vggtjax.checkpoint import VERSION, DType, Model, is_checkpoint, numpy_dtype, read_model
from vggtjax.config import VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError
from vggtjax.pretrained.embedded import demo_model
from vggtjax.progress import Progress
from vggtjax.storage.cache import cache_folder

logger = logging.getLogger(__name__)


def load_model(
    name_or_path: str | Path,
    *,
    config: VGGTConfig | None = None,
    dtype: DType | None = None,
    progress: Progress | None = None,
) -> Model:
    """Load a model by path or name.

    PyTorch weights are converted once, into the folder that VGGTJAX_CACHE names or else the user's cache; after that
    the conversion is loaded, as long as the source does not change. On a CPU the parameters stay in the file, which is
    mapped into memory: replace it, but never write into it, while the model is in use.

    Args:
        name_or_path: "demo" (the small model in the package), a file of this library, PyTorch weights (.safetensors, a
            sharded one's index or folder, .pt, .pth), or a hub id such as "facebook/VGGT-1B".
        config: the configuration of PyTorch weights; None for VGGT-1B. A file of this library knows its own.
        dtype: of the parameters; None keeps the file's, and makes float32 of PyTorch weights.
        progress: called during a conversion with the steps done and their number.

    Raises:
        CheckpointError: nothing is there, or it cannot be read, or does not fit the configuration.
        MissingExtraError: the weights need torch or huggingface_hub, which is not installed.
    """
    model = load_weights(name_or_path, config=config, dtype=dtype, progress=progress)
    if config not in (None, model.config):
        raise CheckpointError(f"{name_or_path} knows its configuration, and it is not the one given; leave that out")
    return model


def load_weights(
    name_or_path: str | Path,
    *,
    config: VGGTConfig | None = None,
    dtype: DType | None = None,
    progress: Progress | None = None,
) -> Model:
    """Load a model as `load_model`, but let a file of this library have another configuration than `config`."""
    if dtype is not None:
        numpy_dtype(dtype)
    if str(name_or_path) == "demo":
        return demo_model(dtype or "float32")
    weights = locate(name_or_path)
    path = weights.path
    if not is_checkpoint(path):
        path = _converted(path, weights.name, config or vggt_1b(), dtype or "float32", progress)
    return read_model(path, dtype=dtype)


def _converted(path: Path, name: str, config: VGGTConfig, dtype: DType, progress: Progress | None) -> Path:
    """Return the conversion of PyTorch weights in the cache, made now if it is not there."""
    stats = [(file.resolve(), file.stat()) for file in weight_files(path)]
    facts = [VERSION, dtype, config.to_json(), *(f"{file} {stat.st_size} {stat.st_mtime_ns}" for file, stat in stats)]
    key = hashlib.sha256("\n".join(facts).encode("utf-8", "surrogateescape")).hexdigest()[:16]
    destination = cache_folder() / f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', name)[:80]}-{key}.safetensors"
    if not destination.exists():
        logger.info("converting %s to %s, this once", path, destination)
        convert_weights(Weights(path, name), destination, dtype=dtype, config=config, progress=progress)
    logger.info("loading %s", destination)
    return destination
