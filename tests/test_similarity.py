"""Similarities: composed, inverted, and fitted with weights."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vggtjax.errors import InputError
from vggtjax.similarity import Similarity, umeyama_sim3

seeds = st.integers(0, 2**32 - 1)


def random_similarity(generator) -> Similarity:
    rotation = Rotation.random(rng=generator).as_matrix()
    return Similarity(float(np.exp(generator.normal())), rotation, 5 * generator.normal(size=3))


def test_after_by_hand():
    turned = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 0, 0]))
    moved = Similarity(1.0, np.eye(3), np.array([0.0, 3, 0]))
    point = np.array([[1.0, 0, 0]])
    assert np.allclose(moved.after(turned).apply(point), [[1, 5, 0]])  # (1, 0, 0) -> (1, 2, 0) -> (1, 5, 0)
    assert np.allclose(turned.after(moved).apply(point), [[-5, 2, 0]])  # -> (1, 3, 0) -> (-6 + 1, 2, 0)


@settings(max_examples=30)
@given(seed=seeds)
def test_a_whole_weight_is_as_many_points(seed):
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(6, 3))
    target = random_similarity(generator).apply(source) + 0.2 * generator.normal(size=(6, 3))
    times = np.array([1, 2, 3, 1, 1, 4])
    one = umeyama_sim3(source, target, weights=times.astype(float))
    other = umeyama_sim3(np.repeat(source, times, axis=0), np.repeat(target, times, axis=0))
    assert one.scale == pytest.approx(other.scale)
    assert np.allclose(one.rotation, other.rotation)
    assert np.allclose(one.translation, other.translation)
    with pytest.raises(InputError, match="6 weights for 7 points"):
        umeyama_sim3(np.eye(7, 3), np.eye(7, 3), weights=np.ones(6))
