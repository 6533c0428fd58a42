"""The wheels that gpu-day needs beside jax, for a machine without a package index: make gpu-day-wheels.

Those of the lock, by their hashes. The machine has jax and what jax needs: jaxlib, numpy, scipy, ml_dtypes, opt_einsum.
Packages of other benchmarks and of files (av, pillow, scikit-image, ...), ten times as large, are left out.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from packaging.requirements import Requirement

PACKAGES = (  # by what needs the others of its line
    "flax", "absl-py", "msgpack", "pyyaml", "typing-extensions",
    "filelock", "platformdirs",
    "jaxtyping", "wadler-lindig",
    "lazy-loader",
    "msgspec",
    "optax",  # of benchmarks/accelerator, whose count makes the bounds
    "rich", "markdown-it-py", "mdurl", "pygments",
    "safetensors",
    "tyro", "docstring-parser", "typeguard",
)  # fmt: skip
LOCK = Path(__file__).parents[2] / "requirements/dev.lock"
_GLIBC = range(28, 4, -1)  # minor versions, the newest first


def main(python: str, folder: str) -> None:
    """Download the wheels for a version of Python, such as 3.12, on Linux with x86_64."""
    pins = locked(LOCK.read_text(encoding="utf-8"), python)
    platforms = [f"manylinux{age}_x86_64" for age in (*(f"_2_{minor}" for minor in _GLIBC), "2014", "2010", "1")]
    with TemporaryDirectory() as temporary:
        requirements = Path(temporary, "requirements.txt")
        requirements.write_text("\n".join(pins.values()), encoding="utf-8")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
        command += ["--only-binary=:all:", "--implementation=cp", f"--python-version={python}"]
        command += [f"--platform={name}" for name in platforms]
        subprocess.run([*command, f"--dest={folder}", f"--requirement={requirements}"], check=True)
    sizes = [path.stat().st_size for path in Path(folder).glob("*.whl")]
    sys.stdout.write(f"{len(sizes)} wheels for Python {python}, {sum(sizes) / 1e6:.1f} MB, in {folder}\n")


def locked(lock: str, python: str) -> Mapping[str, str]:
    """Return the lock's pins of the packages on Linux with this Python, with their hashes, by name."""
    there = {"python_version": python, "python_full_version": f"{python}.0", "implementation_name": "cpython"}
    there |= {"sys_platform": "linux", "platform_machine": "x86_64", "platform_python_implementation": "CPython"}
    pins = {}
    for line in lock.replace("\\\n", "").splitlines():
        text, *hashes = line.split(" --hash=")
        pin = Requirement(text) if hashes else None
        if pin and pin.name in PACKAGES and (pin.marker is None or pin.marker.evaluate(there)):
            pins[pin.name] = " ".join([f"{pin.name}{pin.specifier}", *(f"--hash={found.strip()}" for found in hashes)])
    if absent := set(PACKAGES) - set(pins):
        sys.exit(f"{', '.join(sorted(absent))}: not in the lock for Python {python}; make lock makes it anew")
    return pins


if __name__ == "__main__":
    main(*sys.argv[1:])
