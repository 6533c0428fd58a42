"""What every reader of PyTorch weights gets: torch, and seeded weights of the tiny model's layout."""

import json

import pytest

from tests.shared.seeded import seeded_state_dict


@pytest.fixture(scope="session")
def torch():
    return pytest.importorskip("torch")  # where it is used: it takes seconds to import


@pytest.fixture(scope="session")
def shapes(golden):
    return json.loads((golden / "shapes.json").read_text())


@pytest.fixture(scope="session")
def seeded(shapes):
    return seeded_state_dict(shapes)


@pytest.fixture
def state_dict(seeded):
    """A dict of its own for each test."""
    return dict(seeded)
