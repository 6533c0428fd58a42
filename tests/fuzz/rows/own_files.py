"""Rows of files that the library itself writes and reads again: results, kept parts, what a run goes on from."""

from __future__ import annotations

import json
import os
from pathlib import Path
from unittest.mock import patch

import numpy as np

from tests.fuzz.cases import Reader
from tests.fuzz.rows.foreign import file, made
from tests.shared.dataset_files import npy
from tests.shared.room import make_room
from vggtjax.pipeline.batch.contact import _told as read_card
from vggtjax.pipeline.batch.destination import SETTINGS_NAME, LocalFolder, RemoteFolder
from vggtjax.pipeline.windows.loops import find_loops
from vggtjax.pipeline.windows.store import WindowStore
from vggtjax.pipeline.windows.whole import window_name
from vggtjax.research.evaluation.page import is_report
from vggtjax.results.archive import saved_names
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays
from vggtjax.training.metrics import read_metrics
from vggtjax.training.scenes.dataset import read_index
from vggtjax.training.world.assets import read_object


def _read_archive(path: Path) -> None:
    saved_names(path)
    read_card(path)
    result = Reconstruction.load(path)
    repr(result)
    for value in (result.known_facts, result.length_unit, result.model_note, result.instances):
        assert value is not None


def _read_npz(path: Path) -> None:
    arrays.read_headers(path)
    for array in arrays.read_arrays(path).values():
        array.tofile(os.devnull)  # pages of mapped arrays are read


_ARRAYS = {"depth": np.ones((4, 6, 8), np.float32), "mask": np.ones((3, 4), bool), "words": np.array(["a", "b"])}
_WINDOWS = {"model": "tiny", "window": 3}


def _windows(folder: Path) -> Path:
    """Store three windows of three frames, as a run that was stopped leaves them."""
    store, room = WindowStore(folder, _WINDOWS), make_room(3)
    for number in range(3):
        store.save(window_name(number), room, np.random.default_rng(number).random((4, 8), np.float32))
    return folder


def _read_windows(path: Path) -> None:
    """Take the windows that are whole, and look for loops among them, as a run that goes on does."""
    store, room = WindowStore(path, _WINDOWS), make_room(3)
    names = [window_name(number) for number in range(3)]
    if all(store.find(name, room.frame_names, room.images) is not None for name in names):
        find_loops(store.features(names, 4), [range(3), range(3, 6), range(6, 9)], 1)


_SETTINGS = {"model": "tiny", "method": "vggt", "size": 28, "outputs": ["depth", "mask"], "frames": None}


def _read_remote_settings(path: Path) -> None:
    """Read settings as those of a batch at a URL, whose server gives what the file holds."""
    content = path.read_bytes() if path.is_file() and not path.is_symlink() else None
    given = patch("vggtjax.pipeline.batch.destination.read_url", return_value=content)
    with given, patch("vggtjax.pipeline.batch.destination.write_url"):
        RemoteFolder("s3://bucket/results").begin(_SETTINGS)


_SCENES = {"format": "vggtjax scenes", "version": 1, "scenes": ["scene_0000"], "config": {"height": 4}}
_METRICS = "step,stage,seconds,samples,loss\n1,0,0.5,4,2.5\n2,0,1.0,8,2.25\n"
_EVALUATION = {
    "settings": {"dataset": "plain", "methods": ["vggt"]},
    "sequences": [{"name": "a", "method": "vggt", "metrics": {"abs_rel": 0.1}, "notes": []}],
    "mean": {"vggt": {"abs_rel": 0.1}},
    "seconds": {"vggt": {"depth": 0.5}},
}
_OBJECT = {
    "vertices": np.random.default_rng(0).random((2, 4, 3), np.float32),
    "faces": np.array([[0, 1, 2], [1, 2, 3]], np.int32),
    "uv": np.zeros((4, 2), np.float32),
    "texture": np.zeros((4, 4, 3), np.uint8),
    "fps": np.float32(8),
}
_ARCHIVE = 2**26 + 2**23  # slack where an .npz is read: one of any size may declare 64 MiB


ROWS = (
    Reader("npz", made(lambda path: np.savez_compressed(path, **_ARRAYS), "arrays.npz"), _read_npz, _ARCHIVE),
    Reader("npy", file("array.npy", npy(np.ones((8, 6), np.float32))), arrays.read_array),
    Reader("result", made(lambda path: make_room(3).save_archive(path), "reconstruction.npz"), _read_archive, _ARCHIVE),
    Reader("object of assets", made(lambda path: np.savez(path, **_OBJECT), "anim_walk.npz"), read_object, _ARCHIVE),
    Reader("metrics", file("metrics.csv", _METRICS), read_metrics),
    Reader("index of scenes", file("index.json", json.dumps(_SCENES)), lambda path: read_index(path.parent)),
    Reader("stored windows", _windows, _read_windows, _ARCHIVE),
    Reader(
        "settings of a batch",
        file(SETTINGS_NAME, json.dumps(_SETTINGS)),
        lambda path: LocalFolder(path.parent).begin(_SETTINGS),
    ),
    Reader("settings at a URL", file(SETTINGS_NAME, json.dumps(_SETTINGS)), _read_remote_settings),
    Reader("evaluation", file("results.json", json.dumps(_EVALUATION)), is_report),
)
