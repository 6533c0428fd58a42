"""Explanations of changes that no test notices."""

import tomllib
from pathlib import Path

from benchmarks.mutants import MODULES

ROOT = Path(__file__).parents[2]


def test_every_explained_line_stands_in_its_module():
    for name, groups in tomllib.loads((ROOT / "benchmarks/mutants.toml").read_text()).items():
        lines = {line.strip() for line in (ROOT / MODULES[name].path).read_text().splitlines()}
        for group in groups:
            assert group["line"].splitlines()[0] in lines, (name, group["line"])
            assert group["to"], group["line"]
            assert group["why"], group["line"]
