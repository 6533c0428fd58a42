"""What becomes of a step of the method: it is timed and run, or compiled ahead. See `method.algorithm.Step`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future, as_completed
from types import MappingProxyType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax

from vggtjax.cameras import Cameras
from vggtjax.method.assembly import Assembly
from vggtjax.method.matched_mask import Mined
from vggtjax.method.matches import Matches
from vggtjax.method.passes import Passes
from vggtjax.method.soft_mask import SoftMasking
from vggtjax.method.witnesses import Seen
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.frames import OnDevices
from vggtjax.network.model import Predictions
from vggtjax.network.quantised import STORED
from vggtjax.network.track_head import Tracks
from vggtjax.progress import OnStage, Progress, no_stage
from vggtjax.storage.programs import keep_type, program

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_COLLECTIVE = re.compile(
    r" (all-gather|all-reduce|all-to-all|ragged-all-to-all|reduce-scatter|collective-\w+|send|recv)(?:-start)?\("
)
# What kept programs take and return.
for _kind in (ClipBatch, Predictions, Passes, Seen, Matches, Mined, Cameras, Assembly, Tracks, SoftMasking, *STORED):
    keep_type(_kind)


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
                return jax.block_until_ready(program(function)(*arguments, **static))

        return run


def count_collectives(program: str) -> dict[str, int]:
    """Return the number of communications between devices in the text of a compiled program, by kind."""
    return dict(Counter(_COLLECTIVE.findall(program)))


class Compile:
    """Compiles steps side by side for the shapes of their arguments; equal programs once.

    Call `wait` at the end: later calls with such arguments then find the programs compiled.
    """

    def __init__(self) -> None:
        self._steps: list[tuple[str, Future[Any], bool]] = []
        self._compiling: dict[Any, tuple[Future[Any], Any]] = {}

    def __call__(self, name: str, function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        """Return a function that takes and returns shapes."""
        step = program(function)

        def compile_step(*arguments: _Parameters.args, **static: _Parameters.kwargs) -> _Result:
            key = (step, step.signature(arguments, static))
            if key not in self._compiling:
                self._compiling[key] = step.compile(*arguments, **static)
            compiling, outputs = self._compiling[key]
            self._steps.append((name, compiling, isinstance(function, OnDevices)))
            return outputs

        return compile_step

    def wait(self, progress: Progress | None = None) -> dict[str, StageMemory]:
        """Wait until all programs are compiled, and return the memory of each stage.

        `progress` is called with the number of compiled programs and of all.
        """
        programs = [compiling for compiling, _ in self._compiling.values()]
        for done, compiling in enumerate(as_completed(programs), 1):
            compiling.result()
            if progress is not None:
                progress(done, len(programs))
        memory = ((stage, _memory(compiling.result(), shared)) for stage, compiling, shared in self._steps)
        return {stage: needs for stage, needs in memory if needs is not None}


def _memory(compiled: Any, shared: bool) -> StageMemory | None:
    """Return the memory of a compiled stage, and its communications if devices share it; some platforms do not tell."""
    collectives = count_collectives(compiled.as_text() or "") if shared else {}
    memory = compiled.memory_analysis()
    if memory is None:
        return None
    return StageMemory(memory.temp_size_in_bytes, memory.output_size_in_bytes, collectives)
