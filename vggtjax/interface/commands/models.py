"""Loading a model and a fitted rule of fusion, for several commands. Does not import jax before it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.interface.commands.arguments import ModelName, Revision
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.report import Report
from vggtjax.options import METHODS, Options, has_accelerator
from vggtjax.storage.cache import enable_compilation_cache
from vggtjax.storage.json_values import read_json
from vggtjax.storage.process import keep_freed_memory

if TYPE_CHECKING:
    from vggtjax.method.fusion.family import FusionParams
    from vggtjax.network.checkpoint import Model

_MOST_CONFIG_BYTES = 1 << 20


def load(
    report: Report,
    name: str | None,
    config: Path | None = None,
    compute_dtype: str | None = None,
    stage: str = "load model",
) -> Model:
    """Load a model as a stage of the report, to compute blocks in a type. Raises InputError without a name."""
    name = check_named(name)
    with report.stage(stage) as progress:
        from vggtjax.pipeline.pretrained.load import load_model

        return load_model(name, config=read_config(config), compute_dtype=compute_dtype, progress=progress)


def check_named(name: str | None) -> str:
    """Return the name of a model. Raises InputError without one."""
    if name is None:
        raise InputError(
            "no model is named; give --model a converted .safetensors, a PyTorch checkpoint, a hub id such as "
            "facebook/VGGT-1B, or demo, the small demonstration model, which is not for real footage"
        )
    return name


def at_revision(name: str, revision: str | None) -> str:
    """Return the name of a model with the revision that an option gives."""
    return name if revision is None else f"{name}@{revision}"


@dataclass(frozen=True)
class ModelFiles:
    """The files of a model and of a fitted rule of fusion.

    Attributes:
        model: a converted .safetensors, a PyTorch checkpoint, a hub id such as facebook/VGGT-1B, or demo, the small
            demonstration model, which is not for real footage
        config: JSON file with the configuration of a PyTorch checkpoint; not needed for published weights (VGGT-1B,
            Depth Anything 3)
        revision: commit of a hub id
        fusion: file of a fitted rule of fusion, as vggtjax fit-fusion writes it; the paper's rule by default
    """

    model: ModelName = None
    config: InWords[Path | None] = None
    revision: Revision = None
    fusion: InWords[Path | None] = None

    def load(self, report: Report, options: Options, methods: Sequence[str]) -> tuple[Model, FusionParams | None]:
        """Load the model, and the fitted rule of fusion (None, the paper's rule, without a file).

        The weights have the type in which the blocks are computed here.
        The rule is read first: InputError where it is invalid or none of the `methods` (in place of `options.method`)
        fuses. A warning is logged if the rule was fitted to another model or with other options.
        """
        name = at_revision(check_named(self.model), self.revision)
        dtype = options.computed().compute_dtype
        if self.fusion is None:
            return load(report, name, self.config, dtype), None
        from vggtjax.method.assembly import check_fuses
        from vggtjax.method.fusion.file import load_fusion, warn_if_fitted_otherwise

        params = load_fusion(self.fusion)
        check_fuses(params, *methods)
        model = load(report, name, self.config, dtype)
        fusing = next(name for name in methods if METHODS[name].depth == "fused")
        warn_if_fitted_otherwise(self.fusion, model, options.changed(method=fusing))
        return model, params

    def load_fastest(
        self, report: Report, options: Options, methods: Sequence[str]
    ) -> tuple[Model, FusionParams | None, Options]:
        """Load the model and the rule of fusion; return them, and options with a type that this CPU multiplies fast.

        A type or precision that is given stays. Without one, a trial chooses bfloat16 or float32 for a large model on a
        CPU, and the report says which and why.
        """
        model, params = self.load(report, options, methods)
        if options.compute_dtype is not None or options.precision is not None or has_accelerator():
            return model, params, options
        from vggtjax.pipeline.processor import choose_dtype

        choice = choose_dtype(model.config.embed_dim)
        if choice is None:
            return model, params, options
        exact = "" if choice.dtype == "float32" else "; --dtype float32 is slower and exact"
        report.note(f"computing in {choice.dtype}: {choice.reason}{exact}")
        if choice.dtype != "float32":
            del model  # its weights are read again, narrower
            name = at_revision(check_named(self.model), self.revision)
            model = load(report, name, self.config, choice.dtype, stage=f"weights in {choice.dtype}")
        return model, params, options.changed(compute_dtype=choice.dtype)


def load_on_worker(files: ModelFiles, options: Options) -> tuple[Model, FusionParams | None]:
    """Load the model in a process of a cluster, which then keeps what it compiles, as a command does."""
    keep_freed_memory()
    enable_compilation_cache()
    return files.load(Report(), options, [options.method])


def read_config(path: Path | None) -> VGGTConfig | None:
    return None if path is None else read_json(path, VGGTConfig, "configuration", most_bytes=_MOST_CONFIG_BYTES)
