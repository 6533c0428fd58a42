"""gpu-day on a machine without a package index: python3 benchmarks/gpu_day/alone.py WHEELS --out report.

The machine has jax for its accelerator; WHEELS has the rest, made elsewhere by `make gpu-day-wheels`. What follows
WHEELS are options of gpu-day. This file imports the standard library alone.

The wheels are unpacked into a folder that stands first on PYTHONPATH. A virtual environment would need pip, which a
system's Python may lack; and made by the Python of another virtual environment, it would not see the jax of that one.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

_ROOT = Path(__file__).resolve().parents[2]


class RefusedError(Exception):
    """Why gpu-day cannot run here, as a sentence."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run gpu-day with these wheels; return its exit code, or 2 where it cannot run."""
    parser = argparse.ArgumentParser(description="python -m benchmarks gpu-day, with wheels in place of an index")
    parser.add_argument("wheels", type=Path, help="folder that make gpu-day-wheels made")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="of gpu-day: --out report ...")
    given = parser.parse_args(arguments)
    with TemporaryDirectory(prefix="gpu-day-") as folder:
        try:
            unpack(fitting(given.wheels), Path(folder))
        except RefusedError as refused:
            sys.stderr.write(f"gpu-day: {refused}\n")
            return 2
        path = os.pathsep.join([str(_ROOT), folder, *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-P", "-m", "benchmarks", "gpu-day", *given.options]
        return subprocess.call(command, env={**os.environ, "PYTHONPATH": path})


def fitting(folder: Path) -> list[Path]:
    """Return the wheels of a folder. Raises RefusedError where jax is missing, or a wheel is for another Python."""
    missing = [name for name in ("jax", "jaxlib") if find_spec(name) is None]
    if missing:
        raise RefusedError(f"{sys.executable} has no {missing[0]}; expected a Python with jax for the accelerator")
    if not folder.is_dir():
        raise RefusedError(f"{folder} is no folder; expected the folder of wheels that make gpu-day-wheels writes")
    wheels = sorted(folder.glob("*.whl"))
    if not wheels:
        raise RefusedError(f"{folder} has no wheels; make them where there is an index: make gpu-day-wheels")
    python = "{}.{}".format(*sys.version_info)
    for wheel in wheels:
        if not fits(wheel.name):
            raise RefusedError(
                f"{wheel.name} does not fit Python {python} on {sys.platform}, {platform.machine()}; make wheels for "
                f"it, on Linux with x86_64: make gpu-day-wheels FOR_PYTHON={python}"
            )
    return wheels


def fits(name: str) -> bool:
    """Return whether the wheel of this file name is for this Python and processor."""
    parts = name[: -len(".whl")].split("-")
    if len(parts) < 5:
        return False
    pythons, abis, platforms = (part.split(".") for part in parts[-3:])
    major, minor = sys.version_info[:2]
    own, older = f"cp{major}{minor}", {f"{kind}{major}{i}" for kind in ("cp", "py") for i in range(minor + 1)}
    if "none" in abis:
        runs = not {own, f"py{major}", *older}.isdisjoint(pythons)
    elif "abi3" in abis:
        runs = not older.isdisjoint(pythons)
    else:
        runs = own in pythons and own + getattr(sys, "abiflags", "") in abis
    own_system = [tag for tag in platforms if "linux" in tag and tag.endswith(f"_{platform.machine()}")]
    return runs and ("any" in platforms or (sys.platform == "linux" and bool(own_system)))


def unpack(wheels: Sequence[Path], folder: Path) -> None:
    """Unpack wheels into one folder to import from. Raises RefusedError for a file that is no wheel."""
    for wheel in wheels:
        try:
            with zipfile.ZipFile(wheel) as files:
                files.extractall(folder)
        except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:  # damaged, or encrypted
            raise RefusedError(f"{wheel} cannot be unpacked: {error}") from None


if __name__ == "__main__":
    sys.exit(main())
