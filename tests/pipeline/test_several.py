"""Several methods at once, as one by one; and arguments of another class than their own."""

from contextlib import contextmanager

import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from vggtjax import Options, reconstruct
from vggtjax.errors import InputError
from vggtjax.pipeline.run import compile_ahead
from vggtjax.pipeline.several import reconstruct_methods

METHODS = ("4dvggt-d", "vggt4d")


@pytest.mark.filterwarnings("ignore:the field of view")
def test_methods_at_once_are_methods_one_by_one(model, clip):
    stages = []

    @contextmanager
    def on_stage(name):
        stages.append(name)
        yield None

    made = reconstruct_methods(model, clip, METHODS, on_stage=on_stage)
    assert tuple(made) == METHODS
    assert stages.count("first pass") == stages.count("second pass") == 2  # vggt4d mines and suppresses in its own way
    for method, result in made.items():
        alone = reconstruct(model, clip, method=method)
        assert (result.method, result.settings) == (method, alone.settings)
        for name in ("depth", "depth_confidence", "camera_from_world", "intrinsics", "dynamic_mask", "saliency"):
            np.testing.assert_allclose(getattr(result, name), getattr(alone, name), rtol=1e-5, atol=1e-6, err_msg=name)
        assert result.passes is None


CLIP = np.zeros((2, 56, 56, 3), np.uint8)


def test_arguments_in_the_wrong_place_are_named():
    model = tiny_model()
    for run, message in (
        (lambda: reconstruct(CLIP, model), r"model is ndarray .*; expected what load_model returned: reconstruct\(mod"),  # type: ignore
        (lambda: reconstruct("demo", CLIP), "model is str 'demo'; expected what load_model returned"),  # type: ignore
        (lambda: reconstruct(model.params, CLIP), "model is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options="vggt"), "options is str 'vggt'; .* its fields by name"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options=Options), "options is Options; expected Options"),  # type: ignore
        (lambda: reconstruct(model, CLIP, running={"devices": 1}), "running is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, known={"baseline": 1}), "known is dict .*; expected KnownGeometry"),  # type: ignore
        (lambda: reconstruct(model, CLIP, tracks=[[1, 2]]), "tracks is list"),  # type: ignore
        (lambda: compile_ahead("demo", 2, 56, 56), "model is str 'demo'"),  # type: ignore
        (lambda: reconstruct_methods(CLIP, model, ["vggt"]), "model is ndarray"),  # type: ignore
    ):
        with pytest.raises(InputError, match=message):
            run()
