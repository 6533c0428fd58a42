"""What several tests of the pipeline run: the tiny network, on a ball that crosses the picture."""

import numpy as np
import pytest

from tests.shared.moving_ball import moving_ball
from tests.shared.tiny import tiny_model
from vggtjax import load_clip


@pytest.fixture(scope="session")
def model():
    return tiny_model()


@pytest.fixture(scope="session")
def clip():
    return load_clip((255 * np.asarray(moving_ball(3))).astype(np.uint8), size=56)
