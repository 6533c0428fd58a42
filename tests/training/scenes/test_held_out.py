import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest

from tests.shared.generated import QUICK
from vggtjax.errors import InputError
from vggtjax.training.scenes import SceneConfig, generate, hardness, held_out, held_out_scenes

JUDGED = SceneConfig(height=24, width=24, frames=12)
LARGER = SceneConfig(height=32, width=32, frames=12)


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICK)
def quick(keys, textures, config):
    return jax.vmap(lambda key: generate(key, textures, config))(keys)


@pytest.fixture(scope="module", autouse=True)
def quickly_compiled():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(held_out, "_generate", quick)
        patch.setattr(held_out, "SIZE", JUDGED.height)
        yield


@pytest.fixture(scope="module")
def dynamic():
    return held_out_scenes("dynamic", 3, JUDGED)


@pytest.mark.proof
def test_fewer_scenes_of_another_size_are_the_same_scenes(dynamic):
    calls = []
    larger = held_out_scenes("dynamic", 2, LARGER, progress=lambda *call: calls.append(call))
    assert larger.images.shape == (2, 12, 32, 32, 3)
    assert hardness(dynamic).kept("dynamic").all()
    assert dynamic.dynamic_mask.any(axis=(1, 2, 3)).all()
    np.testing.assert_allclose(larger.camera_from_world, dynamic.camera_from_world[:2], atol=1e-5)
    np.testing.assert_allclose(larger.world_from_part, dynamic.world_from_part[:2], atol=1e-5)
    assert calls[-1] == (4, 4)

    found, judged = hardness(larger), hardness(dynamic)  # other pixels sample the same things
    for name, few, all_ in zip(found._fields, found, judged, strict=True):
        np.testing.assert_allclose(few, all_[:2], rtol=0.1, atol=1 if name == "layers" else 0, err_msg=name)

    again = held_out_scenes("dynamic", 2, LARGER)
    np.testing.assert_array_equal(larger.images, again.images)
    other = held_out_scenes("dynamic", 2, LARGER, seed=1)
    distance = np.abs(other.camera_from_world[:, None] - larger.camera_from_world[None]).max(axis=(2, 3, 4))
    assert (distance > 0.1).all()  # other scenes


@pytest.mark.proof
def test_nothing_moves_in_static_scenes_and_batches_do_not_matter(monkeypatch):
    monkeypatch.setattr(held_out, "_AT_ONCE", 2)  # so that three scenes are found and drawn in several batches
    calls = []
    config = dataclasses.replace(JUDGED, dynamic=1.0)  # which follows from the kind
    clips = held_out_scenes("static", 3, config, progress=lambda *call: calls.append(call))
    assert clips.images.shape == (3, 12, 24, 24, 3)
    assert hardness(clips).kept("static").all()
    assert not clips.dynamic_mask.any()
    assert np.abs(clips.scene_flow).max() < 1e-5
    found = [done for done, _ in calls]
    assert len(calls) > 1
    assert found == sorted(found)
    assert calls[-1] == (6, 6)
    assert len({clip.tobytes() for clip in clips.camera_from_world}) == 3


def test_a_config_without_hard_scenes_is_refused(monkeypatch):
    monkeypatch.setattr(held_out, "_MOST_CANDIDATES", 16)
    with pytest.raises(InputError, match="0 of 16 static scenes are hard enough for a test, and 3 are wanted; choose"):
        held_out_scenes("static", 3, dataclasses.replace(JUDGED, static_camera=1.0))


def test_bad_input_is_one_sentence():
    with pytest.raises(InputError, match="count of scenes is 0; expected a whole number of at least 1"):
        held_out_scenes("static", 0)
    with pytest.raises(InputError, match="test scenes have 11 frames; expected at least 12"):
        held_out_scenes("dynamic", 2, SceneConfig(frames=11))


@pytest.mark.proof
def test_frozen_scenes_are_twins_of_those_that_move():
    config = SceneConfig(height=24, width=24, frames=12, noise=0.0)
    moving = held_out_scenes("dynamic", 2, config)
    frozen = held_out_scenes("dynamic", 2, dataclasses.replace(config, frozen=True))
    assert np.array_equal(moving.camera_from_world, frozen.camera_from_world)
    assert np.abs(frozen.scene_flow).max() < 1e-5
    assert np.abs(moving.scene_flow).max() > 1e-2
    still = ~(moving.dynamic_mask | frozen.dynamic_mask)
    assert np.abs(moving.depth - frozen.depth)[still].max() < 1e-3
    assert frozen.dynamic_mask.any()


def test_bad_values_are_one_sentence():
    cases: Any = (
        ({"height": 7}, "height is 7; expected a whole number of at least 8 and at most 2048"),
        ({"dynamic": 1.5}, "dynamic is 1.5; expected a number of at least 0 and at most 1"),
        ({"motion": (0.0, 3.0)}, r"motion\[1\] is 3.0; expected a number"),
        ({"pitch": (0.0, 90.0)}, r"pitch\[1\] is 90.0; expected a number of at least -60 and at most 60"),
        ({"motion": [[10**400], 1]}, r"motion\[0\]\[0\] is a number of more than 64 bits"),
        ({"frozen": [[]]}, r"frozen is \[\[\]\]; expected true or false"),
    )
    for changes, says in cases:
        with pytest.raises(InputError, match=says):
            SceneConfig(**changes)


def test_parts_of_the_figure_come_first_in_each_kind():
    config = SceneConfig(boxes=2, ellipsoids=1, cylinders=1)
    assert config.kinds == ("box",) * 3 + ("ellipsoid",) * 2 + ("cylinder",) * 5
    assert config.objects == (0, 1, 2, 0, 3, 0, 0, 0, 0, 4)
