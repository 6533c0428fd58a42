"""Clips of worlds in a run: drawn by step, kept in a folder, the same after an interruption."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.asset_folder import write_assets
from tests.shared.training_runs import PROBES, init_probes, make_batch, objective, same
from vggtjax.errors import InputError, VggtjaxError
from vggtjax.training.data import make_world_batch
from vggtjax.training.draws import Worlds, opened_worlds
from vggtjax.training.loop import Task, train
from vggtjax.training.options import RunOptions
from vggtjax.training.recipe import Phase
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.world.config import Places, WorldConfig
from vggtjax.training.world.dataset import write_worlds
from vggtjax.training.world.pool import ClipPool, Job

ROOMS = WorldConfig(places=Places(1, 0, 0), dynamic=1.0)
PHASE = Phase(4, 2, (2, 3), 28, 28, worlds=0.7, world=ROOMS, suppressed=0.5, masked_movers=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_assets(tmp_path_factory.mktemp("assets") / "assets")


@pytest.fixture(scope="module")
def clips(folder, tmp_path_factory):
    """Two clips of a pool, the first in order, the second backwards."""
    with ClipPool(tmp_path_factory.mktemp("clips"), [Job(str(folder), ROOMS, 3, 28, 28, 14, 0)]) as pool:
        return pool.clips(0, [0, 1], [np.arange(3), np.arange(3)[::-1]])


def recipe_of(folder):
    return dataclasses.replace(PROBES, stages=(PHASE,), assets=str(folder))


def world_images(key, clips, phase, frames):
    """The pictures alone, as the small objective of these tests takes them."""
    del key, phase, frames
    return jnp.asarray(clips.images, jnp.float32) / 255


def test_an_interrupted_run_draws_the_same_clips(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("vggtjax.training.run.plot", lambda *_: None)
    recipe, seen = recipe_of(folder), []

    def noted(key, clips, *shape):
        seen.append(clips.images.shape)
        return world_images(key, clips, *shape)

    task = Task(jnp.float32(1), make_batch, init_probes, objective, noted)
    whole = train(recipe, tmp_path / "whole", task=task)
    assert seen
    out = tmp_path / "parts"
    outcome = [train(recipe, out, options=RunOptions(seconds=1e-9), task=task) for _ in range(4)][-1]
    assert outcome.finished
    assert same(outcome.state, whole.state)


def test_the_pool_grows_and_every_step_has_its_own_draw(folder, tmp_path):
    recipe = recipe_of(folder)
    with opened_worlds(dataclasses.replace(recipe, assets=str(folder)), tmp_path) as worlds:
        assert isinstance(worlds, Worlds)
        draws = [worlds.draw(step) for step in range(400)]
    assert 0.6 < np.mean([draw is not None for draw in draws]) < 0.8
    numbers = [draw.numbers for draw in draws if draw is not None]
    assert max(numbers[0]) < max(max(row) for row in numbers)
    assert all(len(set(row)) == PHASE.batch for row in numbers)
    orders = {tuple(frames) for draw in draws if draw is not None for frames in draw.frames}
    assert {(0, 1, 2), (2, 1, 0), (0, 2), (1, 0)} <= orders


def test_pools_of_phases_grow_by_their_own_steps(folder, tmp_path):
    """A second phase of another size begins with as few clips as the first did, and large batches have enough."""
    second = dataclasses.replace(PHASE, steps=400, height=42, batch=32)
    recipe = dataclasses.replace(recipe_of(folder), stages=(dataclasses.replace(PHASE, steps=1000), second))
    with opened_worlds(recipe, tmp_path) as worlds:
        assert worlds is not None
        first = [draw.numbers for step in range(1000, 1010) if (draw := worlds.draw(step)) is not None]
        total = worlds.total
        drawn = [number for step in range(1400) if (draw := worlds.draw(step)) is not None for number in draw.numbers]
    assert max(max(row) for row in first) < 2 * 32 + 10 * 32
    assert max(drawn) < total < 2 * max(drawn)
    assert 3 < len(drawn) / (len({*drawn}) + 16) < 8  # `reuse` is 4; two sizes have equal numbers


def test_a_run_is_told_of_a_renderer_that_ended(folder, tmp_path):
    with ClipPool(tmp_path, [Job(str(folder), ROOMS, 3, 28, 28, 14, 0)]) as pool:
        pool.clips(0, [0], [np.arange(3)])
        for process in pool._workers._processes.values():
            process.kill()
            process.join()
        with pytest.raises(VggtjaxError, match="a process that renders clips ended"):
            pool.clips(0, [1], [np.arange(3)])


def test_frames_are_taken_in_the_order_that_is_asked_for(clips, folder, tmp_path):
    with ClipPool(tmp_path, [Job(str(folder), ROOMS, 3, 28, 28, 14, 0)]) as pool:
        forward = pool.clips(0, [1], [np.arange(3)])
        path = next(tmp_path.rglob("*.npz"))
        path.write_bytes(path.read_bytes()[:1000])  # cut off: made anew
        again = pool.clips(0, [1], [np.arange(3)])
    for name, backward in clips._asdict().items():
        one = getattr(forward, name)[0][::-1]
        np.testing.assert_array_equal(one[:, :, ::-1] if name == "tracks" else one, backward[1])
        np.testing.assert_array_equal(getattr(forward, name), getattr(again, name))


def test_keys_of_what_moves_are_suppressed(clips):
    make = jax.jit(make_world_batch, static_argnums=(2, 3))
    seen = [make(jax.random.key(number), clips, PHASE, 3) for number in range(4)]
    turns = set()
    for batch in seen:
        for number, of_clip in enumerate(zip(batch.regions, batch.clips.depth, batch.clips.tracks, strict=True)):
            turn = 1 if np.array_equal(of_clip[1], clips.depth[number].astype(np.float32)) else -1
            turns.add(turn)
            np.testing.assert_array_equal(of_clip[0], clips.moving[number][..., ::turn])
            np.testing.assert_array_equal(of_clip[1], clips.depth[number].astype(np.float32)[..., ::turn])
            np.testing.assert_array_equal(np.unique(of_clip[2][..., 0]), np.unique(turn * clips.tracks[number][..., 0]))
    assert turns == {1, -1}
    never = make(jax.random.key(0), clips, dataclasses.replace(PHASE, masked_movers=0.0), 3)
    assert not never.regions.any()
    assert seen[0].clips.images.min() >= 0
    assert seen[0].clips.images.max() <= 1


def test_a_set_of_worlds_is_read_by_evaluate(folder, tmp_path):
    from vggtjax.research.evaluation.datasets import find_sequences

    size = SceneConfig(height=32, width=48, frames=3)
    made = write_worlds(tmp_path / "set", folder, size, count=2, seed=1)
    sequences = find_sequences("plain", tmp_path / "set", strict=True)
    assert len(sequences) == len(made) == 2
    sequence = next(iter(sequences.values()))()
    assert sequence.depth is not None
    assert len(sequence) == 3
    assert sequence.depth(0).shape == (32, 48)
    with pytest.raises(InputError, match="height of config 32 instead of 40;"):
        write_worlds(tmp_path / "set", folder, dataclasses.replace(size, height=40), count=2, seed=1)


def test_recipes_that_cannot_be_drawn_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match="expected the folder of their assets"):
        dataclasses.replace(PROBES, stages=(PHASE,))
    missing = dataclasses.replace(recipe_of(folder), assets=str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="is not a folder"):
        train(missing, tmp_path / "out", task=Task(jnp.float32(1), make_batch, init_probes, objective, world_images))
    assert not (tmp_path / "out" / "recipe.json").exists()


def test_renderers_do_not_import_jax():
    """A process that renders starts in two seconds and takes no memory for a network."""
    code = "import sys, vggtjax.training.world.pool; print('jax' in sys.modules)"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout == "False\n"
