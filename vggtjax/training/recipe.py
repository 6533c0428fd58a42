"""What a training run is: model, losses, optimiser and stages, as frozen plain values that read and write JSON."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.model import DENSE_HEADS, HEADS
from vggtjax.training.objective import LossWeights

_MOST_FILE_BYTES = 1 << 20


@dataclass(frozen=True)
class Stage:
    """A stretch of training on clips of one size.

    Each step draws one of `frames` as the number of frames of its clips; height and width are in pixels.
    """

    steps: int
    batch: int  # clips in a step
    frames: tuple[int, ...]
    height: int
    width: int
    dynamic: float = 0.0  # share of scenes in which things move
    motion: tuple[float, float] = (0.1, 1.0)  # range of the camera's share of its largest path

    def __post_init__(self) -> None:
        _settle(self, "stage", may_be_zero=("dynamic", "motion"))
        if not self.frames:
            raise InputError("stage.frames is empty; expected the frame counts to draw from")
        if self.dynamic > 1:
            raise InputError(f"stage.dynamic is {self.dynamic}; expected a share in [0, 1]")


@dataclass(frozen=True)
class OptimiserConfig:
    """The optimiser and its learning rate: a linear warm-up, then the schedule, to `final_fraction` of the peak.

    "stable" keeps the peak and decays along a half cosine in the last `decay_steps` steps; "cosine" decays from the
    warm-up on and does not read `decay_steps`.
    """

    learning_rate: float = 3e-4
    kind: Literal["adamw", "muon"] = "adamw"
    schedule: Literal["stable", "cosine"] = "stable"
    warmup_steps: int = 500
    decay_steps: int = 2000
    final_fraction: float = 0.02
    weight_decay: float = 0.05  # of kernels; times the learning rate
    b1: float = 0.9  # decay of Adam's first moment
    b2: float = 0.95  # and of its second
    clip_norm: float = 1.0  # of the gradient of all trained parameters together
    ema_decay: float = 0.999  # of the averaged parameters that are exported

    def __post_init__(self) -> None:
        zero = ("warmup_steps", "decay_steps", "final_fraction", "weight_decay", "b1", "b2", "ema_decay")
        _settle(self, "optimiser", may_be_zero=zero)
        for name in ("b1", "b2", "ema_decay"):
            if getattr(self, name) >= 1:
                raise InputError(f"optimiser.{name} is {getattr(self, name)}; expected a decay in [0, 1)")
        if self.final_fraction > 1:
            raise InputError(f"optimiser.final_fraction is {self.final_fraction}; expected a share in [0, 1]")


@dataclass(frozen=True)
class Start:
    """Random parameters to start from. The defaults are VGGT's, whose backbone already sees.

    Attributes:
        layer_scale: start of the aggregator's LayerScale. 0.01 keeps attention across frames out of the residual
            stream for hundreds of steps; a model that learns from nothing wants more.
        tied_keys: the keys of the global blocks start equal to their queries, so that attention starts as similarity
            and looks for the same thing in other frames from the first step on.
    """

    layer_scale: float = 0.01
    tied_keys: bool = False

    def __post_init__(self) -> None:
        _settle(self, "start", may_be_zero=())


@dataclass(frozen=True)
class Recipe:
    """Everything that decides what a training run computes: two runs of one recipe give the same numbers."""

    name: str
    stages: tuple[Stage, ...]
    model: VGGTConfig = field(default_factory=VGGTConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    losses: LossWeights = field(default_factory=LossWeights)
    start: Start = field(default_factory=Start)  # not read with parameters to start from
    trainable: Literal["all", "heads"] = "all"  # "heads": backbone and aggregator stay as they are
    untrained: tuple[str, ...] = ("track_head",)  # modules of the model that stay as they are: those without a loss
    compute_dtype: Literal["auto", "float32", "bfloat16"] = "auto"  # bfloat16 on a GPU, else float32
    remat: bool = False  # compute activations again in the backward pass: less memory, more time
    seed: int = 0  # of the random parameters
    data_seed: int = 0

    def __post_init__(self) -> None:
        if isinstance(self.stages, list | tuple):
            object.__setattr__(self, "stages", tuple(_built(Stage, value, "a stage") for value in self.stages))
        for name, kind in (
            ("optimiser", OptimiserConfig),
            ("losses", LossWeights),
            ("model", VGGTConfig),
            ("start", Start),
        ):
            object.__setattr__(self, name, _built(kind, getattr(self, name), name))
        _settle(self, "recipe", may_be_zero=("seed", "data_seed"))
        object.__setattr__(self, "losses", dataclasses.replace(self.losses))  # what was given stays as it is
        _settle(self.losses, "losses", may_be_zero=tuple(f.name for f in dataclasses.fields(self.losses)))
        if not self.name.isprintable() or not 0 < len(self.name) <= 200:
            raise InputError(f"recipe.name is {self.name[:50]!r}; expected up to 200 printable letters")
        if not self.stages:
            raise InputError("recipe.stages is empty; expected at least one stage")
        modules = ("backbone", "aggregator", *HEADS.values())
        if unknown := [name for name in self.untrained if name not in modules]:
            raise InputError(f"recipe.untrained has {unknown}; expected some of {modules}")
        needed = ["camera", *(name for name in DENSE_HEADS if getattr(self.losses, name))]
        if absent := [name for name in needed if name not in self.model.heads]:
            raise InputError(
                f"the model has no head {absent[0]!r}, only {self.model.heads}; training needs 'camera', and "
                "those of losses.depth and losses.points unless these are 0"
            )
        for stage in self.stages:
            if stage.height % self.model.patch_size or stage.width % self.model.patch_size:
                raise InputError(
                    f"a stage has frames of {stage.height} x {stage.width} pixels; expected multiples of the "
                    f"model's patch_size {self.model.patch_size}"
                )
        layers = [layer for layer in self.losses.match_layers if layer >= self.model.depth]
        if self.losses.match and (layers or not self.losses.match_layers or self.model.num_heads < 2):
            raise InputError(
                f"losses.match needs a model of two heads or more and match_layers below its depth {self.model.depth}; "
                f"they are {self.losses.match_layers}, of {self.model.num_heads} heads"
            )
        spent = self.optimiser.warmup_steps
        spent += self.optimiser.decay_steps if self.optimiser.schedule == "stable" else 0
        if spent > self.total_steps:
            raise InputError(
                f"warm-up and decay take {spent} steps and the stages have {self.total_steps}; lower "
                "optimiser.warmup_steps or optimiser.decay_steps"
            )

    @property
    def frozen(self) -> tuple[str, ...]:
        """Modules of the model that stay as they are."""
        absent = {module for name, module in HEADS.items() if name not in self.model.heads}
        untrained = (name for name in self.untrained if name not in absent)
        return (*(("backbone", "aggregator") if self.trainable == "heads" else ()), *untrained)

    @property
    def total_steps(self) -> int:
        """Steps of all stages together."""
        return sum(stage.steps for stage in self.stages)

    def stage_at(self, step: int) -> tuple[int, Stage]:
        """Return the index and the stage of a step, counted from 0; the last one's from the end on."""
        end = 0
        for index, stage in enumerate(self.stages):
            end += stage.steps
            if step < end:
                return index, stage
        return len(self.stages) - 1, self.stages[-1]

    def with_steps(self, steps: int) -> Recipe:
        """Return the recipe with so many steps in all: stages, warm-up and decay keep their shares."""
        if type(steps) is not int or steps < 1:
            raise InputError(f"steps is {steps!r}; expected a whole number above 0")
        total = self.total_steps
        ends = list(itertools.accumulate((stage.steps for stage in self.stages), initial=0))
        lengths = [end * steps // total - start * steps // total for start, end in itertools.pairwise(ends)]
        pairs = zip(self.stages, lengths, strict=True)
        stages = tuple(dataclasses.replace(stage, steps=length) for stage, length in pairs if length)
        optimiser = dataclasses.replace(
            self.optimiser,
            warmup_steps=self.optimiser.warmup_steps * steps // total,
            decay_steps=self.optimiser.decay_steps * steps // total,
        )
        return dataclasses.replace(self, stages=stages, optimiser=optimiser)

    def to_json(self) -> str:
        """Return the recipe as a JSON object; `from_json` reads it back."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Recipe:
        """Read a recipe from JSON text.

        Raises InputError for text that is not a JSON object of known fields with valid values.
        """
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"recipe is not JSON: {error}") from None
        return _built(cls, values, "recipe")


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a JSON file; InputError if it cannot be read or is none."""
    path = Path(path)
    try:
        if path.stat().st_size > _MOST_FILE_BYTES:
            raise InputError(f"{path} is {path.stat().st_size} bytes; expected a small JSON file with a recipe")
        text = path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text; expected a JSON file with a recipe") from None
    try:
        return Recipe.from_json(text)
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None


def _built(kind: type, value: Any, name: str) -> Any:
    """Return `value` as the dataclass `kind`, made of a mapping of exactly known fields if it is one."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise InputError(f"{name} is {_short(value)}; expected an object with the fields of {kind.__name__}")
    known = [f for f in dataclasses.fields(kind) if f.init]
    if unknown := sorted(set(value) - {f.name for f in known}):
        raise InputError(f"{name} has unknown fields {unknown}; expected some of {[f.name for f in known]}")
    required = [f.name for f in known if f.default is f.default_factory is dataclasses.MISSING]
    if missing := [field_ for field_ in required if field_ not in value]:
        raise InputError(f"{name} lacks the fields {missing}")
    try:
        return kind(**value)
    except (TypeError, AttributeError) as error:
        raise InputError(f"{name} has a value of the wrong type: {error}") from None


def _settle(values: Any, name: str, *, may_be_zero: tuple[str, ...]) -> None:
    """Bring a frozen dataclass to its annotated types (lists to tuples, whole numbers to floats) and check it.

    Raises InputError for values of another type, and for numbers that are not finite and above zero (or at least zero).
    """
    hints = typing.get_type_hints(type(values))
    for field_ in dataclasses.fields(values):
        value = _typed(hints[field_.name], getattr(values, field_.name), f"{name}.{field_.name}")
        object.__setattr__(values, field_.name, value)
        for number in value if isinstance(value, tuple) else (value,):
            if type(number) not in (int, float):
                continue
            zero = field_.name in may_be_zero
            if not math.isfinite(number) or number < 0 or (number == 0 and not zero) or number > 2**62:
                raise InputError(
                    f"{name}.{field_.name} is {_short(value)}; expected {'at least' if zero else 'more than'} 0"
                )


def _typed(hint: Any, value: Any, name: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is float and type(value) is int and abs(value) <= 2**62:
        return float(value)
    if origin is Literal:
        if not any(type(value) is type(choice) and value == choice for choice in arguments):
            raise InputError(f"{name} is {_short(value)}; expected one of {arguments}")
        return value
    if origin is tuple and isinstance(value, list | tuple):
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(kinds) != len(value):
            raise InputError(f"{name} is {_short(value)}; expected {len(kinds)} values")
        return tuple(_typed(kind, item, name) for kind, item in zip(kinds, value, strict=True))
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _typed(next(kind for kind in arguments if kind is not type(None)), value, name)
    if origin is not None or not (type(value) is hint or (dataclasses.is_dataclass(hint) and isinstance(value, hint))):
        kind = hint.__name__ if isinstance(hint, type) and origin is None else str(hint)
        raise InputError(f"{name} is {_short(value)}; expected {kind}")
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
