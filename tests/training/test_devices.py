"""Where a training run computes."""

import subprocess
import sys
from pathlib import Path

CODE = """
import dataclasses, jax, numpy as np
from tests.shared.training_runs import RECIPE
from vggtjax.training.devices import placement
def placed(*sizes):
    stages = tuple(dataclasses.replace(stage, batch=size) for stage, size in zip(RECIPE.stages, sizes))
    return placement(dataclasses.replace(RECIPE, stages=stages))

where = placed(4, 2)
print(len(placed(2, 1).whole.device_set), len(where.whole.mesh.devices))
print(jax.device_put(np.ones((4, 3)), where.by_clip).addressable_shards[0].data.shape)
"""


def test_the_most_devices_that_divide_every_batch():
    """One for batches of 2 and 1; two of three for batches of 4 and 2."""
    environment = {"XLA_FLAGS": "--xla_force_host_platform_device_count=3", "PATH": ""}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    made = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert made.stdout.split("\n")[:2] == ["1 2", "(2, 3)"]
