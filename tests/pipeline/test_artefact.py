"""Artefacts: run where this package cannot be imported, with equal numbers; what does not fit is one sentence."""

import json
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from testing.seeded import seeded_images
from tests.tiny import tiny_model
from vggtjax import infer, load_model
from vggtjax.checkpoint import save_model
from vggtjax.pipeline import serve
from vggtjax.pipeline.artefact import write_artefact

SHAPE = (4, 28, 42)  # frames, height, width
INSTALLED = ("jax", "jaxlib", "numpy", "ml_dtypes", "opt_einsum", "scipy")  # by `pip install jax`
ALONE = """
import runpy, sys
folder, site, *arguments = sys.argv[1:]
sys.path[:0] = [folder, site]
sys.argv = [folder + "/serve.py", *arguments]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as end:
    assert not end.code, end.code
loaded = {name.split(".")[0] for name in sys.modules}
assert "flatbuffers" in loaded and not loaded & {"vggtjax", "flax", "safetensors"}
"""


@pytest.fixture(scope="module")
def model():
    return tiny_model()


@pytest.fixture(scope="module")
def written(tmp_path_factory, model):
    frames, height, width = SHAPE
    folder = tmp_path_factory.mktemp("artefact") / "tiny"
    return write_artefact(model, folder, frames=frames, height=height, width=width, mask_pairs=2)


@pytest.fixture
def artefact(written, tmp_path) -> Path:
    """Return a copy that a test may damage."""
    return Path(shutil.copytree(written, tmp_path / "artefact"))


def clip(seed: int) -> np.ndarray:
    return (255 * seeded_images(*SHAPE, seed).transpose(0, 2, 3, 1)).astype(np.uint8)


@pytest.fixture
def site(tmp_path) -> Path:
    """Return a folder of packages as in an environment that has jax alone."""
    folder = tmp_path / "site"
    folder.mkdir()
    for name in INSTALLED:
        for path in Path(jax.__file__).parents[1].glob(f"{name}*"):
            if path.name in (name, f"{name}.libs") or path.match(f"{name}-*.dist-info"):
                (folder / path.name).symlink_to(path)
    return folder


@pytest.mark.proof
def test_a_program_for_gpus_alone_has_their_precision_wherever_it_is_written(model, written, tmp_path):
    frames, height, width = SHAPE
    for_gpus = write_artefact(
        model, tmp_path / "it", frames=frames, height=height, width=width, platforms=("cuda",), mask_pairs=2
    )
    for folder, has_tf32 in ((for_gpus, True), (written, False)):
        assert (json.loads((folder / serve.MANIFEST).read_text())["options"].get("precision") == "tf32") == has_tf32
        program = jax.export.deserialize(bytearray((folder / serve.PROGRAM).read_bytes())).mlir_module()
        convolutions = "\n".join(line for line in program.splitlines() if "stablehlo.convolution" in line)
        found = set(re.findall(r"<precision (\w+)>", convolutions))
        assert found == ({"HIGH", "HIGHEST"} if has_tf32 else {"HIGHEST"})


def test_kernels_that_are_kept_as_bits_are_written_and_read(model, tmp_path):
    path = save_model(tmp_path / "model.safetensors", model.params, model.config)
    narrow = load_model(path, compute_dtype="bfloat16")
    frames, height, width = SHAPE
    options: dict[str, Any] = {"method": "vggt", "compute_dtype": "bfloat16"}
    folder = write_artefact(narrow, tmp_path / "it", frames=frames, height=height, width=width, **options)
    images = jax.numpy.asarray(clip(0)[None].astype(np.float32) / np.float32(255))
    assembly, _ = infer(model.params, images, model.config, **options)
    np.testing.assert_allclose(serve.load(folder)(clip(0))["depth"], np.asarray(assembly.depth)[0], rtol=1e-3)


def test_jax_alone_gives_the_numbers_of_infer(written, site, tmp_path, model):
    for seed in (0, 1):
        np.save(tmp_path / f"clip{seed}.npy", clip(seed))
    clips = [str(tmp_path / f"clip{seed}.npy") for seed in (0, 1)]
    command = [sys.executable, "-I", "-S", "-c", ALONE, written, site, *clips, "--out", tmp_path / "results"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for seed in (0, 1):
        images = jax.numpy.asarray(clip(seed)[None].astype(np.float32) / np.float32(255))
        assembly, passes = infer(model.params, images, model.config, mask_pairs=2)
        expected = {
            "depth": assembly.depth,
            "depth_confidence": assembly.confidence,
            "camera_from_world": assembly.camera_from_world,
            "intrinsics": assembly.intrinsics,
            "dynamic_mask": passes.dynamic_mask,
            "saliency": passes.saliency,
        }
        with np.load(tmp_path / "results" / f"clip{seed}.npz") as results:
            assert set(results) == set(expected)
            for name, value in expected.items():
                np.testing.assert_allclose(results[name], np.asarray(value)[0], rtol=1e-6, atol=1e-6, err_msg=name)
    assert passes.dynamic_mask.any()


def changed(artefact: Path, **fields) -> None:
    path = artefact / serve.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


DAMAGES = {
    "version 2 of the format": lambda folder: changed(folder, version=2),
    "with calling convention 99; jax": lambda folder: changed(folder, calling_convention=99),
    "is for tpu; jax runs on cpu here": lambda folder: changed(folder, platforms=["tpu"]),
    "fields are missing or have wrong types": lambda folder: changed(folder, files={}),
    "is damaged (": lambda folder: (folder / serve.MANIFEST).write_text("{"),
    "program.bin is damaged: its sha256": lambda folder: flipped(folder / serve.PROGRAM),
    "program.bin: No such file": lambda folder: (folder / serve.PROGRAM).unlink(),
}


@pytest.mark.parametrize("message", DAMAGES)
def test_what_does_not_fit_is_one_sentence(artefact, tmp_path, capsys, message):
    DAMAGES[message](artefact)
    np.save(tmp_path / "clip.npy", clip(0))
    assert serve.main([str(tmp_path / "clip.npy"), "--artefact", str(artefact), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.startswith("serve: ")
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (clip(0)[:2], "the frames have shape [2, 28, 42, 3]; this artefact takes [4, 28, 42, 3]"),
        (np.full((*SHAPE, 3), np.nan, np.float32), "values that are not in [0, 1]"),
        (clip(0).astype(np.int32), "the frames have type int32"),
        (np.array([{}]), "cannot read"),  # pickled
    ],
)
def test_frames_that_do_not_fit(written, tmp_path, capsys, frames, message):
    np.save(tmp_path / "clip.npy", frames, allow_pickle=True)
    assert serve.main([str(tmp_path / "clip.npy"), "--artefact", str(written), "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_names_of_files_send_the_terminal_no_control_characters(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(serve, "load", lambda _: lambda frames: {"depth": frames})
    path = tmp_path / "evil\x1b]0;title\x07\nserve: all is well.npy"
    np.save(path, np.zeros(3))
    shown = "evil?]0;title? serve: all is well"

    def printed(*arguments: object) -> tuple[str, str]:
        with suppress(SystemExit):
            serve.main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        assert all(letter == "\n" or letter.isprintable() for letter in said.out + said.err)
        return said

    assert printed(path, "--out", tmp_path / "out") == (f"{tmp_path}/out/{shown}.npz\n", "")
    assert printed(tmp_path / f"no {path.name}", "--out", tmp_path)[1].startswith(
        f"serve: cannot read {tmp_path}/no {shown}"
    )
    assert printed(path, "--out", path) == ("", f"serve: cannot write {tmp_path}/{shown}.npy: File exists\n")
    assert shown in printed(path, "--out", tmp_path, f"--{path.name}")[1]
