"""Settings that a program makes for its own code change no result and break no run."""

import jax
import numpy as np
import pytest

from tests.corner import make_corner, paint
from tests.tiny import tiny_model
from vggtjax import load_clip, reconstruct

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
        assert jax.config.jax_enable_x64
        assert set(np.geterr().values()) == {"raise"}
    for name in ("depth", "depth_confidence", "camera_from_world", "intrinsics"):
        np.testing.assert_array_equal(getattr(other, name), getattr(plain, name))
