"""The workloads, by name."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.suite import work
from benchmarks.suite.cases import Case
from benchmarks.suite.measure import Measured, measure_program, timed
from tests.shared.aggregation import aggregate
from vggtjax.errors import InputError
from vggtjax.method.cues import GramCues
from vggtjax.network.backbone import encode
from vggtjax.network.heads.dpt_head import predict_dense, project_tap
from vggtjax.network.model import forward
from vggtjax.network.precision import Compute
from vggtjax.pipeline.infer import infer

Program = tuple[Callable[..., Any], tuple]  # a function of arrays, and those arrays

DEMO = ("-m", "vggtjax", "demo")
_STEPS = ("trace", "lower", "XLA")
_IMPORTED = "import sys, atexit; atexit.register(lambda: sys.stderr.write(str('jax' in sys.modules))); "
_STARTS = {
    "import vggtjax": "import vggtjax",
    "vggtjax --help": "from vggtjax.interface.commands.main import main; sys.exit(main(['--help']))",
}


class Workload(NamedTuple):
    """A measurement and its work. If there are several results, each has a name."""

    about: str
    measure: Callable[[Case, Iterable[int]], dict[str, Measured]]  # a case, a round per timed run -> results by name
    parts: Callable[[Case], list[work.Work]] | None = None
    of_a_clip: bool = True  # depends on a model and the shape of a clip


def aggregator(case: Case) -> Program:
    """DINOv2 and the alternating blocks, no heads."""

    def run(params, images):
        tokens = encode(params, images, case.config, compute_dtype=case.dtype)
        return aggregate(params, tokens, case.config, case.grid, captures=(), compute=Compute(case.dtype))[0]

    return run, (case.params, case.images())


def plain_pass(case: Case) -> Program:
    """Cameras and depth of images."""

    def run(params, images):
        return forward(params, images, case.config, compute_dtype=case.dtype)

    return run, (case.params, case.images())


def cue_sums(case: Case) -> Program:
    """The cues of every layer with cues, all on the same q and k."""
    cues = GramCues(case.config.motion, case.config.depth)
    counts = cues.layer_counts()
    S, P, N = case.frames, case.grid[0] * case.grid[1], case.config.num_heads

    def run(counts, q, k):
        return jax.lax.scan(lambda sums, row: (cues.add(sums, row, q, k), None), cues.zeros(1, S, P), counts)[0]

    q, k = case.drawn(2, 1, S, P, N, case.config.embed_dim // N).astype(case.dtype)
    return run, (jnp.asarray(counts[counts.any(axis=1)]), q, k)


def two_passes(case: Case) -> Program:
    """The whole method, images to fused depth and cameras."""

    def run(params, images):
        return infer(params, images, case.config, compute_dtype=case.dtype)

    return run, (case.params, case.images())


def depth_head(case: Case) -> Program:
    """Depth and confidence from the outputs of four pairs of blocks; in TF32 beside blocks in bfloat16, as in a run."""
    precision = "tf32" if case.dtype == "bfloat16" else "highest"

    def run(params, tokens, shifts):
        taps = _taps(params, tokens, shifts, case, precision)
        return predict_dense(params, taps, case.config, case.grid, "depth", precision)

    return run, (case.params["depth_head"], *_tapped(case))


def _tapped(case: Case) -> tuple[Any, Any]:
    tokens = case.drawn(1, case.frames, case.grid[0] * case.grid[1], case.config.tap_dim)
    return tokens, jnp.arange(4) / 10


def _taps(params, tokens, shifts, case: Case, precision: str) -> list[Any]:
    """Return four different taps from one array; equal taps would share one norm in the compiled program."""
    return [project_tap(params, tokens + shifts[slot], slot, case.config, precision) for slot in range(4)]


def _start_up(case: Case, rounds: Iterable[int]) -> dict[str, Measured]:
    """Fresh processes: what must not import jax, and the demo before and after its programs are in the cache."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
        environment |= {"VGGTJAX_CACHE": f"{folder}/cache"}

        def start(*arguments: str) -> str:
            command = [sys.executable, *arguments]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                raise InputError(f"{' '.join(command)} failed: {done.stderr.strip().splitlines()[-1:]}")
            return done.stderr

        for name, code in _STARTS.items():
            start("-c", _IMPORTED + code)
            runs = [timed(lambda code=code: start("-c", _IMPORTED + code)) for _ in rounds]
            jax_too = any(said.endswith("True") for said, _ in runs)
            seconds = tuple(seconds for _, seconds in runs)
            found[f"{name}, {'jax' if jax_too else 'no jax'}"] = Measured(seconds)
        for name in ("first", "second"):
            _, seconds = timed(lambda: start(*DEMO, "--out", f"{folder}/out"))
            found[f"vggtjax demo, {name} run"] = Measured((seconds,))
    return found


def _compile_steps(case: Case, rounds: Iterable[int]) -> dict[str, Measured]:
    function, arguments = two_passes(case)
    seconds = []
    for _ in rounds:
        jax.clear_caches()
        traced, tracing = timed(lambda: jax.jit(function).trace(*arguments))
        lowered, lowering = timed(traced.lower)
        seconds.append((tracing, lowering, timed(lowered.compile)[1]))
    return {name: Measured(tuple(column)) for name, column in zip(_STEPS, zip(*seconds, strict=True), strict=True)}


def _program(about: str, build: Callable[[Case], Program], parts: Callable[[Case], list[work.Work]]) -> Workload:
    return Workload(about, lambda case, rounds: {"": measure_program(*build(case), rounds)}, parts)


def _trunk(case: Case) -> list[work.Work]:
    shape = (case.config, case.frames, case.grid)
    return work.backbone(*shape) + work.alternating(*shape)


def _heads(case: Case) -> list[work.Work]:
    return work.camera_head(case.config, case.frames) + work.depth_head(case.config, case.frames, case.grid)


def _both(case: Case) -> list[work.Work]:
    shape = (case.config, case.frames, case.grid)
    return work.backbone(*shape) + work.cues(*shape) + 2 * (work.alternating(*shape) + _heads(case))


WORKLOADS = {
    "aggregator": _program("DINOv2 and the alternating blocks", aggregator, _trunk),
    "pass": _program("a plain pass: cameras and depth", plain_pass, lambda case: _trunk(case) + _heads(case)),
    "cues": _program(
        "the motion cues' sums alone", cue_sums, lambda case: work.cues(case.config, case.frames, case.grid)
    ),
    "two-passes": _program("4dvggt-d, images to fused depth and cameras", two_passes, _both),
    "depth-head": _program(
        "the depth head alone", depth_head, lambda case: work.depth_head(case.config, case.frames, case.grid)
    ),
    "compile": Workload("tracing, lowering and compiling both passes, with no cache", _compile_steps),
    "start-up": Workload("fresh processes, with an empty cache of their own", _start_up, of_a_clip=False),
}
