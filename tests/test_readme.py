"""The Python of the README runs as it stands; links lead somewhere."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.moving_ball import moving_ball

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.filterwarnings("ignore:the field of view")
def test_the_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("frames").mkdir()
    for i, frame in enumerate(moving_ball(6)):
        Image.fromarray((255 * frame).astype(np.uint8)).save(f"frames/{i}.png")
    blocks = [part.split("```")[0] for part in README.read_text().split("```python\n")[1:]]
    assert len(blocks) == 4
    names = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    assert (names["again"].depth == names["result"].depth).all()
    assert set(names["ablation"]) == {"vggt", "pose-decoupling", "hard-replacement", "4dvggt-d"}
    assert names["ablation"]["4dvggt-d"].depth.shape == names["images"].shape[:4]
    assert names["fused"].depth.shape == names["images"].shape[:4]
    assert names["slopes"]["correlation"] != 0


def test_the_python_of_the_docs_runs():
    """Pages that show Python; gradients through the embedded model are part of it."""
    page = (README.parent / "docs" / "research-notes" / "learned-fusion.md").read_text(encoding="utf-8")
    (block,) = (part.split("```")[0] for part in page.split("```python\n")[1:])
    names: dict = {}
    exec(compile(block, "docs/research-notes/learned-fusion.md", "exec"), names)
    assert names["by_masking"].temperature != 0
    assert all(np.isfinite(leaf).all() for leaf in (*names["by_masking"], *names["by_rule"].values()))


@pytest.mark.parametrize("page", [README, *sorted((README.parent / "docs").rglob("*.md"))], ids=lambda page: page.name)
def test_every_link_to_a_file_leads_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing
