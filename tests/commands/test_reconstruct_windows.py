"""The options of long clips on the command line: what is refused, in one sentence, with nothing written."""

import numpy as np
import pytest
from PIL import Image

from tests.clips.test_video import write_video
from vggtjax import Reconstruction, load_model
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import open_source
from vggtjax.commands import main as cli
from vggtjax.commands.reconstruct import Reading, _chosen, _cut_frames
from vggtjax.commands.report import Report
from vggtjax.pipeline import memory
from vggtjax.windows.plan import Windows
from vggtjax.windows.store import FOLDER, write_cut


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
        ("--window 0 --overlap 2", "overlap is 2, but there are no windows"),
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


def test_a_video_that_does_not_fit_in_memory_is_run_in_windows(tmp_path, capsys, monkeypatch):
    """The free memory is made up: one byte less than what 10 frames need."""
    video = write_video(tmp_path / "clip.mp4", range(0, 1200, 100), size=(64, 64))
    model = load_model("demo")
    free = memory.predicted_bytes(model, 10, 64, 64) - 1
    monkeypatch.setattr(memory, "available_bytes", lambda _: free)
    words = ["reconstruct", str(video), "--model", "demo", "--method", "vggt", "--only", "cameras", "--no-loops"]
    assert cli.main([*words, "--out", str(tmp_path / "cut")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    needed = memory.predicted_bytes(model, 12, 64, 64)
    assert f"12 frames need about {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free: running windows of 8" in said
    assert "frames, overlap 2; --window 0 runs all together" in said
    assert Reconstruction.load(tmp_path / "cut").settings["windows"]["count"] == 2
    names = sorted(path.name for path in (tmp_path / "cut").iterdir())
    assert names == ["intrinsics.txt", "reconstruction.npz", "trajectory.txt"]


def test_windows_are_chosen_by_the_frames_that_fit(frames, tmp_path, capsys, monkeypatch):
    model, report = load_model("demo"), Report()
    reading = Reading(open_source(str(frames)), Sampling(), Fitter(size=64, patch=8))

    def with_room(count, *at_once):
        free = None if count is None else memory.predicted_bytes(model, count, 64, 64)
        monkeypatch.setattr(memory, "available_bytes", lambda _: free)
        return _chosen(report, reading, model, tmp_path, at_once)

    assert with_room(7) == (Windows(), None)
    assert with_room(None) == (Windows(), None)
    assert with_room(6, "--tracks") == (Windows(), None)
    assert "but --tracks needs all frames at once: they are run together" in " ".join(capsys.readouterr().err.split())
    assert memory.most_frames(model, 64, 64, memory.predicted_bytes(model, 100, 64, 64)) == 100
    (tmp_path / FOLDER).mkdir()
    write_cut(tmp_path, 4, 2)  # of a run that was stopped
    assert with_room(7) == (Windows(4, 2), 7)


def test_a_clip_of_a_window_is_run_as_a_whole(frames, capsys):
    opened = open_source(str(frames))
    assert _cut_frames(Report(), opened, Sampling(), Windows(7)) is None
    assert "no more than a window of 7: all are run together" in capsys.readouterr().err
    assert _cut_frames(Report(), opened, Sampling(start=1), Windows(5)) == 6
