"""The wheel holds everything that an installation needs and rebuilds bit by bit; the locks fit pyproject.toml."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
_MOST_BYTES = 30e6  # of the wheel; the embedded model is nearly all of it


def repository(folder: Path, umask: int) -> Path:
    """Commit what a wheel is built from, as it is now, in a repository of its own under a umask."""
    folder.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "Makefile"):
        shutil.copyfile(ROOT / name, folder / name)
    for name in ("vggtjax", "converters", "tests"):
        skipped = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=skipped, copy_function=shutil.copyfile)
    day = {f"GIT_{who}_DATE": "2026-01-01T00:00:00Z" for who in ("AUTHOR", "COMMITTER")}
    settings = ("user.name=test", "user.email=test@localhost", "commit.gpgsign=false", "core.compression=0")
    author = [word for setting in settings for word in ("-c", setting)]
    for command in (["init", "--quiet"], ["add", "--all"], ["commit", "--quiet", "--message", "All"]):
        subprocess.run(["git", *author, *command], cwd=folder, check=True, umask=umask, env=os.environ | day)
    for path in folder.rglob("*"):
        path.chmod((0o777 if path.is_dir() else 0o666) & ~umask)
    return folder


def build_wheel(source: Path, umask: int) -> Path:
    """Return the wheel of `make dist`, with this environment's Python in place of the pinned tools."""
    tools = source / ".venv" / "tools"
    (tools / "bin").mkdir(parents=True)
    (tools / "bin" / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@" --wheel\n')
    (tools / "bin" / "python").chmod(0o755)
    command = ["make", "dist", f"SUPPLY={tools}", f"--old-file={tools}/.installed"]
    made = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False, umask=umask)
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr[-2000:]
    (wheel,) = (source / "dist").glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return build_wheel(repository(tmp_path_factory.mktemp("wheel") / "source", 0o022), 0o022)


@pytest.mark.proof
def test_the_wheel_rebuilds_bit_by_bit(wheel, tmp_path):
    again = repository(tmp_path / "again", 0o077)
    (again / "vggtjax" / "stale.py").write_text("not committed")
    for path in again.rglob("*"):
        os.utime(path, (1e9, 1e9))
    assert build_wheel(again, 0o077).read_bytes() == wheel.read_bytes()


def test_every_file_of_the_package_goes_into_the_wheel():
    package = ROOT / "vggtjax"
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["package-data"]
    files = [path.relative_to(package) for path in package.rglob("*") if path.is_file()]
    data = [path for path in files if path.suffix not in (".py", ".pyc")]

    def fits(path: Path, pattern: str) -> bool:
        return path.match(pattern) and len(path.parts) == len(Path(pattern).parts)

    assert Path("pipeline/pretrained/model.safetensors") in data
    assert [path for path in data if not any(fits(path, pattern) for pattern in patterns["vggtjax"])] == []


@pytest.mark.proof
def test_the_wheel_works_outside_the_repository(wheel, tmp_path):
    assert wheel.stat().st_size < _MOST_BYTES
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    tops = {name.split("/")[0] for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert tops == {"vggtjax", "converters"}
    needed_files = ("__init__.pyi", "py.typed", "results/viewer/client/main.js")
    needed_files += (
        "pipeline/pretrained/model.safetensors",
        "pipeline/pretrained/second_pass.json",
        "pipeline/pretrained/WEIGHTS-LICENSE.md",
    )
    assert {f"vggtjax/{name}" for name in needed_files} <= set(names)
    (entry_points,) = (tmp_path / "installed").glob("*.dist-info/entry_points.txt")
    assert "vggtjax = vggtjax.__main__:run" in entry_points.read_text()
    (metadata,) = (tmp_path / "installed").glob("*.dist-info/METADATA")
    needed = [line for line in metadata.read_text().splitlines() if line.startswith("Requires-Dist: av")]
    assert needed  # videos are read without an extra
    assert not any("extra" in line for line in needed)
    environment = {"PYTHONPATH": str(tmp_path / "installed"), "PATH": ""}
    code = "import vggtjax, converters; print(vggtjax.__file__); vggtjax.forward; converters.convert; vggtjax.METHODS"
    made = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
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
    groups = content["dependency-groups"]
    locks = {"dev": needed} | {name: [Requirement(text) for text in texts] for name, texts in groups.items()}
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
