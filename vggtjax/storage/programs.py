"""Jitted functions that the next process need not trace again.

Tracing and lowering the network take as long as loading its compiled form. If compiled programs are kept in the user's
cache (`enable_compilation_cache`), so are, on a CPU, lowered programs (jax.export). Their key is the sources of this
package, the versions of jax, the platform, the static options, and the shapes of the arguments. Programs on several
devices are not kept.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer

from vggtjax.errors import InputError, OutputError, check_regular
from vggtjax.storage.cache import cache_folder, compiled_folder
from vggtjax.storage.cores import core_count
from vggtjax.storage.free_memory import return_freed_memory
from vggtjax.storage.versions import package_digest
from vggtjax.storage.writing import writing

KEPT_BYTES = 2**28  # of lowered programs and texts; the oldest are removed first
_DIGEST = 32  # bytes of the sha256 at the start of a kept file
# Of LLVM on a CPU. Its third level takes up to a fifth longer to compile the network, which runs no faster with it, as
# its products are in libraries.
_OPTIONS_ON_CPU = {"xla_backend_optimization_level": 1}


class Program:
    """A function under `jax.jit` whose lowered form is kept on disk if compiled programs are.

    Its positional arguments are trees of arrays; its keyword arguments are static.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._ready: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any, **static: Any) -> Any:
        """Run the function."""
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments)):
            return jax.jit(self.function, static_argnames=tuple(static))(*arguments, **static)
        return self._find(arguments, static)(*arguments)

    def compile(self, *arguments: Any, **static: Any) -> tuple[Future[Any], Any]:
        """Trace the function for arguments, or for their shapes and types, and compile it in another thread.

        Later calls with such arguments use the program; they wait for nothing, so wait for the future before.

        Returns the future of the compiled program, and the shapes and types of its output.
        """
        key = self.signature(arguments, static)
        if _keeps(arguments):
            self._ready.pop(key, None)
        ready = self._find(arguments, static)
        lowered = ready.lower(*arguments)

        def compile_lowered() -> Any:
            compiled = lowered.compile()
            return_freed_memory()
            if _keeps(arguments):
                self._ready[key] = compiled
            return compiled

        compiling = _compilers().submit(compile_lowered)
        outputs = lowered.out_info
        if _on_several_devices(arguments):  # the next program has to be compiled for arrays that are there
            outputs = jax.tree.map(_placed, outputs, compiling.result().output_shardings)
        return compiling, outputs

    def signature(self, arguments: tuple, static: dict[str, Any]) -> tuple[Any, ...]:
        """Return what tells this program for these arguments, or for their shapes and types, from its others."""
        leaves, structure = jax.tree.flatten(arguments)
        shapes = tuple((jnp.shape(leaf), str(jnp.result_type(leaf))) for leaf in leaves)
        return tuple(sorted((name, repr(value)) for name, value in static.items())), structure, shapes

    def _find(self, arguments: tuple, static: dict[str, Any]) -> Any:
        """Return the jitted function of the arguments alone, or a program that was kept."""
        if not _keeps(arguments):
            return _jitted(self.function, tuple(static.items()))
        key = self.signature(arguments, static)
        if key not in self._ready:
            self._ready[key] = self._load_or_trace(key, static, arguments)
        return self._ready[key]

    def _load_or_trace(self, key: tuple, static: dict[str, Any], arguments: tuple) -> Callable[..., Any]:
        """Return the program of a file, or trace the function and write the file; on failure, the jitted function."""
        function: Any = self.function
        name = f"{function.__module__}.{function.__qualname__}"
        precision = jax.config.values["jax_default_matmul_precision"]
        path = _kept_path("\n".join((source_digest(), name, *map(str, key), str(precision))))
        if (content := _read_kept(path)) is not None:
            return jax.jit(export.deserialize(bytearray(content)).call, compiler_options=_compiler_options())
        jitted = _jitted(function, tuple(static.items()))
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), arguments)
        try:
            exported = export.export(jax.jit(partial(function, **static)))(*shapes)
            content = bytes(exported.serialize())
        except (ValueError, NotImplementedError):  # calls back to the host
            return jitted
        try:
            _keep(path, content)
        except OutputError:  # the cache cannot be written
            return jitted
        return jax.jit(exported.call, compiler_options=_compiler_options())


@cache
def program(function: Callable[..., Any]) -> Program:
    """Return the one program of a function."""
    return Program(function)


@cache
def _jitted(function: Callable[..., Any], static: tuple[tuple[str, Any], ...]) -> Any:
    return jax.jit(partial(function, **dict(static)), compiler_options=_compiler_options())


@cache
def _compilers() -> ThreadPoolExecutor:
    """Return the threads that compile: XLA holds no lock of Python, and has threads of its own.

    On one core with two hyperthreads, two threads compiled a pass for 17 s where one took 15.
    """
    return ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 2), "compile")


def _compiler_options() -> dict[str, Any] | None:
    """Return how XLA compiles on this platform, unless XLA_FLAGS say it."""
    given = os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu":
        return None
    return {name: value for name, value in _OPTIONS_ON_CPU.items() if name not in given}


def keep_type(kind: type) -> type:
    """Decorate a NamedTuple that kept programs take or return: register how it is stored."""
    export.register_namedtuple_serialization(kind, serialized_name=f"{kind.__module__}.{kind.__qualname__}")
    return kind


def _keeps(arguments: Any) -> bool:
    """Return whether a program for these arguments is kept: not on several devices, nor with a caller's function."""
    functions = jax.tree.leaves(arguments, is_leaf=lambda x: isinstance(x, jax.tree_util.Partial))
    is_own = not any(isinstance(leaf, jax.tree_util.Partial) for leaf in functions)
    return _keeping() and jax.default_backend() == "cpu" and is_own and not _on_several_devices(arguments)


def _on_several_devices(arguments: Any) -> bool:
    shardings = (getattr(leaf, "sharding", None) for leaf in jax.tree.leaves(arguments))
    return any(sharding is not None and sharding.num_devices > 1 for sharding in shardings)


def _placed(output: Any, sharding: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(output.shape, output.dtype, sharding=sharding)


def kept_text(name: str, make: Callable[[], str]) -> str:
    """Return text that depends on `name` and the sources of this package alone; keep it if compiled programs are."""
    if not _keeping():
        return make()
    path = _kept_path(f"{source_digest()} {name}")
    if (content := _read_kept(path)) is not None:
        return content.decode()
    text = make()
    with suppress(OutputError):
        _keep(path, text.encode())
    return text


def _kept_path(text: str) -> Path:
    return cache_folder() / "lowered" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.bin"


def _read_kept(path: Path) -> bytes | None:
    """Return the content that `_keep` wrote; None for a missing file, and for a damaged file, which is removed."""
    with suppress(OSError, InputError):
        check_regular(path)
        content = path.read_bytes()
        if content[:_DIGEST] == hashlib.sha256(content[_DIGEST:]).digest():
            return content[_DIGEST:]
        path.unlink()
    return None


def _keep(path: Path, content: bytes) -> None:
    with writing(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
    total = 0
    with suppress(FileNotFoundError):  # another process removes files, too
        for old in sorted(path.parent.glob("*.bin"), key=lambda path: path.stat().st_mtime, reverse=True):
            total += old.stat().st_size
            if total > KEPT_BYTES:
                old.unlink()


def _keeping() -> bool:
    """Return whether compiled programs are kept in the user's cache."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    return folder is not None and Path(folder) == compiled_folder()


@cache
def source_digest() -> str:
    """Return versions, platform, cores, and a digest of all sources: what results depend on besides arguments."""
    versions = [version(name) for name in ("jax", "jaxlib", "flax")]
    return f"{' '.join(versions)} {jax.default_backend()} {core_count()} {package_digest()}"
