import dataclasses
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.training_runs import PROBES, SHORT, TASK, measured
from vggtjax.checkpoint import read_model
from vggtjax.errors import CheckpointError, InputError, OutputError, VggtjaxError
from vggtjax.network.model import init_params
from vggtjax.training.checkpoints import latest
from vggtjax.training.loop import draw_shape, train
from vggtjax.training.metrics import read_metrics
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import OptimiserConfig, Phase, read_recipe
from vggtjax.training.run import MOST_SKIPPED
from vggtjax.training.state import exported

NOW = 1e-9  # seconds: a run that ends after one step


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Six steps at a stretch."""
    out = tmp_path_factory.mktemp("straight")
    seen = []
    return train(SHORT, out, options=RunOptions(log_every=2), progress=seen.append, task=TASK), out, seen


def test_what_a_run_leaves(straight):
    outcome, out, seen = straight
    assert outcome.finished
    assert int(outcome.state.step) == 6
    assert {path.name for path in out.iterdir()} == {
        "checkpoints", "metrics.csv", "metrics.png", "model.safetensors", "recipe.json",
    }  # fmt: skip
    rows = read_metrics(out / "metrics.csv")
    assert [(row["step"], row["stage"], row["samples"]) for row in rows] == [(2, 0, 4), (4, 0, 8), (6, 1, 10)]
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


@pytest.mark.proof
def test_interrupted_after_every_step_gives_the_same_numbers(straight, tmp_path):
    """Also in the middle of an interval that a row averages over, and between stages."""
    whole, out, _ = straight
    part = whole
    for step in range(1, 7):
        part = train(SHORT, tmp_path, options=RunOptions(log_every=2, seconds=NOW), task=TASK)
        assert int(part.state.step) == step
        assert part.finished == (step == 6)
    assert measured(tmp_path / "metrics.csv") == measured(out / "metrics.csv")
    assert same(part.state, whole.state)
    assert (tmp_path / "model.safetensors").read_bytes() == (out / "model.safetensors").read_bytes()


def test_a_finished_run_stays(straight):
    whole, out, _ = straight
    before = (out / "model.safetensors").stat().st_mtime_ns
    again = train(SHORT, out, options=RunOptions(log_every=2), task=TASK)
    assert again.finished
    assert same(again.state, whole.state)
    assert (out / "model.safetensors").stat().st_mtime_ns == before


@pytest.mark.proof
def test_a_run_killed_before_its_model_is_written(straight, tmp_path, monkeypatch):
    """The checkpoint of the last step exists, and the model of an earlier one."""

    def killed(*args, **kwargs):
        raise RuntimeError("killed")

    whole, out, _ = straight
    train(SHORT, tmp_path, options=RunOptions(log_every=2, seconds=NOW), task=TASK)
    with monkeypatch.context() as patch:
        patch.setattr("vggtjax.training.run.save_model", killed)
        with pytest.raises(RuntimeError, match="killed"):
            train(SHORT, tmp_path, options=RunOptions(log_every=2), task=TASK)
    assert latest(tmp_path / "checkpoints") == 6
    assert train(SHORT, tmp_path, options=RunOptions(log_every=2), task=TASK).finished
    assert same(read_model(tmp_path / "model.safetensors").params, exported(whole.state, SHORT))
    assert (tmp_path / "model.safetensors").read_bytes() == (out / "model.safetensors").read_bytes()


def test_one_run_in_a_folder(tmp_path):
    def again(status):
        with pytest.raises(OutputError, match="another run is writing checkpoints and a model into"):
            train(PROBES, tmp_path, task=TASK)

    assert train(PROBES, tmp_path, options=RunOptions(seconds=NOW), progress=again, task=TASK).state.step == 1


@pytest.mark.parametrize(
    ("number", "error"),
    [(signal.SIGTERM, SystemExit), pytest.param(signal.SIGINT, KeyboardInterrupt, marks=pytest.mark.proof)],
)
def test_signals_end_a_run_with_a_checkpoint(straight, tmp_path, number, error):
    def interrupt(status):
        if status.step == 4:
            os.kill(os.getpid(), number)

    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(error) as raised:
        train(SHORT, tmp_path, options=RunOptions(log_every=2), progress=interrupt, task=TASK)
    if error is SystemExit:
        assert raised.value.code == 143
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert latest(tmp_path / "checkpoints") == 4
    assert read_model(tmp_path / "model.safetensors").config == SHORT.model
    train(SHORT, tmp_path, options=RunOptions(log_every=2), task=TASK)
    assert measured(tmp_path / "metrics.csv") == measured(straight[1] / "metrics.csv")


def test_checkpoints_are_written_on_the_way(tmp_path):
    train(PROBES, tmp_path, options=RunOptions(checkpoint_seconds=NOW), task=TASK)
    assert sorted(int(path.name) for path in (tmp_path / "checkpoints").iterdir()) == [5, 6]


def test_a_run_that_only_skips_ends(tmp_path):
    recipe = dataclasses.replace(PROBES, stages=(Phase(MOST_SKIPPED + 50, 1, (2,), 28, 28),))
    with pytest.raises(VggtjaxError, match="50 steps in a row up to step 50 had a loss or gradient"):
        train(recipe, tmp_path, task=dataclasses.replace(TASK, textures=jnp.float32(np.nan)))


def test_a_start_is_read_once(tmp_path):
    params = init_params(9, SHORT.model)
    begun = train(SHORT, tmp_path, init=params, options=RunOptions(seconds=NOW), task=TASK)
    assert same(begun.state.trained["model"]["backbone"], params["backbone"])
    gone_on = train(SHORT, tmp_path, init=init_params(3, SHORT.model), options=RunOptions(seconds=NOW), task=TASK)
    assert same(gone_on.state.trained["model"]["backbone"], params["backbone"])


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
    alone = drawn(dataclasses.replace(phase, sizes=()), 0)  # further sizes leave the numbers of frames as they were
    assert [frames for frames, *_ in alone] == [frames for frames, *_ in shapes]


def test_another_recipe_in_the_folder(tmp_path, caplog):
    train(PROBES, tmp_path, options=RunOptions(seconds=NOW), task=TASK)
    muon = OptimiserConfig(kind="muon", warmup_steps=0, decay_steps=0)
    with pytest.raises(CheckpointError, match=r"another optimiser\.kind"):
        train(dataclasses.replace(PROBES, optimiser=muon), tmp_path, task=TASK)
    faster = dataclasses.replace(PROBES.optimiser, learning_rate=0.1)
    train(dataclasses.replace(PROBES, optimiser=faster), tmp_path, options=RunOptions(seconds=NOW), task=TASK)
    assert "resuming with the new recipe" in caplog.text


def test_bad_arguments(tmp_path):
    with pytest.raises(InputError, match="dtype is 'float16'"):
        RunOptions(dtype="float16")  # type: ignore[arg-type]
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        train(SHORT, tmp_path / "file", task=TASK)
