"""Where a training run computes."""

import subprocess
import sys
from pathlib import Path

CODE = """
import dataclasses, jax, numpy as np
from tests.training_runs import RECIPE
from vggtjax.training.devices import placement
doubled = tuple(dataclasses.replace(stage, batch=2 * stage.batch) for stage in RECIPE.stages)
where = placement(dataclasses.replace(RECIPE, stages=doubled))
print(len(placement(RECIPE).whole.device_set), len(where.whole.mesh.devices))
print(jax.device_put(np.ones((4, 3)), where.by_clip).addressable_shards[0].data.shape)
"""


def test_the_most_devices_that_divide_every_batch():
    """The phases have batches of 2 and 1: one device. With batches of 4 and 2, two of three."""
    environment = {"XLA_FLAGS": "--xla_force_host_platform_device_count=3", "PATH": ""}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    made = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert made.stdout.split("\n")[:2] == ["1 2", "(2, 3)"]
