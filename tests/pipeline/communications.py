"""What tests/pipeline/test_devices.py runs in a process with eight devices: the order of communications in programs.

It prints JSON: what `unordered` returns for each program.
"""

import json
import re

import jax
import jax.numpy as jnp

from tests.tiny import tiny_config
from vggtjax import infer
from vggtjax.config import MotionConfig
from vggtjax.method.fusion_family import start
from vggtjax.network import gathered_attention
from vggtjax.network.frames import BY_FRAME, Frames
from vggtjax.network.model import init_params
from vggtjax.pipeline.devices import frames_mesh
from vggtjax.pipeline.stages import _assemble

COMPUTATION = re.compile(r"(?:ENTRY )?%?([\w.-]+) \(.*\) -> .* \{")
INSTRUCTION = re.compile(r" +(?:ROOT )?%([\w.-]+) = .*? ([\w-]+)\((.*)")
COLLECTIVE = re.compile(r"(all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)(-start)?")


def unordered(text: str) -> tuple[list[tuple[str, str]], int]:
    """Return pairs of a loop, conditional or call that communicates, and a later communication that may run beside it.

    The later one communicates inside, too, or is a communication. Also return the number of computations that
    communicate.
    """
    computations: dict[str, dict[str, tuple[str, list[str]]]] = {}
    current = {}
    for line in text.splitlines():
        if found := COMPUTATION.match(line):
            current = computations.setdefault(found[1], {})
        elif found := INSTRUCTION.match(line):
            current[found[1]] = found[2], re.findall(r"%([\w.-]+)", found[3])
    communicate: dict[str, bool] = {}
    pairs = []
    for name, instructions in computations.items():  # a computation stands before those that call it
        before, inside = {}, []
        communicate[name] = False
        for result, (kind, names) in instructions.items():
            before[result] = {earlier for other in names if other in before for earlier in (other, *before[other])}
            is_inside = any(communicate.get(other, False) for other in names)
            if is_inside or COLLECTIVE.fullmatch(kind):
                pairs += [(other, result) for other in inside if other not in before[result]]
                inside += [result] if is_inside else []
                communicate[name] = True
    return pairs, sum(communicate.values())


def two_sums(x):
    """Return sums of two conditionals, neither of which waits for the other."""
    frames = Frames(frames_mesh(8))

    def run(x):
        return x + sum(jax.lax.cond(x.sum() > low, lambda x: frames.sum(jnp.sin(x)), frames.sum, x) for low in (0, 1))

    return frames.on_devices(run, BY_FRAME)(x)


def gradient(params, images):
    """Return the gradient of a sum of all outputs of both passes, with motion cues and clusters."""

    def total(params, images):
        outputs = infer(params, images, config, mesh=frames_mesh(8), method="vggt4d")
        return sum(jnp.sin(leaf).sum() for leaf in jax.tree.leaves(outputs) if leaf.dtype != bool)

    return jax.grad(total, argnums=(0, 1))(params, images)


def assembly(passes):
    """Return the result of both passes, whose depths are aligned and fused by a fitted rule: two medians."""
    changes = {"method": "4dvggt-d", "align_scale": True, "patch_size": config.patch_size}
    return _assemble(passes, start(("gate",)), frames=Frames(frames_mesh(8), FRAMES), **changes)


FRAMES = 13
gathered_attention.GATHERED_AT_ONCE = 1  # in a loop over heads, as in long clips
config = tiny_config(image_size=28, motion=MotionConfig(cues=MotionConfig().cues[:3]))
params, images = init_params(0, config), jnp.zeros((1, FRAMES, 28, 28, 3))
_, passes = jax.eval_shape(lambda x: infer(params, x, config), jnp.zeros((1, 16, 28, 28, 3)))  # padded for 8 devices
programs = {
    "two sums": (two_sums, jnp.ones((1, 8))),
    "assembly": (assembly, passes),
    "gradient": (gradient, params, images),
}
found = {}
for name, (function, *inputs) in programs.items():
    found[name] = unordered(jax.jit(function).lower(*inputs).compile().as_text() or "")
print(json.dumps(found))  # noqa: T201
