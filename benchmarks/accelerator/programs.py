"""The programs of a reconstruction, compiled for a target: the steps of a run, with shapes in place of arrays."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from benchmarks.accelerator.count import Count, Shares, count
from benchmarks.accelerator.hlo import parse
from benchmarks.accelerator.targets import Target
from benchmarks.suite import work
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.method.algorithm import Clips, run_method
from vggtjax.method.fusion.family import paper_rule
from vggtjax.method.fusion.inputs import observe
from vggtjax.method.passes import Passes
from vggtjax.network.backbone import ClipBatch, Features
from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.frames import AXIS, BY_FRAME, REPLICATED, Frames, OnDevices
from vggtjax.network.kernels.narrow import narrowed
from vggtjax.network.kernels.sampled import early_pairs
from vggtjax.network.model import parameter_shapes, predict
from vggtjax.network.precision import Compute
from vggtjax.options import Options
from vggtjax.research.learning.fit import FitClips, clip_loss

_BLIND = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}  # nothing can be timed


@dataclass(frozen=True)
class Setup:
    """What is compiled: a model, the shape of its clip, how it is computed, and for which target."""

    target: Target
    config: VGGTConfig
    frames: int
    height: int
    width: int
    dtype: str = "bfloat16"
    precision: str = "tf32"
    devices: int = 1

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.height // self.config.patch_size, self.width // self.config.patch_size


class Compiled(NamedTuple):
    """A program for a target; bytes of memory beside its inputs, and the count of its kernels."""

    name: str
    seconds: float
    temporary: int
    outputs: int
    inputs: int
    counted: Count
    needed: float | None  # FLOP that the arithmetic needs, where they are known


@dataclass
class Compiler:
    """Steps of the method that are compiled, rather than run, if their names are wanted."""

    setup: Setup
    wanted: Sequence[str]
    progress: Callable[[str], None] = lambda name: None
    prefix: str = ""
    needed: Mapping[str, float] = field(default_factory=dict)
    found: list[Compiled] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._mesh = Mesh(np.array(self.setup.target.devices(self.setup.devices)), (AXIS,))

    @property
    def frames(self) -> Frames:
        """Where the frames are."""
        if self.setup.devices == 1:
            return Frames()
        share = -(-self.setup.frames // self.setup.devices) * self.setup.devices
        return Frames(self._mesh, None if share == self.setup.frames else self.setup.frames)

    @property
    def compute(self) -> Compute:
        """How the network is computed."""
        return Compute(self.setup.dtype, self.setup.precision, frames=self.frames)

    def step(self, name: str, function: Callable[..., Any], /) -> Callable[..., Any]:
        """Return a function that compiles `function`, and returns the shapes of its outputs."""

        def compiled(*arrays: Any, **static: Any) -> Any:
            bound = partial(function, **static)
            if self.prefix + name in self.wanted:
                self.found.append(self._compile(self.prefix + name, bound, function, arrays))
            return jax.eval_shape(bound, *arrays)

        return compiled

    def _compile(self, name: str, bound: Callable[..., Any], function: Callable[..., Any], arrays: Any) -> Compiled:
        self.progress(name)
        specs = function.specs if isinstance(function, OnDevices) else (REPLICATED,) * len(arrays)
        arguments = jax.tree.map(
            lambda spec, tree: jax.tree.map(lambda leaf: self._placed(leaf, spec), tree),
            specs,
            arrays,
            is_leaf=lambda spec: isinstance(spec, PartitionSpec),
        )
        platform, began = self.setup.target.platform, time.perf_counter()
        lowered = jax.jit(bound).trace(*arguments).lower(lowering_platforms=(platform,))
        program = lowered.compile(compiler_options=_BLIND if platform == "cuda" else None)
        seconds = time.perf_counter() - began
        memory: Any = program.memory_analysis()
        sizes = (memory.temp_size_in_bytes, memory.output_size_in_bytes, memory.argument_size_in_bytes)
        counted = count(parse(program.as_text() or ""), self.setup.target, shares_of(self.setup.config))
        return Compiled(name, seconds, *sizes, counted, self.needed.get(name))

    def _placed(self, leaf: Any, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        shape = jax.eval_shape(jnp.asarray, leaf)
        return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=NamedSharding(self._mesh, spec))


def shares_of(config: VGGTConfig) -> Shares:
    """Return how often the conditionals of a pass are true, by the scope in which they are."""
    depth, motion = config.depth, config.motion
    taps = {f"tap{slot}": 1 / depth for slot in range(len(config.taps))}
    cues = {f"cue-{cue.name}": len(set(motion.layers(cue, depth))) / depth for cue in motion.cues}
    return {
        **taps,
        **cues,
        "matches": len(motion.matching_layers(depth)) / depth,
        "suppress": motion.mask_pairs / depth,
        "early": early_pairs(depth).mean(),
    }


def compile_programs(setup: Setup, names: Sequence[str], progress: Callable[[str], None]) -> list[Compiled]:
    """Compile the programs of these names for a target. Raises InputError where one does not compile."""
    compiler = Compiler(setup, names, progress, needed=_needed(setup))
    for build in _BUILDS:
        if any(name in names for name in _BUILDS[build]):
            try:
                build(compiler, setup)
            except (jax.errors.JaxRuntimeError, NotImplementedError) as error:
                raise InputError(f"{setup.target.name} with {setup.frames} frames: {error}") from error
    return compiler.found


def _params(setup: Setup) -> Any:
    shapes = parameter_shapes(setup.config)
    return jax.eval_shape(partial(narrowed, compute_dtype=setup.dtype), shapes)


def _images(setup: Setup) -> jax.ShapeDtypeStruct:
    frames = -(-setup.frames // setup.devices) * setup.devices
    return jax.ShapeDtypeStruct((1, frames, setup.height, setup.width, 3), jnp.float32)


def _method(compiler: Compiler, setup: Setup) -> None:
    """Compile the steps of 4dvggt-d, and of one frame's tracks, as a reconstruction runs them."""
    images, points = _images(setup), jax.ShapeDtypeStruct((1, 64, 2), jnp.float32)
    tracked = {1: points} if "tracks" in setup.config.heads and images.shape[1] == setup.frames else {}
    clips = Clips(images, frames=setup.frames)  # type: ignore[arg-type]
    run = partial(run_method, _params(setup), compute=compiler.compute, step=compiler.step)
    run(Clips(images, tracked, setup.frames), setup.config, Options())  # type: ignore[arg-type]
    compiler.prefix = "matches: "
    run(clips, setup.config, Options("4dvggt-m"))
    compiler.prefix = ""


def _plain(compiler: Compiler, setup: Setup) -> None:
    """Compile a pass without cues: exact, and with sampled keys on one device."""
    P = setup.grid[0] * setup.grid[1]
    tokens = jax.ShapeDtypeStruct((1, _images(setup).shape[1], P, setup.config.embed_dim), jnp.float32)
    batch = ClipBatch(_images(setup), Features(tokens))  # type: ignore[arg-type]
    for name, how in (("plain pass", "exact"), ("sampled pass", "sampled")):
        if how == "exact" or setup.devices == 1:
            compute = Compute(setup.dtype, setup.precision, attention=how, frames=compiler.frames)
            run = compiler.frames.on_devices(predict, REPLICATED, ClipBatch(BY_FRAME, BY_FRAME, REPLICATED))  # type: ignore[arg-type]
            compiler.step(name, run)(_params(setup), batch, config=setup.config, compute=compute)


def _attention(compiler: Compiler, setup: Setup) -> None:
    """Compile attention and its gradient for the sizes of VGGT's heads, those of the blocks and of the camera head."""

    def run(*heads: Any) -> Any:
        return [jax.value_and_grad(lambda x: attention(x, x, x).astype(jnp.float32).sum())(x) for x in heads]

    sizes = (64, 128)
    compiler.step("attention", run)(*(jax.ShapeDtypeStruct((1, 301, 2, size), setup.dtype) for size in sizes))


def _fusion_gradient(compiler: Compiler, setup: Setup) -> None:
    """Compile the gradient of a fit's loss by the weights of the fusion."""
    shape = (1, setup.frames, setup.height, setup.width)
    passes = jax.eval_shape(
        lambda params, images: run_method(params, images, setup.config, both_outputs=True, compute=Compute())[1],
        parameter_shapes(setup.config),
        jax.ShapeDtypeStruct((*shape, 3), jnp.float32),
    )
    read = passes._replace(features=None, tracks=None)

    def loss(fusion: Any, read: Passes, truth: Any) -> Any:
        clip = FitClips(jax.tree.map(lambda x: x[0], observe(read)), truth[0])
        return clip_loss(fusion, clip, "gaussian")

    weights = jax.eval_shape(paper_rule)
    compiler.step("fusion gradient", jax.value_and_grad(loss))(weights, read, jax.ShapeDtypeStruct(shape, jnp.float32))


def _training_step(compiler: Compiler, setup: Setup) -> None:
    """Compile a step of training: loss and gradient by all parameters, and the optimiser."""
    from vggtjax.training.data import make_batch
    from vggtjax.training.objective import LossWeights, init_probes, objective
    from vggtjax.training.recipe import OptimiserConfig, Phase, Recipe
    from vggtjax.training.scenes.textures import load_textures
    from vggtjax.training.state import apply_gradient, loss_and_gradient, state_shapes

    phase = Phase(steps=1, batch=1, frames=(setup.frames,), height=setup.height, width=setup.width)
    short = OptimiserConfig(warmup_steps=0, decay_steps=0)
    losses = LossWeights(points=1.0 if "points" in setup.config.heads else 0.0)
    recipe = Recipe("count", (phase,), setup.config, short, losses, compute_dtype=setup.dtype, remat=True)  # type: ignore[arg-type]
    state = state_shapes(recipe, init_probes(0, setup.config))
    textures = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), load_textures("training"))
    make = partial(make_batch, phase=phase, frames=setup.frames)
    batch = jax.eval_shape(make, jax.eval_shape(jax.random.key, 0), textures)
    metrics, gradient = compiler.step("training gradient", loss_and_gradient)(
        state.trained, batch, recipe=recipe, objective=objective
    )
    compiler.step("optimiser", apply_gradient)(state, gradient, metrics, recipe=recipe)


_BUILDS: Mapping[Callable[[Compiler, Setup], None], tuple[str, ...]] = {
    _method: (
        "image features", "first pass", "dynamic mask", "second pass", "assemble", "tracks",
        "matches: first pass", "matches: dynamic mask",
    ),
    _plain: ("plain pass", "sampled pass"),
    _attention: ("attention",),
    _fusion_gradient: ("fusion gradient",),
    _training_step: ("training gradient", "optimiser"),
}  # fmt: skip
PROGRAMS = tuple(name for names in _BUILDS.values() for name in names)


def _needed(setup: Setup) -> dict[str, float]:
    """Return the FLOP of the arithmetic, by shapes alone, on each device."""
    shape = (setup.config, setup.frames, setup.grid)
    trunk = work.alternating(*shape) + work.camera_head(setup.config, setup.frames)
    plain = work.flop(trunk + work.depth_head(*shape)) / setup.devices
    return {
        "image features": work.flop(work.backbone(*shape)) / setup.devices,
        "plain pass": plain,
        "second pass": plain,
        "first pass": plain + work.flop(work.cues(*shape)) / setup.devices,
    }
