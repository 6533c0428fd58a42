import math

import pytest

from vggtjax.errors import InputError
from vggtjax.training.metrics import Averages, read_metrics, write_metrics


def row(step, **metrics):
    return {"step": step, "stage": 0, "seconds": step / 3, "samples": 2 * step, **metrics}


def test_averages():
    averages = Averages()
    averages.add({"loss": 1.0, "depth": 4.0})
    averages.add({"loss": math.nan, "skipped": 1.0}, finite_only=True)
    averages.add({"loss": 2.0})
    assert averages.take() == {"loss": 1.5, "depth": 4.0, "skipped": 1.0}
    averages.add({"loss": math.inf})
    assert averages.take() == {"loss": math.inf}


def test_rows_of_different_metrics_share_a_table(tmp_path):
    path = tmp_path / "metrics.csv"
    rows = [row(1, loss=0.5), row(2, loss=0.25, match=1.0), row(3, match=0.5)]
    write_metrics(path, rows)
    assert path.read_text().splitlines() == [
        "step,stage,seconds,samples,loss,match",
        f"1,0,{1 / 3!r},2,0.5,",
        f"2,0,{2 / 3!r},4,0.25,1.0",
        "3,0,1.0,6,,0.5",
    ]
    assert read_metrics(path) == rows


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "does not begin with the columns"),
        (b"\xff\xfe\n", "is no CSV file"),
        (b"step,stage,seconds,samples\n1,2,x,4\n2,0,1,4\n", "line 2"),
    ],
)
def test_other_files_are_refused(tmp_path, content, says):
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_metrics(path)
    with pytest.raises(InputError, match="cannot read"):
        read_metrics(tmp_path / "none.csv")
