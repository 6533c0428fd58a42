"""The benchmark suite: its work model against known figures, small runs of every workload, stored runs."""

import dataclasses
import json
from functools import partial

import jax
import pytest
from PIL import Image

from benchmarks import __main__ as benchmarks
from benchmarks.suite import ceilings, gpu_targets, measure, memory, work, workloads
from benchmarks.suite.cases import TINY, Case
from benchmarks.suite.ceilings import Ceilings, Rounds
from benchmarks.suite.command import measured_rows
from benchmarks.suite.measure import Measured
from benchmarks.suite.memory import slope
from benchmarks.suite.report import Row
from benchmarks.suite.workloads import WORKLOADS
from vggtjax.config import VGGTConfig
from vggtjax.network.model import init_params, parameter_shapes

FULL = VGGTConfig()
SMALL, LARGE = (21, 37), (28, 37)  # 518 x 294, 518 x 392
TERA = 1e12


def trunk(S, grid):
    return work.backbone(FULL, S, grid) + work.alternating(FULL, S, grid)


def test_work_of_the_blocks():
    for S in (1, 8, 100):
        assert work.flop(trunk(S, SMALL)) == pytest.approx((1.538 * S + 0.0601 * S**2) * TERA, rel=0.002)
        assert work.flop(trunk(S, LARGE)) == pytest.approx((2.10 * S + 0.1065 * S**2) * TERA, rel=0.002)
    assert work.flop(work.backbone(FULL, 3, LARGE)) == pytest.approx(3 * 0.737 * TERA, rel=0.002)
    frame, pair = work.alternating(FULL, 1, LARGE)
    assert work.flop([frame]) == pytest.approx(0.735 * TERA, rel=0.002)
    assert (pair["linear"], pair["attention"]) == pytest.approx((0.629 * TERA, 0.1065 * TERA), rel=0.002)
    tokens = 5 + 28 * 37
    assert pair["exp"] == 24 * 16 * tokens**2


def test_work_of_the_heads():
    for grid, known in ((SMALL, 0.170), (LARGE, 0.226)):
        h, w = grid
        made = work.flop(work.depth_head(FULL, 2, grid)) / 2
        # The known figures are of 1 x 1 convolutions after each resize, where here they are before it.
        later = 2 * 256**2 * (64 * h * w - ((h + 1) // 2) * ((w + 1) // 2))
        assert made + later == pytest.approx(known * TERA, rel=0.02)
    camera = work.camera_head(FULL, 3)
    assert round(work.flop(camera) / 3 / TERA, 3) == 0.002
    both = trunk(8, LARGE) + work.alternating(FULL, 8, LARGE)
    both += 2 * (work.camera_head(FULL, 8) + work.depth_head(FULL, 8, LARGE))
    assert work.flop(both) == pytest.approx((3.913 * 8 + 0.2131 * 64) * TERA, rel=0.02)
    assert work.flop(work.cues(FULL, 3, LARGE)) == pytest.approx(3 * 6.6e9, rel=0.02)


def test_the_camera_heads_weights_are_those_of_the_model():
    kernels = [leaf.size for leaf in jax.tree.leaves(parameter_shapes(FULL)["camera_head"]) if leaf.ndim > 1]
    assert work.camera_head(FULL, 1)[0]["weights"] == pytest.approx(4 * 4 * sum(kernels), rel=0.001)


@pytest.mark.parametrize(
    ("name", "build"), [("aggregator", workloads.aggregator), ("depth-head", workloads.depth_head)]
)
def test_the_compiler_counts_the_same_work(name, build):
    """XLA counts a loop's body once, so one pair of blocks counts; norms and the like too, the padding's zeros not."""
    config = dataclasses.replace(TINY, embed_dim=256, dpt_features=64, dpt_channels=(64, 64, 64, 64))
    case = Case("tiny", config, init_params(0, config), 2, 112, 112, "float32")
    count = WORKLOADS[name].parts
    assert count is not None
    parts = count(case)
    if name == "aggregator":
        parts = parts[:2] + [{kind: amount / config.depth for kind, amount in part.items()} for part in parts[2:]]
    function, arguments = build(case)
    counted = jax.jit(function).lower(*arguments).compile().cost_analysis()
    assert counted is not None
    assert counted["flops"] == pytest.approx(work.flop(parts), rel=0.1)


def test_floors_by_hand():
    rates = {"linear": 10.0, "exp": 2.0, "weights": 1.0}
    computing, reading = {"linear": 30.0, "exp": 4.0, "weights": 4.0}, {"linear": 10.0, "weights": 3.0}
    assert work.floor_by_kind([computing, reading], rates) == {"linear": 3.0, "exp": 2.0, "weights": 3.0}
    assert work.flop([computing, reading]) == 40


def test_a_run_is_compared_with_the_better_ceilings_around_it():
    class Scripted(Ceilings):
        def __init__(self):
            self.rates = iter([4.0, 2.0, 1.0])

        def measure(self):
            return {"linear": next(self.rates)}

    rounds = Rounds(2, Scripted())
    assert list(rounds) == [0, 1]
    assert rounds.rates == [{"linear": 4}, {"linear": 2}]
    row = Row("pass", "tiny", 2, 56, 56, "float32", Measured((4.0, 10.0)), [{"linear": 8.0}], rounds.rates)
    assert row.floor == {"linear": 3}
    assert row.share_of_floor == pytest.approx((2 / 4 + 4 / 10) / 2)


def test_slopes_by_hand():
    assert slope((2, 4, 8), (105, 115, 135)) == pytest.approx(5)


def test_memory_of_the_process_is_seen():
    def run():
        kept.append(b"x" * 200_000_000)  # so much that what others free meanwhile hardly counts

    kept: list[bytes] = []
    host, _ = measure.memory_of(run)
    if host is None:
        pytest.skip("this system does not tell")
    assert 190e6 < host < 230e6
    again, _ = measure.memory_of(lambda: None)
    assert again is not None
    assert again < 5e6  # what is there already does not count


def test_what_does_not_fit_is_a_row_and_not_the_end():
    def fails():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    assert measure.without_memory(fails)[""].failure == "out of memory"

    def later(case, rounds):
        for number in rounds:
            if number:
                fails()
        return {}

    class Scripted(Ceilings):
        def __init__(self):
            pass

        def measure(self):
            return {"linear": 1.0}

    case = Case("tiny", TINY, {}, 2, 56, 56, "float32")
    workload = workloads.Workload("fails in its second run", later, lambda case: [{"linear": 1.0}])
    (row,) = measured_rows("pass", workload, case, 2, Scripted())
    assert row.measured.failure == "out of memory"
    assert row.share_of_floor is row.floor_seconds is None

    def breaks():
        raise jax.errors.JaxRuntimeError("INTERNAL: odd")

    with pytest.raises(jax.errors.JaxRuntimeError):
        measure.without_memory(breaks)


@pytest.fixture(scope="module", autouse=True)
def quickly():
    """Programs are compiled sooner and run slower, and ceilings are rough: no test checks speed."""
    jax.config.update("jax_disable_most_optimizations", True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "_SUSTAINED", 1e-3)
        patch.setattr(ceilings, "_IN_A_ROW", 1)
        yield
    jax.config.update("jax_disable_most_optimizations", False)


def test_every_workload_runs(tmp_path, capsys, monkeypatch):
    """But for those of other tests; compiling is timed with a smaller program."""
    elsewhere = {"start-up", "aggregator", "depth-head", "two-passes"}
    names = [name for name in WORKLOADS if name not in elsewhere]
    monkeypatch.setattr(workloads, "two_passes", workloads.cue_sums)
    files = ["--out", str(tmp_path / "a.json"), "--markdown", str(tmp_path / "a.md"), "--plots", str(tmp_path)]
    arguments = ["--sizes", "tiny", "--frames", "2", "--repeats", "1", "--workloads", *names]
    code = benchmarks.main(["suite", *arguments, *files])
    shown = capsys.readouterr()
    assert code == 0, shown.err
    stored = json.loads((tmp_path / "a.json").read_text())
    assert stored["machine"]["jax"] == jax.__version__
    assert all(min(rates) > 0 for rates in stored["ceilings"]["tiny"].values())
    rows = stored["rows"]
    assert {row["workload"].split(":")[0] for row in rows} == set(names)
    for row in rows:
        assert row["min"] <= row["median"] <= row["max"]
        assert row["seconds"] == [row["median"]]
        assert (row["frames"], row["height"]) in ((2, 56), (None, None))
        if WORKLOADS[row["workload"].split(":")[0]].parts:
            assert row["share_of_floor"] > 0
            assert row["floor_seconds"] == pytest.approx(sum(row["floor"].values()))
            assert row["flop_per_second"] == pytest.approx(row["flop"] / row["median"])
            assert row["compile_seconds"] > 0
            assert row["output_bytes"] > 0
    assert "| pass | 2 |" in (tmp_path / "a.md").read_text()
    for name in ("roofline", "scaling"):
        with Image.open(tmp_path / f"{name}.png") as figure:
            assert min(figure.size) > 300


def test_a_stored_run_is_compared(tmp_path, capsys, monkeypatch):
    quick = WORKLOADS["cues"]._replace(measure=lambda case, rounds: {"": Measured(tuple(0.5 for _ in rounds))})
    monkeypatch.setitem(WORKLOADS, "cues", quick)
    arguments = ["suite", "--sizes", "tiny", "--repeats", "1", "--workloads", "cues"]
    assert benchmarks.main([*arguments, "--frames", "2", "--out", str(tmp_path / "a.json")]) == 0
    against = ["--against", str(tmp_path / "a.json"), "--out", str(tmp_path / "b.json")]
    assert benchmarks.main([*arguments, "--frames", "2", "4", *against]) == 0
    shown = capsys.readouterr().out
    assert "1 of 2 rows" in shown  # four frames are not in the stored run
    now, then = (json.loads((tmp_path / name).read_text())["rows"] for name in ("b.json", "a.json"))
    before = next(row["median"] for row in then if row["workload"] == "cues" and row["frames"] == 2)
    assert f"{now[0]['median'] / before:.3f}" in shown


def test_starting_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        workloads, "DEMO", ("-c", "import os, pathlib; pathlib.Path(os.environ['VGGTJAX_CACHE']).mkdir()")
    )
    arguments = ["--workloads", "start-up", "--sizes", "tiny", "--repeats", "1", "--out", str(tmp_path / "start.json")]
    assert benchmarks.main(["suite", *arguments]) == 2  # the second run finds the cache of the first
    assert "FileExistsError" in capsys.readouterr().err
    monkeypatch.setattr(workloads, "DEMO", ("-c", "import time; time.sleep(0.1)"))
    assert benchmarks.main(["suite", *arguments]) == 0, capsys.readouterr().err
    seconds = {row["workload"]: row["median"] for row in json.loads((tmp_path / "start.json").read_text())["rows"]}
    assert set(seconds) == {
        "start-up: import vggtjax, no jax",
        "start-up: vggtjax --help, no jax",
        "start-up: vggtjax demo, first run",
        "start-up: vggtjax demo, second run",
    }
    assert min(seconds.values()) > 0.01


def test_memory_by_frames(tmp_path, capsys, monkeypatch):
    """Of one program, as compiling each takes long; the others are traced."""
    params, images = parameter_shapes(TINY), jax.ShapeDtypeStruct((1, 2, 56, 56, 3), "float32")
    for program in memory._PROGRAMS.values():
        jax.eval_shape(partial(program, config=TINY, compute_dtype="bfloat16"), params, images)
    monkeypatch.setattr(memory, "_PROGRAMS", {"plain pass": memory.forward})
    files = ["--out", str(tmp_path / "memory.json"), "--plots", str(tmp_path)]
    assert benchmarks.main(["memory", "--size", "tiny", "--frames", "1", "3", *files]) == 0, capsys.readouterr().err
    programs = json.loads((tmp_path / "memory.json").read_text())["programs"]
    assert [line["program"] for line in programs] == ["plain pass"]
    for line in programs:
        assert line["bytes_per_frame"] == pytest.approx(slope(line["frames"], line["bytes"]))
        assert 2 * 56 * 56 * 4 < line["bytes_per_frame"] < 2e6  # depth and confidence at the least
    with Image.open(tmp_path / "memory.png") as figure:
        assert min(figure.size) > 300


def test_targets_on_a_small_model(tmp_path, capsys):
    arguments = ["--size", "tiny", "--frames", "2", "--repeats", "1", "--out", str(tmp_path / "targets.json")]
    assert benchmarks.main(["gpu-targets", *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert not any("target" in line for line in lines)  # they are for another model, and another device
    stored = json.loads((tmp_path / "targets.json").read_text())
    assert [(row["workload"], row["frames"]) for row in stored["rows"]] == [
        ("aggregator", 2),
        ("depth-head", 2),
        ("two-passes", 2),
    ]
    assert stored["targets"] == {}
    shown = next(line.split() for line in lines if line.split()[:1] == ["2"])
    assert float(shown[2]) == pytest.approx(500 * stored["rows"][1]["median"], rel=0.01)


def test_targets_go_on_where_memory_ends(monkeypatch, capsys):
    def short(case, repeats):
        if case.frames == 1:
            raise MemoryError
        return {"": measure.Measured((0.5,), temp_bytes=3_000_000, output_bytes=1_000_000)}

    monkeypatch.setattr(gpu_targets, "WORKLOADS", {name: w._replace(measure=short) for name, w in WORKLOADS.items()})
    assert benchmarks.main(["gpu-targets", "--size", "tiny", "--frames", "1", "2"]) == 0
    first, second = (line for line in capsys.readouterr().out.splitlines() if line.split()[:1] in (["1"], ["2"]))
    assert first.count("out of memory") == 4
    assert second.split() == ["2", "500", "250", "0.5", "0.004"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("suite --workloads pass nothing", "workloads has ['nothing']"),
        ("suite --frames 0", "frames is [0]"),
        ("suite --repeats 0", "repeats is 0"),
        ("suite --height 57 --sizes tiny", "height is 57; expected a multiple of 14"),
        ("suite --weights none.safetensors", "expected full among the sizes"),
        ("suite --weights none.safetensors --sizes full", "none.safetensors does not exist"),
        ("suite --against none.json", "cannot read none.json"),
        ("memory --frames 2", "two different numbers"),
        ("memory --size tiny --width -14", "width is -14"),
        ("gpu-targets --frames -1", "frames is [-1]"),
        ("gpu-targets --size demo --weights x", "weights is x and size is demo"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(capsys, arguments, sentence):
    assert benchmarks.main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("benchmarks: ")
    assert sentence in error
    assert len(error.strip().splitlines()) == 1


ROW = {"workload": "cues", "size": "tiny", "frames": 2, "height": 56, "width": 56, "dtype": "float32"}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe",
        b"[" * 100_000,
        b"[]",
        b'{"rows": 3}',
        b'{"rows": [1]}',
        b'{"rows": [{"median": 1}]}',
        json.dumps({"rows": [ROW | {"median": "fast"}]}).encode(),
        json.dumps({"rows": [ROW | {"median": -1}]}).encode(),
        json.dumps({"rows": [ROW | {"median": float("nan")}]}).encode(),
        json.dumps({"rows": [ROW | {"workload": [], "median": 1}]}).encode(),
    ],
)
def test_a_strangers_file_is_one_sentence(tmp_path, capsys, content):
    path = tmp_path / "stored.json"
    path.write_bytes(content)
    assert benchmarks.main(["suite", "--against", str(path)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert len(error.strip().splitlines()) == 1
