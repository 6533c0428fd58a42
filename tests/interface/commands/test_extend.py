"""vggtjax extend: a result of the embedded model grows; what does not fit is refused and nothing is written."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.contents import contents
from vggtjax import Reconstruction, load_model, reconstruct
from vggtjax.errors import InputError
from vggtjax.interface.commands import extend as command
from vggtjax.interface.commands import main as cli
from vggtjax.interface.commands.report import Report
from vggtjax.pipeline.pretrained.embedded import demo_clip

OLD, NEW = range(5), range(5, 8)

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


@pytest.fixture(scope="module")
def pictures():
    return (255 * demo_clip().images).round().astype(np.uint8)


@pytest.fixture(scope="module")
def result(pictures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("old") / "result"
    reconstruct(load_model("demo"), pictures[: len(OLD)]).save(folder, only=("cameras",))
    return folder


def written(folder, pictures, first=0):
    folder.mkdir()
    for number, picture in enumerate(pictures, start=first):
        Image.fromarray(picture).save(folder / f"{number:06}.png")
    return folder


def extended(capsys, *arguments):
    code = cli.main(["extend", *map(str, arguments), "--model", "demo", "--only", "cameras"])
    return code, " ".join(capsys.readouterr().err.split())


def test_new_frames_join_and_the_old_ones_stay(result, pictures, tmp_path, capsys):
    before, new = contents(result), written(tmp_path / "new", pictures[NEW.start : NEW.stop])
    code, _ = extended(capsys, result, new, "--prefix", "later_", "--out", tmp_path / "both")
    assert code == 0
    old, both = Reconstruction.load(result), Reconstruction.load(tmp_path / "both")
    assert both.frame_names == (*old.frame_names, "later_000000", "later_000001", "later_000002")
    assert np.array_equal(both.depth[: len(OLD)], old.depth)
    assert np.array_equal(both.camera_from_world[: len(OLD)], old.camera_from_world)
    assert both.settings["extended"][0]["clip"] == "new"
    assert both.settings["extended"][0]["windows"][0]["anchors"] == list(old.frame_names)
    assert contents(result) == before
    assert not list((tmp_path / "both").glob(".vggtjax-windows"))


def test_what_does_not_fit_is_refused_and_nothing_is_written(result, pictures, tmp_path, capsys):
    before = contents(result)
    other = np.random.default_rng(0).integers(0, 255, (3, *pictures.shape[1:]), np.uint8)
    same = written(tmp_path / "same", pictures[: len(OLD)])
    noise = written(tmp_path / "noise", other, first=100)
    wide = written(tmp_path / "wide", pictures[NEW.start : NEW.stop, :56], first=100)
    out = tmp_path / "out"
    for arguments, sentence in (
        ((same, "--out", out), "'000000' and 4 more of the new clip has the name of a frame of the result"),
        ((noise, "--out", out), "show another place"),
        ((wide, "--out", out), "expected frames of the same shape"),
        ((noise, "--out", result), "the folder of the result, which stays as it is"),
        ((noise, "--out", out, "--anchors", 2), "expected at least 3 anchors"),
        ((noise / "000100.png", "--out", out, "--watch"), "is no folder"),
        ((), "required"),
    ):
        try:
            code, said = extended(capsys, result, *arguments)
        except SystemExit as stop:  # of the parser
            code, said = stop.code, "required"
        assert code == 2, said
        assert sentence in said
        assert not out.exists()
    assert contents(result) == before


def test_a_folder_that_fills_is_watched_until_ctrl_c(result, pictures, tmp_path, monkeypatch):
    """Pictures that come are added; those of another place wait for others; Ctrl-C ends with what there is."""
    folder, old = written(tmp_path / "capture", pictures[5:6]), Reconstruction.load(result)
    calls, steps = [], iter([lambda: Image.fromarray(pictures[6]).save(folder / "later.png"), lambda: None])
    now = iter(np.arange(0, 1000, 2.0))
    monkeypatch.setattr(command.time, "monotonic", lambda: next(now))

    def sleep(_):
        if len(calls) == 2:
            raise KeyboardInterrupt
        next(steps, lambda: None)()

    def grown(result, source):
        calls.append(source.frame_names)
        if len(calls) == 1:
            raise InputError("the new frames show another place")
        names = tuple(f"x_{name}" for name in source.frame_names)
        return type("Result", (), {"frame_names": result.frame_names + names, "depth": np.zeros(9)})()

    monkeypatch.setattr(command.time, "sleep", sleep)
    both = command._watched(folder, old, grown, "x_", Report())
    assert calls == [("000000",), ("000000", "later")]
    assert both.frame_names[-2:] == ("x_000000", "x_later")
