"""A small run of each command in this process, with what its report must contain; and bad input."""

import json
import logging

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import command_worker, embed, held_out, static_mesh
from tests.benchmarks.scenes import SIDE, drawn_scenes, tiny_file
from tests.shared.asset_folder import write_assets
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import read_model
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.research.evaluation.ladder_words import read_second_pass

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return str(tiny_file(tmp_path_factory.mktemp("model")))


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command in this process, on scenes that are not rendered; return what it prints."""
    for module in (held_out, static_mesh):
        monkeypatch.setattr(module, "held_out_scenes", drawn_scenes)
    level = logging.getLogger("vggtjax").level

    def command(*arguments) -> str:
        code = benchmarks.main([str(argument) for argument in arguments])
        shown = capsys.readouterr()
        assert code == 0, shown.err
        return shown.out

    yield command
    logging.getLogger("vggtjax").setLevel(level)


def cells(text: str) -> dict[str, list[str]]:
    """Return the cells of the rows of markdown tables, by the first."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    return {first: others for first, *others in rows}


@pytest.mark.proof
def test_static_mesh(run, tmp_path):
    shown = run("static-mesh", "--clips", 1, "--frames", 4, "--side", 96, "--out", tmp_path / "out")
    assert shown.strip() == (tmp_path / "out/report.md").read_text().strip()
    (row,) = json.loads((tmp_path / "out/rows.json").read_text())
    assert all(0 < row[name] < 3 for name in static_mesh.ROWS.values())
    assert row["faces"] > 0
    assert set(static_mesh.ROWS) < set(cells(shown))


def test_what_a_command_takes(capfd, tmp_path):
    command_worker.main(["--version"])
    answer = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert answer["code"] == 0
    assert answer["seconds"] > 0
    words = ["reconstruct", "none", "--model", "demo", "--out", str(tmp_path / "out")]
    with pytest.raises(InputError, match=r"reconstruct none --model demo .* ended with code 2: .*none"):
        command_worker.run_command(words, tmp_path)


@pytest.mark.proof
def test_a_clip_survives_the_file(tmp_path):
    generator = np.random.default_rng(0)
    truth = Truth(
        images=generator.random((3, 8, 16, 3), np.float32),
        depth=np.exp(generator.normal(size=(3, 8, 16))).astype(np.float32),
        dynamic_mask=generator.random((3, 8, 16)) < 0.3,
        camera_from_world=generator.normal(size=(3, 3, 4)).astype(np.float32),
        intrinsics=generator.normal(size=(3, 3, 3)).astype(np.float32),
    )
    embed.write_demo_clip(tmp_path / "clip.npz", truth)
    again = demo_clip(tmp_path / "clip.npz")
    assert np.abs(again.images - truth.images).max() <= 0.5 / 255 + 1e-6
    assert np.abs(again.depth / truth.depth - 1).max() < 4e-4
    for name in ("dynamic_mask", "camera_from_world", "intrinsics"):
        assert np.array_equal(getattr(again, name), getattr(truth, name))


def test_embed(run, tiny, tmp_path, monkeypatch):
    made = {name: tmp_path / getattr(embed, name).name for name in ("MODEL", "CLIP", "SECOND_PASS")}
    for name, path in made.items():
        monkeypatch.setattr(embed, name, path)
    shown = run("embed", tiny, "--scenes", 3, "--frames", 3, "--image-size", 2 * SIDE)
    model = read_model(made["MODEL"])
    assert (model.name, model.config.image_size) == ("demo", 2 * SIDE)
    assert f"{made['CLIP'].stat().st_size} bytes" in shown
    assert read_second_pass(made["SECOND_PASS"]).clips == 3
    assert demo_clip(made["CLIP"]).images.shape == (3, 2 * SIDE, 2 * SIDE, 3)
    folder = write_assets(tmp_path / "assets")
    run("embed", tiny, "--scenes", 15, "--frames", 3, "--image-size", 2 * SIDE, "--height", SIDE, "--assets", folder)
    assert demo_clip(made["CLIP"]).images.shape == (3, SIDE, 2 * SIDE, 3)
    before = [path.read_bytes() for path in made.values()]
    monkeypatch.setattr(embed, "MOST_CLIP_BYTES", 100)
    with pytest.raises(InputError, match=r"clip\.npz has .* bytes; at most 100 go into the package"):
        embed.embed(str(tiny), frames=3, scenes=3)
    assert [path.read_bytes() for path in made.values()] == before
    assert embed._by_ranks(np.array([[3, 3], [1, 2], [2, 1.5]])).tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("gpu-day --out {tmp} --parts nothing", "parts is 'nothing'; expected one of parity"),
        ("gpu-day --out {tmp}", "is not empty; choose a new folder"),
        ("static-mesh --clips 0", "clips is 0; expected at least 1"),
        ("speed --weights {tmp}/a --converted {tmp}/b --peer {tmp}", "a does not exist"),
        ("known --clips 24", "known is no longer there; commit 2922dfe is the last that has it"),
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
