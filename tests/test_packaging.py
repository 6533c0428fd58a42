"""The wheel holds everything that an installation needs."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
_MOST_BYTES = 30e6  # of the wheel; the embedded model is nearly all of it


def test_the_wheel_works_outside_the_repository(tmp_path):
    source = tmp_path / "source"  # setuptools leaves a build folder, whose stale files would end up in later wheels
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("vggtjax", "converters", "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    made = subprocess.run(build, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size < _MOST_BYTES
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    tops = {name.split("/")[0] for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert tops == {"vggtjax", "converters"}
    needed_files = (
        "__init__.pyi",
        "py.typed",
        "pretrained/model.safetensors",
        "pretrained/WEIGHTS-LICENSE.md",
        "viewer/client/main.js",
    )
    assert {f"vggtjax/{name}" for name in needed_files} <= set(names)
    (entry_points,) = (tmp_path / "installed").glob("*.dist-info/entry_points.txt")
    assert "vggtjax = vggtjax.__main__:run" in entry_points.read_text()
    (metadata,) = (tmp_path / "installed").glob("*.dist-info/METADATA")
    needed = [line for line in metadata.read_text().splitlines() if line.startswith("Requires-Dist: av")]
    assert needed  # videos are read without an extra
    assert not any("extra" in line for line in needed)
    code = "import vggtjax, converters; print(vggtjax.__file__); vggtjax.forward; converters.convert; vggtjax.METHODS"
    made = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "installed"), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    assert str(tmp_path) in made.stdout
