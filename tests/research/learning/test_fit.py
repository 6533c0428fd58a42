"""Fits on simulated observations: what is known is found again, within its standard errors, at the best variance."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.shared.simulated import simulate
from vggtjax.errors import InputError
from vggtjax.method.fusion.family import Observations, fuse, log_precisions, paper_rule, parse_family
from vggtjax.research.learning.fit import FitClips, FitConfig, fit_fusion
from vggtjax.research.learning.objectives import joint_negative_log_likelihood, unit_factor

_TRUE = {"scale": [2.5, 1.5], "power": [0.6, 1.3], "correlation": 0.5}
TRUE = paper_rule() | {name: jnp.asarray(value) for name, value in _TRUE.items()}
FAMILY = ("scale", "power", "correlation")
STANDARD_ERRORS = {"scale": [0.0134, 0.0120], "power": [0.0082, 0.0082], "correlation": 0.0048}


def simulated(seed: int, clips: int, pixels: int = 500, noise: float = 1.0) -> FitClips:
    return FitClips(*simulate(jax.random.key(seed), TRUE, (clips, 1, 1, pixels), noise=noise))


fused = jax.jit(fuse)


@pytest.fixture(scope="module")
def recovered():
    """Return clips, and the fit to them that ought to find TRUE again."""
    clips = simulated(1, 6, 4000)
    config = FitConfig(FAMILY, "joint", steps=90, learning_rate=0.2, clips_at_once=6, patience=40)
    return clips, fit_fusion(clips, clips, config)


def test_variances_and_correlation_are_recovered(recovered):
    """Every one of five numbers within four standard errors, which the sandwich estimator gave for these clips."""
    _, fit = recovered
    for name, errors in STANDARD_ERRORS.items():
        assert (np.abs(np.asarray(fit.params[name]) - np.asarray(TRUE[name])) < 4 * np.asarray(errors)).all(), name


def test_the_fused_depth_attains_the_cramer_rao_bound(recovered):
    """Its mean squared error over the bound 1 / (Fisher information) is 1 within 2 %; the paper's rule is above."""
    (_, fit), fresh = recovered, simulated(2, 16, 20_000)
    rules = {"true": TRUE, "fitted": fit.params, "paper": paper_rule()}
    made = {name: jax.device_get(fused(rule, fresh.seen)) for name, rule in rules.items()}
    errors = {name: np.asarray(one.depth, np.float64) - fresh.truth for name, one in made.items()}
    bound = np.exp(-np.asarray(made["true"].log_precision, np.float64))
    ratio = {name: float((error**2 / bound).mean()) for name, error in errors.items()}
    assert ratio["true"] == pytest.approx(1, abs=0.01)
    assert ratio["fitted"] == pytest.approx(1, abs=0.02)
    assert ratio["paper"] > 1.05
    claimed = np.exp(np.asarray(made["fitted"].log_precision, np.float64))
    assert (errors["fitted"] ** 2 * claimed).mean() == pytest.approx(1, abs=0.03)  # it is the true precision


def test_the_joint_likelihood_is_the_bivariate_normals():
    clip = jax.tree.map(lambda x: x[0], simulated(4, 1, 50))
    claims = [np.exp(np.asarray(claim)).ravel() for claim in jax.jit(log_precisions)(TRUE, clip.seen)]
    found = float(jax.jit(joint_negative_log_likelihood)(TRUE, clip.seen, clip.truth))

    factor = float(jax.jit(unit_factor)(fused(TRUE, clip.seen), clip.truth, jnp.ones(clip.truth.shape, bool)))
    truth, *depths = (np.asarray(x).ravel() for x in (clip.truth, clip.seen.depth1, clip.seen.depth2))
    total = 0.0
    for i in range(50):
        variances = [1 / claim[i] for claim in claims]
        covariance = 0.5 * np.sqrt(variances[0] * variances[1])
        errors = [depth[i] - factor * truth[i] for depth in depths]
        matrix: Any = [[variances[0], covariance], [covariance, variances[1]]]
        total -= multivariate_normal.logpdf(errors, cov=matrix)
    assert found == pytest.approx(total / 50, rel=1e-4)


# The other fits have as many clips, pixels and steps each, and so share two programs.
STEPS = 200


def test_an_interrupted_fit_goes_on_exactly(tmp_path):
    clips, held_out = simulated(5, 8), simulated(6, 4)
    config = FitConfig(FAMILY, steps=STEPS, clips_at_once=4, patience=100)
    whole = fit_fusion(clips, held_out, config)
    path = tmp_path / "state.npz"

    def begun(config: FitConfig, until: int = 0) -> int:
        """Fit to a number of steps, at least once; return the number of the first evaluation."""
        seen = []

        def stop(done: int, total: int | None) -> None:
            assert total == STEPS
            seen.append(done)
            if done >= until:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            fit_fusion(clips, held_out, config, checkpoint=path, progress=stop)
        return seen[0]

    assert begun(config, 100) == 10
    state = path.read_bytes()
    resumed = fit_fusion(clips, held_out, config, checkpoint=path)
    assert jax.tree.all(jax.tree.map(np.array_equal, whole.params, resumed.params))
    assert np.array_equal(whole.losses, resumed.losses)
    path.write_bytes(state)
    assert begun(config) == 110
    assert begun(dataclasses.replace(config, seed=1)) == 10  # the state of another fit is not gone on from
    path.write_bytes(state[:100])  # a file that is not whole is not gone on from
    assert begun(config) == 10


def test_a_fit_ends_where_held_out_clips_gain_nothing():
    """Held-out errors are eight times as large: the fit to the others makes its claims too sure for them."""
    config = FitConfig(("scale",), steps=STEPS, patience=3, clips_at_once=4)
    fit = fit_fusion(simulated(7, 8), simulated(8, 4, noise=8.0), config)
    assert fit.stopped_early
    assert len(fit.losses) < 21
    assert fit.held_out_loss == pytest.approx(fit.losses[:, 2].min(), rel=1e-6)
    assert np.asarray(fit.params["power"]).tolist() == [1, 1]


@pytest.mark.proof
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
    fit = fit_fusion(fitted, held_out, FitConfig(("gate",), steps=100, learning_rate=0.1, patience=100))
    best = 0.3**2 / (0.3**2 + np.where(bad, 1.0, 0.05)[4:] ** 2)  # the weights that are right
    found = np.asarray(fuse(fit.params, held_out.seen).weight)
    assert np.abs(found - best).mean() < 0.4 * np.abs(0.5 - best).mean()


def test_a_soft_mask_is_recovered():
    """Depths that were blended by a known offset and temperature: the fit finds both again, and not a hard mask."""
    generator = np.random.default_rng(0)
    shape = (12, 1, 1, 500)
    margin = jnp.asarray(generator.uniform(-0.5, 0.5, shape), jnp.float32)
    d1, d2 = (jnp.asarray(generator.uniform(1, 3, shape), jnp.float32) for _ in range(2))
    zero = jnp.zeros(shape)
    seen = Observations(d1, zero, d2, zero, (margin >= 0).astype(jnp.float32), margin, jnp.zeros((*shape, 4)))
    true = paper_rule() | {"offset": jnp.asarray(0.1), "temperature": jnp.asarray(0.05)}
    truth = fused(true, seen).depth + 0.02 * jnp.asarray(generator.normal(size=shape), jnp.float32)
    family = parse_family("scale+offset+temperature")
    config = FitConfig(family, steps=STEPS, learning_rate=0.2, patience=60, clips_at_once=4)
    clips = FitClips(seen, truth)
    fit = fit_fusion(clips.taken(np.arange(8)), clips.taken(np.arange(8, 12)), config)
    assert float(fit.params["offset"]) == pytest.approx(0.1, abs=0.01)
    assert float(fit.params["temperature"]) == pytest.approx(0.05, rel=0.15)


def test_bad_settings_are_one_sentence():
    cases: Any = (
        ({"objective": "least squares"}, "objective is 'least squares'"),
        ({"decay": 1.5}, "decay is 1.5"),
        ({"family": "calibrated"}, "family is 'calibrated'; expected a list"),
        ({"family": ("scale", "nothing")}, "family has 'nothing'"),
        ({"family": ("temperature",), "objective": "joint"}, "does not see soft masks"),
    )
    for change, sentence in cases:
        with pytest.raises(InputError, match=sentence):
            FitConfig(**change)


def test_bad_fits_are_one_sentence():
    clips, held_out = simulated(0, 8), simulated(0, 4)
    with pytest.raises(InputError, match="nothing to fit"):
        fit_fusion(clips, held_out, FitConfig(()))
    broken = clips._replace(seen=clips.seen._replace(depth1=jnp.full_like(clips.truth, jnp.nan)))
    with pytest.raises(InputError, match="expected finite"):
        fit_fusion(broken, held_out, FitConfig(steps=STEPS))
    with pytest.raises(InputError, match="compares frames"):
        fit_fusion(clips, held_out, FitConfig(objective="photometric"))
