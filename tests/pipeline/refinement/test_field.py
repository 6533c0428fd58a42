import numpy as np

from vggtjax.pipeline.refinement.field import FieldPrior, Measured, at_pixels, fit_field


def measured(function, count, frame=0, seed=0, precision=400.0):
    place = np.random.default_rng(seed).uniform(0, 1, (count, 2))
    return Measured(np.full(count, frame), place, function(*place.T), np.full(count, precision))


def test_a_smooth_field_is_found_and_frames_without_measurements_have_none():
    def bump(x, y):
        return 0.3 * np.sin(3 * x) * (1 - y)

    fields = fit_field(measured(bump, 600, frame=1), 3, (48, 64), FieldPrior(offset=1.0))
    rows, columns = (np.arange(48) + 0.5) / 48, (np.arange(64) + 0.5) / 64
    assert fields.shape == (3, 9, 12)
    assert not fields[[0, 2]].any()
    assert np.abs(at_pixels(fields[1], (48, 64)) - bump(columns[None], rows[:, None])).max() < 0.04


def test_it_solves_the_normal_equations_of_dense_matrices():
    prior = FieldPrior(step=0.1, offset=0.2, robust=1e6, together=1e6, nodes=4)
    found = measured(lambda x, y: x - y**2, 50)
    weights = np.maximum(0, 1 - np.abs(3 * found.place[..., None] - np.arange(4)))  # [N, 2, 4], of u and v
    A = np.einsum("nj,ni->nij", *weights.transpose(1, 0, 2)).reshape(-1, 16)
    number = np.arange(16).reshape(4, 4)
    H = np.eye(16) / prior.offset**2
    edges = [(number[1:], number[:-1]), (number[:, 1:], number[:, :-1])]
    for a, b in [pair for each in edges for pair in zip(each[0].ravel(), each[1].ravel(), strict=True)]:
        step = np.eye(16)[a] - np.eye(16)[b]
        H += np.outer(step, step) / (prior.step**2 * 11 / 3)
    expected = np.linalg.solve(H + 400 * A.T @ A, 400 * A.T @ found.log_ratio).reshape(4, 4)
    np.testing.assert_allclose(fit_field(found, 1, (10, 10), prior)[0], expected, atol=1e-6)


def test_a_quarter_of_wrong_measurements_hardly_moves_it():
    right = measured(lambda x, y: 0 * x + 0.1, 300)
    wrong = np.arange(300) % 4 == 0
    mixed = right._replace(log_ratio=np.where(wrong, 1.5, right.log_ratio))
    fields = fit_field(mixed, 1, (20, 20), FieldPrior(robust=0.1))
    assert np.abs(fields - 0.1).max() < 0.03
