"""The cache of compiled programs that tests share: where it cannot be written or is damaged, tests run without it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run_tests(cache: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--hasty",
        "-q",
        "-o",
        f"cache_dir={cache}",
        "tests/network/test_pose.py",
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "PYTEST_"))}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]


@pytest.mark.proof
def test_tests_run_without_a_cache_and_with_a_damaged_one(tmp_path):
    (tmp_path / "file").touch()
    run_tests(tmp_path / "file" / "below")
    run_tests(tmp_path / "cache")
    entries = list((tmp_path / "cache").rglob("*-cache"))
    assert len(entries) > 10
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:50])
    run_tests(tmp_path / "cache")
