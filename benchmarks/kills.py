"""Commands that are killed and run again: python -m benchmarks kills --command convert --kills 50.

A process that has imported everything, and started nothing, forks one child for each run. A child kills itself with
SIGKILL just before its n-th change of a file below the work's folder (a file opened for writing, a rename, a removal, a
folder made or removed, an fsync), is killed by the system within the write that makes a file larger than a drawn number
of bytes, or is killed at a random moment. Then the same command runs again.
"""

from __future__ import annotations

import os
import random
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.file_contents import BROKEN, content
from benchmarks.killed_process import KILLED, finish, fork, start
from testing.make_checkpoint import make_checkpoint
from testing.seeded import seeded_images
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.storage.json_values import read_json

_ROOT = Path(__file__).parents[1]
_SIZE, _FRAMES, _CLIPS = 56, 3, 4
_PARTIAL = re.compile(r"partial|incomplete|tmp")  # names of files that are not whole
TINY = VGGTConfig(
    image_size=_SIZE,
    embed_dim=16,
    depth=4,
    taps=(0, 1, 2, 3),
    num_heads=2,
    dino_depth=1,
    dino_num_heads=2,
    camera_depth=1,
    camera_num_heads=2,
    dpt_features=8,
    dpt_channels=(8, 8, 8, 8),
)


class Case(NamedTuple):
    """A command: its words, with {inputs} and {out}, and files of a kind of their own."""

    words: str
    at_once: tuple[str, ...] = ()  # folders that have all their files as soon as they are there, and are not replaced
    growing: tuple[str, ...] = ()  # whole at each moment, with other content than at the end
    timed: tuple[str, ...] = ()  # such as checkpoints: any of them may be there, but no unfinished one after the end


_MODEL = "--model {inputs}/model.safetensors"
CASES = {
    "convert": Case("convert {inputs}/source.safetensors {out}/model.safetensors --config {inputs}/config.json"),
    "reconstruct": Case(f"reconstruct {{inputs}}/clips/a {_MODEL} --out {{out}}/result"),
    "batch": Case(f"batch {{inputs}}/clips {_MODEL} --only cameras,depth --out {{out}}", growing=("index.html",)),
    "export": Case("export {inputs}/result --out {out}/model --to colmap-text", at_once=("model",)),
    "evaluate": Case(f"evaluate plain {{inputs}}/data {_MODEL} --methods vggt,4dvggt-d --out {{out}}/scores"),
    "fit-fusion": Case(
        f"fit-fusion --data plain={{inputs}}/data {_MODEL} --family scale paper --seeds 1 --steps 20 --pixels 300 "
        "--out {out}/fit",
        growing=("fit/states/*.npz",),
    ),
    "train": Case(
        "train --recipe {inputs}/recipe.json --out {out}/run --log-every 2 --checkpoint-seconds 0.1",
        growing=("run/metrics.csv", "run/metrics.png", "run/model.safetensors"),
        timed=("run/checkpoints/*",),
    ),
}


_HEADINGS = ("command", "changes of files", "kills at changes", "in writes", "at random", "two at once", "problems")


class Tally(NamedTuple):
    """What came of a command: kills of each kind, and what was wrong."""

    command: str
    changes: int  # of files in an undisturbed run
    at_changes: int
    in_writes: int
    at_random: int
    pairs: int
    problems: list[str]


Files = dict[str, str]  # names below the folder, with those of folders -> `content`


def kills(*, command: tuple[str, ...] = tuple(CASES), kills: int = 50, pairs: int = 20, seed: int = 0) -> None:
    """Kill commands and run them again: outputs must be whole or absent, and the next run's those of a whole run.

    Args:
        command: what is killed; all by default.
        kills: of each command: four fifths spread over its changes of files, the others in writes or at random moments.
        pairs: rounds of two runs of a command at the same time in one folder.
        seed: of the random moments and sizes.
    """
    for name in command:
        if name not in CASES:
            raise InputError(f"command is {name!r}; expected one of {', '.join(CASES)}")
    screen, tallies = Console(), []
    with TemporaryDirectory() as folder, _places(Path(folder)):
        prepare(Path(folder) / "inputs", command)
        for name in command:
            tally = kill_command(name, Path(folder), kills=kills, pairs=pairs, draws=random.Random(seed))
            tallies.append(tally)
            for problem in tally.problems:
                screen.print(f"{name}: {problem}", markup=False)
            screen.print(f"{name}: {sum(tally[2:5])} kills, {len(tally.problems)} problems")
    table = Table(title="runs that were killed and run again", box=None)
    for heading in _HEADINGS:
        table.add_column(heading, justify="left" if heading == "command" else "right")
    for tally in tallies:
        table.add_row(tally.command, *map(str, tally[1:6]), str(len(tally.problems)))
    screen.print(table)
    if any(tally.problems for tally in tallies):
        raise InputError("some outputs were not whole, or runs did not go on; the problems are above")


def kill_command(name: str, folder: Path, *, kills: int, pairs: int, draws: random.Random) -> Tally:
    """Kill a command so many times, each time with an empty folder, and run two at once."""
    case, work = CASES[name], folder / "work" / name
    words = [word.format(inputs=folder / "inputs", out=work / "out") for word in case.words.split()]
    out = work / "out"

    def run(**how: Any) -> tuple[int, str]:
        out.mkdir(parents=True, exist_ok=True)
        return finish(*start(words, work / "log", out, **how), work / "log")

    wholes, sizes, seconds = [], [2], 1.0
    for _ in range(3):  # the first fills the caches
        began = time.perf_counter()
        code, said = run(count=work / "count")
        seconds = time.perf_counter() - began
        if code:
            raise InputError(f"{name} ends with code {code} without a kill: {said}")
        wholes.append(files_below(out))
        sizes = [path.stat().st_size for path in sorted(out.rglob("*")) if path.is_file() and path.stat().st_size > 1]
        _clear(out)
    changes = int((work / "count").read_text())
    checks = _Checks(case, wholes[-1], [])
    checks.check_places("whole runs", folder)
    checks.check("two whole runs", wholes[-2], ended=True)

    at_changes = min(kills - 2 * max(kills // 10, 1), 10 * changes)
    in_writes = (kills - at_changes) // 2
    killed = {"change": 0, "size": 0, "seconds": 0}

    def all_moments() -> Iterator[tuple[str, float]]:
        for number in range(at_changes):
            yield "change", 1 + number * changes // at_changes
        for _ in range(4 * kills):  # no file may have so many bytes when it is written
            if killed["size"] < in_writes:
                yield "size", draws.randrange(1, draws.choice(sizes))
        for _ in range(4 * kills):  # some come after the end
            if sum(killed.values()) < kills:
                yield "seconds", draws.uniform(0.0, seconds)

    for kind, value in track(all_moments(), f"{name}: kills", total=kills, transient=True):
        label = f"killed at {kind} {value:.6g}"
        code, said = run(**{kind: value})
        if code in KILLED:
            killed[kind] += 1
        elif code:
            checks.problems.append(f"{label}: code {code}: {said}")
        checks.check(label, files_below(out), ended=False)
        for below in case.at_once:
            _clear(out / below)  # the next run replaces nothing; what is beside it stays
        code, said = run()
        if code:
            checks.problems.append(f"{label}: the next run ends with code {code}: {said}")
        else:
            checks.check(f"{label}, then run again", files_below(out), ended=True)
        checks.check_places(f"{label}, then run again", folder)
        _clear(out)
    for number in track(range(pairs), f"{name}: two at once", transient=True):
        out.mkdir(parents=True, exist_ok=True)
        logs = [work / f"log{side}" for side in (0, 1)]
        started = [start(words, log, out) for log in logs]
        checks.check_pair(f"round {number} of two", [finish(*one, log) for one, log in zip(started, logs, strict=True)])
        checks.check(f"round {number} of two", files_below(out), ended=True)
        checks.check_places(f"round {number} of two", folder)
        _clear(out)
    return Tally(name, changes, killed["change"], killed["size"], killed["seconds"], pairs, checks.problems)


class _Checks(NamedTuple):
    """What is wrong with the files of runs, beside those of a whole run."""

    case: Case
    whole: Files
    problems: list[str]

    def check(self, label: str, files: Files, *, ended: bool) -> None:
        """Note files that are half-written, differ, or are left behind or missing where all ought to be there.

        All ought to be there after the end, and in a folder that has all its files at once.
        """
        there = tuple(f"{folder}/" for folder in self.case.at_once if folder in files)
        for path, found in files.items():
            if self._is_timed(path) and "tmp" not in path:
                continue
            if path not in self.whole:
                if ended or path.startswith(there):
                    self.problems.append(f"{label}: {path} is left behind")
            elif found == BROKEN:
                self.problems.append(f"{label}: {path} is half-written")
            elif found != self.whole[path] and (ended or not _fits(path, self.case.growing)):
                self.problems.append(f"{label}: {path} differs from a whole run's")
        missing = [path for path in self.whole.keys() - files.keys() if ended or path.startswith(there)]
        self.problems.extend(f"{label}: {path} is missing" for path in sorted(missing) if not self._is_timed(path))

    def check_pair(self, label: str, ends: list[tuple[int, str]]) -> None:
        """Note two runs that both failed, and one that failed without a sentence."""
        if all(code for code, _ in ends):
            self.problems.append(f"{label}: neither ends: {ends[0][1]}; {ends[1][1]}")
        for code, said in ends:
            if code not in (0, 2) or "Traceback" in said:
                self.problems.append(f"{label}: code {code}: {said}")

    def check_places(self, label: str, folder: Path) -> None:
        """Note what is left for ever, in the temporary folder and, under partial names, in the cache; remove it."""
        left = sorted((folder / "tmp").iterdir())
        left += [path for path in sorted((folder / "cache").rglob("*")) if _PARTIAL.search(path.name)]
        for path in left:
            self.problems.append(f"{label}: {path.relative_to(folder)} is left behind")
            if path.is_dir():
                _clear(path)
            else:
                path.unlink(missing_ok=True)

    def _is_timed(self, path: str) -> bool:
        return _fits(path, self.case.timed)


@contextmanager
def _places(folder: Path) -> Iterator[None]:
    """Let commands have their temporary files and their cache in a folder."""
    earlier = tempfile.tempdir
    (folder / "tmp").mkdir()
    tempfile.tempdir = str(folder / "tmp")  # of the children that this process forks; TMPDIR of those that they start
    os.environ |= {"TMPDIR": tempfile.tempdir, "VGGTJAX_CACHE": str(folder / "cache")}
    try:
        yield
    finally:
        tempfile.tempdir = earlier


def _fits(path: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(path, pattern) for pattern in patterns)


def prepare(inputs: Path, commands: tuple[str, ...]) -> None:
    """Write the inputs of the commands."""
    inputs.mkdir(parents=True)
    golden = _ROOT / "tests" / "golden"
    if "convert" in commands:
        (inputs / "config.json").write_text((golden / "config.json").read_text())
        make_checkpoint(
            inputs / "source.safetensors", read_json(golden / "shapes.json", dict[str, list[int]], "shapes")
        )
    if "train" in commands:
        (inputs / "recipe.json").write_text((_ROOT / "docs" / "recipes" / "smoke.json").read_text())
    for number, clip in enumerate("ab"):
        (inputs / "clips" / clip).mkdir(parents=True)
        for frame, image in enumerate(seeded_images(_FRAMES, _SIZE, _SIZE, number).transpose(0, 2, 3, 1)):
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(inputs / "clips" / clip / f"{frame}.png")
    if {"evaluate", "fit-fusion"} & set(commands):
        _write_data(inputs / "data")

    def write_model() -> int:
        from vggtjax.checkpoint import save_model
        from vggtjax.network.model import init_params

        save_model(inputs / "model.safetensors", init_params(0, TINY), TINY)
        return 0

    code, said = 0, ""
    if any("{inputs}/model.safetensors" in CASES[name].words or name == "export" for name in commands):
        code, said = finish(*fork(write_model, inputs / "log"), inputs / "log")
    if not code and "export" in commands:
        words = CASES["reconstruct"].words.replace("{out}", "{inputs}").format(inputs=inputs).split()
        code, said = finish(*start(words, inputs / "log", inputs), inputs / "log")
    if code:
        raise InputError(f"the inputs cannot be made: {said}")


def _write_data(root: Path) -> None:
    """Write four sequences in the plain layout: three frames each of the embedded clip."""
    from vggtjax.cameras import world_from_camera
    from vggtjax.pretrained.embedded import demo_clip

    clip = demo_clip()
    poses = world_from_camera(np.asarray(clip.camera_from_world))
    for part in range(_CLIPS):
        folder, frames = root / f"clip{part}", range(_FRAMES * part, _FRAMES * (part + 1))
        for below in ("rgb", "depth", "mask"):
            (folder / below).mkdir(parents=True)
        for i in frames:
            Image.fromarray(np.rint(255 * clip.images[i]).astype(np.uint8)).save(folder / f"rgb/{i:05d}.png")
            Image.fromarray(np.rint(1000 * clip.depth[i]).astype(np.uint16)).save(folder / f"depth/{i:05d}.png")
            Image.fromarray(clip.dynamic_mask[i].astype(np.uint8) * 255).save(folder / f"mask/{i:05d}.png")
        np.savetxt(folder / "K.txt", clip.intrinsics[0])
        np.savetxt(folder / "world_from_camera.txt", poses[frames.start : frames.stop].reshape(_FRAMES, 16))


def files_below(folder: Path) -> Files:
    """Return the files and folders below a folder, hidden ones too, with digests of what is in the files."""
    return {str(path.relative_to(folder)): content(path) for path in sorted(folder.rglob("*"))}


def _clear(folder: Path) -> None:
    import shutil

    shutil.rmtree(folder, ignore_errors=True)
