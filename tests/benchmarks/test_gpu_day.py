"""gpu-day at small size on a CPU, and programs for accelerators that are not there: counted, bounded and compiled."""

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.accelerator.count import LAUNCH, count
from benchmarks.accelerator.hlo import parse
from benchmarks.accelerator.targets import _COMPILERS, Target
from benchmarks.gpu_day import alone, command, wheels
from benchmarks.gpu_day.bounds import bound
from benchmarks.gpu_day.lines import Lines, read_lines
from benchmarks.gpu_day.parts import PARTS
from benchmarks.gpu_day.speed import beside_bound
from benchmarks.suite.cases import TINY

PROGRAM = """
ENTRY %main (a: f32[1000,1000]) -> f32[1000,1000] {
  %a = f32[1000,1000]{1,0} parameter(0)
  ROOT %b = f32[1000,1000]{1,0} add(%a, %a)
}
"""
PYTHON = "cp{}{}".format(*sys.version_info)
IMPORTED = """
import jax, sys
before = {name.split(".")[0] for name in sys.modules}
import benchmarks.__main__, benchmarks.gpu_day.command
from importlib.metadata import packages_distributions
packages = packages_distributions()
new = {name.split(".")[0] for name in sys.modules} - before
print(*{name.lower().replace("_", "-") for top in new for name in packages.get(top, ())})
"""


@pytest.mark.proof
def test_all_parts_at_small_size(tmp_path):
    told, outcomes = {}, []
    for name, part in PARTS.items():
        part.run("tiny", Lines(tmp_path / name))
        lines = read_lines(tmp_path / name)
        told[name] = [line["cells"] for line in lines if "sheet" in line]
        outcomes.append(command.Outcome(name, "done", 1.0, lines))
    report = command.report(outcomes)
    assert "NO" not in report  # a bound that does not hold
    assert all(f"- {name}: done" in report and f"## {name}\n" in report for name in PARTS)
    assert all(0 < row["error"] <= row["at most"] for row in told["parity"])
    paths = {row["path"] for row in told["attention"] if row.get("holds")}
    assert paths >= {"chosen here", "chosen here, gradient", "at once"}
    assert all(row["measured"] > 0 and row["memory GB"] > 0 for row in told["speed"])
    assert {row["bound"] for row in told["speed"]} == {"no bound: unknown device"}
    times = [row["ms"] for row in told["kernels"][:-1]]  # the last row sums up all others
    assert times == sorted(times, reverse=True)


def test_a_bound_beside_a_time():
    """A sum reads 4 MB twice and writes 4 MB, at 4.8 TB/s on an H200."""
    least = bound(PROGRAM, TINY, "NVIDIA H200")
    assert isinstance(least, float)
    assert least == pytest.approx(12e6 / 4.8e12 + LAUNCH)
    beside = beside_bound("depth-head", 8, 1.0, least)
    assert beside == {"bound": pytest.approx(1e3 * least / 8), "over_bound": pytest.approx(8 / (1e3 * least))}
    assert str(bound("no program", TINY, "NVIDIA H200")).startswith("no bound: KeyError")
    unknown = bound(PROGRAM, TINY, "cpu")
    assert beside_bound("depth-head", 8, 1.0, unknown) == {"bound": "no bound: unknown device"}


@pytest.mark.parametrize(
    ("tags", "fits"),
    [
        ("py3-none-any", True),
        ("py2.py3-none-any", True),
        ("cp39-abi3-manylinux_2_17_{machine}.manylinux2014_{machine}", True),
        (f"{PYTHON}-{PYTHON}-manylinux_2_28_{{machine}}", True),
        (f"{PYTHON}-{PYTHON}-win_amd64", False),
        (f"{PYTHON}-{PYTHON}-manylinux_2_28_riscv64", False),
        ("cp39-cp39-manylinux_2_28_{machine}", False),
        ("cp399-abi3-manylinux_2_28_{machine}", False),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="the wheels are for Linux")
def test_wheels_that_fit(tags, fits):
    assert alone.fits(f"package-1.0-{tags.format(machine=os.uname().machine)}.whl") is fits


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("none", "has no wheels; make them where there is an index: make gpu-day-wheels"),
        ("package-1.0-cp39-cp39-win32.whl", "package-1.0-cp39-cp39-win32.whl does not fit Python 3."),
        ("package-1.0-py3-none-any.whl", "cannot be unpacked: File is not a zip file"),
    ],
)
def test_what_cannot_start_says_why(tmp_path, capsys, monkeypatch, name, sentence):
    (tmp_path / name).touch()
    assert alone.main([str(tmp_path), "--out", "report"]) == 2
    assert sentence in capsys.readouterr().err
    monkeypatch.setattr(alone, "find_spec", lambda module: None)
    assert alone.main([str(tmp_path)]) == 2
    assert f"{sys.executable} has no jax; expected" in capsys.readouterr().err


def test_wheels_come_before_what_is_installed(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "package-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("package/__init__.py", "")

    def call(command, env):
        root, unpacked, *_ = env["PYTHONPATH"].split(os.pathsep)
        assert (Path(root) / "benchmarks/__main__.py").is_file()
        assert (Path(unpacked) / "package/__init__.py").is_file()
        assert command[1:] == ["-P", "-m", "benchmarks", "gpu-day", "--out", "report", "--size", "small"]
        return 7

    monkeypatch.setattr(subprocess, "call", call)
    assert alone.main([str(tmp_path), "--out", "report", "--size", "small"]) == 7


def test_the_wheels_are_what_is_imported_beside_jax():
    done = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) - {"vggtjax"} <= set(wheels.PACKAGES)
    for python in ("3.11", "3.12", "3.13"):
        pins = wheels.locked(wheels.LOCK.read_text(encoding="utf-8"), python)
        assert all(f"{name}==" in pin and " --hash=sha256:" in pin and ";" not in pin for name, pin in pins.items())


def test_a_wheel_that_is_damaged_within(tmp_path):
    wheel = tmp_path / "package-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as files:
        files.writestr("package/data.txt", "".join(str(i * i) for i in range(5000)))
    content = bytearray(wheel.read_bytes())
    content[200:260] = bytes(60)
    wheel.write_bytes(content)
    with pytest.raises(alone.RefusedError, match="cannot be unpacked"):
        alone.unpack([wheel], tmp_path / "unpacked")


# ruff: noqa: E501  (an instruction of XLA is a line)
# A chip of 1 FLOP/s and 1 byte/s, so that seconds are FLOP or bytes.
UNIT = Target("unit", "cuda", 1 / 0.8, 1 / 0.8, 1 / 0.9, 1.0, 1)
COUNTED = """
HloModule m

%sliced (p0: f32[24,4,4], p1: s32[]) -> f32[1,4,4] {
  %p0 = f32[24,4,4]{2,1,0} parameter(0)
  %p1 = s32[] parameter(1)
  ROOT %slice = f32[1,4,4]{2,1,0} dynamic-slice(%p0, %p1, %p1, %p1), dynamic_slice_sizes={1,4,4}
}

%seldom (t: (f32[4,4])) -> (f32[4,4]) {
  %t = (f32[4,4]{1,0}) parameter(0)
  %x = f32[4,4]{1,0} get-tuple-element(%t), index=0
  %y = f32[4,4]{1,0} add(%x, %x), metadata={op_name="jit(f)/tap0/add"}
  ROOT %out = (f32[4,4]{1,0}) tuple(%y)
}

%never (t: (f32[4,4])) -> (f32[4,4]) {
  ROOT %t = (f32[4,4]{1,0}) parameter(0)
}

%body (state: (f32[24,4,4], s32[], pred[])) -> (f32[24,4,4], s32[], pred[]) {
  %state = (f32[24,4,4]{2,1,0}, s32[], pred[]) parameter(0)
  %w = f32[24,4,4]{2,1,0} get-tuple-element(%state), index=0
  %i = s32[] get-tuple-element(%state), index=1
  %layer = f32[1,4,4]{2,1,0} fusion(%w, %i), kind=kLoop, calls=%sliced, metadata={op_name="jit(f)/while/body/slice"}
  %b = bf16[4,4]{1,0} parameter(1)
  %g = (bf16[4,4]{1,0}, s8[64]{0}) custom-call(%b, %b), custom_call_target="__cublas$lt$matmul", metadata={op_name="jit(f)/dot"}, backend_config={"gemm_backend_config":{"dot_dimension_numbers":{"lhs_contracting_dimensions":["1"]}}}
  %flag = pred[] get-tuple-element(%state), index=2
  %c = (f32[4,4]{1,0}) conditional(%flag, %state, %state), true_computation=%seldom, false_computation=%never, metadata={op_name="jit(f)/tap0/cond"}
  ROOT %next = (f32[24,4,4]{2,1,0}, s32[], pred[]) tuple(%w, %i, %flag)
}

%test (state: (f32[24,4,4], s32[], pred[])) -> pred[] {
  %state = (f32[24,4,4]{2,1,0}, s32[], pred[]) parameter(0)
  ROOT %flag = pred[] get-tuple-element(%state), index=2
}

ENTRY %main (a: (f32[24,4,4], s32[], pred[])) -> (f32[24,4,4], s32[], pred[]) {
  %a = (f32[24,4,4]{2,1,0}, s32[], pred[]) parameter(0)
  ROOT %loop = (f32[24,4,4]{2,1,0}, s32[], pred[]) while(%a), condition=%test, body=%body, backend_config={"known_trip_count":{"n":"24"}}
}
"""


def test_a_program_is_counted_by_hand():
    """Slices as slices, loops by trips, a conditional by its share, a product by its operands, scratch memory not."""
    counted = count(parse(COUNTED), UNIT, {"tap0": 1 / 24})
    slices, products, sums = (kernels for kernels in counted.kernels.values())
    assert (slices.launches, products.launches, sums.launches) == (24, 24, 1)
    assert slices.bytes == 24 * (64 + 64 + 4)
    assert products.flop == {"bfloat16": 24 * 2 * 4 * 4 * 4}
    assert products.bytes == 24 * 3 * 32
    assert sums.bytes == 3 * 64
    assert counted.seconds == pytest.approx(slices.bytes + sums.flop.total() + 24 * 128 + sums.bytes + 49 * LAUNCH)
    assert counted.library_calls == {"__cublas$lt$matmul": 1}
    assert not counted.unknown_loops


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--targets", "h900"], "'h900'"),
        (["--programs", "third pass"], "'third pass'"),
        (["--devices", "3"], "devices is 3"),
        (["--frames", "0"], "frames is [0]"),
    ],
)
def test_what_is_unknown_is_named(arguments, said, capsys):
    assert main(["accelerator", *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.skipif(any(map(find_spec, _COMPILERS["cuda"])), reason="the compiler is installed")
def test_a_compiler_that_is_absent_is_named(capsys):
    assert main(["accelerator", "--size", "tiny", "--frames", "2"]) == 2
    assert ".[accelerator]" in capsys.readouterr().err
