import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.training_runs import SHORT, init_probes
from vggtjax.errors import CheckpointError, OutputError
from vggtjax.training.checkpoints import KEPT, latest, restore, save
from vggtjax.training.recipe import OptimiserConfig
from vggtjax.training.state import initial_state, state_shapes


@pytest.fixture(scope="module")
def state():
    generator = np.random.default_rng(0)
    start = initial_state(SHORT, init_probes(0, SHORT.model))

    def other(leaf):  # so that nothing is what a fresh state would have
        return jnp.asarray(generator.standard_normal(leaf.shape), leaf.dtype) if leaf.dtype == jnp.float32 else leaf + 3

    return jax.tree.map(other, start)


@pytest.fixture(scope="module")
def shapes():
    return state_shapes(SHORT, init_probes(0, SHORT.model))


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


def test_another_schedule_may_go_on(saved, state, shapes):
    later = dataclasses.replace(SHORT, optimiser=OptimiserConfig(learning_rate=1e-3, warmup_steps=0, decay_steps=1))
    found = restore(saved, shapes, later)
    assert found.recipe == SHORT
    np.testing.assert_array_equal(found.state.step, state.step)


def test_last_two_are_kept(tmp_path, state):
    for step in (1, 5, 9):
        save(tmp_path, state._replace(step=jnp.int32(step)), SHORT)
    assert sorted(int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()) == [5, 9]
    assert KEPT == 2
    assert latest(tmp_path) == 9
    save(tmp_path, state._replace(step=jnp.int32(9)), SHORT)  # is there already
    assert latest(tmp_path) == 9


@pytest.mark.parametrize("name", ["none", "empty"])
def test_folders_without_a_checkpoint(tmp_path, shapes, name):
    folder = tmp_path / name
    if name == "empty":
        folder.mkdir()
    assert latest(folder) is None
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        restore(folder, shapes, SHORT)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"model": dataclasses.replace(SHORT.model, embed_dim=32)}, "another model"),
        ({"trainable": "all"}, "another trainable"),
        ({"untrained": ("track_head",)}, "another untrained"),
        ({"optimiser": OptimiserConfig(kind="muon", warmup_steps=0, decay_steps=0)}, r"another optimiser\.kind"),
    ],
)
def test_checkpoint_of_another_recipe(saved, change, says):
    recipe = dataclasses.replace(SHORT, **change)
    with pytest.raises(CheckpointError, match=says):
        restore(saved, state_shapes(recipe, init_probes(0, recipe.model)), recipe)


def test_other_shapes(saved, shapes):
    probes = {"mean": {"kernel": jnp.zeros((3, 4)), "bias": jnp.zeros(3)}}
    with pytest.raises(CheckpointError, match=r"4 arrays differ, such as .*kernel: \(3, 3\), expected \(3, 4\)"):
        restore(saved, state_shapes(SHORT, probes), SHORT)


def test_damaged_checkpoints(tmp_path, state, shapes):
    save(tmp_path, state, SHORT)
    run = tmp_path / "3" / "run" / "metadata"
    text = run.read_text()
    for content in ("{", "{}", json.dumps({"recipe": {"name": "x"}, "notes": {}}), "[1]"):
        run.write_text(content)
        with pytest.raises(CheckpointError, match="cannot be"):
            restore(tmp_path, shapes, SHORT)
    run.write_text(text)
    (tmp_path / "3" / "state" / "_METADATA").write_bytes(b"\x80\x04K\x01.")  # a pickle
    with pytest.raises(CheckpointError, match="cannot be read"):
        restore(tmp_path, shapes, SHORT)


def test_folder_that_cannot_be_written(tmp_path, state):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot write .*choose a folder"):
        save(tmp_path / "file" / "checkpoints", state, SHORT)
