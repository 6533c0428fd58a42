import os
import re
import socket
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from tests.shared.tiny import tiny_config
from vggtjax import infer
from vggtjax.errors import InputError
from vggtjax.interface.commands import main as cli
from vggtjax.network.model import init_params

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "how-to" / "several-devices.md"
WORKER = Path(__file__).with_name("devices_worker.py")
NAMED = {  # in docs/how-to/several-devices.md
    "image features": set(),
    "first pass": {"all-gather", "collective-permute"},
    "dynamic mask": {"all-gather"},
    "second pass": {"all-gather", "all-reduce"},
    "assemble": {"all-gather"},
}
CLOSE = 1e-5  # of the spread of an array

Kept = dict[str, dict[int, dict[str, np.ndarray]]]


class Run(NamedTuple):
    """Numbers of devices and frames; the method whose gradient is computed, if any."""

    devices: int
    frames: int
    gradient_of: str


TWO = Run(2, 5, "")
EIGHT = Run(8, 13, "vggt")  # the frames are padded


def start(run: Run, out: Path, *arguments: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    environment |= {"COUNTS": f"1 {run.devices}", "FRAMES": str(run.frames), "METHOD": run.gradient_of}
    words = [sys.executable, str(WORKER), str(out), *arguments]
    return subprocess.Popen(words, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen, out: Path) -> Kept:
    """Return what -> devices -> name -> array."""
    _, said = process.communicate(timeout=900)
    assert process.returncode == 0, said[-3000:]
    kept: Kept = defaultdict(lambda: defaultdict(dict))
    with np.load(out) as arrays:
        for name, array in arrays.items():
            what, devices, field = name.split("/", 2)
            kept[what][int(devices)][field] = array
    return kept


@pytest.fixture(scope="module", params=[TWO, pytest.param(EIGHT, marks=pytest.mark.proof)], ids=str)
def run(request) -> Run:
    return request.param


@pytest.fixture(scope="module")
def kept(run, tmp_path_factory) -> Kept:
    out = tmp_path_factory.mktemp("devices") / "one.npz"
    return finished(start(run, out), out)


def check_equal(expected: dict[str, np.ndarray], found: dict[str, np.ndarray]) -> None:
    assert expected.keys() == found.keys()
    for name, array in expected.items():
        other = found[name]
        assert (other.shape, other.dtype) == (array.shape, array.dtype), name
        if array.dtype == bool:
            assert 0.02 < array.mean() < 0.98, name
            assert (other == array).all(), name
        else:
            assert np.isfinite(array).all(), name
            assert np.abs(other - array).max() <= CLOSE * np.ptp(array), name


def test_several_devices_give_the_numbers_of_one(run, kept):
    check_equal(kept[f"reconstruct {run.frames}"][1], kept[f"reconstruct {run.frames}"][run.devices])


@pytest.mark.proof
@pytest.mark.parametrize("run", [EIGHT], indirect=True, ids=str)
@pytest.mark.parametrize("what", ["infer", "gradient"])
def test_several_devices_give_the_outputs_and_gradients_of_one(run, kept, what):
    check_equal(kept[f"{what} {run.frames}"][1], kept[f"{what} {run.frames}"][run.devices])


def test_a_pass_has_only_the_collectives_that_the_docs_name(run, kept):
    rows = dict(re.findall(r"^\| (\S.*?) \| .* \| (.*) \|$", DOCS.read_text(), flags=re.MULTILINE))
    for stage, kinds in NAMED.items():
        assert set(re.findall(r"`([\w-]+)`", rows[stage])) == kinds, stage
        found = set(kept[f"collectives of {stage} {run.frames}"][run.devices])
        assert found <= {f"['{name}']" for name in kinds}, stage
    assert kept[f"collectives of first pass {run.frames}"][run.devices]


def test_memory_of_a_device_falls_with_their_number(run, kept):
    for stage in ("image features", "first pass", "second pass"):
        alone, shared = (int(kept[f"memory {run.frames}"][count][f"['{stage}']"]) for count in (1, run.devices))
        assert alone > shared, stage


@pytest.mark.proof
def test_cues_of_many_frames_do_not_mix_up_their_communications(tmp_path):
    """Without an order, devices enter communications of two cues at once, and XLA ends the process."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, picture in enumerate(np.random.default_rng(0).integers(0, 255, (32, 128, 128, 3), np.uint8)):
        Image.fromarray(picture).save(frames / f"{number:02}.png")
    words = ["reconstruct", str(frames), "--model", "demo", "--method", "vggt", "--size", "128", "--only", "cameras"]
    words += ["--devices", "8", "--out", str(tmp_path / "out")]
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=8", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "vggtjax", *words]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[:3000]


@pytest.mark.proof
def test_two_processes(tmp_path):
    kept = finished(start(EIGHT._replace(devices=4, gradient_of=""), tmp_path / "one.npz"), tmp_path / "one.npz")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    outs = [tmp_path / f"{rank}.npz" for rank in range(2)]
    started = [start(EIGHT, out, str(rank), port) for rank, out in enumerate(outs)]
    try:
        both = [finished(process, out) for process, out in zip(started, outs, strict=True)]
    finally:
        for process in started:
            process.kill()
    for one in both:
        check_equal(kept[f"reconstruct {EIGHT.frames}"][4], one["processes"][4])


def test_more_devices_than_there_are(tmp_path, capsys):
    count = jax.device_count() + 1
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "0.png")
    words = ["reconstruct", str(tmp_path), "--model", "demo", "--out", str(tmp_path / "out"), "--devices"]
    for number, sentence in (
        (
            f"{count}",
            f"--devices is {count} and jax sees {count - 1} here; take at most {count - 1}, or split the CPU by "
            f"XLA_FLAGS=--xla_force_host_platform_device_count={count}",
        ),
        ("0", "devices is 0; expected a whole number of at least 1"),
        ("2 --window 4", "--devices and --window exclude each other"),
        ("2 --tracks grid:3", "--devices and --tracks exclude each other"),
    ):
        assert cli.main([*words, *number.split()]) == 2
        assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_mesh_without_an_axis_of_frames():
    config, mesh = tiny_config(image_size=28), jax.make_mesh((1,), ("clips",))
    with pytest.raises(InputError, match=r"mesh has the axes \('clips',\); expected one named 'frames'"):
        infer(init_params(0, config), jnp.zeros((1, 2, 28, 28, 3)), config, mesh=mesh)
