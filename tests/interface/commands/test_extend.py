"""vggtjax extend: a result of the embedded model grows; what does not fit is refused and nothing is written."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.shared.contents import contents
from vggtjax import Reconstruction, load_model, reconstruct
from vggtjax.interface.commands import extend as command
from vggtjax.interface.commands import main as cli
from vggtjax.interface.commands.report import Report
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.pipeline.windows.extend import fitter_of
from vggtjax.pipeline.windows.growth import PlaceError

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
        ((noise, "--out", out), "no known frame shows the place"),
        ((wide, "--out", out), "expected frames of the same shape"),
        ((noise, "--out", result), "the folder of the result, which stays as it is"),
        ((noise, "--out", out, "--anchors", 2), "--anchors is 2"),
        ((noise / "000100.png", "--out", out, "--watch"), "one folder that fills with pictures"),
        ((noise, "--out", out, "--watch", "--stride", 2), "--watch takes every picture that comes"),
        ((noise, "--out", out, "--least-overlap", 1.5), "--least-overlap is 1.5; expected a number between 0 and 1"),
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
    foreign = dataclasses.replace(Reconstruction.load(result), method="monst3r")
    foreign.save(tmp_path / "foreign", only=("cameras",))
    code, said = extended(capsys, tmp_path / "foreign", noise, "--out", out)
    assert (code, out.exists()) == (2, False)
    assert "the result is of monst3r; expected one that vggtjax made" in said


def test_a_kill_while_writing_loses_no_window(result, pictures, tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise OSError(28, "no space left")

    new = written(tmp_path / "new", pictures[NEW.start : NEW.stop], first=100)
    with monkeypatch.context() as patch:
        patch.setattr(Reconstruction, "save", stop)
        assert extended(capsys, result, new, "--out", tmp_path / "both")[0] == 2
    monkeypatch.setattr("vggtjax.pipeline.windows.run.reconstruct", None)  # is not called again
    assert extended(capsys, result, new, "--out", tmp_path / "both")[0] == 0
    assert len(Reconstruction.load(tmp_path / "both").depth) == len(OLD) + len(NEW)


def test_a_folder_that_fills_is_watched_until_ctrl_c(result, pictures, tmp_path, monkeypatch, capsys):
    """Pictures that come are added, those of another place wait, broken ones are left out; Ctrl-C ends it."""
    folder, old, calls = written(tmp_path / "capture", pictures[5:7], first=5), Reconstruction.load(result), []
    clock = iter(np.arange(0, 1000, 2.0))
    monkeypatch.setattr(command.time, "monotonic", lambda: next(clock))

    def more():
        Image.fromarray(pictures[7]).save(folder / "later.png")
        (folder / "broken.png").write_bytes(b"\x89PNG")
        Image.fromarray(pictures[7, :56]).save(folder / "wide.png")
        (folder / "._later.png").write_bytes(b"")

    steps = iter([*[lambda: None] * 4, more, *[lambda: None] * 4])

    def sleep(_):
        step = next(steps, None)
        if step is None:
            raise KeyboardInterrupt
        step()

    def grown(result, paths):
        names = [Path(path).stem for path in paths]
        calls.append(names)
        if "later" not in names and "000006" in names:
            raise PlaceError("000006 shows another place", ["x_000006"])
        return SimpleNamespace(frame_names=(*result.frame_names, *(f"x_{n}" for n in names)), images=result.images)

    monkeypatch.setattr(command.time, "sleep", sleep)
    fitter = fitter_of(old)
    both = command._watched(folder, old, grown, fitter, "x_", Report())  # pyright: ignore[reportArgumentType]
    assert calls == [["000005", "000006"], ["000005"], ["000006", "later"]]
    assert both.frame_names[len(OLD) :] == ("x_000005", "x_000006", "x_later")
    said = " ".join(capsys.readouterr().err.split())
    assert "broken.png is left out until it changes" in said
    assert "wide.png is left out until it changes: it is fitted to 96 x 56 pixels" in said
    assert said.count("left out until") == 2
