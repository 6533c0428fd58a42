"""Processes that share the clips of a step: the numbers of one process, ended workers, bad input."""

import dataclasses
import multiprocessing
import os
import signal
from multiprocessing.process import BaseProcess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.generated import QUICK
from tests.training_runs import CONFIG, SHORT, TASK, measured
from vggtjax.errors import InputError, VggtjaxError
from vggtjax.network.model import init_params
from vggtjax.scenes import load_textures
from vggtjax.training.checkpoints import latest
from vggtjax.training.data import make_batch
from vggtjax.training.loop import train
from vggtjax.training.objective import LossWeights, init_probes, objective, with_counts
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import Phase
from vggtjax.training.workers import check_workers

RECIPE = dataclasses.replace(SHORT, stages=(Phase(3, 2, (2, 3), 28, 28), Phase(3, 4, (2,), 28, 42)))


def quick(function, static=()):
    return jax.jit(function, static_argnums=static, compiler_options=QUICK)


def values(path):
    rows = measured(path)
    return np.array([[row[name] for name in sorted(rows[0])] for row in rows])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    out = tmp_path_factory.mktemp("alone")
    return train(RECIPE, out, options=RunOptions(log_every=2), task=TASK), out


def test_two_workers_give_the_numbers_of_one_process(alone, tmp_path, monkeypatch):
    """Also where a run begins with one process and resumes with two.

    A terminal's Ctrl-C, which every process gets, does not end the workers: neither at their start nor later.
    """
    start = BaseProcess.start

    def interrupt_workers(status):
        for process in multiprocessing.active_children():
            assert process.pid is not None
            os.kill(process.pid, signal.SIGINT)

    def start_and_interrupt(process):
        start(process)
        interrupt_workers(None)

    monkeypatch.setattr(BaseProcess, "start", start_and_interrupt)

    whole, out = alone
    train(RECIPE, tmp_path, options=RunOptions(log_every=2, seconds=1e-9), task=TASK)
    options = RunOptions(log_every=2, workers=2)
    shared = train(RECIPE, tmp_path, options=options, progress=interrupt_workers, task=TASK)
    assert shared.finished
    np.testing.assert_allclose(values(tmp_path / "metrics.csv"), values(out / "metrics.csv"), rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), shared.state, whole.state)
    assert not multiprocessing.active_children()


@pytest.mark.proof
def test_a_worker_that_ends_is_said_and_the_run_resumes(tmp_path):
    def kill(status):
        if status.step == 2:
            multiprocessing.active_children()[0].kill()

    options = RunOptions(log_every=2, checkpoint_seconds=1e-9, workers=2)
    with pytest.raises(VggtjaxError, match="ended with exit code -9, perhaps for lack of memory; take fewer workers"):
        train(RECIPE, tmp_path, options=options, progress=kill, task=TASK)
    assert not multiprocessing.active_children()
    assert latest(tmp_path / "checkpoints") == 2
    assert train(RECIPE, tmp_path, options=RunOptions(), task=TASK).finished


def broken(trained, batch, config, weights, **_):
    raise ValueError("no such loss")


def test_an_error_in_a_worker_is_said(tmp_path):
    task = dataclasses.replace(TASK, objective=broken)
    with pytest.raises(VggtjaxError, match="a worker of the training run failed: ValueError: no such loss") as raised:
        train(RECIPE, tmp_path, options=RunOptions(workers=2), task=task)
    assert "in broken" in raised.value.__notes__[0]  # where in the objective


def test_an_objective_that_cannot_be_sent(tmp_path):
    task = dataclasses.replace(TASK, objective=lambda *_, **__: (jnp.float32(0), {}))
    with pytest.raises(InputError, match="cannot be sent to other processes; define it at the top of a module"):
        train(RECIPE, tmp_path, options=RunOptions(workers=2), task=task)


def test_workers_that_cannot_share(monkeypatch):
    with pytest.raises(
        InputError, match="workers is 3; expected a divisor of the batch of every phase; one is 2 clips"
    ):
        check_workers(RECIPE, 3)
    monkeypatch.setattr(jax, "local_device_count", lambda: 8)
    with pytest.raises(InputError, match="workers is 2, and the CPU is split into 8 devices"):
        check_workers(RECIPE, 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(InputError, match="workers is 2, and jax computes on a gpu; expected 1, or a CPU"):
        check_workers(RECIPE, 2)
    check_workers(RECIPE, 1)


def test_the_loss_of_a_batch_is_the_mean_of_its_shares():
    """The shares have different numbers of matches, which some terms are means over."""
    weights = LossWeights(points=0, match=1, match_layers=(1,), probe=1, moments=1)
    phase = Phase(1, 4, (2,), 28, 28, motion=(0.5, 1.0), suppressed=0.5)
    batch = quick(make_batch, (2, 3))(jax.random.key(0), load_textures("training"), phase, 2)
    probes = init_probes(0, CONFIG)
    trained = {"model": init_params(0, CONFIG), "probes": jax.tree.map(lambda x: x + 0.01, probes)}
    loss = quick(lambda batch: objective(trained, batch, CONFIG, weights)[1])
    counted = quick(with_counts, 1)(batch, CONFIG)
    plain = [jax.tree.map(lambda x, i=i: x[i : i + 2], batch) for i in (0, 2)]
    shares = [jax.tree.map(lambda x, i=i: x[i : i + 2], counted) for i in (0, 2)]
    whole, first, second = jax.device_get([loss(batch), *map(loss, shares)])
    for name, value in whole.items():
        assert np.mean([first[name], second[name]]) == pytest.approx(value, rel=1e-5), name
    apart = jax.device_get([loss(share)["loss_match"] for share in plain])
    assert abs(np.mean(apart) - whole["loss_match"]) > 1e-4 * whole["loss_match"]
