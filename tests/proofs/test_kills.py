"""Commands that are killed and run again: outputs are whole or absent, and the next run's are those of a whole run."""

import random
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatch
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from tests.proofs.contents import BROKEN, Files, files_below
from tests.proofs.killed import Ended, Run, changes_of
from tests.shared.dataset_files import write_plain
from tests.shared.golden import GOLDEN
from tests.shared.make_checkpoint import make_checkpoint
from tests.shared.room import make_room
from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_config, tiny_model
from vggtjax.clips.truth import Truth
from vggtjax.interface.commands.main import main
from vggtjax.network.checkpoint import save_model
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.storage.cache import enable_compilation_cache
from vggtjax.storage.json_values import read_json

ROOT = Path(__file__).parents[2]
SIDE, FRAMES, CLIPS = 56, 3, 4
PARTIAL = re.compile(r"partial|incomplete|tmp")  # names of files that are not whole


class Case(NamedTuple):
    """A command: its words, with {inputs} and {out}, and files of a kind of their own."""

    words: str
    at_once: tuple[str, ...] = ()  # folders that have all their files as soon as they are there, and are not replaced
    growing: tuple[str, ...] = ()  # whole at each moment, with other content than at the end
    timed: tuple[str, ...] = ()  # such as checkpoints: any of them may be there, but no unfinished one after the end


MODEL = "--model {inputs}/model.safetensors"
CASES = {
    "convert": Case(
        "convert {inputs}/source.safetensors {out}/model.safetensors --config {inputs}/config.json --overwrite"
    ),
    "reconstruct": Case(f"reconstruct {{inputs}}/clips/a {MODEL} --out {{out}}/result"),
    "batch": Case(f"batch {{inputs}}/clips {MODEL} --only cameras,depth --out {{out}}", growing=("index.html",)),
    "export": Case("export {inputs}/result --out {out}/model --to colmap-text", at_once=("model",)),
    "evaluate": Case(f"evaluate plain {{inputs}}/data {MODEL} --methods vggt,4dvggt-d --out {{out}}/scores"),
    "fit-fusion": Case(
        f"fit-fusion --data plain={{inputs}}/data {MODEL} --family scale paper --seeds 1 --steps 20 --pixels 300 "
        "--out {out}/fit",
        growing=("fit/states/*.npz",),
    ),
    "train": Case(
        "train --recipe {inputs}/recipe.json --out {out}/run --log-every 2 --checkpoint-seconds 0.1",
        growing=("run/metrics.csv", "run/metrics.png", "run/model.safetensors"),
        timed=("run/checkpoints/*",),
    ),
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """A folder with weights to convert."""
    folder = tmp_path_factory.mktemp("inputs")
    shutil.copy(GOLDEN / "config.json", folder / "config.json")
    make_checkpoint(folder / "source.safetensors", read_json(GOLDEN / "shapes.json", dict[str, list[int]], "shapes"))
    return folder


@pytest.fixture(scope="module")
def inputs(weights) -> Path:
    """The same folder with what the other commands read."""
    folder = weights
    shutil.copy(ROOT / "docs/recipes/smoke.json", folder / "recipe.json")
    save_model(folder / "model.safetensors", tiny_model().params, tiny_config())
    make_room(FRAMES).save(folder / "result")
    for number, name in enumerate("ab"):
        (folder / "clips" / name).mkdir(parents=True)
        for frame, image in enumerate(seeded_images(FRAMES, SIDE, SIDE, number).transpose(0, 2, 3, 1)):
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(folder / "clips" / name / f"{frame}.png")
    clip = demo_clip()
    for part in range(CLIPS):
        frames = slice(FRAMES * part, FRAMES * (part + 1))
        write_plain(folder / f"data/clip{part}", Truth(*(array[frames] for array in clip)))
    return folder


def command(words: list[str]) -> int:
    enable_compilation_cache()  # a command does it before jax is imported
    return main(words)


class Trial:
    """Runs of a case in one folder, each of which begins with nothing but what whole runs have put into the cache."""

    def __init__(self, case: Case, function: Callable[[], int], place: Path) -> None:
        self.case, self.function, self.place, self.out = case, function, place, place / "out"
        self.problems: list[str] = []
        self.whole, began = self._whole_run(), time.perf_counter()
        again = self._whole_run()
        self.seconds, self.changes = time.perf_counter() - began, changes_of(place)
        self.largest = max(path.stat().st_size for path in self.out.rglob("*") if path.is_file())
        self._note(self._wrong(again, ended=True), "a second whole run")
        shutil.rmtree(self.out)

    def _whole_run(self) -> Files:
        shutil.rmtree(self.out, ignore_errors=True)
        ended = Run(self.function, self.place, self.out).finish()
        assert ended.code == 0, ended.said
        return files_below(self.out)

    def kill(self, *, change: int | None = None, size: int | None = None, seconds: float | None = None) -> Ended:
        """Kill a run and run again; note what is wrong after either."""
        label = f"killed at change {change}, size {size}, seconds {seconds}"
        ended = Run(self.function, self.place, self.out, change=change, size=size).finish(seconds)
        if ended.code and not ended.killed:
            self._note([f"code {ended.code}: {ended.said}"], label)
        self._note(self._wrong(files_below(self.out), ended=False), label)
        for below in self.case.at_once:
            shutil.rmtree(self.out / below, ignore_errors=True)  # replaced by no run; what is beside it stays
        again = Run(self.function, self.place, self.out).finish()
        self._note([f"code {again.code}: {again.said}"] if again.code else [], f"{label}, then run again")
        self._end(f"{label}, then run again")
        return ended

    def two_at_once(self) -> None:
        """Run twice at the same time in one folder: one waits or says that the other writes."""
        runs = [Run(self.function, self.place, self.out, log=f"log{number}") for number in (0, 1)]
        ends = [run.finish() for run in runs]
        odd = [end for end in ends if end.code not in (0, 2) or "Traceback" in end.said]
        if all(end.code for end in ends):
            odd = ends
        self._note([f"code {end.code}: {end.said}" for end in odd], "two at once")
        self._end("two at once")

    def _end(self, label: str) -> None:
        """Note what differs after the end, and what is left in the folder of temporary files or half in the cache."""
        self._note(self._wrong(files_below(self.out), ended=True), label)
        partial = [path for path in sorted((self.place / "cache").rglob("*")) if PARTIAL.search(path.name)]
        left = [str(path.relative_to(self.place)) for path in chain((self.place / "tmp").iterdir(), partial)]
        self._note([f"{path} is left behind" for path in left], label)
        for path in (self.out, self.place / "tmp", *partial):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)

    def _wrong(self, files: Files, *, ended: bool) -> Iterator[str]:
        """Yield files that are half-written, differ, or are left behind or missing where all ought to be there.

        All ought to be there after the end, and in a folder that has all its files at once.
        """
        there = tuple(f"{folder}/" for folder in self.case.at_once if folder in files)
        for path, found in files.items():
            if fits(path, self.case.timed) and "tmp" not in path:
                continue
            if path not in self.whole:
                if ended or path.startswith(there):
                    yield f"{path} is left behind"
            elif found == BROKEN:
                yield f"{path} is half-written"
            elif found != self.whole[path] and (ended or not fits(path, self.case.growing)):
                yield f"{path} differs from a whole run's"
        missing = [path for path in self.whole.keys() - files.keys() if ended or path.startswith(there)]
        yield from (f"{path} is missing" for path in sorted(missing) if not fits(path, self.case.timed))

    def _note(self, problems: Iterable[str], label: str) -> None:
        self.problems.extend(f"{label}: {problem}" for problem in problems)


def fits(path: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(path, pattern) for pattern in patterns)


def trial(name: str, inputs: Path, place: Path) -> Trial:
    words = CASES[name].words.format(inputs=inputs, out=place / "out").split()
    return Trial(CASES[name], partial(command, words), place)


@pytest.mark.proof
@pytest.mark.parametrize("name", CASES)
def test_a_command_that_is_killed_and_run_again(name, inputs, tmp_path):
    """Kills spread over the changes of files, in writes and at random moments; and two runs at once."""
    found, draws = trial(name, inputs, tmp_path), random.Random(name)
    kills: list[dict[str, Any]] = [{"change": at} for at in {1 + n * found.changes // 12 for n in range(12)}]
    kills += [{"size": draws.randrange(1, found.largest)} for _ in range(3)]
    least = 0.5 if found.case.timed else 0.9  # a run that hangs on the clock may end before the later changes
    assert sum(found.kill(**kill).killed for kill in kills) >= least * len(kills)
    for _ in range(3):
        found.kill(seconds=draws.uniform(0, found.seconds))
        found.two_at_once()
    assert found.problems == []


def test_a_conversion_that_is_killed(weights, tmp_path):
    found = trial("convert", weights, tmp_path)
    assert found.kill(change=found.changes // 2).killed
    assert found.kill(size=found.largest // 2).killed
    assert found.problems == []


def careless(out: Path) -> int:
    """Write a file in two steps, and another one beside it that is never whole; read neither."""
    (out / "table.csv").write_text("a,b\n1")
    with (out / "table.csv").open("a") as file:
        file.write(",2\n")
    (out / "notes.txt").write_text("" if (out / "seen").exists() else "first")
    (out / "seen").touch()
    (out / "seen").replace(out / "last")
    return 0


def test_what_a_careless_command_leaves_is_found(tmp_path):
    found = Trial(Case(""), partial(careless, tmp_path / "out"), tmp_path)
    assert found.changes == 5
    assert found.kill(change=2).killed
    assert found.problems == ["killed at change 2, size None, seconds None: table.csv is half-written"]
    assert found.kill(change=5).killed
    assert [problem.split(": ")[1] for problem in found.problems[1:]] == ["notes.txt differs from a whole run's"]
    assert found.kill(size=3).killed
    assert "table.csv is half-written" in found.problems[-1]
