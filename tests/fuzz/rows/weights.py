"""Rows of weights, and of what goes with them: configurations, recipes, checkpoints of a run, the hub."""

from __future__ import annotations

import json
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from converters.files import read_state_dict
from tests.fuzz.cases import Reader
from tests.fuzz.rows.foreign import file, made
from tests.shared.dataset_files import write
from tests.shared.tiny import tiny_config
from vggtjax.config import VGGTConfig
from vggtjax.method.fusion.family import start
from vggtjax.method.fusion.file import load_fusion, save_fusion
from vggtjax.network.checkpoint import flat_shapes, read_model, write_checkpoint
from vggtjax.storage.json_values import read_json
from vggtjax.storage.tensor_file import Spec, write_tensors
from vggtjax.training.checkpoints import restore, save
from vggtjax.training.recipe import read_recipe
from vggtjax.training.state import TrainingState

_RECIPE = Path(__file__).parents[3] / "docs/recipes/smoke.json"


def _weights(path: Path) -> None:
    for tensor in read_state_dict(path).tensors.values():
        np.array(tensor)


def _tensors(path: Path) -> Path:
    specs = {"a.weight": Spec((4, 6), np.dtype(np.float32)), "b.bias": Spec((3,), np.dtype(np.float16))}
    write_tensors(path, specs, lambda name: [np.ones(specs[name].shape)], {"format": "pt"})
    return path


def _shards(folder: Path) -> Path:
    for number in (1, 2):
        spec = {f"tensor{number}": Spec((4,), np.dtype(np.float32))}
        write_tensors(folder / f"model-{number}-of-2.safetensors", spec, lambda _: [np.ones(4)])
    names = {f"tensor{number}": f"model-{number}-of-2.safetensors" for number in (1, 2)}
    content = {"metadata": {"total_size": 32}, "weight_map": names}
    return write(folder / "model.safetensors.index.json", json.dumps(content))


def _torch_file(folder: Path, **options: Any) -> Path:
    import torch

    state = {"a.weight": torch.ones(4, 6), "b.bias": torch.ones(3, dtype=torch.bfloat16)}
    torch.save({"model": state, "step": 3}, folder / "model.pt", **options)
    return folder / "model.pt"


def _checkpoint(folder: Path) -> Path:
    config = tiny_config(depth=4, track_features=8, track_hidden=16)
    specs = {name: Spec(shape, np.dtype(np.float32)) for name, shape in flat_shapes(config).items()}
    zeros = {name: np.zeros(spec.shape, np.float32) for name, spec in specs.items()}
    labels: dict[str, Any] = {"name": "tiny", "note": "a note", "untrained_heads": ("tracks",)}
    labels["origin"] = {"model.pt": "0" * 64}
    return write_checkpoint(folder / "tiny.safetensors", specs, lambda name: [zeros[name]], config, **labels)


def _fusion(folder: Path) -> Path:
    save_fusion(folder / "rule.safetensors", start(()), {"model": "demo", "mask_pairs": 5})
    return folder / "rule.safetensors"


@cache
def _state() -> Any:
    """Return the state of a run whose model has one array."""
    kernel = {"kernel": jnp.ones((4, 3))}
    probes = {"mean": {"bias": jnp.zeros(3)}}
    moments = (jnp.int32(3), {"mu": kernel})
    return TrainingState(jnp.int32(3), {"model": kernel, "probes": probes}, kernel, moments, jnp.int32(0))


ROWS = (
    Reader("safetensors", lambda folder: _tensors(folder / "model.safetensors"), _weights),
    Reader("shards with an index", _shards, _weights),
    Reader("torch file", _torch_file, _weights),
    Reader("torch file before 1.6", partial(_torch_file, _use_new_zipfile_serialization=False), _weights),
    Reader("checkpoint", _checkpoint, read_model),
    Reader(
        "config",
        file("config.json", tiny_config().to_json()),
        lambda path: read_json(path, VGGTConfig, "configuration"),
    ),
    Reader("recipe", file("recipe.json", _RECIPE.read_bytes()), read_recipe),
    Reader("fusion file", _fusion, load_fusion),
    Reader(
        "training checkpoint",
        made(lambda path: save(path, _state(), read_recipe(_RECIPE), {"seconds": 0.5}), "checkpoints"),
        lambda path: restore(path, jax.eval_shape(_state), read_recipe(_RECIPE)),
    ),
)
