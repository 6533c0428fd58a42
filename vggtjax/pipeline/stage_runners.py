"""What becomes of the program of a stage: it is run, compiled ahead, or computed as a part of another program."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, as_completed
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

from vggtjax.progress import OnStage, Progress, no_stage
from vggtjax.storage.programs import Program

_COLLECTIVE = re.compile(
    r" (all-gather|all-reduce|all-to-all|ragged-all-to-all|reduce-scatter|collective-\w+|send|recv)(?:-start)?\("
)


class StageMemory(NamedTuple):
    """Memory of a compiled stage on each device beside its inputs, by XLA's own analysis, in bytes."""

    temporary: int
    output: int
    collectives: Mapping[str, int] = MappingProxyType({})  # communications between devices in the program, by kind


class Execute:
    """Runs each program as a stage of its own."""

    def __init__(self, on_stage: OnStage | None = None) -> None:
        self._on_stage = on_stage or no_stage

    def __call__(self, stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
        """Return the outputs of the program, when they are computed."""
        with self._on_stage(stage):
            return jax.block_until_ready(program(*arguments, **options))


def inline(stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
    """Compute the outputs of the program as a part of the caller's own program."""
    del stage
    return program.function(*arguments, **options)


def count_collectives(program: str) -> dict[str, int]:
    """Return the number of communications between devices in the text of a compiled program, by kind."""
    return dict(Counter(_COLLECTIVE.findall(program)))


class Compile:
    """Compiles programs side by side for the shapes of their arguments; a program that two stages share, once.

    Call `wait` at the end: later calls with such arguments then find the programs compiled.
    """

    def __init__(self) -> None:
        self._stages: list[tuple[str, Future[Any], bool]] = []
        self._compiling: dict[Any, tuple[Future[Any], Any]] = {}

    def __call__(self, stage: str, program: Program, *arguments: Any, **options: Any) -> Any:
        """Return the shapes of the program's outputs."""
        key = program.signature(arguments, options)
        if key not in self._compiling:
            self._compiling[key] = program.compile(*arguments, **options)
        compiling, outputs = self._compiling[key]
        frames = options["compute"].frames if "compute" in options else options["frames"]
        self._stages.append((stage, compiling, frames.mesh is not None))
        return outputs

    def wait(self, progress: Progress | None = None) -> dict[str, StageMemory]:
        """Wait until all programs are compiled, and return the memory of each stage.

        `progress` is called with the number of compiled programs and of all.
        """
        programs = [compiling for compiling, _ in self._compiling.values()]
        for done, compiling in enumerate(as_completed(programs), 1):
            compiling.result()
            if progress is not None:
                progress(done, len(programs))
        memory = ((stage, _memory(compiling.result(), shared)) for stage, compiling, shared in self._stages)
        return {stage: needs for stage, needs in memory if needs is not None}


def _memory(compiled: Any, shared: bool) -> StageMemory | None:
    """Return the memory of a compiled stage, and its communications if devices share it; some platforms do not tell."""
    collectives = count_collectives(compiled.as_text() or "") if shared else {}
    memory = compiled.memory_analysis()
    if memory is None:
        return None
    return StageMemory(memory.temp_size_in_bytes, memory.output_size_in_bytes, collectives)
