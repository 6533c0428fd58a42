"""The table of readers: every place where a file or a folder of a stranger enters the library.

What a reader gives is used as the commands use it: frames are decoded, depth and masks of the first frame are read,
mapped tensors are touched.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.captures import folders
from tests.dataset_files import dpt, npy, write
from tests.evaluation.datasets.test_dycheck import dycheck_folder
from tests.evaluation.datasets.test_layouts import kitti_folder, sintel_folder
from tests.fuzz import samples
from tests.fuzz.cases import Reader
from tests.fuzz.samples import clip
from tests.results.test_foreign import QUATERNIONS, WRITERS
from tests.tiny import tiny_config
from vggtjax.app.posted import cleaned
from vggtjax.captures.depth_files import read_dpt, read_exr, read_npy, read_png
from vggtjax.captures.table import read_capture
from vggtjax.clips.images import read_image
from vggtjax.clips.masks import load_masks
from vggtjax.clips.queries import parse_queries
from vggtjax.clips.sampling import Sampling
from vggtjax.clips.sources import clips_by_name, open_source
from vggtjax.config import VGGTConfig
from vggtjax.evaluation.datasets import find_sequences
from vggtjax.evaluation.records import Record, Records
from vggtjax.known.depths import read_depths
from vggtjax.known.intrinsics import at_clip_pixels, read_intrinsics
from vggtjax.known.poses import checked_known_poses, read_poses
from vggtjax.pipeline.contact import _read as read_card
from vggtjax.results.archive import saved_names
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays
from vggtjax.storage.json_values import read_json
from vggtjax.storage.tensor_file import Spec, write_tensors
from vggtjax.training.metrics import read_metrics
from vggtjax.training.recipe import read_recipe
from vggtjax.windows.store import unfinished_cut, write_cut

_CODECS = {  # container -> codec; gif and mxf hold no other
    **dict.fromkeys((".mp4", ".mov", ".mkv", ".avi", ".ts", ".m4v", ".3gp"), "mpeg4"),
    **{
        ".webm": "libvpx",
        ".mpg": "mpeg1video",
        ".wmv": "wmv2",
        ".flv": "flv",
        ".ogv": "libvpx",
        ".mxf": "mpeg2video",
    },
    ".gif": "gif",
}
_POSES = "".join(f"{number} {number} {number % 2} 0 0 0 0 1\n" for number in range(3))
_RECIPE = Path(__file__).parents[2] / "docs/recipes/smoke.json"


def _frames(path: Path) -> None:
    for _ in open_source(path).frames(Sampling(max_frames=5)):
        pass


def _capture(path: Path) -> None:
    capture = read_capture(path)
    for frame in range(min(2, len(capture))):
        capture.depth(frame)
    if capture.frame_names:
        _frames(path)


def _sequences(name: str, path: Path, **options: Any) -> None:
    for open_sequence in find_sequences(name, path, **options).values():
        sequence = open_sequence()
        for read in (sequence.depth, sequence.mask):
            if read is not None:
                read(0)
        read_image(sequence.pictures[0])


def _clips(path: Path) -> None:
    for source in clips_by_name([str(path)]).values():
        open_source(source)


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
        np.array(array)


def _weights(path: Path) -> None:
    from converters.files import read_state_dict

    for tensor in read_state_dict(path).tensors.values():
        np.array(tensor)


def _tensors(path: Path) -> Path:
    specs = {"a.weight": Spec((4, 6), np.dtype(np.float32)), "b.bias": Spec((3,), np.dtype(np.float16))}
    write_tensors(path, specs, lambda name: [np.ones(specs[name].shape)], {"format": "pt"})
    return path


def _shards(folder: Path) -> Path:
    for number in (1, 2):
        spec = {f"tensor{number}": Spec((4,), np.dtype(np.float32))}
        write_tensors(folder / f"model-{number}-of-2.safetensors", spec, lambda _: [np.ones(4)])
    names = {f"tensor{number}": f"model-{number}-of-2.safetensors" for number in (1, 2)}
    content = {"metadata": {"total_size": 32}, "weight_map": names}
    return write(folder / "model.safetensors.index.json", json.dumps(content))


def _torch_file(folder: Path, **options: Any) -> Path:
    import torch

    state = {"a.weight": torch.ones(4, 6), "b.bias": torch.ones(3, dtype=torch.bfloat16)}
    torch.save({"model": state, "step": 3}, folder / "model.pt", **options)
    return folder / "model.pt"


def _checkpoint(folder: Path) -> Path:
    from vggtjax.checkpoint import flat_shapes, write_checkpoint

    config = tiny_config(depth=4, track_features=8, track_hidden=16)
    specs = {name: Spec(shape, np.dtype(np.float32)) for name, shape in flat_shapes(config).items()}
    zeros = {name: np.zeros(spec.shape, np.float32) for name, spec in specs.items()}
    labels: dict[str, Any] = {"name": "tiny", "note": "a note", "untrained_heads": ("tracks",)}
    labels["origin"] = {"model.pt": "0" * 64}
    return write_checkpoint(folder / "tiny.safetensors", specs, lambda name: [zeros[name]], config, **labels)


def _read_checkpoint(path: Path) -> None:
    from vggtjax.checkpoint import read_model

    read_model(path)


def _fusion(folder: Path) -> Path:
    from vggtjax.method.fusion_family import start
    from vggtjax.method.fusion_file import save_fusion

    save_fusion(folder / "rule.safetensors", start(()), {"model": "demo", "mask_pairs": 5})
    return folder / "rule.safetensors"


def _read_fusion(path: Path) -> None:
    from vggtjax.method.fusion_file import load_fusion

    load_fusion(path)


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


def _exr(folder: Path) -> Path:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": np.ones((8, 12), np.float32)}).write(str(folder / "depth.exr"))
    return folder / "depth.exr"


def _pictures(folder: Path) -> Path:
    for number in range(3):
        Image.fromarray(samples.pixels(number)).save(folder / f"{number}.{('png', 'jpg', 'webp')[number]}")
    return folder


def _sintel(folder: Path) -> Path:
    sintel_folder(folder)
    return folder


def _kitti(folder: Path) -> Path:
    kitti_folder(folder, range(3), range(3))
    return folder


def _made(function: Callable[[Path], object], name: str = "set") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        function(folder / name)
        return folder / name

    return make


def _posted(path: Path) -> None:
    if path.is_file() and not path.is_symlink():  # a request is no file
        cleaned(path.read_bytes(), {0: 5})


_PICTURES = {  # suffix -> slack: the last ones can hold 16 million pixels in a few hundred bytes
    **dict.fromkeys((".png", ".jpg", ".bmp", ".ppm", ".tga"), 48 * 2**20),
    **dict.fromkeys((".tif", ".webp", ".jp2", ".avif"), 2**28),
}
_POSTED = {"data": [[{"path": f"/tmp/{'0' * 64}/a.mp4"}], "demo", "vggt", 2, 0], "fn_index": 0, "session_hash": "x"}

READERS = (
    # weights and what goes with them
    Reader("safetensors", lambda folder: _tensors(folder / "model.safetensors"), _weights),
    Reader("shards with an index", _shards, _weights),
    Reader("torch file", _torch_file, _weights),
    Reader("torch file before 1.6", partial(_torch_file, _use_new_zipfile_serialization=False), _weights),
    Reader("checkpoint", _checkpoint, _read_checkpoint),
    Reader(
        "config",
        samples.text_file("config.json", tiny_config().to_json()),
        lambda path: read_json(path, VGGTConfig, "configuration"),
    ),
    Reader("recipe", lambda folder: write(folder / "recipe.json", _RECIPE.read_bytes()), read_recipe),
    Reader("fusion file", _fusion, _read_fusion),
    # arrays and our own files
    Reader("npz", samples.npz, _npz),
    Reader("npy", samples.text_file("array.npy", npy(np.ones((8, 6), np.float32))), arrays.read_array),
    Reader("result", samples.archive, _archive),
    Reader("record", _record, _read_record),
    Reader(
        "metrics",
        samples.text_file("metrics.csv", "step,stage,seconds,samples,loss\n1,0,0.5,4,2.5\n2,0,1.0,8,2.25\n"),
        read_metrics,
    ),
    Reader("kept passes", _passes, _read_passes),
    Reader("cached program", _program, _read_program),
    Reader("index of scenes", _scenes, _read_scenes),
    Reader("cut of windows", _cut, unfinished_cut),
    Reader("request of the app's page", samples.json_file("posted.json", _POSTED), _posted),
    # pictures, videos, masks
    *(
        Reader(f"picture {suffix}", samples.picture_file(f"picture{suffix}"), read_image, slack)
        for suffix, slack in _PICTURES.items()
    ),
    *(
        Reader(f"video {suffix}", samples.video_file(suffix, codec), _frames, 2**28)
        for suffix, codec in _CODECS.items()
    ),
    Reader("folder of pictures", _made(lambda folder: (folder.mkdir(), _pictures(folder))), _frames),
    Reader("masks", samples.masks, lambda path: load_masks(path, clip())),
    # lists and what is known
    Reader("list of clips .csv", samples.manifest("clips.csv"), _clips),
    Reader("list of clips .jsonl", samples.manifest("clips.jsonl"), _clips),
    Reader(
        "points",
        samples.text_file("points.csv", "x,y,frame\n3,4,0\n5.5,6,1\n"),
        lambda path: parse_queries(str(path), clip()),
    ),
    Reader(
        "depths",
        samples.text_file("depths.csv", "frame,x,y,depth\n0,3,4,2.5\n1,5,6,3\n"),
        lambda path: read_depths(path, clip()),
    ),
    Reader(
        "poses",
        samples.text_file("poses.txt", _POSES),
        lambda path: checked_known_poses(read_poses(path, clip()), 3, str(path)),
    ),
    Reader(
        "intrinsics",
        samples.text_file("K.txt", "30 30 14 14\n"),
        lambda path: at_clip_pixels(read_intrinsics(str(path)), clip(), "intrinsics"),
    ),
    # depth maps
    Reader(
        "depth .png",
        samples.text_file("depth.png", samples.depth_png([[1000, 0, 2000]] * 4)),
        lambda path: read_png(path, 1000.0),
    ),
    Reader("depth .dpt", samples.text_file("depth.dpt", dpt(np.ones((6, 8)))), read_dpt),
    Reader("depth .npy", samples.text_file("depth.npy", npy(np.ones((6, 8, 1), np.float32))), read_npy),
    Reader("depth .exr", _exr, read_exr),
    # captures
    Reader("capture Record3D", samples.capture(folders.record3d), _capture),
    Reader("capture .r3d", samples.capture(folders.record3d, zipped=True), _capture),
    Reader("capture Record3D export", samples.capture(folders.record3d_export), _capture),
    Reader("capture Polycam", samples.capture(folders.polycam), _capture),
    Reader("capture nerfstudio", samples.capture(folders.nerfstudio), _capture),
    Reader("capture COLMAP", samples.capture(folders.colmap_text), _capture),
    Reader("capture TUM", samples.capture(folders.tum), _capture),
    # data sets
    Reader("data set plain", samples.plain, partial(_sequences, "plain")),
    Reader("data set tum", samples.tum, partial(_sequences, "tum")),
    Reader("data set bonn", samples.tum, partial(_sequences, "bonn")),
    Reader("data set dycheck", _made(partial(dycheck_folder, frames=3)), partial(_sequences, "dycheck")),
    Reader(
        "data set dycheck, lidar", _made(partial(dycheck_folder, frames=3)), partial(_sequences, "dycheck", gt="lidar")
    ),
    Reader("data set sintel", _sintel, partial(_sequences, "sintel")),
    Reader("data set kitti", _kitti, partial(_sequences, "kitti")),
    Reader("data set davis", samples.davis, partial(_sequences, "davis")),
    Reader("data set 7scenes", samples.seven_scenes, partial(_sequences, "7scenes")),
    # results of other programs
    *(
        Reader(
            f"result of {name}",
            _made(writer, "theirs"),
            partial(Reconstruction.load, format=name, quaternion=QUATERNIONS[name]),
        )
        for name, writer in WRITERS.items()
    ),
)
