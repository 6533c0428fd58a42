"""What code runs here: versions, and a digest of this package's sources. Does not import jax before it is needed."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def _package_digest() -> str:
    """Return a digest of all Python files of this package."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()


def installed_version(package: str) -> str | None:
    """Return the version of a package; None for one that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


@cache
def running_versions() -> str:
    """Return in words which code runs in this process: equal words, equal results."""
    from vggtjax import __version__

    return f"vggtjax {__version__} (sources {_package_digest()[:8]}) with jax {version('jax')}"


@cache
def source_digest() -> str:
    """Return versions, platform, cores, and a digest of all sources: what results depend on besides arguments."""
    from vggtjax.storage.backend import backend
    from vggtjax.storage.process import core_count

    versions = [version(name) for name in ("jax", "jaxlib", "flax")]
    return f"{' '.join(versions)} {backend()} {core_count()} {_package_digest()}"
