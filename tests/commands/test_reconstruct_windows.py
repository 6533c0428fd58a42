"""The options of long clips on the command line: what is refused, in one sentence, with nothing written."""

import numpy as np
import pytest
from PIL import Image

from vggtjax import Reconstruction
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import open_source
from vggtjax.commands import main as cli
from vggtjax.commands.reconstruct import _cut_frames
from vggtjax.commands.report import Report
from vggtjax.windows.plan import Windows


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    for number, value in enumerate(np.random.default_rng(0).integers(0, 255, (7, 64, 64, 3), np.uint8)):
        Image.fromarray(value).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--window 15 --overlap 8", "--window is 15 and --overlap is 8; expected a window of at least twice the"),
        ("--window 8 --overlap 1", "overlap is 1; expected a whole number of at least 2"),
        ("--overlap 2", "overlap is 2, but there are no windows"),
        ("--window 4 --tracks grid:3", "--tracks and --window exclude each other"),
        ("--window 4 --shared-focal", "known cameras or lengths and --window exclude each other"),
    ],
)
def test_options_that_cannot_be(frames, tmp_path, capsys, options, sentence):
    out = tmp_path / "out"
    assert cli.main(["reconstruct", str(frames), "--model", "demo", "--out", str(out), *options.split()]) == 2
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert sentence in said
    assert "Traceback" not in said
    assert not out.exists()


def test_a_clip_in_windows(frames, tmp_path, capsys):
    words = ["reconstruct", str(frames), "--model", "demo", "--method", "vggt", "--only", "cameras", "--no-loops"]
    assert cli.main([*words, "--window", "4", "--overlap", "2", "--out", str(tmp_path / "cut")]) == 0
    assert "7 frames in windows of 4 that share at least 2" in capsys.readouterr().err
    assert Reconstruction.load(tmp_path / "cut").settings["windows"]["count"] == 3
    names = sorted(path.name for path in (tmp_path / "cut").iterdir())
    assert names == ["intrinsics.txt", "reconstruction.npz", "trajectory.txt"]


def test_a_clip_of_a_window_is_run_as_a_whole(frames, capsys):
    opened = open_source(str(frames))
    assert _cut_frames(Report(), opened, Sampling(), Windows(7)) is None
    assert "no more than a window of 7: all are run together" in capsys.readouterr().err
    assert _cut_frames(Report(), opened, Sampling(start=1), Windows(5)) == 6
