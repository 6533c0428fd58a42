"""A small run of each command in this process, with what its report must contain; and bad input."""

import json
import logging
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import (
    approximations,
    command_worker,
    embed,
    known,
    known_clips,
    long_clips,
    refine_cameras,
    static_mesh,
)
from tests.benchmarks.scenes import SIDE, drawn_scenes, tiny_file
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import read_model
from vggtjax.pipeline.pretrained.embedded import demo_clip

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return str(tiny_file(tmp_path_factory.mktemp("model")))


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command in this process, on scenes that are not rendered; return what it prints."""
    for module in (approximations, embed, known_clips, refine_cameras, static_mesh):
        monkeypatch.setattr(module, "held_out_scenes", drawn_scenes)
    for module in (known, refine_cameras):
        monkeypatch.setattr(module, "ProcessPoolExecutor", lambda workers, context: ThreadPoolExecutor(workers))
    level = logging.getLogger("vggtjax").level

    def command(*arguments) -> str:
        code = benchmarks.main([str(argument) for argument in arguments])
        shown = capsys.readouterr()
        assert code == 0, shown.err
        return shown.out

    yield command
    logging.getLogger("vggtjax").setLevel(level)
    logging.disable(logging.NOTSET)


def cells(text: str) -> dict[str, list[str]]:
    """Return the cells of the rows of markdown tables, by the first."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    return {first: others for first, *others in rows}


@pytest.mark.proof
def test_approximations(run, tiny, monkeypatch):
    monkeypatch.setattr(approximations, "WAYS", {"exact": "exact", "sampled": "sampled"})
    monkeypatch.setattr(approximations, "_HEADS", 2)
    monkeypatch.setattr(approximations, "_WIDTH", 16)
    small = ["--scenes", "1", "--frames", "4", "--speed", "1", "--height", "28", "--width", "28", "--repeats", "1"]
    rows = [line.split() for line in run("approximations", "--model", tiny, *small).splitlines() if line.strip()]
    exact, timed = [row for row in rows if row[0] == "exact"]
    assert exact[4:] == ["0.00%", "0.00°", "0.00%"]
    assert timed[3::2] == ["1.00", "1.00"]
    assert next(row for row in rows if row[0] == "sampled")[-3] != "0.00%"


@pytest.mark.proof
def test_known(run, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(known_clips, "FRAMES", 4)
    shown = cells(run("known", "--model", tiny, "--clips", 2, "--seeds", 0, "--folder", tmp_path))
    assert set(known.ROWS) < set(shown)
    assert shown["intrinsics"][0].startswith("0.0000, 100 %")
    assert shown["poses"][1].startswith("0.0000") or "refused" in shown["poses"][-1]


@pytest.mark.proof
def test_refine_cameras(run, tiny, tmp_path):
    pytest.importorskip("pycolmap")
    counts = ("--static", 1, "--dynamic", 1, "--workers", 1)
    shown = run("refine-cameras", "--model", tiny, "--out", tmp_path / "out", "--side", 56, *counts)
    assert shown.strip() == (tmp_path / "out/report.md").read_text().strip()
    rows = json.loads((tmp_path / "out/rows.json").read_text())
    assert [row["kind"] + " " + row["masks"] for row in rows] == [
        "static mined", "dynamic mined", "dynamic none", "dynamic true",
    ]  # fmt: skip
    assert [row["ate"][0] == row["ate"][1] for row in rows] == [not row["refined"] for row in rows]


@pytest.mark.proof
def test_static_mesh(run, tmp_path):
    shown = run("static-mesh", "--clips", 1, "--frames", 4, "--side", 96, "--out", tmp_path / "out")
    assert shown.strip() == (tmp_path / "out/report.md").read_text().strip()
    (row,) = json.loads((tmp_path / "out/rows.json").read_text())
    assert all(0 < row[name] < 3 for name in static_mesh.ROWS.values())
    assert row["faces"] > 0
    assert set(static_mesh.ROWS) < set(cells(shown))


@pytest.mark.proof
def test_long_clips(run, tiny, tmp_path, monkeypatch):
    def walk(kind, count, frames, side, seed):
        config = long_clips.SceneConfig(height=side, width=side, frames=frames)
        yield jax.tree.map(lambda array: array[0], drawn_scenes(kind, 1, config))

    taken = {"own": 1e6, "total": 2e6, "seconds": 3.0, "processor": 4.0}
    monkeypatch.setattr(long_clips, "run_command", lambda words, cache, devices=1: taken)
    monkeypatch.setattr(long_clips, "drawn_walks", walk)
    small = ["--frames", "8", "--window", "5", "--overlaps", "2", "--walks", "1", "--memory", "6"]
    shown = run("long-clips", "--model", tiny, "--out", tmp_path, *small)
    assert len((tmp_path / "paths.csv").read_text().splitlines()) == 1 + 2 * 5
    assert "6 frames in windows of 5: peak 1 MB of its own, 2 MB with mapped files, 3 s, 4 s of the processors" in shown


def test_what_a_command_takes(capfd, tmp_path):
    command_worker.main(["--version"])
    answer = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert answer["code"] == 0
    assert answer["seconds"] > 0
    words = ["reconstruct", "none", "--model", "demo", "--out", str(tmp_path / "out")]
    with pytest.raises(InputError, match=r"reconstruct none --model demo .* ended with code 2: .*none"):
        command_worker.run_command(words, tmp_path)


@pytest.mark.proof
def test_embed(run, tiny, tmp_path, monkeypatch):
    for name in ("MODEL", "CLIP"):
        monkeypatch.setattr(embed, name, tmp_path / name)
    monkeypatch.setattr(embed, "demo_model", lambda: read_model(tmp_path / "MODEL"))
    shown = run("embed", tiny, "--scenes", 3, "--frames", 3, "--image-size", 2 * SIDE)
    model = read_model(tmp_path / "MODEL")
    assert (model.name, model.config.image_size) == ("demo", 2 * SIDE)
    assert f"{(tmp_path / 'CLIP').stat().st_size} bytes" in shown
    assert demo_clip(tmp_path / "CLIP").images.shape == (3, 2 * SIDE, 2 * SIDE, 3)
    assert embed._by_ranks(np.array([[3, 3], [1, 2], [2, 1.5]])).tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("gpu-day --out {tmp} --parts nothing", "parts is 'nothing'; expected one of parity"),
        ("gpu-day --out {tmp}", "is not empty; choose a new folder"),
        ("long-clips --out {tmp}/out --frames 16", "expected at least 0 walks, longer than a window"),
        ("refine-cameras --frames 2", "frames is 2; expected at least 3"),
        ("static-mesh --clips 0", "clips is 0; expected at least 1"),
        ("speed --weights {tmp}/a --converted {tmp}/b --peer {tmp}", "a does not exist"),
        ("suite --against {tmp}/file", "is not a run that --out wrote"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, arguments, sentence):
    (tmp_path / "file").touch()
    assert benchmarks.main(arguments.format(tmp=tmp_path).split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("benchmarks: ")
    assert sentence in error
    assert len(error.strip().splitlines()) == 1
