"""The truth of a small room, written as other programs write their results."""

from functools import partial
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.room import make_room

ROOM = make_room(3)


def write_flat(folder, padded, logarithmic):
    """VGGT4D's `process_scene` pads all numbers, MonST3R's `save_*` those of frame_ alone; quaternions have w first."""
    folder.mkdir(parents=True)
    poses = ROOM.world_from_camera.astype(float)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    with (folder / "pred_traj.txt").open("w") as file:
        for number, (pose, turn) in enumerate(zip(poses, quaternions, strict=True)):
            file.write(" ".join(str(value) for value in (float(number), *pose[:3, 3], *turn)) + "\n")
    np.savetxt(folder / "pred_intrinsics.txt", ROOM.intrinsics.reshape(-1, 9), fmt="%.6f")
    for number in range(3):
        short = f"{number:04d}" if padded else str(number)
        Image.fromarray(ROOM.images[number]).save(folder / f"frame_{number:04d}.png")
        np.save(folder / f"frame_{number:04d}.npy", ROOM.depth[number])
        confidence = ROOM.depth_confidence[number]
        np.save(folder / f"conf_{short}.npy", np.log(confidence) if logarithmic else confidence)
        Image.fromarray(255 * ROOM.dynamic_mask[number].astype(np.uint8)).save(folder / f"dynamic_mask_{short}.png")
        Image.fromarray(np.full((28, 42), 255, np.uint8)).save(folder / f"enlarged_dynamic_mask_{short}.png")
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(folder / "dynamic_mask_bw.png")  # of MonST3R's pair viewer


def write_cut3r(folder):
    """CUT3R's `prepare_output`."""
    for name in ("depth", "conf", "color", "camera"):
        (folder / name).mkdir(parents=True)
    for number in range(3):
        np.save(folder / f"depth/{number:06d}.npy", ROOM.depth[number])
        np.save(folder / f"conf/{number:06d}.npy", ROOM.depth_confidence[number])
        Image.fromarray(ROOM.images[number]).save(folder / f"color/{number:06d}.png")
        pose, intrinsics = ROOM.world_from_camera[number], ROOM.intrinsics[number]
        np.savez(folder / f"camera/{number:06d}.npz", pose=pose, intrinsics=intrinsics)


def write_da3(folder, kind="npz", rows=3):
    """Depth Anything 3's exporters npz and mini_npz: camera-from-world, with a last row or without."""
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    poses[:, :3] = ROOM.camera_from_world
    arrays = {"depth": ROOM.depth, "conf": ROOM.depth_confidence, "intrinsics": ROOM.intrinsics}
    arrays["extrinsics"] = poses[:, :rows]
    (folder / "exports" / kind).mkdir(parents=True)
    if kind == "npz":
        arrays["image"] = ROOM.images
    np.savez_compressed(folder / "exports" / kind / "results.npz", allow_pickle=True, **arrays)


def write_spatialtracker(folder, name="clip_result.npz"):
    """SpatialTrackerV2's `inference.py`: the video is shares of white, frames first and colours second."""
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    poses[:, :3] = ROOM.camera_from_world
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / name,
        coords=np.zeros((3, 5, 3), np.float32),
        extrinsics=poses,
        intrinsics=ROOM.intrinsics,
        depths=ROOM.depth,
        video=ROOM.images.transpose(0, 3, 1, 2).astype(np.float32) / 255,
        visibs=np.ones((3, 5, 1), bool),
        unc_metric=ROOM.depth_confidence,
    )


def rearrange(folder):
    """DAS3R's `rearrange.py` on what its predictor wrote."""
    write_flat(folder / "before", padded=False, logarithmic=True)
    for number in range(3):
        for old, new in (
            (f"frame_{number:04d}.npy", f"depth_maps/frame_{number:04d}.npy"),
            (f"frame_{number:04d}.png", f"images/frame_{number:04d}.png"),
            (f"conf_{number}.npy", f"confidence_maps/conf_{number:04d}.npy"),
            (f"dynamic_mask_{number}.png", f"dynamic_masks/dynamic_mask_{number:04d}.png"),
        ):
            (folder / new).parent.mkdir(exist_ok=True)
            (folder / "before" / old).rename(folder / new)
    for name in ("pred_traj.txt", "pred_intrinsics.txt"):
        (folder / "before" / name).rename(folder / name)


WRITERS = {
    "vggt4d": partial(write_flat, padded=True, logarithmic=False),
    **dict.fromkeys(("monst3r", "easi3r", "das3r", "pomato"), partial(write_flat, padded=False, logarithmic=True)),
    "cut3r": write_cut3r,
    "da3": write_da3,
    "spatialtrackerv2": write_spatialtracker,
}
WITH_MASKS = ("vggt4d", "monst3r", "easi3r", "das3r", "pomato")
QUATERNIONS: dict[str, Any] = dict.fromkeys(WRITERS) | dict.fromkeys(WITH_MASKS, "wxyz")
