"""check-weights: alone, and beside a stand-in for the public code that checks what it gets and gives stored numbers."""

import hashlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from converters.torch_to_flax import source_shapes
from tests.shared.command import refusal
from tests.shared.command import run as run_command
from tests.shared.seeded import seeded_state_dict
from tests.shared.tiny import tiny_config
from vggtjax import load_model
from vggtjax.interface.commands import check_weights as command
from vggtjax.research.parity.outputs import OUTPUTS, parities
from vggtjax.research.parity.own_run import demo_frames, run_own

FRAMES = 2
STAND_IN = """
import json
from pathlib import Path
import numpy as np
import torch

FOLDER = Path(__file__).parents[2]
Aggregator = AggregatorFor4D = CameraHead = DPTHead = TrackHead = object

class Base(torch.nn.Module):
    def __init__(self):
        super().__init__()
        for name, shape in json.loads((FOLDER / "shapes.json").read_text()).items():
            *path, leaf = name.split(".")
            module = self
            for part in path:
                if not hasattr(module, part):
                    module.add_module(part, torch.nn.Module())
                module = getattr(module, part)
            module.register_parameter(leaf, torch.nn.Parameter(torch.zeros(shape)))

    def made(self, kind, images):
        stored = dict(np.load(FOLDER / f"{kind}.npz"))
        for name, tensor in self.state_dict().items():
            assert torch.equal(tensor, torch.from_numpy(stored.pop("weights/" + name))), name
        assert np.array_equal(images[0].numpy().transpose(0, 2, 3, 1), stored.pop("images"))
        return {name: torch.from_numpy(array)[None] for name, array in stored.items()}

class VGGT(Base):
    def forward(self, images, query_points=None):
        assert query_points.shape == (1, 9, 2)
        print("a line on standard output")
        return self.made("plain", images)

class VGGTFor4D(Base):
    def forward(self, images, dyn_masks=None):
        assert dyn_masks.dtype == torch.bool and dyn_masks.shape == (*images.shape[:2], *images.shape[3:])
        return self.made("masked", images), None
"""
PARTS = {
    "vggt/models/vggt.py": STAND_IN,
    "vggt4d/models/vggt4d.py": STAND_IN,
    "vggt/models/aggregator.py": "vit_large = None",
    "vggt/heads/track_head.py": "DPTHead = object",
    "vggt/layers/vision_transformer.py": "DinoVisionTransformer = Block = MemEffAttention = object",
    "vggt/utils/pose_enc.py": """
def pose_encoding_to_extri_intri(pose, size):
    return next(pose.new_tensor(c) for p, c in CAMERAS if pose.equal(pose.new_tensor(p))), None
""",
}


@pytest.fixture(scope="module")
def seeded(tmp_path_factory):
    """Weights of a tiny network in PyTorch's layout, its configuration, and what our passes give."""
    folder, config = tmp_path_factory.mktemp("weights"), tiny_config()
    tensors = seeded_state_dict(source_shapes(config), 3)
    save_file(tensors, folder / "tiny.safetensors")
    (folder / "config.json").write_text(config.to_json())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGGTJAX_CACHE", str(folder / "cache"))
        model = load_model(folder / "tiny.safetensors", config=config)
        frames = demo_frames(model, FRAMES)
        made, _, equal = run_own(model, frames, masked=True)
        assert equal
        yield folder, tensors, frames.images, made


def checkout(folder: Path, seeded, **changed: np.ndarray) -> Path:
    """Write the stand-in, which gives our numbers but for those that are changed."""
    _, tensors, images, made = seeded
    poses = [(made[f"{kind}pose_encoding"], made[f"{kind}cameras"]) for kind in ("", "masked: ")]
    cameras = [tuple(array[None].tolist() for array in pair) for pair in poses]
    for name, text in PARTS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text.replace("CAMERAS", repr(cameras)))
    (folder / "shapes.json").write_text(json.dumps({name: list(array.shape) for name, array in tensors.items()}))
    for kind, prefix in (("plain", ""), ("masked", "masked: ")):
        arrays = {output.public: (made | changed).get(prefix + name) for name, output in OUTPUTS.items()}
        arrays = {name: array for name, array in arrays.items() if array is not None}
        arrays["depth"] = arrays["depth"][..., None]
        weights = {f"weights/{name}": array for name, array in tensors.items()}
        np.savez(folder / f"{kind}.npz", allow_pickle=False, images=images, **arrays, **weights)
    return folder


def run(capsys, seeded, *arguments) -> tuple[int, str, str]:
    words = ["check-weights", *arguments, "--config", seeded[0] / "config.json", "--frames", FRAMES]
    return run_command(capsys, *words)


def test_beside_code_that_gives_the_same(tmp_path, capsys, seeded):
    peer = checkout(tmp_path / "peer", seeded)
    code, out, err = run(capsys, seeded, seeded[0] / "tiny.safetensors", "--peer", peer, "--out", tmp_path / "out")
    rows = dict(re.findall(r"^\| ([\w: ]+) \|.*\| (\S+) \|$", out, re.MULTILINE))
    assert set(rows) >= {*OUTPUTS, "cameras", "masked: pose_encoding", "masked: depth", "masked: world_points"}
    assert (code, "**no**" in out) == (0, False), err
    assert (tmp_path / "out" / "check-weights.md").read_text() == out
    assert "torch" in out
    assert re.search(r"SHA-256 of tiny.safetensors \| [0-9a-f]{64} ", out)
    code, _, err = run(capsys, seeded, seeded[0] / "tiny.safetensors", "--out", tmp_path / "out")
    assert (code, "check-weights.md exists" in err) == (2, True)
    assert run(capsys, seeded, seeded[0] / "tiny.safetensors", "--out", tmp_path / "out", "--overwrite")[0] == 0
    assert "public code" not in (tmp_path / "out" / "check-weights.md").read_text()


def test_a_wrong_output_is_named_and_the_exit_code_is_1(tmp_path, capsys, seeded):
    made = seeded[3]
    apart = made["world_points_confidence"].copy()
    apart[1, 5, 7] += 3e-4 * apart.std()
    peer = checkout(tmp_path, seeded, world_points_confidence=apart)
    (peer / "vggt4d" / "models" / "vggt4d.py").unlink()
    code, out, err = run(capsys, seeded, seeded[0] / "tiny.safetensors", "--peer", peer)
    assert (code, "masked" in out) == (1, False)
    assert [line.split(" | ")[0] for line in out.splitlines() if "**no**" in line] == ["| world_points_confidence"]
    assert "1 of 13 checks do not hold: world_points_confidence" in err
    assert run(capsys, seeded, seeded[0] / "tiny.safetensors", "--peer", peer, "--tolerance", "1e-3")[0] == 0


def test_alone(capsys, seeded, monkeypatch, tmp_path):
    code, out, _ = run(capsys, seeded, seeded[0] / "tiny.safetensors")
    assert (code, out.count("| yes |"), "torch" in out) == (0, 4, False)
    tensors = seeded[1] | {"depth_head.scratch.output_conv2.2.bias": np.array([200, 0], np.float32)}  # exp overflows
    save_file(tensors, tmp_path / "large.safetensors")
    code, out, _ = run(capsys, seeded, tmp_path / "large.safetensors")
    assert code == 1
    assert re.search(r"all outputs are finite \| \d+ of \d+ values \| \*\*no\*\*", out)


def test_the_table_says_which_file_was_checked_and_its_type(tmp_path, capsys, seeded):
    folder, out = seeded[0], tmp_path / "half.safetensors"
    config = ("--config", folder / "config.json", "--dtype", "bfloat16", "--heads", "camera,depth")
    assert run_command(capsys, "convert", folder / "tiny.safetensors", out, *config)[0] == 0
    code, said, _ = run_command(capsys, "check-weights", out, "--frames", 1)
    assert (code, said.count("| yes |")) == (0, 4)
    digest = hashlib.sha256(out.read_bytes()).hexdigest()
    assert f"| SHA-256 of half.safetensors, the file | {digest} |" in said
    assert "| SHA-256 of tiny.safetensors, its source |" in said
    assert "| weights | bfloat16 |" in said
    assert "| heads | camera, depth |" in said


def test_bad_input(tmp_path, capsys, seeded, monkeypatch, tiny_demo):
    weights, peer = seeded[0] / "tiny.safetensors", checkout(tmp_path / "peer", seeded)
    save_file({"conv.weight": np.zeros((3, 3), np.float32)}, tmp_path / "other.safetensors")

    class Runs:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "it-ran",))

    torch.save({"aggregator.camera_token": Runs()}, tmp_path / "code.pt")
    (tmp_path / "empty").mkdir()
    cases = [
        ((weights, "--peer", tmp_path / "empty"), "has no file vggt/models/vggt.py"),
        ((tmp_path / "other.safetensors", "--peer", peer), "does not fit the configuration"),
        ((tmp_path / "code.pt", "--peer", peer), "could run code, and is not opened"),
        ((weights, "--tolerance", "0"), "expected a number between 0 and 1"),
        ((tiny_demo, "--peer", peer), "is in this library's format"),
    ]
    for arguments, words in cases:
        code, out, err = run(capsys, seeded, *arguments)
        assert (code, out, words in err) == (2, "", True), err
    assert not (tmp_path / "it-ran").exists()
    assert "frames is 17; expected at most the 16" in refusal(capsys, "check-weights", "demo", "--frames", 17)
    (peer / "vggt" / "models" / "vggt.py").write_text("import a_module_that_is_not_there")
    code, _, err = run(capsys, seeded, weights, "--peer", peer)
    assert (code, "No module named 'a_module_that_is_not_there'; install what it needs" in err) == (2, True)
    (peer / "vggt" / "models" / "vggt.py").write_text("import os\nos.kill(os.getpid(), 9)")
    code, _, err = run(capsys, seeded, weights, "--peer", peer)
    assert (code, "was ended by signal 9, as a system does that is short of memory" in err) == (2, True)
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    code, _, err = run(capsys, seeded, weights, "--peer", peer)
    assert (code, "torch is not installed; pip install torch" in err) == (2, True)
    assert not any(name.split(".")[0] in ("vggt", "vggt4d") for name in sys.modules)


def test_parity_by_hand():
    public = {"depth": np.array([0.0, 2.0]), "masked: tracks": np.array([[100.0, 100.0]])}  # spread 1 and 0
    own = {"depth": np.array([5e-5, 2.0]), "masked: tracks": np.array([[100.0, 100.001]])}
    depth, tracks = parities(own, public)
    assert (depth.holds, depth.largest, depth.spreads) == (True, 5e-5, 5e-5)
    assert (tracks.holds, tracks.tolerance) == (True, "2e-03 absolute")
    assert not parities(own, public, 4e-5)[0].holds
    assert not parities(own | {"depth": np.array([np.nan, 2.0])}, public)[0].holds
    with pytest.raises(ValueError, match="differ in their outputs: depth"):
        parities({"masked: tracks": own["masked: tracks"]}, public)
