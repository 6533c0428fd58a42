import dataclasses
import json
import sys

import numpy as np
import pytest

from tests.shared.command import run
from tests.shared.dataset_files import depth_png, write_plain
from tests.shared.room import make_room
from tests.shared.scored_room import room_and_truth
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.truth import Truth
from vggtjax.interface.commands.evaluate import _frames_in_words
from vggtjax.research.evaluation.datasets import DATASETS, chosen_frames
from vggtjax.research.evaluation.metrics.trajectory import trajectory_errors
from vggtjax.research.evaluation.protocol import score
from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels

S = 4
ROOM = make_room(S)


@pytest.fixture(autouse=True)
def without_plots(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)


@pytest.fixture
def walk(tmp_path):
    """A sequence with its truth, and the very truth as a result."""
    images = ROOM.images.astype(np.float32) / 255
    truth = Truth(images, ROOM.depth, ROOM.dynamic_mask, ROOM.camera_from_world, ROOM.intrinsics)
    write_plain(tmp_path / "data/walk", truth)
    size = np.tile(ROOM.depth.shape[1:], (S, 1))
    names = tuple(f"{frame:05d}" for frame in range(S))
    ones, zeros = np.ones((S, 2)), np.zeros((S, 2))
    place = {"source_size": size, "source_scale": ones, "source_offset": zeros}
    result = dataclasses.replace(ROOM, frame_names=names, **place)
    return tmp_path / "data/walk", result


def scored(folder, result, *arguments, capsys):
    """Return exit code, console, and the record of the result of a sequence."""
    root = folder.parent.parent
    result.save(root / "mine/walk", only=("depth",))
    words = ("plain", folder.parent, "--results", f"mine={root / 'mine'}", "--out", root / "out", *arguments)
    code, out, err = run(capsys, "evaluate", *words)
    return code, out + err, json.loads((root / "out/results.json").read_text())["sequences"][0]


@pytest.mark.parametrize("lost", [["-inf"] * 16, ["nan"] * 16, ["0"] * 16])
def test_a_pose_that_is_not_finite_leaves_its_frame_out(walk, capsys, lost):
    folder, result = walk
    poses = (folder / "world_from_camera.txt").read_text().splitlines()
    poses[1] = " ".join(lost)
    (folder / "world_from_camera.txt").write_text("\n".join(poses))
    code, shown, record = scored(folder, result, capsys=capsys)
    assert code == 0, shown
    assert "walk: 1 of 4 frames have no pose: 00001" in shown
    assert "00001" in (folder.parent.parent / "out/index.html").read_text()
    assert record["left_out"] == {"poses": {"count": 1, "of": 4, "why": "have no pose", "frames": ["00001"]}}
    assert record["metrics"]["ate"] < 1e-4
    assert record["metrics"]["abs_rel"] < 2e-4  # of all four frames
    assert record["metrics"]["distance_paired_mean"] < 2e-3
    assert record["settings"]["strict"] is False
    page = (folder.parent.parent / "out/index.html").read_text()
    for place in (shown, page):  # nothing is drawn, but all is scored
        assert "plots are left out, as matplotlib is not installed" in place
        assert "frames: every frame; --stride, --start, --max-frames and --skip change it" in place
    assert not (folder.parent.parent / "out/plots").exists()
    assert (folder.parent.parent / "out/table.md").stat().st_size > 100
    code, shown, record = scored(folder, result, "--strict", capsys=capsys)
    assert code == 2
    lost_one = "1 of 4 frames have no pose: 00001; add them, or score the other frames, without --strict"
    assert record["reason"] == lost_one
    (folder / "world_from_camera.txt").write_text("\n".join([" ".join(lost)] * 2 + poses[2:]))
    _, _, record = scored(folder, result, capsys=capsys)
    assert "trajectory: there are 2 true cameras; an alignment needs 3" in " ".join(record["notes"])
    assert record["metrics"]["j_mean"] == 1


def test_a_missing_frame_of_every_kind(walk, capsys):
    folder, result = walk
    names = ("depth/00000.png", "mask/00003.png", "rgb/00002.png")
    for name in names:
        (folder / name).unlink()
    (folder / "K.txt").write_text((folder / "K.txt").read_text() * S)  # for each frame, as the poses
    code, shown, record = scored(folder, result, capsys=capsys)
    assert code == 0, shown
    assert {what: (each["count"], each["frames"]) for what, each in record["left_out"].items()} == {
        "depth": (1, ["00000"]),
        "masks": (1, ["00003"]),
        "pictures": (1, ["00002"]),
    }
    assert (record["frames"], record["metrics"]["mask_frames"]) == (3, 2)
    assert record["metrics"]["depth_pixels"] == 2 * ROOM.depth[0].size
    assert record["metrics"]["j_mean"] == 1
    assert record["metrics"]["ate"] < 1e-4  # each pose is still that of its own picture
    assert record["metrics"]["distance_paired_mean"] < 2e-3


def test_keyframes_are_scored_at_their_own_frames(walk, capsys):
    folder, result = walk
    chosen = [0, 1, 3]
    arrays = ("depth", "depth_confidence", "dynamic_mask", "camera_from_world", "intrinsics", "images", "source_size",
              "source_scale", "source_offset", "valid_box", "saliency")  # fmt: skip
    taken = {name: None if getattr(result, name) is None else getattr(result, name)[chosen] for name in arrays}
    names = tuple(result.frame_names[frame] for frame in chosen)
    few = dataclasses.replace(result, **taken, timestamps=None, frame_names=names)
    code, shown, record = scored(folder, few, capsys=capsys)
    assert code == 0, shown
    assert "mine of walk: 1 of 4 frames have no result: 00002" in shown
    assert record["left_out"]["results"]["frames"] == ["00002"]
    assert (record["frames"], record["metrics"]["j_mean"]) == (3, 1)
    assert record["metrics"]["ate"] < 1e-4
    code, shown, record = scored(folder, few, "--strict", capsys=capsys)
    assert (code, record["reason"].startswith("the result is of frames 00000, 00001, 00003, ...")) == (2, True)


def test_depth_of_another_size_is_taken_at_the_pixels_of_the_pictures_and_never_blended(walk, capsys):
    folder, result = walk
    H, W = ROOM.depth.shape[1:]
    for frame in range(S):
        large = np.rint(1000 * ROOM.depth[frame]).astype(np.uint16).repeat(2, axis=0).repeat(2, axis=1)
        large[:4] = 0  # unknown
        (folder / f"depth/{frame:05d}.png").write_bytes(depth_png(large))
    code, shown, record = scored(folder, result, capsys=capsys)
    assert code == 0, shown
    assert f"its depth has {2 * W} x {2 * H} pixels and pictures {W} x {H}" in shown
    assert record["metrics"]["abs_rel"] < 2e-4
    assert record["metrics"]["depth_pixels"] == S * (H - 2) * W
    code, _, record = scored(folder, result, "--strict", capsys=capsys)
    assert code == 2
    assert f"expected ({H}, {W}), the size of" in record["reason"]
    assert "in 4 of 4 frames" in shown
    for frame in (0, 1, 3):
        right = np.rint(1000 * ROOM.depth[frame]).astype(np.uint16)
        (folder / f"depth/{frame:05d}.png").write_bytes(depth_png(right))
    _, shown, _ = scored(folder, result, capsys=capsys)
    assert f"its depth has {2 * W} x {2 * H} pixels and pictures {W} x {H} in 1 of 4 frames" in shown
    (folder / "depth/00001.png").write_bytes(depth_png(np.ones((W, H))))  # on its side
    code, shown, record = scored(folder, result, capsys=capsys)
    assert code == 0, shown
    assert record["left_out"]["depth"]["frames"] == ["00001"]
    assert record["metrics"]["depth_pixels"] == (S - 1) * H * W - 2 * W


def test_a_sequence_of_which_nothing_is_left_is_refused(walk, capsys):
    folder, result = walk
    for kind in ("depth", "mask"):
        for path in (folder / kind).iterdir():
            path.unlink()
    (folder / "world_from_camera.txt").write_text("\n".join([" ".join(["nan"] * 16)] * S))
    code, shown, record = scored(folder, result, capsys=capsys)
    assert code == 2
    assert record["status"] == "failed"
    assert record["reason"].startswith("nothing is left to score: ")
    assert "nothing could be scored" in shown


def test_the_frames_that_are_taken_are_said(walk, capsys):
    folder, result = walk
    _, shown, record = scored(folder, result, "--stride", "2", capsys=capsys)
    sentence = "frames: one frame of 2 (stride 2), by --stride"
    assert sentence in shown
    settings = json.loads((folder.parent.parent / "out/results.json").read_text())["settings"]
    assert (settings["stride"], settings["frames"]) == (2, sentence)
    assert sentence in (folder.parent.parent / "out/index.html").read_text()
    assert record["frames"] == 2
    of_tum = _frames_in_words(chosen_frames("tum", Sampling()), "tum", Sampling())
    assert of_tum.startswith("frames: one frame of 3 (stride 3), at most 90, as the protocol of tum has it; --stride")
    of_bonn = _frames_in_words(chosen_frames("bonn", Sampling(max_frames=5)), "bonn", Sampling(max_frames=5))
    assert of_bonn == "frames: every frame, from frame 30 to 139, at most 5, by --max-frames"
    for name, has_one in {"davis": True, "kitti": True, "plain": False, "capture": False}.items():
        assert DATASETS[name].has_protocol == has_one


def test_frames_are_left_out_by_number(walk, capsys):
    folder, result = walk
    _, shown, record = scored(folder, result, "--skip", "1", capsys=capsys)
    assert "frames: every frame, without 1, by --skip" in shown
    assert (record["frames"], record["settings"]["skip"], record["notes"][-1:]) == (3, "1", [])
    assert record["metrics"]["j_mean"] == 1  # each of its own frame
    code, _, record = scored(folder, result, "--skip", "0-9", capsys=capsys)
    assert (code, record["reason"]) == (2, "skip leaves none of 4 frames of sequence walk; expected to leave one")


def test_errors_of_cameras_are_those_of_the_frames_that_are_left():
    room, sequence = room_and_truth(frames=6)
    poses = np.array(sequence.world_from_camera)
    moved = poses.copy()
    moved[:, :3, 3] += np.random.default_rng(0).normal(size=(6, 3))
    left = [0, 2, 3, 5]
    for frame in (1, 4):
        poses[frame] = np.nan
    truth = TruthAtPixels(dataclasses.replace(sequence, world_from_camera=poses), room)
    camera_from_world = np.linalg.inv(moved)[:, :3].astype(np.float32)
    result = dataclasses.replace(room, camera_from_world=camera_from_world)
    expected = trajectory_errors(result.world_from_camera[left], poses[left])
    assert score(result, truth).metrics["ate"] == pytest.approx(expected.ate, rel=1e-6)
    assert expected.ate > 0.1
