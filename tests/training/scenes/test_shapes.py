import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.shared.generated import gauge
from vggtjax.training.scenes.shapes import SHAPES, box_normal, cylinder_normal, ellipsoid_normal

SIZE = (1.0, 2.0, 3.0)


def interval(shape, origin, direction, size):
    """Where one ray enters and leaves one shape."""
    origin, direction = (jnp.asarray(v, jnp.float32)[None, :, None] for v in (origin, direction))
    near, far = SHAPES[shape][0](origin, direction, jnp.asarray(size, jnp.float32)[None])
    assert near.shape == far.shape == (1, 1)
    return float(near[0, 0]), float(far[0, 0])


def test_normals_by_hand():
    size = jnp.asarray(SIZE)[:, None] * jnp.ones((1, 4))
    points = jnp.asarray([(1, 0.5, 0.5), (-0.2, -2, 1), (0, 1.9, -3), (-1, 1.9, 2.9)]).T
    np.testing.assert_array_equal(box_normal(points, size).T, [(1, 0, 0), (0, -1, 0), (0, 0, -1), (-1, 0, 0)])

    size = jnp.asarray([2.0, 1, 1])[:, None] * jnp.ones((1, 3))
    points = jnp.asarray([(2, 0, 0), (0, 0, -1), (2**0.5, 0.5**0.5, 0)]).T  # the last: gradient (x / 4, y)
    expected = [(1, 0, 0), (0, 0, -1), (0.2**0.5, 0.8**0.5, 0)]
    np.testing.assert_allclose(ellipsoid_normal(points, size).T, expected, atol=1e-6)

    size = jnp.asarray([2.0, 1, 1])[:, None] * jnp.ones((1, 4))
    points = jnp.asarray([(0.1, 1, 0.1), (-1, -1, 0.5), (-2, 0.3, 0), (2**0.5, -0.9, 0.5**0.5)]).T
    expected = [(0, 1, 0), (0, -1, 0), (-1, 0, 0), (0.2**0.5, 0, 0.8**0.5)]
    np.testing.assert_allclose(cylinder_normal(points, size).T, expected, atol=1e-6)


coordinate = st.floats(-1, 1)
vector = st.tuples(coordinate, coordinate, coordinate)
extent = st.floats(0.2, 2)


@pytest.mark.parametrize("shape", list(SHAPES))
@settings(max_examples=40)
@given(start=vector, through=vector, size=st.tuples(extent, extent, extent))
def test_a_ray_enters_and_leaves_on_the_surface(shape, start, through, size):
    origin, size = 8 * np.array(start), np.array(size)
    direction = 2 * np.array(through) * size - origin  # towards the shape or past it
    assume(np.linalg.norm(direction) > 0.5)
    near, far = interval(shape, origin, direction, size)
    along = np.linspace(-4, 6, 2001)
    outward = gauge(shape, origin + along[:, None] * direction, size)
    if not near < far:
        assert outward.min() > 1 - 2e-2  # a ray that just touches may be called a miss
        return
    points = origin + np.array([[near], [(near + far) / 2], [far]]) * direction
    at = gauge(shape, points, size)
    assert at[[0, 2]] == pytest.approx(1, abs=2e-3)
    assert at[1] < 1 + 2e-3
    clear = (np.abs(along - near) > 0.02) & (np.abs(along - far) > 0.02) & (np.abs(outward - 1) > 1e-2)
    np.testing.assert_array_equal((outward < 1)[clear], ((near < along) & (along < far))[clear])
    assume((far - near) * np.linalg.norm(direction) > 0.1)
    normal = np.asarray(SHAPES[shape][1](jnp.asarray(points[[0]].T), jnp.asarray(size[:, None])))[:, 0]
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
    assert normal @ direction < 0.05 * np.linalg.norm(direction)  # faces the ray, but at an edge it may be the other's
