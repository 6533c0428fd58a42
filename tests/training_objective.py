"""Objectives of training runs in tests; worker processes import this file alone."""

import jax.numpy as jnp


def objective(trained, batch, config, weights, *, compute_dtype, remat):
    """Pull the probes' colour and the camera head's pose to the clips."""
    colour = batch.mean(axis=(1, 2, 3))
    found = colour @ trained["probes"]["mean"]["kernel"] + trained["probes"]["mean"]["bias"][None]
    colour_loss = jnp.mean(jnp.sum((found - colour) ** 2, axis=-1))
    pose = trained["model"]["camera_head"]["pose_branch"]["fc2"]
    distance = pose["kernel"][None] - colour.mean(axis=-1)[:, None, None]
    pose_loss = jnp.mean(distance**2) + jnp.mean(pose["bias"] ** 2)
    loss = weights.translation * colour_loss + weights.rotation * pose_loss
    return loss, {"colour_loss": colour_loss, "pose_loss": pose_loss}


def broken(trained, batch, config, weights, **_):
    """Fail as an objective with a mistake does."""
    raise ValueError("no such loss")
