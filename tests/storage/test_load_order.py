"""What else is in the process: other libraries, in every order of the imports, and platforms that jax cannot start."""

import importlib.util
import os
import subprocess
import sys
from functools import partial

import pytest

_SAVE = """
import io, numpy, zlib
from PIL import Image
Image.new("RGB", (64, 64)).save(io.BytesIO(), "PNG")
numpy.savez_compressed(io.BytesIO(), zeros=numpy.zeros(1000))
print("saved")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere libraries do not share symbols by name")
@pytest.mark.parametrize(
    "order", [("vggtjax", "pycolmap"), ("PIL.Image", "pycolmap", "vggtjax"), ("pycolmap", "vggtjax")]
)
def test_pictures_and_archives_are_saved_or_the_order_of_imports_is_refused(order):
    """What must not happen is an abort or a hang while a result is written, after all the work."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    program = "".join(f"import {name}\n" for name in order) + _SAVE
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    if order[0] == "pycolmap" and run.returncode == 1:  # where Python itself brings zlib, this order works
        assert "put `import vggtjax` before `import pycolmap`" in run.stderr.splitlines()[-1]
    else:
        assert (run.returncode, run.stdout) == (0, "saved\n"), run.stderr


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
