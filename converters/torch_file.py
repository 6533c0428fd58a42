"""State dicts of torch files, without running code that may be in them."""

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

from vggtjax.errors import CheckpointError, MissingExtraError

_WRAPPERS = ("model", "state_dict")  # what trainers call the weights beside their own state

logger = logging.getLogger(__name__)


def read_torch(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the tensors of a torch file, mapped into memory where its format allows, and what else is among them.

    Raises:
        CheckpointError: the file is damaged, would run code, or holds no state dict.
        MissingExtraError: torch is not installed.
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

    if path.suffix == ".safetensors":  # torch goes by the name
        raise CheckpointError(f"{path} is a torch file by its content; rename it to .pt")
    with path.open("rb") as file:
        mapped = file.read(4) == b"PK\x03\x04"
    if not mapped:
        logger.warning("%s is of torch's old format, before 1.6: all of it is read into memory", path)
    try:
        if mapped:
            _check_archive(path)
        with warnings.catch_warnings():  # about pickles of other programs, which are about to be refused
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} is damaged, or holds Python objects that could run code and is not opened for that reason; "
            "save the state dict alone, best as .safetensors"
        ) from error
    except CheckpointError:
        raise
    except Exception as error:  # a damaged stream makes the unpickler raise anything
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise CheckpointError(f"{path} is not a whole torch file ({reason}); copy or download it again") from error


def _check_archive(path: Path) -> None:
    """Refuse compressed entries: they would be mapped as they are, and can be vast."""
    with zipfile.ZipFile(path) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise CheckpointError(f"{path} is a compressed archive; expected a torch file as torch.save writes it")


def _array(value: Any) -> np.ndarray | None:
    """Return a tensor's values without a copy, or None for anything else."""
    import torch

    if not isinstance(value, torch.Tensor):
        return None
    try:
        if value.dtype == torch.bfloat16:  # unknown to numpy
            return value.detach().view(torch.int16).numpy().view(ml_dtypes.bfloat16)
        return value.detach().numpy()
    except (TypeError, RuntimeError):  # sparse, quantised, float8, without data
        return None
