"""PyTorch weights -> parameter tree by the rule table, checked strictly: in memory, or file to file."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import count, groupby
from math import prod
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import ml_dtypes
import numpy as np
from flax.traverse_util import unflatten_dict

from converters.files import Tensor, read_state_dict, weight_files
from converters.foreign import refuse_foreign
from converters.locate import Weights, locate
from converters.published import published_config, shared_once
from converters.rules import IGNORED, Rule, Transform, rules
from converters.trained import SOURCES, USUAL, own_heads, own_names
from vggtjax.config import FAMILIES, VGGTConfig
from vggtjax.errors import CheckpointError, InputError, problems_sentence, reading
from vggtjax.network.checkpoint import DType, flat_shapes, numpy_dtype, write_checkpoint
from vggtjax.progress import Progress, no_progress
from vggtjax.storage.tensor_file import Spec

T = TypeVar("T")

_FLOATS = tuple(np.dtype(kind) for kind in (np.float32, ml_dtypes.bfloat16, np.float16, np.float64))
_DIGEST_BLOCK = 2**20  # bytes of a source file per step of progress


class Conversion(NamedTuple):
    """Outcome of a conversion."""

    path: Path  # of the checkpoint
    config: VGGTConfig
    tensors: int  # converted tensors of the source
    left_out: tuple[str, ...]  # names of the other tensors: of omitted heads, and of DINOv2's pre-training
    parameters: int
    bytes: int  # of the checkpoint
    dtype: str
    sha256: Mapping[str, str]  # of the source files, by name
    revision: str = ""  # commit on the hub; empty for other sources

    def summary(self) -> dict[str, Any]:
        """Return the conversion's facts for display, as plain values."""
        ignored = IGNORED[self.config.family].fullmatch
        heads = sorted({name.split(".")[0] for name in self.left_out if not ignored(name)})
        return {
            "wrote": str(self.path),
            "tensors": f"{self.tensors} converted, {len(self.left_out)} left out"
            + (f" ({', '.join(heads)})" if heads else ""),
            "parameters": self.parameters,
            "bytes": self.bytes,
            "dtype": self.dtype,
            "heads": list(self.config.heads),
            **({"revision": self.revision} if self.revision else {}),
            **{f"sha256 of {name}": digest for name, digest in self.sha256.items()},
        }


class Target(NamedTuple):
    """One array of the parameter tree and its source tensors: one, or one per layer of a stacked array."""

    shape: tuple[int, ...]
    transform: Transform
    sources: list[str]
    stacked: bool

    def parts(self, tensors: Mapping[str, Tensor]) -> Iterator[np.ndarray]:
        """Yield the target's parts, consecutive on axis 0, as views of the sources; one source is mapped at a time."""
        for source in self.sources:
            tensor = np.asarray(tensors[source])
            if lost := tensor.size - np.count_nonzero(np.isfinite(tensor)):
                raise CheckpointError(
                    f"{lost} of {tensor.size} values of {source} are not finite; get the weights again"
                )
            part = self.transform(tensor)
            yield part[None] if self.stacked else part


def convert_state_dict(state_dict: Mapping[str, np.ndarray], config: VGGTConfig) -> dict[str, Any]:
    """Return the parameter tree (nested dicts of numpy arrays) of a PyTorch state dict; types are kept.

    Raises CheckpointError, which lists unknown, missing, duplicate and mis-shaped keys, and types other than float;
    or names the other network of the state dict.
    """
    refuse_foreign("the state dict", state_dict)
    tensors = {name: np.asarray(value) for name, value in _own(state_dict, config, "the state dict").items()}
    targets = plan_conversion(tensors, config)
    flat = {path: np.concatenate(list(target.parts(tensors))) for path, target in targets.items()}
    return unflatten_dict(flat, sep=".")


def convert(
    source: str | Path,
    destination: str | Path,
    *,
    dtype: DType = "float32",
    config: VGGTConfig | None = None,
    heads: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Conversion:
    """Convert weights of a PyTorch model to a checkpoint of this library; memory holds one source tensor at a time.

    Args:
        source: a .safetensors file, the index or folder of shards, a .pt or .pth file, or a hub id, which may end in
            "@" and a commit of 40 hexadecimal letters.
        destination: the file to write; an existing file is replaced.
        dtype: of the parameters in the checkpoint.
        config: the model's configuration; None for that of a published model: VGGT-1B, or the Depth Anything 3 of the
            weights' width. Weights do not tell the numbers of attention heads.
        heads: names of the heads to convert, in any order; None for all heads of the configuration. The source may lack
            the other heads.
        progress: called with the number of steps done and the total: tensors, and hashed blocks of the source.

    Raises:
        CheckpointError: the source cannot be read, does not fit the configuration (the message counts the problems and
            lists the first ones), or belongs to another network.
        InputError: an unknown head, or the destination is the source.
        OutputError: the destination cannot be written.
        MissingExtraError: the source needs torch or huggingface_hub, which is not installed.
    """
    known = tuple(dict.fromkeys(name for family in FAMILIES.values() for name in family.heads))
    if unknown := [name for name in heads or () if name not in known]:  # before anything is downloaded
        raise InputError(f"heads has {unknown}; expected some of {known}")
    return convert_weights(locate(source), destination, dtype=dtype, config=config, heads=heads, progress=progress)


def convert_weights(
    weights: Weights,
    destination: str | Path,
    *,
    dtype: DType,
    config: VGGTConfig | None,
    heads: Sequence[str] | None = None,
    with_its_heads: bool = False,
    progress: Progress | None = None,
) -> Conversion:
    """Convert located weights as `convert` does; `with_its_heads`, the model has those heads alone that they have."""
    kind = numpy_dtype(dtype)
    destination = Path(destination).expanduser()
    files = weight_files(weights.path)
    for file in files:  # all of the shards
        if os.path.isfile(destination) and os.path.isfile(file) and os.path.samefile(destination, file):  # noqa: PTH113, PTH121
            raise InputError(f"the destination {destination} is the source; choose another name")
    tensors, problems = read_state_dict(weights.path)
    refuse_foreign(weights.name, tensors)
    config = config or published_config(tensors, weights)
    if heads is not None:
        if unknown := [name for name in heads if name not in config.heads]:
            raise InputError(f"heads has {unknown}; expected some of {config.heads}")
        config = dataclasses.replace(config, heads=tuple(name for name in config.heads if name in heads))
    tensors = _own(tensors, config, weights.name)
    if with_its_heads:
        config = own_heads(tensors, config, weights.name)
    targets = plan_conversion(tensors, config, problems)
    used = {source for target in targets.values() for source in target.sources}
    total = len(used) + sum(-(-file.stat().st_size // _DIGEST_BLOCK) for file in files)
    done = count(1)

    def advance() -> None:
        (progress or no_progress)(next(done), total)

    def parts(path: str) -> Iterator[np.ndarray]:
        for part in targets[path].parts(tensors):
            yield part
            advance()

    sha256 = {file.name: _digest(file, advance) for file in files}
    refuse_foreign(weights.name, sha256=sha256)
    specs = {path: Spec(target.shape, kind) for path, target in targets.items()}
    labels = {"name": weights.name, "origin": sha256, "revision": weights.revision}
    path = write_checkpoint(destination, specs, parts, config, **labels)
    return Conversion(
        path,
        config,
        tensors=len(used),
        left_out=tuple(name for name in tensors if name not in used),
        parameters=sum(prod(spec.shape) for spec in specs.values()),
        bytes=path.stat().st_size,
        dtype=dtype,
        sha256=sha256,
        revision=weights.revision,
    )


def _own(tensors: Mapping[str, T], config: VGGTConfig, source: str) -> Mapping[str, T]:
    """Return tensors by the network's own names; raises CheckpointError as `own_names`, and for another network's."""
    modules = {rule.source.partition(".")[0] for rule in rules(config)}
    own = own_names(tensors, modules, source, USUAL[config.family])
    if own is not tensors:
        refuse_foreign(source, own)
    return shared_once(own, source)


def plan_conversion(
    tensors: Mapping[str, Tensor], config: VGGTConfig, problems: Sequence[str] = ()
) -> dict[str, Target]:
    """Match every tensor with the rule table; return flat target name -> its sources.

    Only shapes and types of the tensors are read. Raises CheckpointError, which lists the `problems` of the reader and
    unknown, missing, duplicate and mis-shaped keys, as many as a message has room for.
    """
    shapes = flat_shapes(config)
    problems = list(problems)
    targets: dict[str, Target] = {}
    known, is_ignored = _keys_of_other_heads(config), IGNORED[config.family].fullmatch
    for path, keys in _expected(shapes, config).items():
        sources = []
        for key in keys:
            known |= set(key.names)
            names = [name for name in key.names if name in tensors]
            if not names:
                problems.append(f"missing key {key.names[0]}")
            elif len(names) > 1:
                problems.append(f"duplicate keys {' and '.join(names)}: one parameter under two names")
            for name in names:
                if tensors[name].shape != key.shape:
                    problems.append(f"mis-shaped key {name}: {list(tensors[name].shape)}, expected {list(key.shape)}")
                if tensors[name].dtype not in _FLOATS:
                    problems.append(f"key {name} has type {tensors[name].dtype}, expected floating point")
            sources += names
        rule = _table(config)[path][0]
        targets[path] = Target(shapes[path], rule.transform, sources, rule.stacked)
    problems += [f"unknown key {name}" for name in tensors if name not in known and not is_ignored(name)]
    if problems:
        subject = f"the checkpoint does not fit the configuration{_hint(tensors, config)}"
        raise CheckpointError(problems_sentence(subject, problems))
    return targets


def source_shapes(config: VGGTConfig) -> dict[str, tuple[int, ...]]:
    """Return name -> shape of the tensors in a published state dict, without the ignored ones."""
    expected = (key for keys in _expected(flat_shapes(config), config).values() for key in keys)
    return {key.names[0]: key.shape for key in expected}


def _keys_of_other_heads(config: VGGTConfig) -> set[str]:
    """Return the source names of the heads that the model lacks."""
    whole = flat_shapes(dataclasses.replace(config, heads=config.row.heads))
    absent = {path: shape for path, shape in whole.items() if path not in flat_shapes(config)}
    return {name for keys in _expected(absent, config).values() for key in keys for name in key.names}


def _hint(tensors: Mapping[str, Tensor], config: VGGTConfig) -> str:
    """Return advice if the source is of another width or lacks whole heads, else an empty text."""
    token = tensors.get("aggregator.camera_token", tensors.get("backbone.pretrained.camera_token"))
    if token is not None and token.shape and token.shape[-1] != config.embed_dim:
        widths = f"embed_dim is {token.shape[-1]} in it and {config.embed_dim} in the configuration"
        return f" ({widths}: give its own by --config FILE.json)"
    modules = {name.split(".")[0] for name in tensors}
    expected = dict.fromkeys(SOURCES[config.family][head] for head in config.heads)
    absent = [name for name in expected if name not in modules]
    if not modules & set(expected) or not absent:
        return ""
    return f" (it has no {', '.join(absent)}: omit these heads by --heads of vggtjax convert)"


def _digest(file: Path, advance: Callable[[], None]) -> str:
    digest = hashlib.sha256()
    with reading(file, CheckpointError), file.open("rb") as opened:
        while block := opened.read(_DIGEST_BLOCK):
            digest.update(block)
            advance()
    return digest.hexdigest()


class _Key(NamedTuple):
    """One source tensor: possible names, and shape."""

    names: list[str]
    shape: tuple[int, ...]


@lru_cache(maxsize=8)
def _table(config: VGGTConfig) -> Mapping[str, list[Rule]]:
    """Return target path -> its rules."""
    by_path = attrgetter("path")
    return {path: list(group) for path, group in groupby(sorted(rules(config), key=by_path), by_path)}


def _expected(shapes: Mapping[str, tuple[int, ...]], config: VGGTConfig) -> dict[str, list[_Key]]:
    """Return target path -> source tensors, in order of layers."""
    expected = {}
    for path, shape in shapes.items():
        aliases = _table(config)[path]
        layers, part = (range(shape[0]), shape[1:]) if aliases[0].stacked else (range(1), shape)
        source_shape = aliases[0].transform.source_shape(part)
        expected[path] = [_Key([rule.name(layer) for rule in aliases], source_shape) for layer in layers]
    return expected
