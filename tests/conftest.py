"""What every test shares: strict jax settings, the tiny model of the golden files, real footage where it is present."""

import gc
import hashlib
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from hypothesis import settings

from tests.shared.golden import GOLDEN, golden_config, golden_params
from tests.shared.tiny import save_tiny_demo
from vggtjax import VGGTConfig
from vggtjax.pipeline.pretrained import embedded

CLIPS = Path(__file__).parents[2] / "shared" / "clips"
_MAPPINGS = 40_000  # Linux allows 65530; so many programs take 5 GB
_CACHE_BYTES = 2**31  # a larger cache of compiled programs is emptied; a whole run fills a tenth of it

gc.set_threshold(50_000, 50, 100)  # tracing makes many small objects, which are not garbage
jax.config.update("jax_numpy_rank_promotion", "raise")
settings.register_profile("untimed", deadline=None)  # a busy machine is no fault of the code
settings.load_profile("untimed")


def pytest_addoption(parser):
    parser.addoption("--hasty", action="store_true", help="compile programs quickly rather than well, and run sooner")


def pytest_configure(config):
    """Set XLA's flags and the shared cache before anything is compiled, which takes most of the time of the tests."""
    if config.getoption("--hasty"):
        flags = ["--xla_backend_optimization_level=0"]
        if jax.__version_info__ < (0, 11):  # XLA ends a process for a flag that it does not know
            flags.append("--xla_cpu_use_fusion_emitters=false")
        given = os.environ.get("XLA_FLAGS", "").split()  # a worker's has them already
        os.environ["XLA_FLAGS"] = " ".join([*given, *(flag for flag in flags if flag not in given)])
    _share_compiled_programs(config)


def pytest_report_header(config) -> str:
    return f"compiled programs: {os.environ.get('JAX_COMPILATION_CACHE_DIR', 'not cached')}"


def _share_compiled_programs(config) -> None:
    """Let all workers, their child processes and later runs share one cache of compiled programs.

    It lies in pytest's own cache, so `--cache-clear` empties it and `-p no:cacheprovider` does without. A cache that
    cannot be written is not used; jax compiles anew what it cannot read.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or not hasattr(config, "cache"):
        return
    try:
        folder = config.cache.mkdir(f"compiled-{_processor()}")
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"it can be written")
        if not hasattr(config, "workerinput") and sum(file.stat().st_size for file in folder.iterdir()) > _CACHE_BYTES:
            shutil.rmtree(folder)
    except OSError:
        return
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)  # for child processes


def _processor() -> str:
    """Return a digest of the processor's features: programs compiled for one may not run on another."""
    features = Path("/proc/cpuinfo")
    text = features.read_text() if features.is_file() else ""
    flags = next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), platform.processor())
    return hashlib.sha256(flags.encode()).hexdigest()[:16]


@pytest.fixture(scope="session", autouse=True)
def short_films():
    """Let the film of a report have 2 of its 24 pictures, which take most of the time of a result that is saved."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vggtjax.results.thumbnail._FRAMES", 2)
        yield


@pytest.fixture
def empty_reports(monkeypatch):
    """Leave the report of a saved result empty: it takes a third of the time, and has tests of its own."""
    monkeypatch.setattr("vggtjax.results.export.report_page", lambda *_: "")


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
def tiny_demo_file(tmp_path_factory) -> Path:
    return save_tiny_demo(tmp_path_factory.mktemp("model") / "model.safetensors")


@pytest.fixture(scope="module")
def tiny_demo(tiny_demo_file) -> Iterator[Path]:
    """Let the model "demo" be a tiny network for the tests of a module, which do not depend on what it has learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(embedded, "MODEL", tiny_demo_file)
        yield tiny_demo_file


@pytest.fixture(scope="session")
def clips() -> Path:
    """Folder of real footage; tests that need it are skipped where it is absent."""
    if not CLIPS.is_dir():
        pytest.skip("real footage (shared/clips beside the repository) is not here")
    return CLIPS
