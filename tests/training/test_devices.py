"""Where a training run computes."""

import dataclasses
import subprocess
import sys
from pathlib import Path

from tests.training_runs import RECIPE
from vggtjax.training.devices import placement

ROOT = Path(__file__).parents[2]
CODE = """
import jax, numpy as np
from tests.training_runs import RECIPE
from vggtjax.training.devices import placement
where = placement(RECIPE)
print(len(where.whole.mesh.devices), jax.device_put(np.ones((4, 3)), where.by_clip).addressable_shards[0].data.shape)
"""


def test_one_device():
    where = placement(RECIPE)
    assert len(where.whole.device_set) == 1


def test_the_most_devices_that_divide_every_batch():
    """The phases have batches of 2 and 1: one device. With batches of 4 and 2, two of three."""
    code = CODE.replace("placement(RECIPE)", "placement(dataclasses.replace(RECIPE, stages=STAGES))")
    stages = "import dataclasses\nSTAGES = tuple(dataclasses.replace(s, batch=2 * s.batch) for s in RECIPE.stages)\n"
    code = code.replace("where =", stages + "where =", 1)
    made = subprocess.run(
        [sys.executable, "-c", code],
        env={"XLA_FLAGS": "--xla_force_host_platform_device_count=3", "PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    assert made.stdout.split("\n")[0] == "2 (2, 3)"


def test_every_phase_counts():
    alone = dataclasses.replace(RECIPE, stages=RECIPE.stages[:1])
    assert placement(alone).whole.mesh.axis_names == ("clips",)
