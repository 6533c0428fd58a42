"""Rows of arrays, and of the files that the library itself writes and reads again."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from tests.dataset_files import npy, write
from tests.fuzz import samples
from tests.fuzz.cases import Reader
from tests.room import make_room
from vggtjax.app.posted import cleaned
from vggtjax.evaluation.records import Record, Records
from vggtjax.pipeline.contact import _read as read_card
from vggtjax.results.archive import saved_names
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays
from vggtjax.training.metrics import read_metrics
from vggtjax.windows.loops import find_loops
from vggtjax.windows.store import WindowStore, unfinished_cut, write_cut
from vggtjax.windows.whole import window_name


def _archive(path: Path) -> None:
    saved_names(path)
    read_card(path)
    result = Reconstruction.load(path)
    repr(result)
    for value in (result.known_facts, result.length_unit, result.model_note, result.instances):
        assert value is not None


def _npz(path: Path) -> None:
    arrays.read_headers(path)
    for array in arrays.read_arrays(path).values():
        array.tofile(os.devnull)  # pages of mapped arrays are read


_RECORD = Record("a", "vggt", "ok", {"size": 28}, {"abs_rel": 0.1}, ("a note",), "", 3, {"depth": 0.5})


def _record(folder: Path) -> Path:
    Records(folder).keep(_RECORD, {"abs_rel": np.ones(3)})
    return folder


def _read_record(path: Path) -> None:
    record = Records(path).kept("a", "vggt", {"size": 28})
    if record is not None:
        Records(path).curves(record)


def _passes(folder: Path) -> Path:
    from vggtjax.learning.clip_passes import ClipPasses, kept_passes

    maps = {
        name: np.ones((2, 4, 4), np.float32) for name in ("depth1", "confidence1", "depth2", "confidence2", "truth")
    }
    passes = ClipPasses(
        **maps,
        saliency=np.ones((2, 2, 2), np.float32),
        dynamic_mask=np.zeros((2, 4, 4), bool),
        images=np.zeros((2, 4, 4, 3), np.uint8),
        camera_from_world=np.ones((2, 3, 4), np.float32),
        intrinsics=np.ones((2, 3, 3), np.float32),
        true_dynamic=np.zeros((2, 4, 4), bool),
    )
    kept_passes({}, lambda: passes, folder)
    return next(folder.glob("*.npz"))


def _read_passes(path: Path) -> None:
    from vggtjax.learning.clip_passes import _read

    _read(path)


def _program(folder: Path) -> Path:
    from vggtjax.storage.programs import _keep

    _keep(folder / "program.bin", b"content" * 30)
    return folder / "program.bin"


def _read_program(path: Path) -> None:
    from vggtjax.storage.programs import _read_kept

    assert _read_kept(path) in (None, b"content" * 30), "a damaged program is used"


def _scenes(folder: Path) -> Path:
    index = {"format": "vggtjax scenes", "version": 1, "scenes": ["scene_0000"], "config": {"height": 4}}
    write(folder / "index.json", json.dumps(index))
    return folder


def _read_scenes(path: Path) -> None:
    from vggtjax.scenes.dataset import read_index

    read_index(path)


def _cut(folder: Path) -> Path:
    write_cut(folder, 16, 4)
    return folder


_SETTINGS = {"model": "tiny", "window": 3}


def _windows(folder: Path) -> Path:
    """Store three windows of three frames, as a run that was stopped leaves them."""
    store, room = WindowStore(folder, _SETTINGS), make_room(3)
    for number in range(3):
        features = np.random.default_rng(number).random((4, 8), np.float32)
        store.save(window_name(number), room, features)
    return folder


def _read_windows(path: Path) -> None:
    """Take the windows that are whole, and look for loops among them, as a run that goes on does."""
    store, room = WindowStore(path, _SETTINGS), make_room(3)
    names = [window_name(number) for number in range(3)]
    if all(store.find(name, room.frame_names, room.images) is not None for name in names):
        find_loops(store.features(names, 4), [range(3), range(3, 6), range(6, 9)], 1)


def _posted(path: Path) -> None:
    if path.is_file() and not path.is_symlink():  # a request is no file
        cleaned(path.read_bytes(), {0: 5})


_POSTED = {"data": [[{"path": f"/tmp/{'0' * 64}/a.mp4"}], "demo", "vggt", 2, 0], "fn_index": 0, "session_hash": "x"}

_ARCHIVE = 2**26 + 2**23  # slack where an .npz is read: one of any size may declare 64 MiB

ROWS = (
    Reader("npz", samples.npz, _npz, _ARCHIVE),
    Reader("npy", samples.text_file("array.npy", npy(np.ones((8, 6), np.float32))), arrays.read_array),
    Reader("result", samples.archive, _archive, _ARCHIVE),
    Reader("record", _record, _read_record, _ARCHIVE),
    Reader(
        "metrics",
        samples.text_file("metrics.csv", "step,stage,seconds,samples,loss\n1,0,0.5,4,2.5\n2,0,1.0,8,2.25\n"),
        read_metrics,
    ),
    Reader("kept passes", _passes, _read_passes, _ARCHIVE),
    Reader("cached program", _program, _read_program),
    Reader("index of scenes", _scenes, _read_scenes),
    Reader("cut of windows", _cut, unfinished_cut),
    Reader("stored windows", _windows, _read_windows, _ARCHIVE),
    Reader("request of the app's page", samples.json_file("posted.json", _POSTED), _posted),
)
