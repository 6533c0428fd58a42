"""The command `vggtjax evaluate` on a small data set on disk, and its page in a browser where there is one."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from vggtjax import cameras as geometry
from vggtjax.commands import main as cli
from vggtjax.pretrained.embedded import demo_clip

FRAMES = 4
MODEL = ("--model", "demo")

pytestmark = [pytest.mark.filterwarnings("ignore:the field of view"), pytest.mark.usefixtures("tiny_demo")]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two sequences in the plain layout: the embedded clip's first frames and its next ones."""
    root, clip = tmp_path_factory.mktemp("data"), demo_clip()
    poses = geometry.world_from_camera(np.asarray(clip.camera_from_world))
    for name, start in (("first", 0), ("second", FRAMES)):
        folder = root / name
        for below in ("rgb", "depth", "mask"):
            (folder / below).mkdir(parents=True)
        for i in range(start, start + FRAMES):
            Image.fromarray(np.rint(255 * clip.images[i]).astype(np.uint8)).save(folder / f"rgb/{i:05d}.png")
            Image.fromarray(np.rint(1000 * clip.depth[i]).astype(np.uint16)).save(folder / f"depth/{i:05d}.png")
            Image.fromarray(clip.dynamic_mask[i].astype(np.uint8) * 255).save(folder / f"mask/{i:05d}.png")
        np.savetxt(folder / "K.txt", clip.intrinsics[0])
        np.savetxt(folder / "world_from_camera.txt", poses[start : start + FRAMES].reshape(FRAMES, 16))
    return root


def run(capsys, *arguments):
    code = cli.main([str(a) for a in arguments])
    shown = capsys.readouterr()
    return code, shown.out, shown.err


FIRST_LINES = """
import sys
from vggtjax.commands import main as cli
from vggtjax.evaluation import datasets
def found(*_, **__):
    print("jax" in sys.modules, file=sys.stderr)
    return {f"s{number}": None for number in range(9)}
datasets.find_sequences = found
sys.exit(cli.main(["evaluate", "plain", "somewhere", "--out", sys.argv[1], "--model", "nothing.safetensors"]))
"""


def test_what_it_will_do_is_said_before_jax_is_imported(tmp_path):
    command = [sys.executable, "-c", FIRST_LINES, str(tmp_path / "out")]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 2
    said = made.stderr.splitlines()
    assert said[0].startswith("score vggt, vggt4d, pose-decoupling, hard-replacement, 4dvggt-d with the model nothing")
    assert said[0].endswith("on plain in somewhere")
    assert said[1] == "False"
    assert "9 sequences: s0, s1, s2, s3, s4, s5, s6, s7 and 1 more" in said


@pytest.fixture(scope="module")
def evaluated(dataset, tiny_demo, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluated")
    assert cli.main(["evaluate", "plain", str(dataset), "--out", str(out), *MODEL, "--methods", "vggt,4dvggt-d"]) == 0
    return out


def test_all_of_it(dataset, evaluated, capsys):
    values = json.loads((evaluated / "results.json").read_text())
    assert {(e["name"], e["method"], e["status"]) for e in values["sequences"]} == {
        (name, method, "ok") for name in ("first", "second") for method in ("vggt", "4dvggt-d")
    }
    needed = {"accuracy_mean", "distance_paired_mean", "ate", "rte", "rre", "j_mean", "f_mean", "abs_rel", "ause"}
    for entry in values["sequences"]:
        assert needed <= set(entry["metrics"])
        assert all(np.isfinite(value) for value in entry["metrics"].values())
        assert entry["metrics"]["distance_paired_mean"] >= entry["metrics"]["accuracy_mean"]
    for metric in needed:
        each = [e["metrics"][metric] for e in values["sequences"] if e["method"] == "vggt"]
        if metric != "abs_rel":
            assert values["mean"]["vggt"][metric] == pytest.approx(np.mean(each))
    assert values["settings"]["dataset"] == "plain"
    assert values["settings"]["model"]["name"] == "demo"
    assert "The model demo is a small demonstration model" in (evaluated / "index.html").read_text()
    for name in ("results.csv", "table.md", "table.tex", "index.html", "plots/first/paths.png"):
        assert (evaluated / name).stat().st_size > 100
    assert not list(evaluated.rglob(".vggtjax-partial*"))

    # Again, with one method more in mind: what is finished is not done again.
    before = (evaluated / "sequences/first/vggt.json").stat().st_mtime_ns
    code, out, err = run(capsys, "evaluate", "plain", dataset, "--out", evaluated, *MODEL, "--methods", "vggt")
    assert code == 0, err
    assert "first pass" not in err
    assert "index.html" in out
    assert (evaluated / "sequences/first/vggt.json").stat().st_mtime_ns == before


def test_results_of_a_folder(dataset, tmp_path, capsys):
    arguments = ("--model", "demo", "--out", tmp_path / "theirs/first", "--format", "vggt4d")
    code, _, err = run(capsys, "reconstruct", dataset / "first/rgb", *arguments)
    assert code == 0, err
    arguments = ("evaluate", "plain", dataset, "--results", f"ours={tmp_path / 'theirs'}", "--out", tmp_path / "out")
    code, out, err = run(capsys, *arguments)
    assert code == 0, err
    values = json.loads((tmp_path / "out/results.json").read_text())
    assert [(e["name"], e["method"], e["status"]) for e in values["sequences"]] == [
        ("first", "ours", "ok"), ("second", "ours", "failed"),
    ]  # fmt: skip
    assert "second, ours: failed: there is no" in out
    assert values["mean"]["ours"]["failed"] == 1

    # A result of other frames is not taken for one of these.
    shutil.copytree(tmp_path / "theirs/first", tmp_path / "wrong/second")
    code, out, err = run(
        capsys, "evaluate", "plain", dataset, "--results", tmp_path / "wrong", "--sequences", "second", "--out",
        tmp_path / "none",
    )  # fmt: skip
    assert code == 2
    assert "second, wrong: failed: the result is of frames 00000" in out
    assert "nothing could be scored" in err

    # The same result in VGGT4D's files scores the same.
    shutil.move(tmp_path / "theirs/first/vggt4d", tmp_path / "vggt4d/first")
    code, _, err = run(
        capsys, "evaluate", "plain", dataset, "--results", tmp_path / "vggt4d", "--format", "vggt4d", "--quaternion",
        "wxyz", "--sequences", "first", "--out", tmp_path / "again",
    )  # fmt: skip
    assert code == 0, err
    again = json.loads((tmp_path / "again/results.json").read_text())["sequences"][0]["metrics"]
    for name, value in values["sequences"][0]["metrics"].items():
        if name != "saliency_auc":
            assert again[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nothing", "{data}"], "data set 'nothing' is not known"),
        (["plain", "{data}", "--sequences", "third"], "sequence 'third'"),
        (["plain", "{data}", "--smooth-frames", "2"], "--smooth-frames is 2"),
        (["plain", "{data}", "--format", "cut3r"], "give both or neither"),
        (["plain", "{data}", "--results", "{data}", "--methods", "vggt"], "exclude each other"),
        (["plain", "{data}", "--results", "{data}", "--format", "da3", "--quaternion", "wxyz"], "none for others"),
        (["plain", "{data}", "--results", "a={data}", "a={tmp}"], "two folders named a"),
        (["plain", "{data}", "--results", "{data}", "--config", "{tmp}/c.json"], "--config and --results exclude"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(dataset, tmp_path, capsys, arguments, sentence):
    places = {"data": dataset, "tmp": tmp_path}
    code, _, err = run(capsys, "evaluate", *(a.format(**places) for a in arguments), "--out", tmp_path / "out")
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("vggtjax: ")
    assert sentence in last
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["index.html", "sequences"])
def test_files_of_others_are_never_replaced(dataset, tmp_path, capsys, name):
    (tmp_path / name).write_text("mine")
    code, _, err = run(capsys, "evaluate", "plain", dataset, "--out", tmp_path)
    assert code == 2
    assert f"{name} exists and is not part of an earlier evaluation" in err
    assert (tmp_path / name).read_text() == "mine"
