"""A fitted rule of fusion in a file that `--fusion` takes: safetensors, with its origin in the header."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtjax.errors import CheckpointError, InputError
from vggtjax.method.assembly import FusionRule
from vggtjax.method.fusion.family import PARTS, FusionParams, projected, start
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.storage.json_values import parse_json
from vggtjax.storage.tensor_file import Spec, StoredTensor, read_tensors, write_tensors

logger = logging.getLogger(__name__)

FORMAT = "vggtjax fusion"
VERSION = 1


def save_fusion(path: str | Path, params: FusionParams, about: Mapping[str, Any] | None = None) -> None:
    """Write a tree with `about`, plain values that tell its origin; OutputError where the file cannot be written."""
    leaves = {name: np.asarray(leaf, np.float32) for name, leaf in _named(params).items()}
    write_tensors(
        path,
        {name: Spec(leaf.shape, leaf.dtype) for name, leaf in leaves.items()},
        lambda name: [np.atleast_1d(leaves[name])],
        {"format": FORMAT, "version": str(VERSION), "about": json.dumps(dict(about or {}))},
    )


def load_fusion(path: str | Path) -> FusionParams:
    """Read a tree; InputError if the file cannot be read, is not a tree of this family, or has values out of range."""
    tensors, _ = _read(path)
    wanted = _expected(any(name.startswith("gate.") for name in tensors))
    shapes = {name: stored.shape for name, stored in tensors.items()}
    if wrong := sorted(name for name in wanted.keys() | shapes.keys() if wanted.get(name) != shapes.get(name)):
        raise InputError(
            f"{path} has {wrong[0]} of shape {shapes.get(wrong[0])}; expected {wanted.get(wrong[0])}: fit it again"
        )
    leaves = {name: np.asarray(stored, np.float32) for name, stored in tensors.items()}
    if bad := sorted(name for name, leaf in leaves.items() if not np.isfinite(leaf).all()):
        raise InputError(f"{path} has values of {bad[0]} that are not finite; fit it again")
    params: FusionParams = {name: jnp.asarray(leaves[name]) for name in PARTS}
    for name, leaf in leaves.items():
        if name.startswith("gate."):
            _, layer, kind = name.split(".")
            params.setdefault("gate", {}).setdefault(layer, {})[kind] = jnp.asarray(leaf)
    for name, leaf in projected(params).items():
        if name in PARTS and not np.allclose(leaf, params[name]):
            part = PARTS[name]
            raise InputError(
                f"{path} has {name} {np.asarray(params[name]).tolist()}; expected values in [{part.low}, {part.high}]"
            )
    return params


def origin_of_fit(model: Model, options: Options) -> dict[str, Any]:
    """Return what a fit depends on that `warn_if_fitted_otherwise` compares, as JSON values."""
    digests = {"model_sha256": model.identity.sha256, "weights_sha256": _weights_digest(model)}
    return {
        "model": model.name,
        **digests,
        **options.passes_settings(model.config.motion),
        "align_scale": options.align_scale,
    }


def warn_if_fitted_otherwise(path: Path, model: Model, options: Options) -> None:
    """Log a warning for each of the model, the options of the passes and `align_scale` that differs from the fit's.

    Models are compared by the sha256 of the model or of its weights, whose type in memory does not count; not if the
    file has neither.
    """
    _, about = _read(path)
    settings: dict[str, Any] = options.passes_settings(model.config.motion) | {"align_scale": options.align_scale}
    settings, about = {"mask": "gram"} | settings, {"mask": "gram"} | about  # absent where it is the papers'
    digest = about.get("model_sha256")
    if isinstance(digest, str):
        digests = (digest, about.get("weights_sha256"))
        if model.identity.sha256 not in digests and _weights_digest(model) not in digests:
            about["model"] = f"{about.get('model')} (sha256 {digest[:8]})"
            settings["model"] = f"{model.name} (sha256 {model.identity.sha256[:8]})"
    for name, value in settings.items():
        if name in about and about[name] != value:
            logger.warning("%s was fitted with %s %s, and is used with %s", path, name, about[name], value)


def fusion_digest(fusion: FusionRule | None) -> str | None:
    """Return what tells a rule in the settings of a result: the digest of a tree's values, the name of a function."""
    if fusion is None:
        return None
    if callable(fusion):
        return f"function {getattr(getattr(fusion, 'func', fusion), '__qualname__', type(fusion).__name__)}"
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(fusion):
        digest.update(np.asarray(leaf, np.float32).tobytes())
    return digest.hexdigest()[:16]


def check_kept(fusion: FusionRule | None) -> None:
    """Raise InputError for a function where results are kept by their settings, which cannot tell functions apart."""
    if callable(fusion):
        raise InputError(
            "fusion is a function, and a later run could not tell whose results it keeps; expected a fitted rule "
            "(load_fusion), or call reconstruct for each clip"
        )


def _read(path: str | Path) -> tuple[Mapping[str, StoredTensor], dict[str, Any]]:
    """Return a file's tensors and its origin."""
    try:
        file = read_tensors(path)
    except CheckpointError as error:
        raise InputError(f"{error}; expected a file that vggtjax fit-fusion wrote") from None
    if file.metadata.get("format") != FORMAT or file.metadata.get("version") != str(VERSION):
        raise InputError(f"{path} is not a fitted fusion of version {VERSION}; expected what vggtjax fit-fusion wrote")
    return file.tensors, parse_json(file.metadata.get("about", "{}"), dict[str, Any], f"origin of the fusion {path}")


def _weights_digest(model: Model) -> str:
    """Return a digest of configuration and parameters in float32: equal if values are equal, whatever their type."""
    params = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model.widened().params)
    return dataclasses.replace(model, params=params).identity.sha256


def _named(params: FusionParams) -> dict[str, Any]:
    flat, _ = jax.tree_util.tree_flatten_with_path(params)
    return {".".join(entry.key for entry in path): leaf for path, leaf in flat}


def _expected(gate: bool) -> dict[str, tuple[int, ...]]:
    tree = jax.eval_shape(lambda: start(("gate",) if gate else ()))
    return {name: leaf.shape for name, leaf in _named(tree).items()}
