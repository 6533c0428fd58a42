"""Devices of a run: parameters on every device, clips spread over the devices."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vggtjax.training.recipe import Recipe


class Placement(NamedTuple):
    """Shardings of replicated arrays, and of arrays with the batch as first axis."""

    whole: NamedSharding
    by_clip: NamedSharding


def placement(recipe: Recipe) -> Placement:
    """Return shardings over the largest number of this machine's devices that divides the batch of every phase.

    A CPU counts as one device unless XLA_FLAGS=--xla_force_host_platform_device_count=N splits it, which keeps more of
    its cores busy with small models.
    """
    devices = jax.local_devices()
    batches = math.gcd(*(phase.batch for phase in recipe.stages))
    count = max(n for n in range(1, len(devices) + 1) if batches % n == 0)
    mesh = Mesh(np.array(devices[:count]), ("clips",))
    return Placement(NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("clips")))
