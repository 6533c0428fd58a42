"""What commands share to load a model and a fitted rule of fusion. Does not import jax before it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError

if TYPE_CHECKING:
    from vggtjax.checkpoint import Model
    from vggtjax.commands.report import Report
    from vggtjax.method.fusion_rule import FusionParams

_MOST_CONFIG_BYTES = 1 << 20


def load(report: Report, name: str | None, config: Path | None = None) -> Model:
    """Load a model as a stage of the report. Raises InputError without a name."""
    if name is None:
        raise InputError(
            "no model is named; give --model a converted .safetensors, a PyTorch checkpoint, a hub id such as "
            "facebook/VGGT-1B, or demo, the small demonstration model, which is not for real footage"
        )
    with report.stage("load model") as progress:
        from vggtjax.pretrained.load import load_model

        return load_model(name, config=read_config(config), progress=progress)


class FittedFusion:
    """A fitted rule of fusion from a file; the paper's rule without a file."""

    def __init__(self, path: Path | None, methods: Sequence[str]) -> None:
        """Read the file; InputError where it is invalid or no method fuses."""
        self._path = path
        self.params: FusionParams | None = None
        if path is not None:
            from vggtjax.method.fusion_file import read_fusion

            self.params = read_fusion(path, methods)

    def warn(self, model: Model, **settings: Any) -> None:
        """Log a warning if the rule was fitted to another model or with other settings."""
        if self._path is not None:
            from vggtjax.method.fusion_file import warn_if_fitted_otherwise

            warn_if_fitted_otherwise(self._path, model, **settings)


def read_config(path: Path | None) -> VGGTConfig | None:
    if path is None:
        return None
    try:
        if path.stat().st_size > _MOST_CONFIG_BYTES:
            raise InputError(f"{path} is {path.stat().st_size} bytes; expected a small JSON file with a configuration")
        return VGGTConfig.from_json(path.read_text())
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text; expected a JSON file with a configuration") from None
