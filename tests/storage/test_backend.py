"""Platforms that jax cannot start."""

import os
import subprocess
import sys

import pytest

from vggtjax.storage.backend import backend


@pytest.mark.parametrize(
    ("platforms", "program"),
    [
        ("wrong", "import vggtjax; vggtjax.load_model('demo')"),
        ("cuda", "from vggtjax.interface.commands.main import main; main(['doctor'])"),
    ],
)
def test_a_platform_that_is_not_there_is_named(platforms, program):
    environment = os.environ | {"JAX_PLATFORMS": platforms}
    run = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=100, check=False
    )
    if platforms == "cuda" and not run.stderr:
        pytest.skip("there is a GPU")
    assert f"jax cannot start on JAX_PLATFORMS={platforms}" in run.stderr
    assert "unset it" in run.stderr.splitlines()[-1]


def test_this_platform():
    assert backend() in ("cpu", "gpu", "tpu")
