import subprocess
import sys

import pytest

from vggtjax.errors import InputError
from vggtjax.results.saving import Saving


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"confidence_percentile": -1}, "confidence_percentile is -1; expected a number of at least 0 and less"),
        ({"confidence_percentile": float("nan")}, "confidence_percentile is nan"),
        ({"resolution": "full"}, "resolution is 'full'; expected one of"),
        ({"format": "cut3r"}, "format is 'cut3r'; expected one of"),
    ],
)
def test_values_out_of_range(changes, message):
    with pytest.raises(InputError, match=message):
        Saving().changed(**changes)


def test_single_values_change():
    saving = Saving(confidence_percentile=5)
    assert saving.changed(layout="vggt4d", resolution="original") == Saving(5, "original", "vggt4d")


def test_the_command_line_can_import_it_quickly():
    loaded = "import sys, vggtjax.results.saving; sys.exit(any(name in sys.modules for name in ('numpy', 'jax')))"
    assert subprocess.run([sys.executable, "-c", loaded], check=False).returncode == 0
