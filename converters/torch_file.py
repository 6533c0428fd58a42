"""State dicts of torch files, read without running pickled code."""

from __future__ import annotations

import logging
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from vggtjax.errors import CheckpointError, MissingExtraError, one_line

_WRAPPERS = ("model", "state_dict")  # keys of the weights in training checkpoints
_MOST_LEVELS = 3  # of mappings around the weights
_REFUSED = re.compile(r"GLOBAL ([\w.]{1,100})")  # in torch's words on a class that it does not read

logger = logging.getLogger(__name__)


def read_torch(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the tensors of a torch file, mapped into memory if the format permits, and the problems of its entries.

    Raises CheckpointError if the file is damaged, contains code, or holds no state dict; MissingExtraError unless torch
    is installed.
    """
    state_dict = _weights(_load(path), path)
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


def _weights(content: Any, path: Path) -> Any:
    """Return the mapping of tensors within the mappings of a training checkpoint: its `model`, or the only one.

    What else holds weights, such as a moving average, is named. Raises CheckpointError where that leaves a choice.
    """
    for _ in range(_MOST_LEVELS):
        if not isinstance(content, Mapping):
            return content
        wrappers = [key for key in _WRAPPERS if isinstance(content.get(key), Mapping)][:1]
        if not wrappers and _holds_tensors(content):
            return content
        held = [key for key, value in content.items() if isinstance(value, Mapping) and _holds_weights(value)]
        chosen = wrappers or held
        if not chosen:
            return content
        if len(chosen) > 1:
            names = ", ".join(one_line(str(key), 40) for key in chosen)
            raise CheckpointError(f"{path} holds weights in {names}; save one of them alone")
        (key,) = chosen
        if others := [one_line(str(other), 40) for other in held if other != key]:
            logger.warning("%s: weights are read from %r; those in %s are not", path, key, ", ".join(others))
        elif key not in _WRAPPERS:
            logger.warning("%s: weights are read from %s", path, one_line(repr(key), 40))
        content = content[key]
    return content


def _holds_tensors(content: Mapping[Any, Any]) -> bool:
    import torch

    return any(isinstance(value, torch.Tensor) and value.ndim > 0 for value in content.values())


def _holds_weights(content: Mapping[Any, Any], levels: int = _MOST_LEVELS) -> bool:
    """Return whether a mapping has tensors by names; an optimiser's are by number."""
    if any(isinstance(key, str) for key in content) and _holds_tensors(content):
        return any(isinstance(key, str) and "." in key for key in content)
    inner = [value for value in content.values() if isinstance(value, Mapping)]
    return levels > 1 and any(_holds_weights(value, levels - 1) for value in inner)


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
        refused = _REFUSED.search(str(error))
        held = f"an object of {refused[1]}: Python objects" if refused else "Python objects"
        raise CheckpointError(
            f"{path} is damaged, or holds {held} that could run code, and is not opened; save the state dict "
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
