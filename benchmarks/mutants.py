"""Changes of the code that some test must notice: python -m benchmarks mutants --module pose.

cosmic-ray (https://cosmic-ray.readthedocs.io) makes the changes, one at a time, in a copy of the repository, and runs
the tests of the module. Install it in any environment whose programs are on the PATH: `pipx install cosmic-ray`.
mutants.toml explains changes that the module's own tests do not notice, such as a factor that cancels.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.suite.report import write_json
from vggtjax.errors import InputError

_ROOT = Path(__file__).parents[1]


class Module(NamedTuple):
    """A file, and the tests that must notice its changes."""

    path: str
    tests: tuple[str, ...]


MODULES = {
    "fusion": Module("vggtjax/method/fusion.py", ("tests/method/test_fusion.py",)),
    "mask": Module("vggtjax/method/mask.py", ("tests/method/test_mask.py",)),
    "motion": Module("vggtjax/method/cues.py", ("tests/method/test_cues.py",)),
    "pose": Module("vggtjax/network/pose.py", ("tests/network/test_pose.py",)),
    "files": Module("vggtjax/storage/writing.py", ("tests/storage/test_writing.py",)),
}
# One or two changes for each operator; cosmic-ray knows a dozen, most of which fail at once.
_KEPT = {
    "ReplaceBinaryOperator": "Add_Sub|Sub_Add|Mul_Div|Div_Mul|FloorDiv_Mul|Mod_Mul|Pow_Mul|BitAnd_BitOr",
    "ReplaceComparisonOperator": "Eq_NotEq|NotEq_Eq|Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Is_IsNot|IsNot_Is",
    "ReplaceUnaryOperator": "USub_UAdd|Invert_USub|Delete_Not",
}
_CONFIG = """
[cosmic-ray]
module-path = "{path}"
timeout = {seconds}
excluded-modules = []
test-command = "{command}"
[cosmic-ray.distributor]
name = "local"
[cosmic-ray.filters.operators-filter]
exclude-operators = [{excluded}]
"""
_ROWS = """
SELECT spec.start_pos_row, result.test_outcome, result.diff, result.output = 'timeout'
FROM mutation_specs AS spec JOIN work_results AS result ON spec.job_id = result.job_id
WHERE result.worker_outcome != 'SKIPPED' ORDER BY spec.start_pos_row
"""


class Score(NamedTuple):
    """What became of the changes of a module."""

    module: str
    changes: int
    noticed: int
    late: int  # noticed because the tests took too long, as they also do on a busy machine
    explained: int  # changes of mutants.toml that no test noticed
    survivors: list[str]  # the others: each a line's number, the line before and after
    stale: list[str]  # explained changes that tests notice, or that were not made

    def percent(self, *, explained: bool) -> str:
        """Return the share of noticed changes, or of noticed and explained ones."""
        return f"{100 * (self.noticed + explained * self.explained) / max(self.changes, 1):.1f} %"


def mutants(
    *, module: tuple[str, ...] = tuple(MODULES), seconds: float = 120.0, share: int = 1, out: Path | None = None
) -> None:
    """Change modules in one place at a time, run their tests, and list the changes that no test notices.

    Args:
        module: names of modules; all by default.
        seconds: after which a run of the tests has noticed its change.
        share: take every n-th change alone.
        out: JSON file for the scores and the survivors.
    """
    if unknown := [name for name in module if name not in MODULES]:
        raise InputError(f"module is {unknown[0]!r}; expected some of {', '.join(MODULES)}")
    if share < 1 or not seconds > 0:
        raise InputError(f"share is {share} and seconds is {seconds}; expected at least 1, and more than 0")
    for program in ("cosmic-ray", "cr-filter-operators"):
        if shutil.which(program) is None:
            raise InputError(f"there is no program {program}; install it: pipx install cosmic-ray")
    console, scores = Console(), []
    for name in module:
        with TemporaryDirectory() as folder:
            scores.append(_score(name, Path(folder), seconds, share, console))
        for line in scores[-1].survivors:
            console.print(f"{MODULES[name].path}:{line}", markup=False, soft_wrap=True)
        for change in scores[-1].stale if share == 1 else ():
            console.print(f"explained without need: {change}", markup=False, soft_wrap=True)
        if out is not None:
            write_json(out, {"scores": [score._asdict() for score in scores]})
    table = Table(title="changes that the tests of a module notice", title_justify="left")
    for heading in ("module", "changes", "noticed", "share", "by time", "explained", "with explained"):
        table.add_column(heading, justify="left" if heading == "module" else "right")
    for score in scores:
        noticed, both = score.percent(explained=False), score.percent(explained=True)
        row = score.changes, score.noticed, noticed, score.late, score.explained, both
        table.add_row(MODULES[score.module].path, *map(str, row))
    console.print(table)


def _score(name: str, folder: Path, seconds: float, share: int, console: Console) -> Score:
    path, tests = MODULES[name]
    root, session = folder / "copy", str(folder / "session.sqlite")
    _copy(root)
    pytest = f"{sys.executable} -m pytest -x -q --hasty -p no:cacheprovider {' '.join(tests)}"
    excluded = ", ".join(f'"core/{kind}_(?!({kept})$).*"' for kind, kept in _KEPT.items())
    config = folder / "config.toml"
    config.write_text(_CONFIG.format(path=path, seconds=seconds, command=pytest, excluded=excluded))
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(root)}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"  # most programs of these tests are small

    def run(*words: str) -> None:
        done = subprocess.run(words, cwd=root, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{words[0]} {words[1]} failed for {name}: {' '.join(done.stderr.split())[-300:]}")

    run(*pytest.split())
    run("cosmic-ray", "init", str(config), session)
    run("cr-filter-operators", session, str(config))
    with closing(sqlite3.connect(session)) as connection:
        left = [
            job
            for (job,) in connection.execute("SELECT job_id FROM mutation_specs EXCEPT SELECT job_id FROM work_results")
        ]
        for number, job in enumerate(sorted(left)):
            if number % share:
                connection.execute("DELETE FROM mutation_specs WHERE job_id = ?", (job,))
                connection.execute("DELETE FROM work_items WHERE job_id = ?", (job,))
        connection.commit()
    total = len(range(0, len(left), share))
    running = subprocess.Popen(
        ["cosmic-ray", "exec", str(config), session],
        cwd=root,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(name, total=total)
        while running.poll() is None:
            progress.update(task, completed=len(_rows(session)))
            try:
                running.wait(1)
            except subprocess.TimeoutExpired:
                continue
    rows = _rows(session)
    if running.returncode or len(rows) < total:
        raise InputError(
            f"cosmic-ray ended with code {running.returncode} after {len(rows)} of {total} changes of {name}"
        )
    survivors = [(line, _shown(diff)) for line, outcome, diff, _ in rows if outcome == "SURVIVED"]
    noticed, known = len(rows) - len(survivors), _explained(name)
    late = sum(is_late for *_, is_late in rows)
    unknown = [f"{line}: {change}" for line, change in survivors if change not in known]
    stale = sorted(known - {change for _, change in survivors})
    return Score(name, len(rows), noticed, late, len(survivors) - len(unknown), unknown, stale)


def _copy(root: Path) -> None:
    """Copy the files that git knows."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=_ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (source := _ROOT / name).is_file():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, root / name)


def _rows(session: str) -> Sequence[tuple[int, str, str, int]]:
    with closing(sqlite3.connect(session, timeout=60)) as connection:
        return connection.execute(_ROWS).fetchall()


def _explained(name: str) -> set[str]:
    """Return the changes of a module that its own tests do not notice, for a reason."""
    groups = tomllib.loads((Path(__file__).with_suffix(".toml")).read_text()).get(name, [])
    return {f"{group['line']} -> {to}" for group in groups for to in group["to"]}


def _shown(diff: str) -> str:
    """Return the changed lines of a diff."""
    lines = diff.splitlines()
    changed = [text[1:].strip() for text in lines if text[:1] in "+-" and not text.startswith(("+++", "---"))]
    return " -> ".join(changed)
