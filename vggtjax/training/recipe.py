"""A training recipe: model, losses, optimiser and phases, as frozen plain values that read and write JSON."""

from __future__ import annotations

import dataclasses
import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.errors import InputError, whole_number
from vggtjax.network.model import HEADS
from vggtjax.storage.json_values import (
    Count,
    Natural,
    NotNegative,
    Positive,
    Share,
    check_fields,
    parse_json,
    read_json,
)
from vggtjax.training.objective import LossWeights
from vggtjax.training.scenes.config import SceneConfig, Side
from vggtjax.training.world.config import WorldConfig

_MOST_FILE_BYTES = 1 << 20
Decay = Annotated[float, Meta(ge=0, lt=1)]
Seed = Annotated[int, Meta(ge=0, lt=2**31)]
Gamma = Annotated[float, Meta(ge=0, le=4)]
Sizes = Annotated[tuple[tuple[Side, Side], ...], Meta(max_length=16)]


@dataclass(frozen=True)
class Phase:
    """A stretch of training.

    Each step draws one of `frames` as the number of frames of its clips, and one of (`height`, `width`) and `sizes` as
    their size in pixels.
    """

    steps: Count
    batch: Count  # clips in a step
    frames: Annotated[tuple[int, ...], Meta(min_length=1)]
    height: int
    width: int
    dynamic: float = 0.0  # share of scenes in which objects move
    motion: tuple[float, float] = (0.1, 1.0)  # range of the camera's share of its largest path
    suppressed: Share = 0.0  # share of clips in which the keys of random regions are suppressed, whatever moves
    suppress: Suppress = "zero"  # how
    suppressed_pairs: tuple[Share, Share] = (0.0, 1.0)  # range of the share of pairs, from the first, that do
    gamma: Gamma = 0.5  # width of the range around 0 from which the logarithm of a clip's gamma is drawn
    sizes: Sizes = ()  # further heights and widths
    pitch: tuple[float, float] = (0.0, 0.0)  # range of the angle by which cameras look further down, in degrees
    roll: float = 0.0  # largest further roll of a camera, in degrees
    field_of_view: tuple[float, float] = SceneConfig.field_of_view  # range of the horizontal one, in degrees
    boxes: int = SceneConfig.boxes  # most boxes of a scene; each is present or absent
    ellipsoids: int = SceneConfig.ellipsoids
    cylinders: int = SceneConfig.cylinders
    worlds: Share = 0.0  # share of steps whose clips are of generated worlds, with the recipe's assets
    world: WorldConfig = field(default_factory=WorldConfig)
    reuse: Positive = 4.0  # how often a clip of a world is drawn, on average
    masked_movers: Share = 0.6  # share of moving clips of worlds in which the keys of what moves are suppressed
    known_cameras: Share = 0.0  # share of steps in which the network reads the true cameras

    def __post_init__(self) -> None:
        check_fields(self, "phase")
        if len(set(self.all_sizes)) <= len(self.sizes):
            raise InputError(f"sizes is {self.sizes}; expected sizes other than {(self.height, self.width)}, each once")
        low, high = self.suppressed_pairs
        if not (low <= high and high > 0):
            raise InputError(
                f"suppressed_pairs is {self.suppressed_pairs}; expected the smaller share first, the larger above 0"
            )
        for frames in self.frames:
            self.scenes(frames)

    @property
    def all_sizes(self) -> tuple[tuple[int, int], ...]:
        """Height and width of the phase, and its further sizes."""
        return ((self.height, self.width), *self.sizes)

    def of_size(self, index: int) -> Phase:
        """Return the phase with one of `all_sizes` alone."""
        height, width = self.all_sizes[index]
        return dataclasses.replace(self, height=height, width=width, sizes=()) if self.sizes else self

    def scenes(self, frames: int) -> SceneConfig:
        """Return the configuration of scenes of `frames` frames. Raises InputError for invalid values."""
        same = ("boxes", "ellipsoids", "cylinders", "motion", "pitch", "roll", "field_of_view")
        return SceneConfig(
            self.height, self.width, frames, self.dynamic, **{name: getattr(self, name) for name in same}
        )


@dataclass(frozen=True)
class OptimiserConfig:
    """The optimiser and its learning rate: a linear warm-up, then the schedule, to `final_fraction` of the peak.

    "stable" keeps the peak and decays along a half cosine in the last `decay_steps` steps; "cosine" decays after the
    warm-up and does not read `decay_steps`.
    """

    learning_rate: Positive = 3e-4
    kind: Literal["adamw", "muon"] = "adamw"
    schedule: Literal["stable", "cosine"] = "stable"
    warmup_steps: Natural = 500
    decay_steps: Natural = 2000
    final_fraction: Share = 0.02
    weight_decay: NotNegative = 0.05  # of kernels; times the learning rate
    b1: Decay = 0.9  # decay of Adam's first moment
    b2: Decay = 0.95  # and of its second
    clip_norm: Positive = 1.0  # of the gradient of all trained parameters together
    ema_decay: Decay = 0.999  # of the averaged parameters that are exported

    def __post_init__(self) -> None:
        check_fields(self, "optimiser")


@dataclass(frozen=True)
class Start:
    """The parameters to start from. The defaults of random ones are VGGT's, whose backbone is pretrained.

    Attributes:
        layer_scale: start of the aggregator's LayerScale. 0.01 keeps attention across frames out of the residual
            stream for hundreds of steps; a model without a pretrained backbone needs more.
        tied_keys: the keys of the global blocks start equal to their queries, so that attention starts as similarity
            and finds equal tokens in other frames from the first step on.
        new_pairs: indices, in the recipe's model, of the pairs that the model to start from lacks. A new pair starts as
            a copy of the next old one, with a LayerScale of 0: a plain pass of the deeper model computes the same.
    """

    layer_scale: Positive = 0.01
    tied_keys: bool = False
    new_pairs: tuple[Natural, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, "start")


@dataclass(frozen=True)
class Recipe:
    """Everything that decides what a training run computes: two runs of one recipe give the same numbers."""

    name: str
    stages: Annotated[tuple[Phase, ...], Meta(min_length=1)]  # the phases, under the key of recipe files
    model: VGGTConfig = field(default_factory=VGGTConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    losses: LossWeights = field(default_factory=LossWeights)
    start: Start = field(default_factory=Start)
    assets: str = ""  # folder of textures, photographs and objects, for phases with worlds
    trainable: Literal["all", "heads"] = "all"  # "heads": backbone and aggregator stay unchanged
    untrained: tuple[str, ...] = ("track_head",)  # modules of the model that stay unchanged: those without a loss
    compute_dtype: Literal["auto", "float32", "bfloat16"] = "auto"  # bfloat16 on a GPU, else float32
    remat: bool = False  # compute activations again in the backward pass: less memory, more time
    seed: Seed = 0  # of the random parameters
    data_seed: Seed = 0

    def __post_init__(self) -> None:
        check_fields(self, "recipe")
        if not self.name.isprintable() or not 0 < len(self.name) <= 200:
            raise InputError(f"recipe.name is {self.name[:50]!r}; expected up to 200 printable letters")
        modules = ("backbone", "aggregator", *HEADS.values())
        if unknown := [name for name in self.untrained if name not in modules]:
            raise InputError(f"recipe.untrained has {unknown}; expected some of {modules}")
        needed = ["camera", *self.losses.dense]
        if absent := [name for name in needed if name not in self.model.heads]:
            raise InputError(
                f"the model has no head {absent[0]!r}, only {self.model.heads}; training needs 'camera', and "
                "those of losses.depth and losses.points unless these are 0"
            )
        for height, width in (size for phase in self.stages for size in phase.all_sizes):
            if height % self.model.patch_size or width % self.model.patch_size:
                raise InputError(
                    f"a phase has frames of {height} x {width} pixels; expected multiples of the "
                    f"model's patch_size {self.model.patch_size}"
                )
        if not self.assets and any(phase.worlds for phase in self.stages):
            raise InputError("a phase has worlds and recipe.assets is empty; expected the folder of their assets")
        if not self.model.reads_cameras and any(phase.known_cameras for phase in self.stages):
            raise InputError(
                f"a phase has known_cameras and the model, of family {self.model.family} with camera_depth "
                f"{self.model.camera_depth}, does not read any; leave known_cameras out"
            )
        new, last = self.start.new_pairs, self.model.depth - 1
        if len(set(new)) < len(new) or any(pair >= last or pair in self.model.taps for pair in new):
            raise InputError(
                f"start.new_pairs is {new}; expected different indices below {last}, the last pair of a model of depth "
                f"{self.model.depth}, and none of its taps {self.model.taps}"
            )
        layers = [layer for layer in self.losses.match_layers if layer >= self.model.depth]
        if self.losses.match and (layers or not self.losses.match_layers or self.model.num_heads < 2):
            raise InputError(
                "losses.match needs a model of at least two heads and match_layers below its depth "
                f"{self.model.depth}; they are {self.losses.match_layers}, of {self.model.num_heads} heads"
            )
        spent = self.optimiser.warmup_steps
        spent += self.optimiser.decay_steps if self.optimiser.schedule == "stable" else 0
        if spent > self.total_steps:
            raise InputError(
                f"warm-up and decay take {spent} steps and the phases have {self.total_steps}; lower "
                "optimiser.warmup_steps or optimiser.decay_steps"
            )

    @property
    def initial_model(self) -> VGGTConfig:
        """Configuration of the model to start from: the recipe's without the new pairs."""
        old = [pair for pair in range(self.model.depth) if pair not in self.start.new_pairs]
        first, second, third, fourth = (old.index(tap) for tap in self.model.taps)
        return dataclasses.replace(self.model, depth=len(old), taps=(first, second, third, fourth))

    @property
    def frozen(self) -> tuple[str, ...]:
        """Modules of the model that stay unchanged."""
        absent = {module for name, module in HEADS.items() if name not in self.model.heads}
        untrained = (name for name in self.untrained if name not in absent)
        return (*(("backbone", "aggregator") if self.trainable == "heads" else ()), *untrained)

    @property
    def total_steps(self) -> int:
        """Steps of all phases together."""
        return sum(phase.steps for phase in self.stages)

    def phase_at(self, step: int) -> tuple[int, Phase]:
        """Return the index and the phase of a step, counted from 0; of the last phase for a step beyond the end."""
        end = 0
        for index, phase in enumerate(self.stages):
            end += phase.steps
            if step < end:
                return index, phase
        return len(self.stages) - 1, self.stages[-1]

    def with_steps(self, steps: int) -> Recipe:
        """Return the recipe with `steps` steps in total: phases, warm-up and decay keep their shares."""
        steps = whole_number("steps", steps, 1)
        total = self.total_steps
        ends = list(itertools.accumulate((phase.steps for phase in self.stages), initial=0))
        lengths = [end * steps // total - start * steps // total for start, end in itertools.pairwise(ends)]
        pairs = zip(self.stages, lengths, strict=True)
        stages = tuple(dataclasses.replace(phase, steps=length) for phase, length in pairs if length)
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
        """Read a recipe from JSON text. Raises InputError for text that is not a recipe with valid values."""
        return parse_json(text, cls, "recipe", most_bytes=_MOST_FILE_BYTES)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a JSON file. Raises InputError as `Recipe.from_json`, and for an unreadable file."""
    return read_json(path, Recipe, "recipe", most_bytes=_MOST_FILE_BYTES)
