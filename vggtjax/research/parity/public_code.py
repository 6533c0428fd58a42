"""The networks of the public PyTorch code, from a checkout, with weights of a file. Needs torch, imports no jax."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from converters.files import read_state_dict, weight_files
from converters.rules import IGNORED, rules
from converters.trained import SOURCES, own_names
from vggtjax.config import VGGT_HEADS, MotionConfig, VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError, problems_sentence
from vggtjax.storage.tensor_file import is_tensor_file

MODELS = {  # package of the checkout -> module, class of the network, its aggregator
    "vggt": ("vggt.models.vggt", "VGGT", "Aggregator"),
    "vggt4d": ("vggt4d.models.vggt4d", "VGGTFor4D", "AggregatorFor4D"),
}


def add_checkout(checkout: Path) -> None:
    """Let this process import the packages of a checkout: their code runs here."""
    sys.path.insert(0, str(checkout))


def build(package: str, config: VGGTConfig) -> Any:
    """Return a network of the public code, without weights and without the heads that the configuration lacks.

    Its constructor makes VGGT-1B; networks of other sizes are put together from its parts.
    """
    module, name, _ = MODELS[package]
    public = importlib.import_module(module)
    whole = replace(config, heads=VGGT_HEADS, motion=MotionConfig())
    with ExitStack() as stack:
        if whole != vggt_1b():
            stack.enter_context(_sizes(package, config))
        model = getattr(public, name)()
    for head in VGGT_HEADS:
        if head not in config.heads:
            setattr(model, SOURCES["vggt"][head], None)
    return model.eval()


def read_weights(path: Path, name: str) -> dict[str, Any]:
    """Return the float32 tensors of a PyTorch file by VGGT's own names. No pickled code runs."""
    import torch

    if is_tensor_file(weight_files(path)[-1]):  # by the reader of safetensors, which shares no line with ours
        from safetensors.torch import load_file

        files = weight_files(path)[1:] or [path]
        tensors = {key: tensor for file in files for key, tensor in load_file(file).items()}
    else:
        arrays = read_state_dict(path).tensors
        tensors = {key: torch.from_numpy(np.asarray(a).astype(np.float32, copy=False)) for key, a in arrays.items()}
    modules = {rule.source.partition(".")[0] for rule in rules(vggt_1b())}
    return {key: tensor.float() for key, tensor in own_names(tensors, modules, name).items()}


def give_weights(model: Any, tensors: dict[str, Any]) -> None:
    """Put weights into a network in place of its own; raises CheckpointError where names or shapes do not fit.

    Weights of heads that the network lacks are left out.
    """
    lacking = [SOURCES["vggt"][head] for head in VGGT_HEADS if getattr(model, SOURCES["vggt"][head], None) is None]
    used = {name: tensor for name, tensor in tensors.items() if name.partition(".")[0] not in lacking}
    try:
        missing, unknown = model.load_state_dict(used, strict=False, assign=True)
    except RuntimeError as error:  # shapes
        raise CheckpointError(f"the weights do not fit the public code: {error}") from error
    problems = [f"missing key {name}" for name in sorted(missing) if not IGNORED["vggt"].fullmatch(name)]
    if problems := problems + [f"unknown key {name}" for name in unknown]:
        raise CheckpointError(problems_sentence("the weights do not fit the public code", problems))


@contextmanager
def _sizes(package: str, config: VGGTConfig) -> Iterator[None]:
    """Let the constructor of the public network make one of these sizes."""
    from vggt.heads import track_head  # pyright: ignore[reportMissingImports]: of the checkout
    from vggt.layers import vision_transformer  # pyright: ignore[reportMissingImports]
    from vggt.models import aggregator  # pyright: ignore[reportMissingImports]

    module, _, aggregator_name = MODELS[package]
    public = importlib.import_module(module)
    width = {"dim_in": config.tap_dim}
    channels = {"out_channels": list(config.dpt_channels)}
    sides = {"img_size": config.image_size, "patch_size": config.patch_size, "embed_dim": config.embed_dim}
    taps = {"intermediate_layer_idx": list(config.taps)}
    patch = {"patch_size": config.patch_size}
    tracks = {"features": config.track_features, "hidden_size": config.track_hidden}
    levels = {"corr_levels": config.track_corr_levels, "corr_radius": config.track_corr_radius}
    backbone = {
        "embed_dim": config.embed_dim,
        "depth": config.dino_depth,
        "num_heads": config.dino_num_heads,
        "block_fn": partial(vision_transformer.Block, attn_class=vision_transformer.MemEffAttention),
    }
    vit = partial(vision_transformer.DinoVisionTransformer, **backbone)
    changes: list[tuple[Any, str, dict[str, Any]]] = [
        (public, aggregator_name, sides | {"depth": config.depth, "num_heads": config.num_heads}),
        (public, "CameraHead", width | {"trunk_depth": config.camera_depth, "num_heads": config.camera_num_heads}),
        (public, "DPTHead", width | channels | taps | patch | {"features": config.dpt_features}),
        (track_head, "DPTHead", channels | taps),
        (public, "TrackHead", width | patch | tracks | levels),
    ]
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(aggregator, "vit_large", vit))
        for owner, name, sizes in changes:
            part = getattr(owner, name)
            made = lambda part=part, sizes=sizes, **given: part(**{**given, **sizes})  # noqa: E731
            stack.enter_context(mock.patch.object(owner, name, made))
        yield
