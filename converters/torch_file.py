"""State dicts of torch files, read without running pickled code."""

from __future__ import annotations

import logging
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from vggtjax.errors import CheckpointError, MissingExtraError, one_line

_WRAPPERS = ("model", "state_dict")  # keys of the weights in training checkpoints

logger = logging.getLogger(__name__)


def read_torch(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the tensors of a torch file, mapped into memory if the format permits, and the problems of its entries.

    Raises CheckpointError if the file is damaged, contains code, or holds no state dict; MissingExtraError unless torch
    is installed.
    """
    state_dict = _load(path)
    for _ in _WRAPPERS:  # one may be inside the other
        wrapped = (state_dict.get(key) for key in _WRAPPERS if isinstance(state_dict, Mapping))
        state_dict = next((value for value in wrapped if isinstance(value, Mapping)), state_dict)
    if not isinstance(state_dict, Mapping) or not state_dict:
        raise CheckpointError(
            f"{path} holds a {type(state_dict).__name__}; expected a state dict, alone or as 'model' or 'state_dict'"
        )
    tensors: dict[str, np.ndarray] = {}
    problems = []
    for name, value in state_dict.items():
        array = _array(value)
        if isinstance(name, str) and array is not None:
            tensors[name] = array
        else:
            kind = getattr(value, "dtype", type(value).__name__)
            problems.append(f"entry {name!r} is not a dense tensor of a known type ({kind})")
    return tensors, problems


def _load(path: Path) -> Any:
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(f"reading the torch file {path}", "convert") from error

    if path.suffix == ".safetensors":  # torch chooses the format by the name
        raise CheckpointError(f"{path} is a torch file by its content; rename it to .pt")
    with path.open("rb") as file:
        mapped = file.read(4) == b"PK\x03\x04"
    if not mapped:
        logger.warning("%s has the format of torch before 1.6: the whole file is read into memory", path)
    try:
        if mapped:  # a memory map of compressed entries would show compressed bytes, and the contents can be huge
            with zipfile.ZipFile(path) as archive:
                compressed = any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist())
            if compressed:
                raise CheckpointError(f"{path} is a compressed archive; expected a torch file as torch.save writes it")
        with warnings.catch_warnings():  # about pickles of other programs, which are refused below
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} is damaged, or holds Python objects that could run code, and is not opened; save the state dict "
            "alone, preferably as .safetensors"
        ) from error
    except CheckpointError:
        raise
    except Exception as error:  # the unpickler raises any exception for a damaged stream
        reason = one_line(str(error).strip().split("\n")[0]) or type(error).__name__
        raise CheckpointError(f"{path} is not a whole torch file ({reason}); copy or download it again") from error


def _array(value: Any) -> np.ndarray | None:
    """Return a tensor's values without a copy; None for other values."""
    import torch

    if not isinstance(value, torch.Tensor):
        return None
    try:
        if value.dtype == torch.bfloat16:  # unknown to numpy
            return value.detach().view(torch.int16).numpy().view(ml_dtypes.bfloat16)
        return value.detach().numpy()
    except (TypeError, RuntimeError):  # sparse, quantised, float8, without data
        return None
