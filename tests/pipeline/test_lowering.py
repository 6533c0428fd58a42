"""Every program is lowered for NVIDIA GPUs and TPUs, which need not be there: nothing is compiled or run."""

import re
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax._src.cudnn import fused_attention_stablehlo as cudnn

from tests.shared.aggregation import aggregate
from tests.shared.tiny import tiny_config
from vggtjax.method.algorithm import Clips, run_method, run_passes
from vggtjax.method.fusion.family import PARTS, start
from vggtjax.method.mask_refinement import cluster_losses, cluster_points
from vggtjax.network.heads.dpt_head import predict_dense
from vggtjax.network.kernels import attention
from vggtjax.network.model import forward, parameter_shapes
from vggtjax.network.precision import Compute
from vggtjax.options import METHODS, Options
from vggtjax.training.data import make_batch
from vggtjax.training.recipe import Phase
from vggtjax.training.scenes.textures import load_textures

PLATFORMS = ("cuda", "tpu")
SIZE, FRAMES = (56, 56), 4
CONFIG = tiny_config(track_corr_levels=3)
CUDNN = ("__cudnn$fmhaSoftmax", "__cudnn$fmhaSoftmaxBackward")
CALLS = [export.DisabledSafetyCheck.custom_call(name) for name in CUDNN]


def array(*shape, dtype: Any = jnp.float32) -> Any:
    return jax.ShapeDtypeStruct(shape, dtype)


def shapes(tree):
    return jax.tree.map(lambda x: array(*jnp.shape(x), dtype=jnp.result_type(x)), tree)


def lowered(function, *arguments, platforms=PLATFORMS, **options):
    """Lower a function of arrays. A callback to the host cannot be lowered for two platforms."""
    return export.export(jax.jit(function), platforms=platforms, disabled_checks=CALLS)(*arguments, **options)


def text(*arguments, **options):
    return str(lowered(*arguments, **options).mlir_module())


class Lower:
    """Lowers each step in place of running it, once for equal keywords and shapes."""

    def __init__(self):
        self.outputs = {}

    def __call__(self, name, function):
        def lower(*arguments, **static):
            leaves, structure = jax.tree.flatten(shapes(arguments))
            key = (name, str(static), tuple(leaves), structure)
            if key not in self.outputs:
                exported = lowered(partial(function, **static), *shapes(arguments))
                self.outputs[key] = jax.tree.unflatten(exported.out_tree, exported.out_avals)
            return self.outputs[key]

        return lower


@pytest.fixture(scope="module")
def lower():
    return Lower()


OTHERS = [method for method in METHODS if method not in ("vggt4d", "4dvggt-d")]


@pytest.mark.parametrize(
    "method", ["vggt4d", "4dvggt-d", *(pytest.param(name, marks=pytest.mark.proof) for name in OTHERS)]
)
def test_the_stages_of_a_method(lower, method):
    """`vggt4d` in bfloat16, the others in float32; one of them with tracks, one with a fitted rule of fusion."""
    dtype = "bfloat16" if method == "vggt4d" else "float32"
    points = {3: array(1, 2, 2)} if method == "vggt" else {}
    fusion = shapes(start(tuple(PARTS))) if method == "4dvggt-d" else None
    options = Options(method=method, compute_dtype=dtype)
    clips = Clips(array(1, FRAMES, *SIZE, 3), query_points=points)
    how = {"fusion": fusion, "both_outputs": method != "vggt4d", "step": lower}
    run_method(parameter_shapes(CONFIG), clips, CONFIG, options, **how)
    assert {"image features", "first pass", "dynamic mask", "assemble"} <= {stage for stage, *_ in lower.outputs}


@pytest.mark.parametrize(
    ("precision", "head"), [("tf32", "HIGH"), pytest.param("highest", "HIGHEST", marks=pytest.mark.proof)]
)
def test_the_precision_of_products(precision, head):
    """Those of a dense head and of its four taps have the given precision; all others are exact."""
    run = partial(forward, config=CONFIG, outputs=("camera", "depth"), precision=precision)
    lines = text(run, parameter_shapes(CONFIG), array(1, 2, *SIZE, 3), platforms=["cuda"]).splitlines()
    found = {}
    for name in ("convolution", "dot_general"):
        products = [line for line in lines if f"stablehlo.{name}" in line]
        found[name] = [set(re.findall("HIGH(?:EST)?|DEFAULT", line)) for line in products]
    patches, *of_the_head = found["convolution"]
    assert patches == {"HIGHEST"}
    assert of_the_head == [{head}] * 21
    assert found["dot_general"].count({"HIGHEST"}) == len(found["dot_general"]) - (11 if head == "HIGH" else 0)


def test_sampled_attention(lower):
    options = Options(attention="sampled", method="vggt")
    run_passes(parameter_shapes(CONFIG), array(1, FRAMES, *SIZE, 3), CONFIG, options, step=lower)


def test_mask_refinement():
    pixels, points = (FRAMES, *SIZE), (FRAMES, 50)
    lowered(cluster_points, shapes(jax.random.key(0)), array(*points, 3), array(*points, dtype=bool))
    arrays = (array(*pixels, 3), array(*pixels), array(*pixels, dtype=bool), array(FRAMES, 3, 4), array(FRAMES, 3, 3))
    lowered(
        cluster_losses,
        *arrays,
        array(*points, dtype=np.int32),
        array(*points, dtype=bool),
        array(*points, dtype=np.int32),
    )


def test_the_gradient_of_the_blocks():
    """Attention has a backward pass of its own."""
    h, w = (side // CONFIG.patch_size for side in SIZE)

    def loss(params, tokens):
        return aggregate(params, tokens, CONFIG, (h, w), captures=(), compute=Compute(remat=True))[0].sum()

    lowered(jax.grad(loss), parameter_shapes(CONFIG), array(1, FRAMES, h * w, CONFIG.embed_dim))


def test_the_gradient_of_a_dense_head():
    """Resizing has a backward pass of its own."""
    h, w = (side // CONFIG.patch_size for side in SIZE)

    def loss(params, taps):
        return predict_dense(params, taps, CONFIG, (h, w), "depth")[0].sum()

    taps = [array(1, FRAMES, h * w, width) for width in CONFIG.dpt_channels]
    lowered(jax.grad(loss), parameter_shapes(CONFIG)["depth_head"], taps)


@pytest.mark.proof
def test_batches_that_are_drawn_on_the_device():
    run = partial(make_batch, phase=Phase(4, 1, (2,), *SIZE), frames=2)
    lowered(run, *shapes((jax.random.key(0), load_textures("training"))))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_the_kernels_that_need_their_device(monkeypatch, masked, dtype):
    """What `attention` takes where it finds the device: cuDNN's kernel and its gradient, and that for TPUs."""
    heads = array(2, 140, 2, 64, dtype=dtype)
    visible = array(2, 140, dtype=bool) if masked else None
    assert "tpu_custom_call" in text(attention._on_tpu, heads, heads, heads, visible, platforms=["tpu"])
    if dtype == "float32":  # which cuDNN does not take
        return
    monkeypatch.setattr(cudnn, "check_cudnn_version", lambda: 91200)  # as on a machine that has cuDNN
    run = partial(attention._packed, implementation="cudnn")
    assert CUDNN[0] in text(run, heads, heads, heads, visible, platforms=["cuda"])
    gradient = jax.grad(lambda q, k, v: run(q, k, v, visible).astype(np.float32).sum(), argnums=(0, 1, 2))
    if not masked:
        assert CUDNN[1] in text(gradient, heads, heads, heads, platforms=["cuda"])
