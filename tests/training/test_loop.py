"""The loop of a training run: what it leaves, exact resume, signals, its metrics, and where it computes."""

import dataclasses
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.da3 import TINY
from tests.shared.training_runs import PROBES, SHORT, TASK, measured, same
from vggtjax.errors import InputError, OutputError, VggtjaxError
from vggtjax.network.checkpoint import read_model
from vggtjax.network.model import init_params
from vggtjax.training.checkpoints import latest
from vggtjax.training.draws import draw_shape, draws_cameras
from vggtjax.training.loop import train
from vggtjax.training.metrics import Averages, read_metrics, write_metrics
from vggtjax.training.objective import LossWeights
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import Phase, read_recipe
from vggtjax.training.run import MOST_SKIPPED
from vggtjax.training.state import exported

NOW = 1e-9  # seconds: a run that ends after one step


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Six steps at a stretch."""
    out = tmp_path_factory.mktemp("straight")
    seen = []
    return train(SHORT, out, options=RunOptions(log_every=2), progress=seen.append, task=TASK), out, seen


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the picture of metrics, which takes half the time of a run as short as these."""
    monkeypatch.setattr("vggtjax.training.run.plot", lambda *_: None)


def test_what_a_run_leaves(straight):
    outcome, out, seen = straight
    assert outcome.finished
    assert int(outcome.state.step) == 6
    files = "checkpoints metrics.csv metrics.png model.safetensors recipe.json"
    assert {path.name for path in out.iterdir()} == {*files.split()}
    rows = read_metrics(out / "metrics.csv")
    assert [(row["step"], row["stage"], row["samples"]) for row in rows] == [(2, 0, 4), (4, 0, 8), (6, 1, 12)]
    assert rows[2]["loss"] < rows[0]["loss"]
    assert all(0 <= row["render_share"] < 1 for row in rows)
    assert read_recipe(out / "recipe.json") == SHORT
    assert latest(out / "checkpoints") == 6
    model = read_model(outcome.model)
    assert model.config == SHORT.model
    assert (model.name, model.note, model.untrained_heads) == ("tiny", "", ("depth", "points", "tracks"))
    assert same(model.params, exported(outcome.state, SHORT))
    assert [status.step for status in seen] == [0, 2, 4, 6, 6]
    assert seen[0].seconds_left is None
    assert seen[2].seconds_left > 0
    assert seen[-1].seconds_left == 0
    assert seen[-1].metrics == rows[-1]


def test_an_interrupted_run_gives_the_same_numbers(straight, tmp_path, undrawn):
    """Ended by its time within an interval of metrics, by SIGTERM, and by SIGINT between two stages."""
    whole, out, _ = straight
    train(SHORT, tmp_path, options=RunOptions(log_every=2, seconds=NOW), task=TASK)
    assert latest(tmp_path / "checkpoints") == 1
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    for number, step, error in ((signal.SIGTERM, 2, SystemExit), (signal.SIGINT, 4, KeyboardInterrupt)):

        def interrupt(status, number=number, step=step):
            if status.step == step:
                with pytest.raises(OutputError, match="another run is writing checkpoints and a model into"):
                    train(SHORT, tmp_path, task=TASK)
                os.kill(os.getpid(), number)

        with pytest.raises(error) as raised:
            train(SHORT, tmp_path, options=RunOptions(log_every=2), progress=interrupt, task=TASK)
        if isinstance(raised.value, SystemExit):
            assert raised.value.code == 143
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
        assert latest(tmp_path / "checkpoints") == step
        assert read_model(tmp_path / "model.safetensors").config == SHORT.model
    other = init_params(3, SHORT.model)  # a start is read once
    often = RunOptions(log_every=2, checkpoint_seconds=NOW)
    assert same(train(SHORT, tmp_path, init=other, options=often, task=TASK).state, whole.state)
    assert sorted(int(path.name) for path in (tmp_path / "checkpoints").iterdir()) == [5, 6]
    assert measured(tmp_path / "metrics.csv") == measured(out / "metrics.csv")
    assert (tmp_path / "model.safetensors").read_bytes() == (out / "model.safetensors").read_bytes()


def test_a_finished_run_stays_and_says_that_its_recipe_has_changed(straight, tmp_path, undrawn, caplog):
    whole, out, _ = straight
    copy = shutil.copytree(out, tmp_path / "copy")
    faster = dataclasses.replace(SHORT, optimiser=dataclasses.replace(SHORT.optimiser, learning_rate=0.1))
    again = train(faster, copy, task=TASK)
    assert again.finished
    assert same(again.state, whole.state)
    assert (copy / "model.safetensors").read_bytes() == (out / "model.safetensors").read_bytes()
    assert "resuming with the new recipe" in caplog.text


def test_a_run_that_only_skips_ends(tmp_path):
    recipe = dataclasses.replace(PROBES, stages=(Phase(MOST_SKIPPED + 50, 1, (2,), 28, 28),))
    with pytest.raises(VggtjaxError, match="50 steps in a row up to step 50 had a loss or gradient"):
        train(recipe, tmp_path, task=dataclasses.replace(TASK, textures=jnp.float32(np.nan)))


def test_frames_and_sizes_depend_on_seed_and_step_alone():
    phase = Phase(60, 1, (2, 3, 5), 28, 28, sizes=((14, 28), (28, 42)))

    def drawn(phase: Phase, data_seed: int) -> list[tuple[int, int, int]]:
        recipe = dataclasses.replace(SHORT, stages=(phase,), data_seed=data_seed)
        shapes = [draw_shape(recipe, step) for step in range(60)]
        for index, one, _ in shapes:
            assert index == 0
            assert one == dataclasses.replace(phase, height=one.height, width=one.width, sizes=())
        return [(frames, one.height, one.width) for _, one, frames in shapes]

    shapes = drawn(phase, 0)
    assert shapes == drawn(phase, 0) != drawn(phase, 1)
    assert {frames for frames, *_ in shapes} == {2, 3, 5}
    assert {tuple(size) for _, *size in shapes} == {(28, 28), (14, 28), (28, 42)}
    given = (dataclasses.replace(phase, known_cameras=0.3),)
    recipe = dataclasses.replace(SHORT, stages=given, model=TINY, losses=LossWeights(points=0))
    told = [draws_cameras(recipe, step) for step in range(200)]
    assert told == [draws_cameras(recipe, step) for step in range(200)]
    assert 0.2 < np.mean(told) < 0.4
    alone = drawn(dataclasses.replace(phase, sizes=()), 0)  # further sizes leave the numbers of frames as they were
    assert [frames for frames, *_ in alone] == [frames for frames, *_ in shapes]


CODE = """
import dataclasses, jax, numpy as np
from tests.shared.training_runs import RECIPE
from vggtjax.training.run import placement
def placed(*sizes):
    stages = tuple(dataclasses.replace(stage, batch=size) for stage, size in zip(RECIPE.stages, sizes))
    return placement(dataclasses.replace(RECIPE, stages=stages))

where = placed(4, 2)
print(len(placed(2, 1).whole.device_set), len(where.whole.mesh.devices))
print(jax.device_put(np.ones((4, 3)), where.by_clip).addressable_shards[0].data.shape)
"""


def test_the_most_devices_that_divide_every_batch():
    """One for batches of 2 and 1; two of three for batches of 4 and 2."""
    environment = {"XLA_FLAGS": "--xla_force_host_platform_device_count=3", "PATH": ""}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    made = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert made.stdout.split("\n")[:2] == ["1 2", "(2, 3)"]


def row(step, **metrics):
    return {"step": step, "stage": 0, "seconds": step / 3, "samples": 2 * step, **metrics}


def test_averages():
    averages = Averages()
    averages.add({"loss": 1.0, "depth": 4.0})
    averages.add({"loss": math.nan, "skipped": 1.0}, finite_only=True)
    averages.add({"loss": 2.0})
    assert averages.take() == {"loss": 1.5, "depth": 4.0, "skipped": 1.0}
    averages.add({"loss": math.inf})
    assert averages.take() == {"loss": math.inf}


def test_rows_of_different_metrics_share_a_table(tmp_path):
    path = tmp_path / "metrics.csv"
    rows = [row(1, loss=0.5), row(2, loss=0.25, match=1.0), row(3, match=0.5)]
    write_metrics(path, rows)
    rest = [f"1,0,{1 / 3!r},2,0.5,", f"2,0,{2 / 3!r},4,0.25,1.0", "3,0,1.0,6,,0.5"]
    assert path.read_text().splitlines() == ["step,stage,seconds,samples,loss,match", *rest]
    assert read_metrics(path) == rows


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "does not begin with the columns"),
        (b"\xff\xfe\n", "is no CSV file"),
        (b"step,stage,seconds,samples\n1,2,x,4\n2,0,1,4\n", "line 2"),
    ],
)
def test_other_files_are_refused(tmp_path, content, says):
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_metrics(path)
    with pytest.raises(InputError, match="cannot read"):
        read_metrics(tmp_path / "none.csv")
