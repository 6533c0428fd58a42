"""What is predicted of memory, beside XLA's own count, and what is read of the system."""

import re
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest
from PIL import Image

from vggtjax.config import vggt_1b
from vggtjax.network.kernels.cpu_attention import _chunks
from vggtjax.pipeline import memory
from vggtjax.pipeline.pretrained.embedded import demo_model
from vggtjax.pipeline.windows.choice import Planned
from vggtjax.storage.memory import host_room, own_limits

_ROOT = Path(__file__).parents[2]
_FULL = Planned(vggt_1b(), 5_026_145_968)  # of float32
_HALF = Planned(vggt_1b(), 5_026_145_968 // 2)


@pytest.mark.parametrize(
    ("config", "frames", "size", "counted"),  # temporary bytes of the first pass by XLA's count for a CPU
    [
        (None, 64, (64, 64), 67_111_600),  # the embedded model
        (vggt_1b(), 32, (294, 518), 1_382_190_560),
        (vggt_1b(), 32, (518, 518), 2_610_586_656),
    ],
)
def test_the_passes_are_predicted_within_a_third_of_the_counts_of_xla(config, frames, size, counted):
    assert memory.pass_bytes(config or demo_model().config, frames, *size) == pytest.approx(counted, rel=1 / 3)


@pytest.mark.parametrize(
    ("frames", "counted"),  # temporary bytes of the first pass for an H100, 518 x 392 pixels, by benchmarks accelerator
    [(8, 0.81e9), (50, 2.00e9), (200, 7.04e9)],
)
def test_so_are_those_of_a_gpu(frames, counted):
    predicted = memory.pass_bytes(vggt_1b(), frames, 392, 518, accelerator=True)
    assert predicted == pytest.approx(counted, rel=1 / 3)
    assert predicted < memory.pass_bytes(vggt_1b(), frames, 392, 518, accelerator=False)


def test_every_device_holds_all_frames_after_a_pass():
    """XLA counts 51 bytes a pixel of all frames for the dynamic mask, on one of four devices as on one alone."""
    model = demo_model()
    needs = memory.predicted_bytes(model, 64, 256, 256, devices=8, accelerator=True) - model.parameter_bytes
    assert needs > 51 * 64 * 256 * 256


def test_the_logits_that_more_cores_hold_at_once_are_counted(monkeypatch):
    queries, keys = 4 * (5 + 21 * 37), 32 * (5 + 21 * 37)  # of one of eight devices
    needs, rows = [], []
    for times in (1, 4):
        monkeypatch.setattr("vggtjax.network.kernels.cpu_attention.times_for_cores", lambda times=times: times)
        rows.append(_chunks(jnp.zeros((queries, 1)), keys).shape[1])
        needs.append(memory.pass_bytes(vggt_1b(), 32, 294, 518, devices=8))
    assert rows == [782, 1564]
    assert needs[1] - needs[0] == pytest.approx(4 * keys * (rows[1] - rows[0]))


@pytest.mark.parametrize(
    ("frames", "height", "width", "method", "devices", "measured"),  # peaks in MB of processes, by benchmarks memory
    [
        (32, 64, 64, "vggt4d", 1, 771),
        (32, 64, 64, "4dvggt-d", 1, 586),
        (16, 128, 128, "4dvggt-d", 1, 614),
        (32, 128, 128, "hard-replacement", 1, 758),
        (4, 256, 256, "vggt", 1, 589),
        (8, 256, 256, "vggt4d", 1, 807),
        (32, 256, 256, "4dvggt-d", 1, 1316),
        (8, 512, 512, "4dvggt-d", 1, 1253),
        (24, 192, 256, "vggt4d", 2, 1201),  # and more devices, by --split
        (24, 192, 256, "vggt", 4, 1136),
        (32, 256, 256, "4dvggt-d", 4, 1771),
        (32, 256, 256, "4dvggt-d", 8, 2339),
    ],
)
def test_the_peaks_of_processes_are_predicted_within_the_error_that_is_promised(
    monkeypatch, frames, height, width, method, devices, measured
):
    monkeypatch.setattr("jax.local_device_count", lambda: devices)
    monkeypatch.setattr("vggtjax.network.kernels.cpu_attention.times_for_cores", lambda: 1)
    predicted = memory.predicted_bytes(demo_model(), frames, height, width, method=method, devices=devices)
    assert predicted == pytest.approx(1e6 * measured, rel=memory.ERROR)


@pytest.mark.parametrize(
    ("frames", "height", "width", "method", "measured"),  # by --full CHECKPOINT, with weights of 5.03 GB
    [
        (2, 294, 518, "4dvggt-d", 5640),
        (4, 294, 518, "vggt", 5670),
        (3, 252, 252, "vggt4d", 5550),
        (2, 294, 518, "4dvggt-d", 5390),
    ],
)
def test_so_are_those_of_processes_with_a_model_of_full_size(frames, height, width, method, measured):
    predicted = memory.predicted_bytes(_FULL, frames, height, width, method=method)
    assert predicted == pytest.approx(1e6 * measured, rel=memory.ERROR)


@pytest.mark.parametrize(
    ("page", "pattern", "model"),  # each match: frames of 518 x 294, and GB with the digits that are given
    [
        ("docs/my-video.md", r"^\| (\d+) \| [^|]*\| ([\d.]+) GB \|", _FULL),
        ("docs/troubleshooting.md", r"(\d+) frames: ([\d.]+) GB", _FULL),
        ("docs/troubleshooting.md", r"(\d+) frames(?: of 518 x 294)?\s+need (?:about )?([\d.]+) GB", _FULL),
        ("docs/how-to/long-clips.md", r"^\| (\d+)(?: \([^|]*\))? \| ([\d.]+) GB \|", _FULL),
        ("docs/how-to/long-clips.md", r"(600) frames need about ([\d.]+) GB", _FULL),
        ("docs/questions.md", r"do (\d+) frames need\? \| about ([\d.]+) GB", _FULL),
        ("docs/questions.md", r"do (\d+) frames need\?.*?([\d.]+) with bfloat16 weights", _HALF),
        ("README.md", r"take (\d+) frames for[^.]*?\s([\d.]+) GB of memory", _FULL),
    ],
)
def test_the_pages_say_what_the_program_predicts(page, pattern, model):
    found = re.findall(pattern, (_ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert found
    for frames, said in found:
        predicted = memory.predicted_bytes(model, int(frames), 294, 518) / 1e9
        assert f"{predicted:.{len(said.partition('.')[2])}f}" == said, (page, frames)


def test_free_memory_is_the_least_of_the_host_and_the_control_groups(tmp_path):
    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def room():
        found = host_room(tmp_path)
        return None if found is None else (found.size / 1024, found.limit, found.is_hard)

    assert room() is None
    write("proc/meminfo", "MemTotal: 2000 kB\nMemAvailable: 1000 kB\n")
    write("proc/self/status", "Name: python\nVmRSS: 100 kB\n")
    assert room() == (1100, "in the computer", False)
    write("proc/self/cgroup", "4:memory:/a/b\n0::/c/d\n")
    write("sys/fs/cgroup/memory/a/memory.limit_in_bytes", f"{900 * 1024}")
    write("sys/fs/cgroup/memory/a/memory.usage_in_bytes", f"{200 * 1024}")
    write("sys/fs/cgroup/memory/a/memory.stat", f"total_inactive_file {50 * 1024}\n")
    write("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712")
    write("sys/fs/cgroup/memory/memory.usage_in_bytes", "5")
    assert room() == (100 + 750, "in its container (cgroup)", True)
    write("sys/fs/cgroup/c/memory.max", f"{300 * 1024}")
    write("sys/fs/cgroup/c/memory.current", f"{100 * 1024}")
    write("sys/fs/cgroup/c/d/memory.max", "max")
    assert room() == (100 + 200, "in its container (cgroup)", True)
    write("proc/self/status", "Name: python\nVmSize: 700000 kB\nVmData: 300 kB\nVmRSS: 100 kB\n")
    title = "Limit                     Soft Limit           Hard Limit           Units\n"
    data = f"Max data size             {2**40}        unlimited            bytes\n"
    space = f"Max address space         {(700000 + 400150) * 1024}            unlimited            bytes\n"
    write("proc/self/limits", title + data + space)
    address = (700000 + 400150) * 1024
    assert own_limits(tmp_path) == [("ulimit -d", 2**40, 300 * 1024), ("ulimit -v", address, 700000 * 1024)]
    stacks = 300_000_000 / 1024  # of threads that start later
    assert room() == (100 + 200, "in its container (cgroup)", True)
    write("sys/fs/cgroup/c/memory.max", "max")
    write("sys/fs/cgroup/memory/a/memory.limit_in_bytes", "9223372036854771712")
    write("proc/meminfo", "MemTotal: 2000000 kB\nMemAvailable: 1000000 kB\n")
    assert room() == (pytest.approx(100 + 400150 - stacks), "within ulimit -v", True)


@pytest.mark.proof
def test_a_limit_too_low_for_the_libraries_is_met_by_a_sentence(tmp_path):
    """Without the sentence a library that cannot start a thread ends the process."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_AS, (800_000_000,) * 2)"
    code = f"{limit}; from vggtjax.interface.commands.main import main; raise SystemExit(main(['info', 'demo']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(r"vggtjax: ulimit -v leaves this process 0\.\d\d GB, .* ulimit -v unlimited\n", done.stderr)


def test_a_limit_too_low_for_a_clip_is_met_by_a_sentence(tmp_path):
    for number in range(8):
        Image.new("RGB", (1024, 1024), (number, 0, 0)).save(tmp_path / f"{number}.png")
    code = f"""
import resource
from vggtjax.interface.commands.main import main
from vggtjax import load_model
load_model("demo")
used = int(next(line for line in open("/proc/self/status") if line.startswith("VmSize")).split()[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (used + 1_050_000_000,) * 2)
words = ["reconstruct", {str(tmp_path)!r}, "--model", "demo", "--size", "1024", "--out", {str(tmp_path / "out")!r}]
raise SystemExit(main(words))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    sizes = r"vggtjax: 8 frames need about \d\.\d\d GB, \d\.\d\d GB are free within ulimit -v"
    assert re.search(rf"{sizes}; what fits: .*--size \d+", done.stderr)
    assert not (tmp_path / "out").exists()
