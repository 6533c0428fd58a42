"""Models on disk: one safetensors file with flat Flax names; configuration, name and note are in its metadata."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NoReturn

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from msgspec import Meta

from vggtjax.config import VGGTConfig
from vggtjax.errors import CheckpointError, InputError, check_choice, problems_sentence
from vggtjax.network.kernels.narrow import is_multiplied
from vggtjax.network.kernels.quantised import Halves, Quantised, halves, is_quantised, is_stored, quantise
from vggtjax.network.layers import Params
from vggtjax.network.model import parameter_shapes
from vggtjax.storage.backend import backend
from vggtjax.storage.file_digest import FileFacts, content_digest, file_facts
from vggtjax.storage.json_values import parse_json
from vggtjax.storage.kept_text import kept_text
from vggtjax.storage.tensor_file import Spec, is_tensor_file, read_tensors, write_tensors

DType = Literal["float32", "bfloat16"]
LoadedDType = Literal["float32", "bfloat16", "int8"]

FORMAT = "vggtjax"
VERSION = "1"

_DTYPES = {name: np.dtype(jax.numpy.dtype(name)) for name in ("float32", "bfloat16")}
_MOST_METADATA_LETTERS = 2**16
_MOST_NAME_LETTERS = 200

Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
_COMMIT = re.compile("[0-9a-f]{40}")


@dataclass(frozen=True)
class ModelIdentity:
    """Name and digest of a model: two models of equal identity compute equal results."""

    name: str
    sha256: str  # of the file, if the model is unchanged since reading; else of configuration and parameters

    def to_json(self) -> dict[str, str]:
        """Return the identity as plain values, for the settings and records of results."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, eq=False)
class Model:
    """A network ready to run."""

    config: VGGTConfig
    params: Params = field(repr=False)  # nested dicts of arrays with Flax names, layers stacked on axis 0
    name: str = ""
    path: Path | None = None  # file of the parameters
    origin: Mapping[str, str] = field(default_factory=dict)  # names of the source files of a conversion -> sha256
    revision: str = ""  # commit of the source files on the hub; empty if they are not from there
    untrained_heads: tuple[str, ...] = ()  # heads with random parameters
    note: str = ""  # for users of the model; part of the settings of its results
    _file: FileFacts | None = field(default=None, init=False, repr=False)  # `dataclasses.replace` forgets both
    _wide: Callable[[], Model] | None = field(default=None, init=False, repr=False)

    @cached_property
    def identity(self) -> ModelIdentity:
        """Name and digest of the model; the first use reads all parameters, or their file."""
        in_file = self._file is not None and self._file == file_facts(self._file.path)
        return ModelIdentity(self.name, content_digest(self._file) if in_file else _params_digest(self.widened()))

    def widened(self) -> Model:
        """Return the model as it is without weights in the type of the products: on the host, read again."""
        if self._wide is None:
            return self
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            return self._wide()

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        leaves = jax.tree.leaves(self.params, is_leaf=is_stored)
        return sum((leaf[0] if is_stored(leaf) else leaf).size for leaf in leaves)

    @property
    def parameter_bytes(self) -> int:
        """Bytes of all parameters."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self.params))

    @property
    def dtype(self) -> str:
        """Type of most parameters."""
        sizes = Counter[str]()
        for leaf in jax.tree.leaves(self.params, is_leaf=lambda leaf: isinstance(leaf, Halves)):
            values = leaf.bits if isinstance(leaf, Halves) else leaf
            sizes["bfloat16" if isinstance(leaf, Halves) else str(values.dtype)] += values.size
        return sizes.most_common(1)[0][0]

    @property
    def warning(self) -> str:
        """The note as a sentence; empty without a note."""
        return f"The model {self.name} is a {self.note}." if self.note else ""

    @property
    def heads(self) -> tuple[str, ...]:
        """Names of the model's heads."""
        return self.config.heads

    def __getitem__(self, name: str) -> NoReturn:
        """Raise InputError: functions of parameters that are given a Model in their place end here."""
        raise InputError(
            "a Model is given in place of its parameters; give model.params, and model.config as config "
            "(infer and reconstruct take the Model itself)"
        )

    def summary(self) -> dict[str, Any]:
        """Return the model's facts for display, as plain values."""
        return {
            "name": self.name,
            "path": None if self.path is None else str(self.path),
            **({"note": self.note} if self.note else {}),
            "parameters": self.parameter_count,
            "bytes": self.parameter_bytes,
            "dtype": self.dtype,
            "heads": [f"{head} (untrained)" if head in self.untrained_heads else head for head in self.heads],
            **({"revision": self.revision} if self.revision else {}),
            **{f"sha256 of {file}": digest for file, digest in self.origin.items()},
            "family": self.config.family,
            "pairs": self.config.depth,
            **{size: getattr(self.config, size) for size in ("embed_dim", "num_heads", "image_size", "patch_size")},
        }


def is_checkpoint(path: str | Path) -> bool:
    """Return whether a file is a checkpoint of this library, by its content."""
    return is_tensor_file(path) and read_tensors(path).metadata.get("format") == FORMAT


def checkpoint_config(path: str | Path) -> VGGTConfig:
    """Return the configuration of a checkpoint of this library without its parameters; raises CheckpointError."""
    return _read_metadata(Path(path), read_tensors(path).metadata)[0]


def read_model(
    path: str | Path, *, dtype: LoadedDType | None = None, compute_dtype: str | None = None, **fields: Any
) -> Model:
    """Read a checkpoint of this library.

    Args:
        path: the file.
        dtype: of the parameters; None for the types in the file. "int8" rounds the kernels of the blocks to 8 bits and
            leaves the others as they are in the file: an approximation.
        compute_dtype: of the blocks; "bfloat16" reads what they multiply in it: equal results, half the memory. On a
            CPU kernels are `Halves`, by which there is no gradient.
        fields: fields of `Model` in place of those in the file: name, note, untrained_heads.

    Raises CheckpointError, which counts the problems and lists the first ones, unless the file is a whole checkpoint of
    this library that fits its own configuration.
    """
    path, platform = Path(path), backend()
    facts = file_facts(path)
    tensors, metadata = read_tensors(path)
    config, stored_fields = _read_metadata(path, metadata)
    check_parameters(f"{path} does not fit its own configuration", tensors, config)
    content = np.asarray(np.memmap(path, np.uint8, mode="r"))
    flat: dict[str, Any] = {}
    is_as_stored = dtype != "int8"
    for key, stored in tensors.items():
        is_narrowed = compute_dtype == "bfloat16" and is_multiplied(key)
        # What is read in another type is mapped by itself: its pages leave the memory with it.
        in_eight_bits = dtype == "int8" and is_quantised(key)
        is_other = in_eight_bits or (dtype not in (None, "int8") and numpy_dtype(dtype) != stored.dtype)
        tensor = np.asarray(stored) if is_narrowed or is_other else stored.within(content)
        if in_eight_bits:
            flat[key] = jax.block_until_ready(quantise(tensor))
            continue
        if dtype not in (None, "int8"):
            tensor = tensor.astype(numpy_dtype(dtype), copy=False)
        is_as_stored &= tensor.dtype == stored.dtype
        if is_narrowed:
            tensor = tensor.astype(numpy_dtype("bfloat16"), copy=False)
            if key.endswith(".kernel") and platform == "cpu":
                flat[key] = jax.block_until_ready(halves(tensor))
                continue
        flat[key] = jax.device_put(tensor).block_until_ready()  # on a CPU, a view of the file if aligned
    model = Model(config, unflatten_dict(flat, sep="."), path=path, **(stored_fields | fields))
    if is_as_stored:
        object.__setattr__(model, "_file", facts)
    if compute_dtype == "bfloat16":
        object.__setattr__(model, "_wide", partial(read_model, path, dtype=dtype, **fields))
    return model


def check_finite(model: Model) -> None:
    """Raise CheckpointError, which names the first parameter that is not finite; reads all of them."""
    flat: dict[str, Any] = flatten_dict(model.params, sep=".")
    parts = ((path, part) for path, leaf in flat.items() for part in jax.tree.leaves(_whole(leaf)))
    for path, part in parts:
        values = np.asarray(part).astype(np.float32, copy=False)
        if lost := values.size - np.count_nonzero(np.isfinite(values)):
            raise CheckpointError(
                f"{lost} of {values.size} values of {path} of the model {model.name} are not finite; get it again"
            )


def _whole(leaf: Any) -> Any:
    return np.asarray(leaf.bits).view(numpy_dtype("bfloat16")) if isinstance(leaf, Halves) else leaf


def save_model(path: str | Path, params: Params, config: VGGTConfig, **labels: Any) -> Path:
    """Write parameters, nested dicts of float32 or bfloat16 arrays, as a checkpoint of this library; return its path.

    An existing file is replaced. `labels` are `name`, `note` and `untrained_heads` of `write_checkpoint`. Raises
    CheckpointError, which counts the problems and lists the first ones, if the parameters do not fit the configuration,
    and OutputError if the file cannot be written.
    """
    flat: dict[str, Any] = {name: _whole(leaf) for name, leaf in flatten_dict(params, sep=".").items()}
    if any(isinstance(leaf, Quantised) for leaf in flat.values()):
        raise CheckpointError("the parameters are int8; expected float32 or bfloat16: save the model as it was before")
    check_parameters("the parameters do not fit the configuration", flat, config)
    specs = {key: Spec(leaf.shape, leaf.dtype) for key, leaf in flat.items()}
    return write_checkpoint(path, specs, lambda key: [np.asarray(flat[key])], config, **labels)


def write_checkpoint(
    path: str | Path,
    specs: Mapping[str, Spec],
    pieces: Callable[[str], Iterable[np.ndarray]],
    config: VGGTConfig,
    *,
    name: str | None = None,
    note: str = "",
    untrained_heads: Sequence[str] = (),
    origin: Mapping[str, str] | None = None,
    revision: str = "",
) -> Path:
    """Write a checkpoint of this library piece by piece, as `write_tensors` does; return its path.

    Without `name` the model is named after the file. `note` and `untrained_heads` are those of `Model`; `origin` gives
    the names and sha256 of the source files of a conversion, `revision` their commit on the hub.
    """
    path = Path(path)
    _check_labels(path, note, untrained_heads, config)
    metadata = {"format": FORMAT, "version": VERSION, "config": config.to_json(), "name": name or path.stem}
    metadata |= {"note": note} if note else {}
    metadata |= {"untrained": json.dumps(list(untrained_heads))} if untrained_heads else {}
    metadata |= {"origin": json.dumps(origin)} if origin else {}
    metadata |= {"revision": revision} if revision else {}
    write_tensors(path, specs, pieces, metadata)
    return path


@lru_cache(maxsize=8)
def flat_shapes(config: VGGTConfig) -> Mapping[str, tuple[int, ...]]:
    """Return flat dotted name -> shape of a model's parameters."""

    def shapes_text() -> str:
        flat: dict[str, Any] = flatten_dict(parameter_shapes(config), sep=".")
        return json.dumps({path: leaf.shape for path, leaf in flat.items()})

    shapes = json.loads(kept_text(f"shapes {config.to_json()}", shapes_text))
    return MappingProxyType({path: tuple(shape) for path, shape in shapes.items()})


def numpy_dtype(dtype: DType) -> np.dtype:
    """Return the numpy type of a parameter type's name; raise InputError for other names."""
    check_choice("dtype", dtype, tuple(_DTYPES))
    return _DTYPES[dtype]


def check_parameters(subject: str, tensors: Mapping[str, Any], config: VGGTConfig) -> None:
    """Raise CheckpointError with the problems of flat parameters (names, shapes, types) for a configuration."""
    shapes = flat_shapes(config)
    problems = [f"missing parameter {name}" for name in shapes if name not in tensors]
    for name, tensor in tensors.items():
        if name not in shapes:
            problems.append(f"unknown parameter {name}")
        elif tensor.shape != shapes[name]:
            problems.append(f"mis-shaped parameter {name}: {list(tensor.shape)}, expected {list(shapes[name])}")
        if tensor.dtype not in _DTYPES.values():
            problems.append(f"parameter {name} has type {tensor.dtype}, expected {' or '.join(_DTYPES)}")
    if problems:
        raise CheckpointError(problems_sentence(subject, problems))


def _read_metadata(path: Path, metadata: Mapping[str, str]) -> tuple[VGGTConfig, dict[str, Any]]:
    """Return the configuration, and the other fields of the model; its name is the file's stem if invalid."""
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"{path} is not a checkpoint of this library; load_model converts PyTorch weights")
    if metadata.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {metadata.get('version', '')[:20]!r} of the format; this vggtjax reads {VERSION!r}"
        )
    parse = partial(parse_json, most_bytes=_MOST_METADATA_LETTERS, error=CheckpointError)
    config = parse(metadata.get("config", ""), VGGTConfig, f"the configuration of {path}")
    origin = parse(metadata.get("origin", "{}"), dict[str, Sha256], f"the origin of {path}")
    if not all(name.isprintable() for name in origin):
        raise CheckpointError(f"the origin of {path} names files with unprintable letters; expected names and sha256")
    revision = metadata.get("revision", "")
    if revision and not _COMMIT.fullmatch(revision):
        raise CheckpointError(
            f"the revision of {path} is {revision[:50]!r}; expected a commit of 40 hexadecimal digits"
        )
    name = metadata.get("name", "")
    is_valid = name.isprintable() and 0 < len(name) <= _MOST_NAME_LETTERS
    note = metadata.get("note", "")
    untrained = parse(metadata.get("untrained", "[]"), tuple[str, ...], f"the list of untrained heads of {path}")
    _check_labels(path, note, untrained, config)
    name = name if is_valid else path.stem
    fields = {"name": name, "origin": origin, "revision": revision, "note": note, "untrained_heads": untrained}
    return config, fields


def _check_labels(path: Path, note: str, untrained_heads: Sequence[str], config: VGGTConfig) -> None:
    if not note.isprintable() or len(note) > _MOST_NAME_LETTERS:
        raise CheckpointError(f"the note of {path} is {note[:50]!r}; expected up to 200 printable letters")
    if unknown := [head for head in untrained_heads if head not in config.heads]:
        raise CheckpointError(f"{path} names the untrained heads {unknown}; expected some of {config.heads}")


def _params_digest(model: Model) -> str:
    digest = hashlib.sha256(model.config.to_json().encode())
    flat: dict[str, Any] = flatten_dict(model.params, sep=".")
    for name, leaf in sorted(flat.items()):
        for part in jax.tree.leaves(_whole(leaf)):  # two of a quantised kernel
            values = np.ascontiguousarray(part)
            digest.update(f"{name} {values.dtype} {values.shape}".encode())
            digest.update(values.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
