"""Platforms that jax cannot start."""

import os
import subprocess
import sys
from functools import partial

import pytest


@pytest.mark.parametrize(
    ("platforms", "program"),
    [
        ("wrong", "import vggtjax; vggtjax.load_model('demo')"),
        ("cuda", "from vggtjax.interface.commands.main import main; main(['doctor'])"),
    ],
)
def test_a_platform_that_is_not_there_is_named(platforms, program):
    run = partial(subprocess.run, env=os.environ | {"JAX_PLATFORMS": platforms}, capture_output=True, text=True)
    run = run([sys.executable, "-c", program], timeout=100, check=False)
    if platforms == "cuda" and not run.stderr:
        pytest.skip("there is a GPU")
    assert f"jax cannot start on JAX_PLATFORMS={platforms}" in run.stderr
    assert "unset it" in run.stderr.splitlines()[-1]
