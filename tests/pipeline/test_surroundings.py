from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.corner import make_corner, paint
from tests.shared.tiny import tiny_model
from vggtjax import forward, load_clip, load_model, reconstruct
from vggtjax.method.algorithm import run_method
from vggtjax.network.model import init_params, parameter_shapes
from vggtjax.options import METHODS, Options

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


def test_settings_of_the_program_change_no_result(tmp_path):
    model, clip = tiny_model(), load_clip(paint(make_corner(2, 0.5)), size=56)

    def run():
        result = reconstruct(model, clip, method="vggt", consistent_depth=True)
        result.save(tmp_path / "out", only=("cameras",))
        return result

    plain = run()
    with jax.enable_x64(True), jax.transfer_guard("disallow"), np.errstate(all="raise"):
        other = run()
        assert jax.config.read("jax_enable_x64")
        assert set(np.geterr().values()) == {"raise"}
    for name in ("depth", "depth_confidence", "camera_from_world", "intrinsics"):
        np.testing.assert_array_equal(getattr(other, name), getattr(plain, name))


@pytest.fixture(name="strict")
def _strict():
    with jax.numpy_dtype_promotion("strict"):
        yield


_IMAGES = jax.ShapeDtypeStruct((1, 5, 56, 56, 3), jnp.float32)


@pytest.mark.usefixtures("strict")
@pytest.mark.parametrize(
    ("method", "masks", "dtype"),
    [*((method, None, "float32") for method in METHODS), ("4dvggt-d", jnp.bool_, "bfloat16"),
     ("4dvggt-m", None, "bfloat16"), ("4dvggt-d", jnp.float32, "float32")],
)  # fmt: skip
def test_types_may_be_promoted_strictly_in_every_method(method, masks, dtype):
    """Tracing is enough: types are checked there."""
    config = tiny_model().config
    params = parameter_shapes(config)
    given = {} if masks is None else {"masks": jax.ShapeDtypeStruct(_IMAGES.shape[:4], masks)}
    run = partial(run_method, config=config, options=Options(method=method, compute_dtype=dtype, align_scale=True))
    made, _ = jax.eval_shape(lambda params, images, given: run(params, images, **given), params, _IMAGES, given)
    assert made.depth.dtype == jnp.float32


@pytest.mark.usefixtures("strict")
def test_types_may_be_promoted_strictly_in_heads_weights_and_models(tiny_demo):
    config = tiny_model().config
    run = partial(forward, config=config, outputs=config.heads)
    points = jax.ShapeDtypeStruct((1, 3, 2), jnp.float32) if "tracks" in config.heads else None
    for stored in (jnp.float32, jnp.bfloat16):
        as_stored = partial(jax.ShapeDtypeStruct, dtype=stored)
        params = jax.tree.map(lambda leaf, of=as_stored: of(leaf.shape), parameter_shapes(config))
        assert jax.eval_shape(lambda p, x, q: run(p, x, query_points=q), params, _IMAGES, points).depth is not None
    init_params(0, config)
    load_model("demo")
