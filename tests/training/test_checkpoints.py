import asyncio
import dataclasses
import json
import os
import shutil
from contextlib import closing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.training_runs import SHORT, init_probes
from vggtjax.errors import CheckpointError
from vggtjax.training.checkpoints import _explaining, latest, restore, save
from vggtjax.training.recipe import OptimiserConfig
from vggtjax.training.state import state_shapes


@pytest.fixture(scope="module")
def shapes():
    return state_shapes(SHORT, init_probes(0, SHORT.model))


@pytest.fixture(scope="module")
def state(shapes):
    """Nothing is what a fresh state would have."""
    generator = np.random.default_rng(0)

    def other(leaf):
        values = generator.standard_normal(leaf.shape) if leaf.dtype == jnp.float32 else np.full(leaf.shape, 3)
        return jax.device_put(np.asarray(values, leaf.dtype))

    return jax.tree.map(other, shapes)


@pytest.fixture(scope="module")
def saved(tmp_path_factory, state):
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    save(folder, state, SHORT, {"seconds": 0.1 + 0.2})
    return folder


def test_round_trip_is_exact(saved, state, shapes):
    assert latest(saved) == 3
    found = restore(saved, shapes, SHORT)
    assert found.recipe == SHORT
    assert found.notes == {"seconds": 0.1 + 0.2}
    assert jax.tree.structure(found.state) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(found.state), jax.tree.leaves(state), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_the_last_two_are_kept_and_what_an_interrupted_save_left_is_removed(tmp_path, saved, state):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    shutil.copytree(saved / "3", tmp_path / "9.orbax-checkpoint-tmp")
    assert latest(tmp_path) == 3
    assert (tmp_path / "9.orbax-checkpoint-tmp").exists()  # who reads removes nothing
    save(tmp_path, state._replace(step=jnp.int32(10)), SHORT)
    save(tmp_path, state._replace(step=jnp.int32(12)), SHORT)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["10", "12"]
    assert latest(tmp_path) == 12


def test_folders_without_a_checkpoint(tmp_path, shapes):
    for folder in (tmp_path, tmp_path / "none"):
        assert latest(folder) is None
        with pytest.raises(CheckpointError, match="holds no checkpoint"):
            restore(folder, shapes, SHORT)


def test_checkpoint_of_another_recipe(saved, shapes):
    """It is refused before its state is read, whose shapes would differ."""
    for changes, says in (
        ({"trainable": "all"}, "another trainable"),
        ({"optimiser": OptimiserConfig(kind="muon", warmup_steps=0, decay_steps=0)}, r"another optimiser\.kind"),
    ):
        with pytest.raises(CheckpointError, match=says):
            restore(saved, shapes, dataclasses.replace(SHORT, **changes))


def test_damaged_checkpoints(tmp_path, saved, shapes):
    run = json.loads((saved / "3/run/metadata").read_text())
    for number, (name, content) in enumerate(
        (
            ("run/metadata", b"{"),
            ("run/metadata", json.dumps(run | {"recipe": {"name": "x"}}).encode()),
            ("state/_METADATA", b"\x80\x04K\x01."),  # a pickle
            ("state/manifest.ocdbt", b"\x00" * 99),
            ("state/_METADATA", None),
        )
    ):
        folder = Path(shutil.copytree(saved, tmp_path / f"damaged{number}"))
        if content is None:
            (folder / "3" / name).unlink()
            os.mkfifo(folder / "3" / name)
        else:
            (folder / "3" / name).write_bytes(content)
        says = "is a pipe" if content is None else "cannot be read as a checkpoint|is a checkpoint of|holds the state"
        with pytest.raises(CheckpointError, match=says):
            restore(folder, shapes, SHORT)


def test_where_a_read_fails_the_others_end_before_orbax_closes_their_loop(tmp_path):
    ended = []

    async def slow():
        await asyncio.sleep(0.05)
        ended.append(True)

    async def broken():
        raise ValueError("damaged")

    async def both():
        await asyncio.gather(slow(), broken())

    refused = pytest.raises(CheckpointError, match="damaged")
    with refused, _explaining(tmp_path), closing(asyncio.new_event_loop()) as loop:
        loop.run_until_complete(both())
    assert ended
