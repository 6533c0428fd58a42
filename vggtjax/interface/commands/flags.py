"""How the options of commands look: what tyro cannot tell from the fields of the dataclasses that hold them.

Two rules cover most fields: where None is the default, the text says what happens without the option, and what is off
by default is a flag without one to turn it off. The table has the others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, StructConstructorSpec, StructFieldSpec
from tyro.constructors import StructTypeInfo as Asked

from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Framing
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.pipeline.batch.cluster import Cluster
from vggtjax.pipeline.batch.recipe import BatchRecipe, ClipRecipe
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.windows.plan import Extending
from vggtjax.results.saving import GROUPS, Saving, parse_groups

T = TypeVar("T")
InWords = Annotated[T, tyro.conf.arg(help_behavior_hint="")]
"""An option of a command whose text tells its default in words: the help adds no "(default: None)"."""

Switch = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")]
"""A flag that is off unless it is given, without a flag to turn it off."""


Look = Callable[[Any], Any]  # from the type of a field to the type that tyro reads


def _in_words(metavar: str | None = None, *, reads: Any = None, **given: Any) -> Look:
    """Annotate a field, or what it `reads` in place of the field's type."""
    return lambda hint: Annotated[reads or hint, tyro.conf.arg(metavar=metavar, help_behavior_hint="", **given)]


def _among(group: str, constructor: Any = None) -> Look:
    """Put an option, which is the parameter of a constructor, or all options of a part, into a group of the help."""
    prefix = None if constructor is None else False
    return lambda hint: Annotated[constructor or hint, tyro.conf.arg(name=group, help="", prefix_name=prefix)]


def in_group(group: str, constructor: Callable[..., Any]) -> Any:
    """Return the annotation of a value that a constructor makes of options, which stand in a group of the help."""
    return tyro.conf.arg(constructor=constructor, name=group, help="", prefix_name=False)


def option(name: str, hint: Any, default: Any = Parameter.empty, **given: Any) -> Callable[..., Any]:
    """Return a constructor for `in_group` that takes one option, `given` to `tyro.conf.arg`, and returns its value."""

    def value(**values: Any) -> Any:
        return values[name]

    vars(value)["__signature__"] = Signature([Parameter(name, Parameter.KEYWORD_ONLY, default=default)])
    value.__annotations__ = {name: Annotated[hint, tyro.conf.arg(**given)]}
    return value


def _refine_mask(refine_mask: Switch = False, no_refine_mask: Switch = False) -> bool | None:
    """Whether the mask is refined; the method's own choice by default.

    Args:
        refine_mask: remove pixels from the mask that agree with other frames, as vggt4d does.
        no_refine_mask: leave the mask as it was mined, with vggt4d too.
    """
    if refine_mask and no_refine_mask:
        raise InputError("--refine-mask and --no-refine-mask are opposites; give one of them")
    return True if refine_mask else False if no_refine_mask else None


_DEVICES = "share the frames of a clip among this many devices, each with a copy of the weights"
_NO_MEMORY_CHECK = (
    "do not compare the memory that a clip needs with what is free; without windows, all frames are run together"
)
_UNDISTORT = (
    "undistort the frames of a capture that states the distortion coefficients of its lens (the default);\n"
    "--no-undistort keeps the distorted frames and ignores the coefficients"
)
_PAD_FRAMES = (
    "pad clips to one of a few lengths, so that clips of similar length share compiled programs; for many\n"
    "lengths on a GPU, where compiling takes longer than running"
)
_MASKS = (
    "folder with a folder of pictures for each clip, named like it, as --masks of vggtjax reconstruct takes\n"
    "them; masks of other clips are mined"
)

# One argument with commas; tyro's own reading of a tuple would take the words that follow.
_GROUPS = PrimitiveConstructorSpec(
    nargs=1,
    metavar="GROUP,GROUP",
    instance_from_str=lambda words: parse_groups(words[0]),
    is_instance=lambda value: value is None or isinstance(value, tuple),
    str_from_instance=lambda value: [",".join(value or GROUPS)],
)
_DTYPE = Literal["float32", "bfloat16"]
_DEPTHS = _in_words("FILE|FOLDER|source", aliases=("--depths",))
_CLIP = {
    "sampling": _among("input"),
    "framing": _among("input"),
    "undistort": _among("input", option("undistort", InWords[bool], True, help=_UNDISTORT)),
    "options": _among("method"),
    "devices": _among("limits", option("devices", int, 1, help=_DEVICES, help_behavior_hint="(default: 1)")),
    "known": _among("known cameras and scale"),
    "unchecked": _among("limits", option("no_memory_check", Switch, False, help=_NO_MEMORY_CHECK)),
    "saving": _among("output"),
}
_FIELDS: dict[type, dict[str, Look]] = {
    Options: {
        "refine_mask": _among("method", _refine_mask),
        "consistent_depth": _in_words(),
        "compute_dtype": _in_words(name="dtype", reads=_DTYPE | None),
        "attention": _in_words(),
    },
    Framing: {"mode": lambda hint: Annotated[hint, tyro.conf.arg(name="preprocess", help_behavior_hint="")]},
    Sampling: {"skip": _in_words("N,N-N")},
    KnownGeometry: {
        "intrinsics": _in_words("FX,FY,CX,CY|FILE|source|exif"),
        "poses": _in_words("FILE|source"),
        "baseline": _in_words("I,J,METRES"),
        "known_depths": _DEPTHS,
    },
    Extending: {"prefix": _in_words("LETTERS")},
    Saving: {"only": lambda hint: InWords[Annotated[hint, _GROUPS]]},
    Cluster: {"address": _in_words("HOST:PORT|auto")},
    ClipRecipe: _CLIP,
    BatchRecipe: _CLIP
    | {
        "pad_frames": _among("limits", option("pad_frames", Switch, False, help=_PAD_FRAMES)),
        "masks": _among("input", option("masks", InWords[Path | None], None, help=_MASKS)),
    },
}

REGISTRY = ConstructorRegistry()


@REGISTRY.struct_rule
def _dataclass(asked: Asked) -> StructConstructorSpec | None:
    """Return the fields of a dataclass of options, with the texts of its docstring."""
    kind = asked.type
    if not dataclasses.is_dataclass(kind) or not kind.__module__.startswith("vggtjax."):
        return None
    bases = [base for base in reversed(kind.__mro__) if dataclasses.is_dataclass(base)]
    texts = {text.arg_name: text for base in bases for text in docstring_parser.parse(base.__doc__ or "").params}
    looks = {name: look for base in bases for name, look in _FIELDS.get(base, {}).items()}
    hints = get_type_hints(kind, include_extras=True)
    fields = []
    for field in dataclasses.fields(kind):
        given = tyro.MISSING_NONPROP if field.default is dataclasses.MISSING else field.default
        default = getattr(asked.default, field.name) if isinstance(asked.default, kind) else given
        hint = _annotated(hints[field.name], looks.get(field.name), given)
        text = " ".join((texts[field.name].description or "").split()) if field.name in texts else None
        fields.append(StructFieldSpec(field.name, hint, default, text))
    return StructConstructorSpec(kind, tuple(fields))


def _annotated(hint: Any, look: Look | None, default: Any) -> Any:
    """Return a field's type as it is annotated, or as the table has it, or else by the rules."""
    if any(type(part).__module__.startswith("tyro.") for part in getattr(hint, "__metadata__", ())):
        return hint
    if look is not None:
        return look(hint)
    if default is False:
        return Switch
    return InWords[hint] if default is None else hint
