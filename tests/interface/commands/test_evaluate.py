import json
import shutil
import sys
from itertools import product

import numpy as np
import pytest

from tests.shared.command import refusal, run
from vggtjax.interface.commands import main as cli

MODEL = ("--model", "demo")

pytestmark = [pytest.mark.filterwarnings("ignore:the field of view"), pytest.mark.usefixtures("tiny_demo")]


@pytest.fixture(scope="module")
def evaluated(sequences, tiny_demo, tmp_path_factory):
    """The folder of an evaluation of two methods on one sequence."""
    out = tmp_path_factory.mktemp("evaluated")
    arguments = (*MODEL, "--methods", "vggt,4dvggt-d", "--sequences", "clip0", "--out", str(out))
    assert cli.main(["evaluate", "plain", str(sequences), *arguments]) == 0
    return out


@pytest.mark.usefixtures("no_plots")  # after those of the first run
def test_a_second_run_adds_a_sequence_and_does_nothing_again(sequences, evaluated, capsys):
    for name in ("results.csv", "table.md", "table.tex", "index.html", "plots/clip0/paths.png"):
        assert (evaluated / name).stat().st_size > 100
    before = (evaluated / "sequences/clip0/vggt.json").stat().st_mtime_ns
    arguments = (*MODEL, "--methods", "vggt,4dvggt-d", "--sequences", "clip0,clip1", "--out", evaluated)
    code, out, err = run(capsys, "evaluate", "plain", sequences, *arguments)
    assert code == 0, err
    assert err.splitlines()[0].startswith("score vggt,4dvggt-d with the model demo")
    assert "2 sequences: clip0, clip1" in err
    assert "index.html" in out
    assert (evaluated / "sequences/clip0/vggt.json").stat().st_mtime_ns == before

    values = json.loads((evaluated / "results.json").read_text())
    scored = {(e["name"], e["method"], e["status"]) for e in values["sequences"]}
    assert scored == set(product(("clip0", "clip1"), ("vggt", "4dvggt-d"), ["ok"]))
    needed = {"accuracy_mean", "distance_paired_mean", "ate", "rte", "rre", "j_mean", "f_mean", "abs_rel", "ause"}
    of_masks = {"j_mean", "f_mean"}  # which the plain first pass does not make
    for entry in values["sequences"]:
        assert (needed - of_masks if entry["method"] == "vggt" else needed) <= set(entry["metrics"])
        assert (entry["method"] == "vggt") != ("j_mean" in entry["metrics"])
        assert all(np.isfinite(value) for value in entry["metrics"].values())
        assert entry["metrics"]["distance_paired_mean"] >= entry["metrics"]["accuracy_mean"]
    assert "j_mean" not in values["mean"]["vggt"]
    for metric in needed - of_masks - {"abs_rel"}:
        each = [e["metrics"][metric] for e in values["sequences"] if e["method"] == "vggt"]
        assert values["mean"]["vggt"][metric] == pytest.approx(np.mean(each))
    assert (values["settings"]["dataset"], values["settings"]["model"]["name"]) == ("plain", "demo")
    assert "The model demo is a small demonstration model" in (evaluated / "index.html").read_text()
    assert not list(evaluated.rglob(".vggtjax-partial*"))


@pytest.mark.usefixtures("no_plots")
def test_results_of_a_folder(sequences, tmp_path, capsys):
    arguments = (*MODEL, "--out", tmp_path / "theirs/clip0", "--format", "vggt4d", "--only", "depth",
                 "--no-consistent-depth")  # fmt: skip
    code, _, err = run(capsys, "reconstruct", sequences / "clip0/rgb", *arguments)
    assert code == 0, err
    score = ("evaluate", "plain", sequences, "--sequences")
    arguments = ("clip0,clip1", "--results", f"ours={tmp_path / 'theirs'}", "--out", tmp_path / "out")
    code, out, err = run(capsys, *score, *arguments)
    assert code == 0, err
    values = json.loads((tmp_path / "out/results.json").read_text())
    outcomes = [(e["name"], e["method"], e["status"]) for e in values["sequences"]]
    assert outcomes == [("clip0", "ours", "ok"), ("clip1", "ours", "failed")]
    assert "clip1, ours: failed: there is no" in out
    assert values["mean"]["ours"]["failed"] == 1

    # A result of other frames is not taken for one of these.
    shutil.copytree(tmp_path / "theirs/clip0", tmp_path / "wrong/clip1")
    code, out, err = run(capsys, *score, "clip1", "--results", tmp_path / "wrong", "--out", tmp_path / "none")
    assert code == 2
    assert "clip1, wrong: failed: the result is of frames 00000" in out
    assert "nothing could be scored" in err

    # The same result in VGGT4D's files scores the same.
    shutil.move(tmp_path / "theirs/clip0/vggt4d", tmp_path / "vggt4d/clip0")
    arguments = ("--results", f"theirs=vggt4d:{tmp_path / 'vggt4d'}", "--quaternion", "wxyz")
    code, _, err = run(capsys, *score, "clip0", *arguments, "--out", tmp_path / "again")
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
        (["plain", "{data}", "--results", "{data}", "--methods", "vggt"], "exclude each other"),
        (["plain", "{data}", "--results", "{data}", "--format", "da3", "--quaternion", "wxyz"], "none for others"),
        (["plain", "{data}", "--results", "a=easi4r:{data}"], "where FORMAT is one of vggtjax, vggt4d"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(sequences, tmp_path, capsys, arguments, sentence):
    words = [argument.format(data=sequences) for argument in arguments]
    assert sentence in refusal(capsys, "evaluate", *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_list_that_names_missing_frames_is_one_sentence_and_exit_code_2(sequences, tmp_path, capsys):
    listed = tmp_path / "frames.json"
    listed.write_text('{"clip0": [0, 2], "clip1": [1, 99]}')
    arguments = ("plain", sequences, "--frames-list", listed, *MODEL, "--out", tmp_path / "out")
    assert f"{listed} names frame 99 of sequence clip1, which has" in refusal(capsys, "evaluate", *arguments)
    assert not (tmp_path / "out").exists()


def test_what_is_missing_is_said_once_with_its_path(tmp_path, capsys):
    """Whatever the number of methods; and the data set is looked at before matplotlib and the model are missed."""
    (tmp_path / "data/training/final/alley_2").mkdir(parents=True)
    arguments = (*MODEL, "--methods", "vggt,vggt4d,4dvggt-d", "--out", tmp_path / "out")
    code, out, _ = run(capsys, "evaluate", "sintel", tmp_path / "data", *arguments)
    expected = f"the sequence has no pictures; expected {tmp_path}/data/training/final/alley_2/*.png"
    assert code == 2
    assert out.count("failed:") == 1
    assert f"alley_2, vggt, vggt4d, 4dvggt-d: failed: {expected}\n" in out


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("tum", "holds no sequence; expected {root}/rgb.txt or {root}/SEQUENCE/rgb.txt"),
        ("kitti", "expected {root}/val/DRIVE/proj_depth/groundtruth/image_02 or {root}/groundtruth_depth_gathered/DR"),
    ],
)
def test_the_data_set_is_looked_at_before_the_extra(tmp_path, capsys, monkeypatch, name, sentence):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    (tmp_path / "data").mkdir()
    said = refusal(capsys, "evaluate", name, tmp_path / "data", "--out", tmp_path / "out")
    assert sentence.format(root=tmp_path / "data") in said


def test_files_of_others_are_never_replaced(sequences, tmp_path, capsys):
    (tmp_path / "index.html").write_text("mine")
    said = refusal(capsys, "evaluate", "plain", sequences, "--out", tmp_path)
    assert "index.html exists and is not part of an earlier evaluation" in said
    assert (tmp_path / "index.html").read_text() == "mine"
