"""Commands that are killed and run again: python -m benchmarks kills --command convert --kills 50.

A process that has imported everything, and started nothing, forks one child for each run. A child kills itself with
SIGKILL just before its n-th change of a file below the work's folder (a file opened for writing, a rename, a removal, a
folder made or removed, an fsync), or is killed at a random moment. Then the same command runs again.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import time
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.killed_process import finish, fork, start
from benchmarks.make_checkpoint import make_checkpoint
from benchmarks.seeded import seeded_images
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.storage.json_values import read_json

_ROOT = Path(__file__).parents[1]
_SIZE, _FRAMES, _CLIPS = 56, 3, 4
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
    """A command: its words, with {inputs} and {out}, files that grow while it runs, and files that a clock names."""

    words: str
    growing: tuple[str, ...] = ()
    timed: tuple[str, ...] = ()  # such as checkpoints: any of them may be there, but no unfinished one


_MODEL = "--model {inputs}/model.safetensors"
CASES = {
    "convert": Case("convert {inputs}/source.safetensors {out}/model.safetensors --config {inputs}/config.json"),
    "reconstruct": Case(f"reconstruct {{inputs}}/clips/a {_MODEL} --out {{out}}/result"),
    "batch": Case(f"batch {{inputs}}/clips {_MODEL} --only cameras,depth --out {{out}}", ("index.html",)),
    "export": Case("export {inputs}/result --out {out}/model --to colmap-text"),
    "evaluate": Case(f"evaluate plain {{inputs}}/data {_MODEL} --methods vggt,4dvggt-d --out {{out}}/scores", ("*",)),
    "fit-fusion": Case(
        f"fit-fusion --data plain={{inputs}}/data {_MODEL} --family scale paper --seeds 1 --steps 20 --pixels 300 "
        "--out {out}/fit",
        ("*",),
    ),
    "train": Case(
        "train --recipe {inputs}/recipe.json --out {out}/run --log-every 2 --checkpoint-seconds 0.1",
        ("*",),
        ("run/checkpoints/*",),
    ),
}


class Tally(NamedTuple):
    """What came of a command: kills at changes and at random moments, and what was wrong."""

    command: str
    changes: int  # of files in an undisturbed run
    at_changes: int
    at_random: int
    pairs: int
    problems: list[str]


Files = dict[str, str]  # names below the folder, with those of folders -> digest, empty for folders


def kills(*, command: tuple[str, ...] = tuple(CASES), kills: int = 50, pairs: int = 20, seed: int = 0) -> None:
    """Kill commands and run them again: outputs must be whole or absent, and the next run's those of a whole run.

    Args:
        command: what is killed; all by default.
        kills: of each command, nine tenths of them spread over its changes of files, the others at random moments.
        pairs: rounds of two runs of a command at the same time in one folder.
        seed: of the random moments.
    """
    for name in command:
        if name not in CASES:
            raise InputError(f"command is {name!r}; expected one of {', '.join(CASES)}")
    screen, tallies = Console(), []
    with TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        os.environ["VGGTJAX_CACHE"] = str(Path(folder) / "cache")
        prepare(inputs, command)
        for name in command:
            tally = kill_command(name, Path(folder), kills=kills, pairs=pairs, draws=random.Random(seed))
            tallies.append(tally)
            for problem in tally.problems:
                screen.print(f"{name}: {problem}", markup=False)
            screen.print(f"{name}: {tally.at_changes + tally.at_random} kills, {len(tally.problems)} problems")
    table = Table(title="runs that were killed and run again", box=None)
    for heading in ("command", "changes of files", "kills at changes", "at random moments", "two at once", "problems"):
        table.add_column(heading, justify="left" if heading == "command" else "right")
    for tally in tallies:
        table.add_row(tally.command, *map(str, tally[1:5]), str(len(tally.problems)))
    screen.print(table)
    if any(tally.problems for tally in tallies):
        raise InputError("some outputs were not whole, or runs did not go on; the problems are above")


def kill_command(name: str, folder: Path, *, kills: int, pairs: int, draws: random.Random) -> Tally:
    """Kill a command so many times, each time with an empty folder, and run two at once."""
    case, work, problems = CASES[name], folder / "work" / name, []

    def words(out: Path) -> list[str]:
        return [word.format(inputs=folder / "inputs", out=out) for word in case.words.split()]

    def run(out: Path, **how: Any) -> tuple[int, str]:
        out.mkdir(parents=True, exist_ok=True)
        return finish(*start(words(out), work / "log", out, **how), work / "log")

    out = work / "out"
    count_file, wholes, seconds = work / "count", [], 1.0
    for _ in range(3):  # the first fills the caches
        began = time.perf_counter()
        code, said = run(out, count=count_file)
        seconds = time.perf_counter() - began
        if code:
            raise InputError(f"{name} ends with code {code} without a kill: {said}")
        wholes.append(files_below(out))
        _clear(out)
    whole, changes = wholes[-1], int(count_file.read_text())
    varying = {path for path in whole if whole[path] != wholes[-2].get(path)}  # such as pages with times

    def timed(path: str) -> bool:
        return any(fnmatch(path, pattern) for pattern in case.timed)

    def check(label: str, files: Files, *, ended: bool) -> None:
        for path, digest in files.items():
            if timed(path) and "tmp" not in path:
                continue
            if path not in whole:
                if ended:
                    problems.append(f"{label}: {path} is left behind")
                continue
            grows = not ended and any(fnmatch(path, pattern) for pattern in case.growing)
            if digest != whole[path] and path not in varying and not grows:
                problems.append(f"{label}: {path} differs from a whole run's")
        if ended:
            problems.extend(f"{label}: {path} is missing" for path in whole.keys() - files.keys() if not timed(path))

    at_changes = min(kills - kills // 10, 10 * changes)
    moments: list[int | float] = [1 + number * changes // at_changes for number in range(at_changes)]
    killed = [0, 0]

    def all_moments() -> Iterator[int | float]:
        yield from moments
        for _ in range(2 * kills):  # some come after the end
            if sum(killed) < kills:
                yield draws.uniform(0.0, seconds)

    for moment in track(all_moments(), f"{name}: kills", total=kills, transient=True):
        is_change = isinstance(moment, int)
        label = f"killed at change {moment}" if is_change else f"killed after {moment:.2f} s"
        code, said = run(out, change=moment) if is_change else run(out, seconds=moment)
        if code == -signal.SIGKILL:
            killed[0 if is_change else 1] += 1
        elif code:
            problems.append(f"{label}: code {code}: {said}")
        check(label, files_below(out), ended=False)
        if name == "export" and (out / "model").exists():
            _clear(out)  # it never replaces what is there
        code, said = run(out)
        if code:
            problems.append(f"{label}: the next run ends with code {code}: {said}")
        else:
            check(f"{label}, then run again", files_below(out), ended=True)
        _clear(out)
    for number in track(range(pairs), f"{name}: two at once", transient=True):
        out.mkdir(parents=True, exist_ok=True)
        started = [start(words(out), work / f"log{side}", out) for side in (0, 1)]
        ends = [finish(*process, work / f"log{side}") for side, process in enumerate(started)]
        if all(code for code, _ in ends):
            problems.append(f"round {number} of two: neither ends: {ends[0][1]}; {ends[1][1]}")
        for code, said in ends:
            if code not in (0, 2) or "Traceback" in said:
                problems.append(f"round {number} of two: code {code}: {said}")
        check(f"round {number} of two", files_below(out), ended=True)
        _clear(out)
    return Tally(name, changes, killed[0], killed[1], pairs, problems)


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
    """Return the files and folders below a folder, hidden ones too, with digests of the files."""
    paths = sorted(folder.rglob("*"))
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for path in paths
    }


def _clear(folder: Path) -> None:
    import shutil

    shutil.rmtree(folder, ignore_errors=True)
