"""The options of long clips on the command line: what is refused, in one sentence, with nothing written."""

import re

import numpy as np
import pytest
from PIL import Image

from tests.shared.videos import write_video
from vggtjax import Reconstruction, load_model
from vggtjax.errors import DeviceMemoryError
from vggtjax.interface.commands import main as cli
from vggtjax.interface.commands.clip_options import GivenInputs
from vggtjax.interface.commands.one_clip import OneClip
from vggtjax.interface.commands.report import Report
from vggtjax.options import Options
from vggtjax.pipeline import memory
from vggtjax.pipeline.batch.many import reconstruct_many
from vggtjax.pipeline.batch.recipe import ClipRecipe
from vggtjax.pipeline.steps import Compile
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.pipeline.windows.store import FOLDER, write_cut
from vggtjax.results.saving import Saving
from vggtjax.storage.memory import Room, in_gigabytes

SIDE = 96  # of the model's frames

pytestmark = [pytest.mark.filterwarnings("ignore:the field of view"), pytest.mark.usefixtures("tiny_demo")]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    for number, value in enumerate(np.random.default_rng(0).integers(0, 255, (7, SIDE, SIDE, 3), np.uint8)):
        Image.fromarray(value).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--window 15 --overlap 8", "--window is 15 and --overlap is 8; expected a window of at least twice the"),
        ("--overlap 2", "overlap is 2, but there are no windows"),
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


def free_for(monkeypatch, count, clips=1, *, hard=False):
    """Make up the free memory: what so many frames need, and one byte; nothing is known for None."""
    needed = 0 if count is None else memory.predicted_bytes(load_model("demo"), count, SIDE, SIDE, clips=clips) + 1
    monkeypatch.setattr(memory, "available", lambda _: None if count is None else Room(needed, "of a test", hard))
    return needed


def fail_once(monkeypatch):
    """Let the first program that is compiled find no memory."""
    run, calls = Compile.__call__, []

    def failing(self, stage, *arguments, **options):
        calls.append(stage)
        if len(calls) == 1:
            raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 123 bytes")
        return run(self, stage, *arguments, **options)

    monkeypatch.setattr(Compile, "__call__", failing)
    return calls


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "clip.mp4", range(0, 1600, 100), size=(SIDE, SIDE))


_WORDS = ["--model", "demo", "--method", "vggt", "--only", "cameras", "--no-loops", "--no-consistent-depth"]


@pytest.fixture(scope="module")
def in_windows(video, tiny_demo, tmp_path_factory):
    """The video in windows of 8 frames."""
    out = tmp_path_factory.mktemp("result") / "cut"
    assert cli.main(["reconstruct", str(video), *_WORDS, "--window", "8", "--out", str(out)]) == 0
    return Reconstruction.load(out)


def test_a_video_that_does_not_fit_in_memory_is_run_in_windows(video, in_windows, tmp_path, capsys, monkeypatch):
    free = free_for(monkeypatch, 10)
    assert cli.main(["reconstruct", str(video), *_WORDS, "--out", str(tmp_path / "cut")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    needed = memory.predicted_bytes(load_model("demo"), 16, SIDE, SIDE)
    sizes = f"16 frames need about {in_gigabytes(needed)}, {in_gigabytes(free)} are free of a test"
    assert f"{sizes}: running windows of 8 frames, overlap 2; --window 0 runs all together" in said
    cut = Reconstruction.load(tmp_path / "cut")
    assert cut.settings["windows"]["count"] == in_windows.settings["windows"]["count"] == 3
    assert np.array_equal(cut.depth, in_windows.depth)
    names = sorted(path.name for path in (tmp_path / "cut").iterdir())
    assert names == ["intrinsics.txt", "reconstruction.npz", "trajectory.txt"]


def test_a_run_without_memory_is_run_once_more_in_windows(video, in_windows, tmp_path, capsys, monkeypatch):
    calls = fail_once(monkeypatch)
    words = ["reconstruct", str(video), *_WORDS, "--window", "0", "--no-memory-check"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"16 frames of {SIDE} x {SIDE} pixels do not fit in the memory of the device" in said
    assert "running once more, in windows of 8 frames" in said
    assert len(calls) > 1
    assert np.array_equal(Reconstruction.load(tmp_path / "out").depth, in_windows.depth)


def test_clips_of_a_batch_that_do_not_fit_are_run_in_windows(video, in_windows, tmp_path, monkeypatch):
    def outcome(out, **changes):
        saved = {"options": Options(method="vggt"), "saving": Saving(only=("cameras",))}
        (only,) = reconstruct_many(load_model("demo"), {"a": video}, tmp_path / out, **saved, **changes)
        if only.status == "done":
            assert np.array_equal(Reconstruction.load(tmp_path / out / "a").depth.shape, in_windows.depth.shape)
            assert not (tmp_path / out / "a" / FOLDER).exists()
        return only

    free_for(monkeypatch, 10, clips=3)
    predicted = outcome("predicted")
    assert (predicted.status, predicted.frames) == ("done", 16)
    assert predicted.reason.endswith("running windows of 8 frames, overlap 2")
    fail_once(monkeypatch)
    retried = outcome("retried", unchecked=True)
    assert "run once more, in windows of 8 frames" in retried.reason


@pytest.mark.parametrize("hard", [False, True])
def test_a_clip_that_cannot_fit_is_refused_before_the_work(frames, tmp_path, capsys, monkeypatch, hard):
    """Seven frames need less than 15 % more than five, which is tried in memory that is free but has no limit."""
    if not hard:
        monkeypatch.setattr(memory, "ERROR", 0.0)
    free_for(monkeypatch, 5, hard=hard)
    words = ["reconstruct", str(frames), "--model", "demo", "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--window", "0"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(r"GB are free of a test; what fits: --max-frames 5, or --size \d+", said)
    assert said.endswith("(--no-memory-check runs it all the same)")
    assert not (tmp_path / "out").exists()


def test_windows_are_chosen_by_the_frames_that_fit(frames, tmp_path, capsys, monkeypatch):
    model = load_model("demo")

    def with_room(count, *, window=None, devices=1, **options):
        free_for(monkeypatch, count)
        recipe = ClipRecipe().changed(size=SIDE, devices=devices, **options)
        clip = OneClip(Report(), str(frames), model, None, recipe, GivenInputs(), tmp_path)
        return clip.cut(Windows(window))

    def said():
        return " ".join(capsys.readouterr().err.split())

    assert with_room(7) == (Windows(), None)
    assert with_room(None) == (Windows(), None)
    assert with_room(6, refine_cameras=True) == (Windows(), None)
    assert "but --refine-cameras needs all frames at once: they are run together" in said()
    assert with_room(None, window=7) == (Windows(7), None)
    assert "no more than a window of 7: all are run together" in said()
    assert with_room(6, window=4) == (Windows(4), 7)
    assert with_room(6) == (Windows(), None)  # seven frames are too few for windows of eight
    assert "GB are free of a test: that may not be enough" in said()
    monkeypatch.setattr(memory, "ERROR", 0.0)
    with pytest.raises(DeviceMemoryError, match="what fits: --max-frames 3"):
        with_room(3, window=4)
    monkeypatch.setattr("jax.local_device_count", lambda: 2)  # a split CPU, whose devices share one memory
    with pytest.raises(DeviceMemoryError, match="7 frames need about"):
        with_room(6, devices=2)
    assert with_room(100, devices=2) == (Windows(), None)
    assert memory.most_frames(model, SIDE, SIDE, memory.predicted_bytes(model, 100, SIDE, SIDE)) == 100
    (tmp_path / FOLDER).mkdir()
    write_cut(tmp_path, 4, 2)  # of a run that was stopped
    assert with_room(7) == (Windows(4, 2), 7)
