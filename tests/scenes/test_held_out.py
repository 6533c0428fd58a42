"""Test scenes: as hard as is asked, the same every time, whatever the size and the count."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest

from tests.generated import QUICK
from vggtjax.errors import InputError
from vggtjax.scenes import SceneConfig, SyntheticClip, generate, hardness, held_out, held_out_scenes

JUDGED = SceneConfig(height=24, width=24, frames=12)
LARGER = SceneConfig(height=32, width=32, frames=12)


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICK)
def quick(keys, textures, config):
    return jax.vmap(lambda key: generate(key, textures, config))(keys)


@pytest.fixture(autouse=True)
def quickly_compiled(monkeypatch):
    monkeypatch.setattr(held_out, "_generate", quick)
    monkeypatch.setattr(held_out, "SIZE", JUDGED.height)


@pytest.fixture(scope="module")
def dynamic():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(held_out, "_generate", quick)
        patch.setattr(held_out, "SIZE", JUDGED.height)
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
    assert calls[-1] == (2, 2)

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
    assert calls[-1] == (3, 3)
    assert len({clip.tobytes() for clip in clips.camera_from_world}) == 3


def made_up(centres, angles, depth, part_ids, moving):
    """One clip whose cameras stand at centres [S, 3] and are turned about y by angles [S]."""
    S = len(centres)
    cos, sin, zero, one = np.cos(angles), np.sin(angles), np.zeros(S), np.ones(S)
    rotation = np.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], axis=-1).reshape(S, 3, 3)
    pose = np.concatenate([rotation, -rotation @ centres[..., None]], axis=-1)
    blank = np.zeros((1, *depth.shape))
    fields: dict[str, Any] = {
        "images": np.zeros((*blank.shape, 3)),
        "depth": depth[None],
        "object_ids": part_ids[None],
        "part_ids": part_ids[None],
        "dynamic_mask": moving[None],
        "scene_flow": np.zeros((*blank.shape, 3)),
        "camera_from_world": pose[None],
        "intrinsics": np.tile(np.eye(3), (1, S, 1, 1)),
        "world_from_part": np.tile(np.eye(3, 4), (1, S, 3, 1, 1)),
    }
    return SyntheticClip(**fields)


def test_hardness_by_hand():
    """A path of 3 and 4 round a right angle, whose corner is 2.4 off the chord; turns of 5 and 20 degrees."""
    depth = np.full((3, 10, 10), 10.0)
    part_ids = np.zeros((3, 10, 10), np.int32)
    depth[:, :2], part_ids[:, :2] = 2.0, 1
    depth[:, 2:4], part_ids[:, 2:4] = 2.4, 2  # too close behind part 1 to be another layer
    depth[:, 4, :1], part_ids[:, 4, :1] = 30.0, 3  # too few pixels to be one
    moving = part_ids == 1
    moving[0] = False
    clip = made_up(np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0]]), np.radians([0, 5, -15]), depth, part_ids, moving)
    found = hardness(clip)
    assert {name: float(value[0]) for name, value in found._asdict().items()} == pytest.approx(
        {"path": 0.7, "bend": 2.4 / 7, "turn": 20, "spread": 5, "layers": 2, "movers": 0.4 / 3}, rel=1e-6
    )
    assert not found.kept("static").any()  # two layers only
    hard = found._replace(layers=np.array([3.0]))
    assert hard.kept("static").all()
    assert hard.kept("dynamic").all()
    for name, value in {"path": 0.1, "bend": 0.05, "turn": 5.0, "spread": 1.5}.items():
        assert not hard._replace(**{name: np.array([value])}).kept("static").any()
    for movers in (0.01, 0.5):
        still = hard._replace(movers=np.array([movers]))
        assert still.kept("static").all()
        assert not still.kept("dynamic").any()


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
