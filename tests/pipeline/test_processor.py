from typing import Any

import jax
import pytest

from vggtjax.interface.commands.models import ModelFiles
from vggtjax.interface.commands.report import Report
from vggtjax.network.kernels.quantised import Halves, is_stored
from vggtjax.options import Options
from vggtjax.pipeline import processor
from vggtjax.pipeline.processor import choose_dtype

chosen: Any = choose_dtype  # of no type: a test knows where there is a choice
NARROW_AND_WIDE = {"twice": (1.0, 2.0), "hardly": (1.0, 1.4)}  # seconds


@pytest.fixture
def cpu(monkeypatch, tmp_path):
    """Make up what Linux says of the processor, and the seconds of the trial."""

    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))

    def made_up(text: str | None, seconds=NARROW_AND_WIDE["twice"]):
        info = tmp_path / "cpuinfo"
        if text is not None:
            info.write_text(text)
        monkeypatch.setattr(processor, "_CPU_INFO", info)
        monkeypatch.setattr(processor, "_seconds", lambda channels: seconds)

    return made_up


@pytest.mark.parametrize(
    ("text", "dtype"),
    [
        ("model name\t: AMD EPYC\nflags\t\t: fpu avx512f avx512_bf16 sha_ni\n", "bfloat16"),
        ("flags\t\t: fpu amx_tile amx_bf16\n", "bfloat16"),
        ("processor\t: 0\nFeatures\t: fp asimd bf16 i8mm\n", "bfloat16"),
        ("flags\t\t: fpu avx2\nbugs\t\t: avx512_bf16\n", "float32"),
        ("flags", "float32"),
        (None, "float32"),  # no Linux
    ],
)
def test_only_a_processor_with_a_unit_is_tried(cpu, text, dtype):
    cpu(text)
    choice = chosen(1024)
    assert choice.dtype == dtype
    assert ("2.0 times as fast" if dtype == "bfloat16" else "no known unit") in choice.reason
    assert chosen(64) is None


def test_a_trial_that_gains_little_or_fails_leaves_float32(cpu, monkeypatch):
    flags = "flags : amx_bf16\n"
    cpu(flags, NARROW_AND_WIDE["hardly"])
    assert chosen(1024) == ("float32", "this processor multiplies bfloat16 1.4 times as fast as float32")

    for error, said in ((jax.errors.JaxRuntimeError("UNIMPLEMENTED: none\nmore"), "UNIMPLEMENTED: none more"),
                        (MemoryError(), "MemoryError")):  # fmt: skip

        def fails(channels, error=error):
            raise error

        monkeypatch.setattr(processor, "_seconds", fails)
        assert chosen(2048) == ("float32", f"the trial of bfloat16 failed: {said}")


def test_a_later_run_computes_in_the_same_type(cpu):
    """On the same processor with the same cores, however busy it is by then."""
    text = "processor : 0\nmodel name : {}\nflags : amx_bf16\n\nprocessor : 1\n"
    cpu(text.format("A"))
    first = chosen(1024)
    cpu(text.format("A"), NARROW_AND_WIDE["hardly"])
    assert chosen(1024) == first
    cpu(text.format("B"), NARROW_AND_WIDE["hardly"])
    assert chosen(1024).dtype == "float32"


def test_the_trial_takes_the_time_of_both_products():
    narrow, wide = processor._seconds(64)
    assert 0 < narrow < 1
    assert 0 < wide < 1


def test_a_model_is_loaded_in_the_type_that_is_chosen(cpu, monkeypatch, tiny_demo, capsys):
    cpu("flags : avx512_bf16\n")
    monkeypatch.setattr(processor, "_FEWEST_CHANNELS", 0)

    def loaded(given):
        model, _, options = ModelFiles(model="demo").load_fastest(Report(), given, ["4dvggt-d"])
        leaves = jax.tree.leaves(model.params, is_leaf=is_stored)
        return options, sum(isinstance(leaf, Halves) for leaf in leaves), capsys.readouterr().err

    options, kernels, said = loaded(Options())
    assert options == Options(compute_dtype="bfloat16")
    assert kernels
    assert "computing in bfloat16: this processor multiplies bfloat16 2.0 times as fast as float32" in said
    assert "--dtype float32 is slower and exact" in said
    for given in (Options(compute_dtype="float32"), Options(precision="highest")):
        options, kernels, said = loaded(given)
        assert options == given
        assert not kernels
        assert "computing in" not in said
