"""Other libraries in the process, in every order of the imports."""

import importlib.util
import subprocess
import sys

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
