"""Terms of the training objective that can be computed by hand."""

import jax.numpy as jnp
import numpy as np

from vggtjax.training.objective import _flow_moments


def test_moments_of_the_flow_by_hand():
    place = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], np.float32)[None, None]
    flow = np.zeros((1, 2, 4, 2), np.float32)
    flow[0, 1] = [[0.2, 0.0], [0.4, 0.0], [0.2, -0.1], [9.0, 9.0]]
    depth_inverse = np.array([1.0, 2.0, 10.0, 1.0], np.float32)  # 10 counts as 4
    seen = np.array([True, True, True, False])  # the flow of what is not seen does not count
    made, known = _flow_moments(
        jnp.asarray(flow),
        jnp.asarray(place),
        jnp.broadcast_to(jnp.asarray(depth_inverse), (1, 2, 4)),
        jnp.broadcast_to(jnp.asarray(seen)[None, None, :, None], (1, 2, 4, 1)),
    )
    expected = [
        [0.8 / 3, -0.1 / 3],  # flow
        [(0.2 + 0.8 + 0.8) / 3, -0.4 / 3],  # times inverse depth
        [(-0.1 + 0.2 - 0.1) / 3, 0.05 / 3],  # times x
        [(-0.1 - 0.2 + 0.1) / 3, -0.05 / 3],  # times y
        [7 / 3, 21 / 3],  # inverse depth and its square
    ]
    assert np.allclose(made[0, 1], np.ravel(expected), atol=1e-6)
    assert np.allclose(made[0, 0, :8], 0)
    assert known.all()


def test_moments_of_too_few_patches_are_not_known():
    seen = np.zeros((1, 1, 4, 1), bool)
    seen[0, 0, :2] = True
    zeros = jnp.zeros((1, 1, 4, 2))
    made, known = _flow_moments(zeros, zeros, jnp.ones((1, 1, 4)), jnp.asarray(seen))
    assert not known.any()
    assert np.isfinite(made).all()
