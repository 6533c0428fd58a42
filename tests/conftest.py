"""What every test shares: strict jax settings, the tiny model of the golden files, real footage where it is present."""

import os
from pathlib import Path

import jax
import pytest
from hypothesis import settings

from testing.golden import GOLDEN, golden_config, golden_params
from vggtjax import VGGTConfig

CLIPS = Path(__file__).parents[2] / "shared" / "clips"
_MAPPINGS = 2**14  # Linux allows 65530

jax.config.update("jax_numpy_rank_promotion", "raise")
settings.register_profile("untimed", deadline=None)  # a busy machine is no fault of the code
settings.load_profile("untimed")


def pytest_addoption(parser):
    parser.addoption("--hasty", action="store_true", help="compile programs quickly rather than well, and run sooner")


def pytest_configure(config):
    """Compiling is two thirds of the time that the tests take."""
    if config.getoption("--hasty"):
        flags = ["--xla_backend_optimization_level=0"]
        if jax.__version_info__ < (0, 11):  # XLA ends a process for a flag that it does not know
            flags.append("--xla_cpu_use_fusion_emitters=false")
        given = os.environ.get("XLA_FLAGS", "").split()  # a worker's has them already
        os.environ["XLA_FLAGS"] = " ".join([*given, *(flag for flag in flags if flag not in given)])


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Forget compiled programs before the kernel's limit on a process's mappings, of which each program takes some."""
    yield
    maps = Path("/proc/self/maps")
    if maps.is_file() and maps.read_bytes().count(b"\n") > _MAPPINGS:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def same_folder():
    """Refuse a test that leaves the process in another folder, where the tests after it would run."""
    before = Path.cwd()
    yield
    assert Path.cwd() == before


@pytest.fixture(scope="session")
def golden() -> Path:
    """Folder of numbers that the public PyTorch code computed for seeded weights."""
    return GOLDEN


@pytest.fixture(scope="session")
def config() -> VGGTConfig:
    """The tiny model: 24 pairs like VGGT-1B, so that every layer index is a real one."""
    return golden_config()


@pytest.fixture(scope="session")
def seeded_params():
    """Return the tiny model's parameters for a seed."""
    return golden_params


@pytest.fixture(scope="session")
def params(seeded_params):
    return seeded_params(7)


@pytest.fixture(scope="session")
def clips() -> Path:
    """Folder of real footage; tests that need it are skipped where it is absent."""
    if not CLIPS.is_dir():
        pytest.skip("real footage (shared/clips beside the repository) is not here")
    return CLIPS
