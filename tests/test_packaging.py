"""The wheel holds everything that an installation needs and rebuilds bit by bit; the locks fit pyproject.toml."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
_MOST_BYTES = 30e6  # of the wheel; the embedded model is nearly all of it


def sources(folder: Path) -> Path:
    """Copy what a wheel is built from: setuptools leaves a build folder, whose stale files would enter later wheels."""
    folder.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    for name in ("vggtjax", "converters", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def build_wheel(source: Path, out: Path) -> Path:
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(source)]
    dated = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
    made = subprocess.run(command, capture_output=True, text=True, check=False, env=dated)
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr[-2000:]
    (wheel,) = out.glob("*.whl")
    return wheel


def test_the_wheel_works_outside_the_repository_and_rebuilds_bit_by_bit(tmp_path):
    wheel = build_wheel(sources(tmp_path / "source"), tmp_path)
    again = sources(tmp_path / "again")
    for path in again.rglob("*"):
        os.utime(path, (1e9, 1e9))
    assert build_wheel(again, tmp_path / "rebuilt").read_bytes() == wheel.read_bytes()
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


def test_the_locks_fit_the_project_and_have_hashes():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    project, extras = content["project"], content["project"]["optional-dependencies"]
    needed = [Requirement(text) for text in project["dependencies"] + extras["dev"]]
    own = next(one for one in needed if one.name == project["name"])
    needed += [Requirement(text) for extra in own.extras for text in extras[extra]]
    needed.remove(own)
    locks = {"dev": needed, "supply": [Requirement(text) for text in content["dependency-groups"]["supply"]]}
    for name, requirements in locks.items():
        text = (ROOT / f"requirements/{name}.lock").read_text("utf-8").replace("\\\n", "")
        entries = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
        pins: dict[str, list[str]] = {}
        for entry in entries:
            assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), entry
            package, version = entry.split()[0].split("==")
            pins.setdefault(package, []).append(version)
        for requirement in requirements:
            versions = pins.get(re.sub(r"[-_.]+", "-", requirement.name).lower(), [])
            assert versions, f"{requirement.name} is not in {name}.lock; run make lock"
            assert all(requirement.specifier.contains(version) for version in versions), f"{requirement}: {versions}"
