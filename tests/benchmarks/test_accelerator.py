"""Programs for accelerators that are not there: how they are counted, and that they compile."""

from importlib.util import find_spec

import pytest

from benchmarks.__main__ import main
from benchmarks.accelerator.count import LAUNCH, count
from benchmarks.accelerator.hlo import parse
from benchmarks.accelerator.targets import _COMPILERS, TARGETS, Target

# ruff: noqa: E501  (an instruction of XLA is a line)
# A chip of 1 FLOP/s and 1 byte/s, so that seconds are FLOP or bytes.
UNIT = Target("unit", "cuda", 1 / 0.8, 1 / 0.8, 1 / 0.9, 1.0, 1)
PROGRAM = """
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
    counted = count(parse(PROGRAM), UNIT, {"tap0": 1 / 24})
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


def test_descriptions_of_targets():
    described = TARGETS["h100"]._description()
    assert "core_count: 132" in described
    assert "cuda_compute_capability { major: 9\nminor: 0 }" in described
