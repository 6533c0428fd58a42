"""Jitted functions that need not be traced again by the next process.

Tracing and lowering the network take as long as loading what XLA has compiled of it. Where compilations are kept in the
user's cache (`cache.keep_compilations`), so are the lowered programs (jax.export): by the sources of this package, the
versions of jax, the platform, the static options, and the shapes of the arguments.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer

from vggtjax.errors import OutputError
from vggtjax.storage.cache import compiled_folder, lowered_folder
from vggtjax.storage.writing import writing

KEPT_BYTES = 2**28  # of lowered programs; the oldest go first
_DIGEST = 32  # bytes of the sha256 that a kept file begins with
_PACKAGE = Path(__file__).parents[1]


class Program:
    """A function under `jax.jit`, whose lowered form is kept on disk where compilations are."""

    def __init__(self, function: Callable[..., Any], static: Sequence[str] = ()) -> None:
        self.__name__ = function.__name__
        self._function, self._static = function, tuple(static)
        self._jitted = jax.jit(function, static_argnames=self._static)
        self._ready: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Run the function."""
        ready, options = self._found(arguments, options)
        return ready(*arguments, **options)

    def compile(self, *arguments: Any, **options: Any) -> tuple[Any, Any]:
        """Compile for arguments, or shapes of such, which calls with the like of them find; return it and its output.

        Of the output, shapes and types.
        """
        key, _ = self._key(arguments, options)
        self._ready.pop(key, None)
        ready, options = self._found(arguments, options)
        lowered = ready.lower(*arguments, **options)
        compiled = lowered.compile()
        if key is not None and ready is not self._jitted:
            self._ready[key] = compiled
        return compiled, lowered.out_info

    def _key(self, arguments: tuple, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return what a program on disk depends on, or None where none is kept; and the options that are traced."""
        traced = {name: value for name, value in options.items() if name not in self._static}
        if not _keeping():
            return None, traced
        leaves, structure = jax.tree.flatten((arguments, traced))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return None, traced
        static = tuple(sorted((name, repr(value)) for name, value in options.items() if name in self._static))
        return (static, structure, tuple((jnp.shape(leaf), str(jnp.result_type(leaf))) for leaf in leaves)), traced

    def _found(self, arguments: tuple, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return what to call, and the options that it takes: the traced ones, or all."""
        key, traced = self._key(arguments, options)
        if key is None:
            return self._jitted, options
        if key not in self._ready:
            fixed = {name: value for name, value in options.items() if name in self._static}
            self._ready[key] = self._kept(key, fixed, arguments, traced)
        ready = self._ready[key]
        return ready, options if ready is self._jitted else traced

    def _kept(self, key: tuple, fixed: dict[str, Any], arguments: tuple, traced: dict[str, Any]) -> Callable[..., Any]:
        """Return the program of a file, or trace it and write the file; the jitted function if it cannot be written."""
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        text = "\n".join(
            (source_digest(), name, *map(str, key), str(jax.config.values["jax_default_matmul_precision"]))
        )
        path = lowered_folder() / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.bin"
        if (content := _read_kept(path)) is not None:
            return jax.jit(export.deserialize(bytearray(content)).call)
        shapes, named = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), (arguments, traced)
        )
        try:
            exported = export.export(jax.jit(partial(self._function, **fixed)))(*shapes, **named)
            content = bytes(exported.serialize())
        except (ValueError, NotImplementedError):  # calls back to the host
            return self._jitted
        try:
            _keep(path, content)
            _prune(path.parent)
        except OutputError:  # a cache that cannot be written is none
            return self._jitted
        return jax.jit(exported.call)


def keep_type(kind: type) -> type:
    """Decorate a NamedTuple that programs take or return, so that it can be part of one on disk."""
    export.register_namedtuple_serialization(kind, serialized_name=f"{kind.__module__}.{kind.__qualname__}")
    return kind


def kept_text(name: str, make: Callable[[], str]) -> str:
    """Return text that follows from the sources of this package: what was made of them before, where it is kept."""
    if not _keeping():
        return make()
    path = lowered_folder() / f"{hashlib.sha256(f'{source_digest()} {name}'.encode()).hexdigest()[:32]}.txt"
    if (content := _read_kept(path)) is not None:
        return content.decode()
    text = make()
    with suppress(OutputError):
        _keep(path, text.encode())
    return text


def _read_kept(path: Path) -> bytes | None:
    """Return what `_keep` wrote; None where there is no file, or a damaged one, which is removed."""
    try:
        content = path.read_bytes()
        if content[:_DIGEST] == hashlib.sha256(content[_DIGEST:]).digest():
            return content[_DIGEST:]
        path.unlink()
    except OSError:
        pass
    return None


def _keep(path: Path, content: bytes) -> None:
    with writing(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)


def _keeping() -> bool:
    folder = jax.config.values["jax_compilation_cache_dir"]
    return folder is not None and Path(folder) == compiled_folder() and jax.default_backend() == "cpu"


@cache
def source_digest() -> str:
    """Return what the results of this package depend on beside arguments: its sources, versions, and the platform."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    versions = [version(name) for name in ("jax", "jaxlib", "flax")]
    return f"{' '.join(versions)} {jax.default_backend()} {digest.hexdigest()}"


def _prune(folder: Path) -> None:
    files = sorted(folder.glob("*.bin"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in files:
        total += path.stat().st_size
        if total > KEPT_BYTES:
            path.unlink(missing_ok=True)
