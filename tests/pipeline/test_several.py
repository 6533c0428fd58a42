"""Several methods at once: the same results as one by one, from passes that are run once."""

from contextlib import contextmanager

import numpy as np
import pytest

from vggtjax import reconstruct
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
