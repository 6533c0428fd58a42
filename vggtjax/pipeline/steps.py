"""What becomes of a step of the method: it is timed and run, or compiled ahead. See `method.algorithm.Step`."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax

from vggtjax.options import has_accelerator
from vggtjax.progress import OnStage, Progress, no_progress, no_stage
from vggtjax.storage.process import core_count, return_freed_memory

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_COLLECTIVE = re.compile(
    r" (all-gather|all-reduce|all-to-all|ragged-all-to-all|reduce-scatter|collective-\w+|send|recv)(?:-start)?\("
)
# Of LLVM on a CPU. Its third level takes up to a fifth longer to compile the network, which runs no faster with it, as
# its products are in libraries.
_OPTIONS_ON_CPU = {"xla_backend_optimization_level": 1}


class StageMemory(NamedTuple):
    """Memory of a compiled stage on each device beside its inputs, by XLA's own analysis, in bytes."""

    temporary: int
    output: int
    collectives: Mapping[str, int] = MappingProxyType({})  # communications between devices in the program, by kind


class Execute:
    """Runs each step as a compiled program of its own, which `on_stage` sees."""

    def __init__(self, on_stage: OnStage | None = None) -> None:
        self._on_stage = on_stage or no_stage

    def __call__(self, name: str, function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        """Return the step's function, which returns when its outputs are computed."""

        def run(*arguments: _Parameters.args, **static: _Parameters.kwargs) -> _Result:
            with self._on_stage(name):
                return jax.block_until_ready(_jitted(function, tuple(static))(*arguments, **static))

        return run


class Compile:
    """Compiles steps side by side for the shapes of their arguments; equal programs once.

    Call `wait` at the end: later calls with such arguments then find the programs compiled.
    """

    def __init__(self) -> None:
        self._steps: list[tuple[str, Future[Any], bool]] = []
        self._compiling: dict[Any, tuple[Future[Any], Any]] = {}

    def __call__(self, name: str, function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        """Return a function that takes and returns shapes."""

        def compile_step(*arguments: _Parameters.args, **static: _Parameters.kwargs) -> _Result:
            leaves, structure = jax.tree.flatten(arguments)
            shapes = tuple(map(jax.typeof, leaves))
            key = function, tuple(static.items()), structure, shapes
            if key not in self._compiling:
                self._compiling[key] = _compiled(_jitted(function, tuple(static)).lower(*arguments, **static), leaves)
            compiling, outputs = self._compiling[key]
            self._steps.append((name, compiling, _on_several_devices(leaves)))
            return outputs

        return compile_step

    def wait(self, progress: Progress | None = None) -> dict[str, StageMemory]:
        """Wait until all programs are compiled, and return the memory of each stage.

        `progress` is called with the number of compiled programs and of all.
        """
        programs = [compiling for compiling, _ in self._compiling.values()]
        for done, compiling in enumerate(as_completed(programs), 1):
            compiling.result()
            (progress or no_progress)(done, len(programs))
        memory = ((stage, _memory(compiling.result(), shared)) for stage, compiling, shared in self._steps)
        return {stage: needs for stage, needs in memory if needs is not None}


@cache
def _jitted(function: Callable[..., Any], static: tuple[str, ...]) -> Any:
    """Return a step's function under jit, compiled as fast as is sensible, unless XLA_FLAGS say it."""
    options = {} if has_accelerator() else _OPTIONS_ON_CPU
    given = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in options.items() if name not in given}
    return jax.jit(function, static_argnames=static, compiler_options=options or None)


def _compiled(lowered: Any, arguments: Sequence[Any]) -> tuple[Future[Any], Any]:
    """Compile in another thread; return the future, and shapes and types of the outputs."""

    def compile_lowered() -> Any:
        compiled = lowered.compile()
        return_freed_memory()
        return compiled

    compiling, outputs = _compilers().submit(compile_lowered), lowered.out_info
    if _on_several_devices(arguments):
        outputs = jax.tree.map(_placed, outputs, compiling.result().output_shardings)  # the next step needs them
    return compiling, outputs


def _on_several_devices(arrays: Sequence[Any]) -> bool:
    shardings = (getattr(array, "sharding", None) for array in arrays)
    return any(sharding is not None and sharding.num_devices > 1 for sharding in shardings)


def _placed(output: Any, sharding: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(output.shape, output.dtype, sharding=sharding)


@cache
def _compilers() -> ThreadPoolExecutor:
    """Return the threads that compile: XLA holds no lock of Python, and has threads of its own.

    On one core with two hyperthreads, two threads compiled a pass for 17 s where one took 15.
    """
    return ThreadPoolExecutor(max(1, core_count() // 2), "compile")


def _memory(compiled: Any, shared: bool) -> StageMemory | None:
    """Return the memory of a compiled stage, and its communications if devices share it; some platforms do not tell."""
    collectives = dict(Counter(_COLLECTIVE.findall(compiled.as_text() or ""))) if shared else {}
    memory = compiled.memory_analysis()
    if memory is None:
        return None
    return StageMemory(memory.temp_size_in_bytes, memory.output_size_in_bytes, collectives)
