"""The trees of folders on the page of protocols: files at these places, and no others, are a data set."""

import io
import json
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from tests.shared import dataset_files as made
from tests.shared.dataset_files import opened, write
from tests.shared.documented import DOCS
from vggtjax.research.evaluation.datasets import DATASETS

PAGE = (DOCS / "reference" / "evaluation-protocols.md").read_text()
ROW = "1 0 0 0 0 1 0 0 0 0 1 0"
_FRAME = {"file_path": "images/frame_00001.png", "depth_file_path": "depth/frame_00001.png"}
_CAMERA = {"w": 4, "h": 3, "fl_x": 4.0, "fl_y": 4.0, "cx": 2.0, "cy": 1.5, "camera_model": "PINHOLE"}
TRANSFORMS = _CAMERA | {"frames": [_FRAME | {"transform_matrix": np.eye(4).tolist()}]}
K = [[4.0, 0, 1.5], [0, 4.0, 1], [0, 0, 1]]


JPEG = io.BytesIO()
Image.new("RGB", (4, 3)).save(JPEG, "JPEG")
VIDEO = io.BytesIO()
np.savez(
    VIDEO,
    images_jpeg_bytes=[JPEG.getvalue()],
    tracks_XYZ=np.array([[[0.0, 0, 2]]]),
    visibility=np.ones((1, 1), bool),
    fx_fy_cx_cy=np.array([4.0, 4, 2, 1.5]),
)
LABELLED = (
    "Total number of regions:\n2\n\n0\n\n255\n\nConfusion penality matrix\n0 1\n1 0\n\nFrame number:\n0\nFile name:\n"
    "camel01_0001_gt.pgm\n"
)
SCENE = {"depth_format": "uint16_png_div1000", "tags": {"dynamics": "dynamic"}}


def _lines(says: str) -> str:
    """Return lines of a list of TUM, as many as bonn leaves out, and one more."""
    return "".join(f"{1341846313 + i / 30:.6f} {says}\n" for i in range(31))


# What is in the files: the first pattern that the end of a path fits.
CONTENTS = {
    r"\.npz": VIDEO.getvalue(),
    r"\.dat": LABELLED,
    r"_gt\.pgm": b"P5\n4 3\n255\n" + bytes([255] * 12),
    r"meta\.json": json.dumps(SCENE),
    r"poses/.*\.npy": made.npy(np.eye(4)),
    r"intrinsic\.npy": made.npy(np.array(K)),
    r"GroundTruth/.*\.png": made.png(np.full((3, 4), 255, np.uint8)),
    r"(camel01|JPEGImages/\w+)/\w+\.(jpg|png)": made.picture(),
    r"(Annotations|mask)/.*\.png": made.png(np.full((3, 4), 255, np.uint8)),
    r"(rgb|images|final|image_02/data|image_gathered|480p)/.*|color\.png": made.picture(),
    r"depth.*\.png": made.depth_png([[1000] * 4] * 3),
    r"\.npy": made.npy(np.ones((3, 4), np.float32)),
    r"\.dpt": made.dpt(np.ones((3, 4))),
    r"\.cam": made.cam(K, np.eye(3, 4)),
    r"K\.txt": "4 0 2\n0 4 1.5\n0 0 1\n",
    r"world_from_camera\.txt": f"{ROW}\n",
    r"transforms\.json": json.dumps(TRANSFORMS),
    r"/rgb\.txt": _lines("rgb/1341846313.592026.png"),
    r"/depth\.txt": _lines("depth/1341846313.592088.png"),
    r"groundtruth\.txt": _lines("0 0 0 0 0 0 1"),
    r"calibration\.txt": "4 4 2 1.5\n",
    r"train\.json": json.dumps({"frame_names": ["0_00000"]}),
    r"camera/0_00000\.json": made.camera_json(),
    r"cameras\.bin": made.cameras_bin([(1, 1, 4, 3, [4.0, 4.0, 2.0, 1.5])]),
    r"images\.bin": made.images_bin([(1, (1, 0, 0, 0), (0, 0, 0), 1, "0_00000.png")]),
    r"calib_cam_to_cam\.txt": "P_rect_02: 4 0 2 0 0 4 1 0 0 0 1 0\n",
    r"pose\.txt": "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
}


class Layout(NamedTuple):
    """A tree, the data sets that it is of, and what the page says of it."""

    names: list[str]
    tree: str
    says: str


def layouts() -> list[Layout]:
    section = PAGE.split("### How the folders look")[1].split("\n### ")[0]
    blocks = re.findall(r"\n\n(`[^\n]*(?:\n[^\n]+)*)\n\n```text\n(ROOT/\n.*?)```", section, flags=re.DOTALL)
    return [Layout(re.findall(r"`([\w-]+)`", re.split(r"[;:.]", says)[0]), tree, says) for says, tree in blocks]


def paths(tree: str) -> Iterator[str]:
    """Yield the files of a tree."""
    folders: list[str] = []
    for line in tree.splitlines()[1:]:
        name = line.split()[0]
        depth = (len(line) - len(line.lstrip())) // 2 - 1
        folders = [*folders[:depth], name]
        if not name.endswith("/"):
            yield "".join(folders)


CASES = [
    pytest.param(name, layout, gt, id=f"{name} {gt}{number}")
    for number, layout in enumerate(layouts())
    for name in layout.names
    for gt in DATASETS[name].gt or (None,)
]


def test_every_data_set_has_a_tree():
    assert {name for layout in layouts() for name in layout.names} == set(DATASETS)


@pytest.mark.parametrize(("name", "layout", "gt"), CASES)
@pytest.mark.filterwarnings("ignore")
def test_files_of_a_tree_are_a_data_set(name, layout, gt, tmp_path):
    """With all the ground truth that the data set has."""
    for path in paths(layout.tree):
        content = next(content for end, content in CONTENTS.items() if re.search(f"(?:{end})$", f"/{path}"))
        write(tmp_path / path, content)
    roots = ["", *re.findall(r"`ROOT/([\w/-]+)`", layout.says.split(" too")[0])]
    for root in roots:
        (sequence,) = opened(name, tmp_path / root, gt=gt, stride=1)
        truth = {
            "depth": sequence.depth is not None and sequence.depth(0).any(),
            "masks": sequence.mask is not None and sequence.mask(0).any(),
            "poses": sequence.world_from_camera is not None,
            "intrinsics": sequence.intrinsics is not None,
            "tracks": sequence.tracks is not None,
        }
        assert {kind for kind, is_there in truth.items() if is_there} >= set(DATASETS[name].truth)
