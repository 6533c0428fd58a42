"""Fits on simulated observations: what is known is found again, within its standard errors, at the best variance."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.simulated import simulate
from vggtjax.errors import InputError
from vggtjax.learning.fit import FitClips, FitConfig, fit_fusion
from vggtjax.learning.objectives import joint_negative_log_likelihood, unit_factor
from vggtjax.method.fusion_family import Observations, fuse, identity, log_precisions, parse_family
from vggtjax.storage.arrays import read_arrays, write_arrays

TRUE = identity() | {
    "scale": jnp.asarray([2.5, 1.5]),
    "power": jnp.asarray([0.6, 1.3]),
    "correlation": jnp.asarray(0.5),
}
FAMILY = ("scale", "power", "correlation")
STANDARD_ERRORS = {"scale": [0.0095, 0.0085], "power": [0.0058, 0.0058], "correlation": 0.0034}


def simulated(seed: int, clips: int = 48, pixels: int = 1000, truth=TRUE) -> FitClips:
    seen, depth = simulate(jax.random.key(seed), truth, (clips, 1, 1, pixels))
    return FitClips(seen, depth)


@pytest.fixture(scope="module")
def recovered():
    """Return clips, and the fit to them that ought to find TRUE again."""
    clips = simulated(1)
    config = FitConfig(FAMILY, "joint", steps=120, learning_rate=0.15, clips_at_once=48, patience=40)
    return clips, fit_fusion(clips, clips, config)


def test_variances_and_correlation_are_recovered(recovered):
    """Every one of five numbers within four standard errors, which the sandwich estimator gave for these clips."""
    _, fit = recovered
    for name, errors in STANDARD_ERRORS.items():
        assert (np.abs(np.asarray(fit.params[name]) - np.asarray(TRUE[name])) < 4 * np.asarray(errors)).all(), name


def test_the_fused_depth_attains_the_cramer_rao_bound(recovered):
    """Its mean squared error over the bound 1 / (Fisher information) is 1 within 2 %; the paper's rule is above."""
    (_, fit), fresh = recovered, simulated(2, 16, 20_000)
    bound = np.exp(-np.asarray(fuse(TRUE, fresh.seen).log_precision, np.float64))

    def ratio(params) -> float:
        error = np.asarray(fuse(params, fresh.seen).depth - fresh.truth, np.float64)
        return float((error**2 / bound).mean())

    assert ratio(TRUE) == pytest.approx(1, abs=0.01)
    assert ratio(fit.params) == pytest.approx(1, abs=0.02)
    assert ratio(identity()) > 1.05
    claimed = np.asarray(fuse(fit.params, fresh.seen).log_precision, np.float64)
    error = np.asarray(fuse(fit.params, fresh.seen).depth - fresh.truth, np.float64)
    assert (error**2 * np.exp(claimed)).mean() == pytest.approx(1, abs=0.03)  # the claimed precision is the true one


def test_the_joint_likelihood_is_the_bivariate_normals():

    clips = simulated(4, 1, 50)
    clip = jax.tree.map(lambda x: x[0], clips)
    claims = [np.exp(np.asarray(claim)).ravel() for claim in log_precisions(TRUE, clip.seen)]
    found = float(joint_negative_log_likelihood(TRUE, clip.seen, clip.truth))

    factor = float(unit_factor(fuse(TRUE, clip.seen), clip.truth, jnp.ones(clip.truth.shape, bool)))
    truth, *depths = (np.asarray(x).ravel() for x in (clip.truth, clip.seen.depth1, clip.seen.depth2))
    total = 0.0
    for i in range(50):
        variances = [1 / claim[i] for claim in claims]
        covariance = 0.5 * np.sqrt(variances[0] * variances[1])
        errors = [depth[i] - factor * truth[i] for depth in depths]
        matrix: Any = [[variances[0], covariance], [covariance, variances[1]]]
        total -= multivariate_normal.logpdf(errors, cov=matrix)
    assert found == pytest.approx(total / 50, rel=1e-4)


def test_an_interrupted_fit_goes_on_exactly(tmp_path):
    clips, held_out = simulated(5, 8, 200), simulated(6, 4, 200)
    config = FitConfig(FAMILY, steps=60, clips_at_once=4, patience=100)
    whole = fit_fusion(clips, held_out, config)
    path = tmp_path / "state.npz"

    def stop(done: int, total: int | None) -> None:
        assert total == 60
        if done == 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_fusion(clips, held_out, config, checkpoint=path, progress=stop)
    resumed = fit_fusion(clips, held_out, config, checkpoint=path)
    assert jax.tree.all(jax.tree.map(np.array_equal, whole.params, resumed.params))
    assert np.array_equal(whole.losses, resumed.losses)
    other = fit_fusion(clips, held_out, FitConfig(FAMILY, steps=20, clips_at_once=4, seed=1), checkpoint=path)
    assert len(other.losses) == 3  # the state of another fit is not gone on from
    path.write_bytes(path.read_bytes()[:100])  # a file that is not whole is not gone on from
    assert np.array_equal(fit_fusion(clips, held_out, config, checkpoint=path).losses, whole.losses)
    arrays = read_arrays(path)  # of the ended fit, whose step is 60
    *_, step = [name for name, array in arrays.items() if array.shape == () and array == 60]  # others: the optimiser's
    for wrong in (2**31 - 1, -10, 61):
        write_arrays(path, arrays | {step: np.array(wrong, np.int32)})
        assert np.array_equal(fit_fusion(clips, held_out, config, checkpoint=path).losses, whole.losses)


def test_a_fit_ends_where_held_out_clips_gain_nothing():
    """Held-out errors are eight times as large: the fit to the others makes its claims too sure for them."""
    clips = simulated(7, 8, 200)
    seen, depth = simulate(jax.random.key(8), TRUE, (4, 1, 1, 200), noise=8.0)
    config = FitConfig(("scale",), steps=400, patience=3, clips_at_once=4)
    fit = fit_fusion(clips, FitClips(seen, depth), config)
    assert fit.stopped_early
    assert len(fit.losses) < 41
    assert fit.held_out_loss == pytest.approx(fit.losses[:, 2].min(), rel=1e-6)
    assert np.asarray(fit.params["power"]).tolist() == [1, 1]


def test_a_gate_learns_what_the_table_cannot():
    """Pass 2 is bad where one of two features is high and the other low: no sum of a slope for each says so."""
    generator = np.random.default_rng(0)
    shape = (6, 2, 16, 16)
    depth = generator.uniform(1, 3, shape)
    features = generator.integers(0, 2, (6, 2, 2, 2, 4)).astype(float).repeat(8, axis=2).repeat(8, axis=3)
    bad = features[..., 0] != features[..., 2]
    d2 = depth + generator.normal(size=shape) * np.where(bad, 1.0, 0.05)
    d1 = depth + generator.normal(size=shape) * 0.3
    zero = np.zeros(shape)
    seen = Observations(*(jnp.asarray(x, jnp.float32) for x in (d1, zero, d2, zero, zero, zero - 1, features)))
    clips = FitClips(seen, jnp.asarray(depth, jnp.float32))
    fitted, held_out = clips.taken(np.arange(4)), clips.taken(np.arange(4, 6))
    fit = fit_fusion(fitted, held_out, FitConfig(("gate",), steps=200, patience=100))
    best = 0.3**2 / (0.3**2 + np.where(bad, 1.0, 0.05)[4:] ** 2)  # the weights that are right
    found = np.asarray(fuse(fit.params, held_out.seen).weight)
    assert np.abs(found - best).mean() < 0.4 * np.abs(0.5 - best).mean()


def test_a_soft_mask_is_recovered():
    """Depths that were blended by a known offset and temperature: the fit finds both again, and not a hard mask."""
    generator = np.random.default_rng(0)
    shape = (8, 1, 1, 2000)
    margin = jnp.asarray(generator.uniform(-0.5, 0.5, shape), jnp.float32)
    d1, d2 = (jnp.asarray(generator.uniform(1, 3, shape), jnp.float32) for _ in range(2))
    zero = jnp.zeros(shape)
    seen = Observations(d1, zero, d2, zero, (margin >= 0).astype(jnp.float32), margin, jnp.zeros((*shape, 4)))
    true = identity() | {"offset": jnp.asarray(0.1), "temperature": jnp.asarray(0.05)}
    truth = fuse(true, seen).depth + 0.02 * jnp.asarray(generator.normal(size=shape), jnp.float32)
    config = FitConfig(parse_family("scale+offset+temperature"), steps=200, learning_rate=0.2, patience=60)
    fit = fit_fusion(FitClips(seen, truth), FitClips(seen, truth), config)
    assert float(fit.params["offset"]) == pytest.approx(0.1, abs=0.01)
    assert float(fit.params["temperature"]) == pytest.approx(0.05, rel=0.15)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"objective": "least squares"}, "objective is 'least squares'"),
        ({"decay": 1.5}, "decay is 1.5"),
        ({"family": "calibrated"}, "family is 'calibrated'; expected a list"),
        ({"family": ("scale", "nothing")}, "family has 'nothing'"),
        ({"family": ("temperature",), "objective": "joint"}, "does not see soft masks"),
    ],
)
def test_bad_settings_are_one_sentence(change, sentence):
    with pytest.raises(InputError, match=sentence):
        FitConfig(**change)


def test_bad_fits_are_one_sentence():
    clips = simulated(0, 2, 10)
    with pytest.raises(InputError, match="nothing to fit"):
        fit_fusion(clips, clips, FitConfig(()))
    broken = clips._replace(seen=clips.seen._replace(depth1=jnp.full_like(clips.truth, jnp.nan)))
    with pytest.raises(InputError, match="expected finite"):
        fit_fusion(broken, clips, FitConfig())
    with pytest.raises(InputError, match="compares frames"):
        fit_fusion(clips, clips, FitConfig(objective="photometric"))
