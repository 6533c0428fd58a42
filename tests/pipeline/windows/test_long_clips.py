"""Long clips end to end, with a double of the network that knows the truth: exact paths, movers, kills, bad input."""

import dataclasses
import logging
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.pipeline.windows import walk as walks
from tests.pipeline.windows.walk import CONFIG, FRAMES, movers, walk, window_result
from tests.shared.contents import contents
from vggtjax.cameras import checked_centres, umeyama_sim3
from vggtjax.errors import ClipError, InputError, OutputError
from vggtjax.pipeline.windows.run import run_windows
from vggtjax.pipeline.windows.store import FOLDER
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.writing import locked_folder

NOTHING = np.zeros((FRAMES, CONFIG.height, CONFIG.width), bool)


def exact(clip) -> Reconstruction:
    return window_result(clip, 0, NOTHING)


def reconstructed(out, run, *, loops=False, source=None) -> Reconstruction:
    images = np.asarray(walk().images) if source is None else source
    cut, plan = walks.windows_of(loops=loops), walks.plan_of()
    return run_windows(images, out, cut, plan, walks.tools_of(run), walks.SETTINGS)


def path_error(result) -> float:
    """Return the largest distance of a camera from the truth after Sim(3), as a share of the path's extent."""
    found, true = checked_centres(result.camera_from_world), checked_centres(walk().camera_from_world)
    return np.linalg.norm(umeyama_sim3(found, true).apply(found) - true, axis=1).max() / np.ptp(true, axis=0).max()


def test_a_result_knows_its_source_which_is_looked_at_once(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "vggtjax.pipeline.windows.run.source_setting", lambda source: seen.append(source) or {"source": "x"}
    )
    assert reconstructed(tmp_path, exact).settings["source"] == "x"
    assert len(seen) == 1


def test_exact_windows_give_the_exact_path_and_depth(tmp_path):
    result, true = reconstructed(tmp_path, exact, loops=True), walk()
    assert path_error(result) < 1e-5
    scale = umeyama_sim3(checked_centres(result.camera_from_world), checked_centres(true.camera_from_world)).scale
    assert np.abs(scale * result.depth / true.depth - 1).max() < 1e-5
    assert np.array_equal(result.images, np.round(255 * true.images).astype(np.uint8))
    assert result.frame_names == tuple(f"{frame:06d}" for frame in range(FRAMES))
    used = [loop["used"] for loop in result.settings["windows"]["loops"]]
    assert used
    assert all(used)


@pytest.mark.parametrize(
    ("share", "off", "worse"), [(0.4, 0.03, 5e-4), pytest.param(0.6, 0.1, 0.02, marks=pytest.mark.proof)]
)
def test_movers_spoil_the_path_unless_the_masks_leave_them_out(tmp_path, share, off, worse):
    moving = movers(share)

    def run(clip):
        return window_result(clip, 0, moving, off)

    masked = reconstructed(tmp_path / "masks", run)
    assert path_error(masked) < 1e-5
    assert np.array_equal(masked.dynamic_mask, moving)
    assert np.array_equal(np.unique(masked.instances), [0, 1])  # one object, with one number in all windows

    def unmasked(clip):
        made = run(clip)
        return dataclasses.replace(made, dynamic_mask=np.zeros_like(made.dynamic_mask))

    assert path_error(reconstructed(tmp_path / "none", unmasked)) > worse


def test_windows_without_matches_leave_motion_to_the_others(tmp_path):
    """In the first window matches cannot be used: its frames have the motion of their other window, or none, 1."""
    runs = []

    def run(clip):
        window = window_result(clip, 0, NOTHING)
        patches = np.ones((len(clip), 2, 2), np.float32)
        runs.append(window)
        masks, motion = ("cues", None) if len(runs) == 1 else ("matches", 3 * patches)
        settings = window.settings | {"masks": masks}
        return dataclasses.replace(window, saliency=patches, motion=motion, settings=settings)

    result = reconstructed(tmp_path, run)
    assert result.motion is not None
    assert np.array_equal(result.motion[:, 0, 0], np.where(np.arange(FRAMES) < 11, 1, 3))  # the second begins there
    number = len(runs)
    assert result.settings["masks"] == f"matches ({number - 1} of {number} windows); cues (1 of {number} windows)"


def test_windows_without_shared_static_pixels_are_joined_by_their_cameras(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        result = reconstructed(tmp_path, lambda clip: window_result(clip, 0, ~NOTHING))
    assert "windows 0 and 1, which share frames 11 to 15, share no static pixels" in caplog.text
    assert "joined by their cameras" in caplog.text
    assert path_error(result) < 1e-4
    assert result.settings["windows"]["static_pixels"] == [0] * 4


def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(tmp_path):
    calls: list[str] = []

    def run(clip):
        calls.append(clip.frame_names[0])
        return window_result(clip, 0, movers(), 0.03)

    reconstructed(tmp_path / "whole", run, loops=True)
    every, calls = calls, []
    assert len(every) > 5  # five windows, and those of loops
    np.savez(tmp_path / "walk.npz", **walk()._asdict())
    files = [str(tmp_path / name) for name in ("killed", "walk.npz")]
    words = [sys.executable, "-m", "tests.pipeline.windows.killed", *files, "write", "30"]
    killed = subprocess.run(words, cwd=Path(__file__).parents[3], check=False)
    assert killed.returncode == -signal.SIGKILL  # while files of frames are written
    assert not (tmp_path / "killed" / "reconstruction.npz").exists()
    assert len(list((tmp_path / "killed").rglob("[0-9]*.npz"))) == 5
    reconstructed(tmp_path / "killed", run, loops=True)
    assert calls == []  # nothing is computed twice
    whole, again = contents(tmp_path / "whole"), contents(tmp_path / "killed")
    assert again.keys() == whole.keys()  # and the folder of the windows is gone
    assert again == whole


def test_stored_windows_of_other_frames_are_not_used(tmp_path, caplog):
    def fails_late(clip):
        if clip.frame_names[0] != "000000":
            raise RuntimeError("killed")
        return exact(clip)

    images = np.asarray(walk().images)
    caplog.set_level(logging.INFO)
    for _ in range(2):
        with pytest.raises(RuntimeError):
            reconstructed(tmp_path, fails_late)
    assert "are kept from a run that was stopped" in caplog.text
    caplog.clear()
    result = reconstructed(tmp_path, exact, source=images[:, ::-1].copy())
    assert "are kept from a run that was stopped" not in caplog.text
    assert np.array_equal(result.images[0], np.round(255 * images[0, ::-1]).astype(np.uint8))


def test_bad_input_is_one_sentence_and_leaves_no_result(tmp_path):
    with pytest.raises(InputError, match="the clip has 16 frames and window is 16; expected a longer clip"):
        reconstructed(tmp_path / "short", exact, source=np.asarray(walk().images[:16]))
    sizes = [np.zeros((32, 48, 3), np.uint8)] * 20 + [np.zeros((48, 48, 3), np.uint8)] * 20
    with pytest.raises(ClipError, match="48 x 48 pixels and those before it to 48 x 32; windows need frames of one"):
        reconstructed(tmp_path / "sizes", exact, source=sizes)
    used = locked_folder(tmp_path / "used" / FOLDER, "a clip")
    with used, pytest.raises(OutputError, match="another run is writing"):
        reconstructed(tmp_path / "used", exact)
    assert not list(tmp_path.rglob("reconstruction.npz"))
