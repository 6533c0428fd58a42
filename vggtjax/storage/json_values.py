"""Untrusted JSON -> checked dataclasses, and the same checks for dataclasses built in Python.

The annotation of a field spells its constraint once, such as `Annotated[int, Meta(ge=1)]` or a name below. Every
problem is one sentence with the place in the document, the value, and the expected values. Does not import jax.
"""

from __future__ import annotations

import dataclasses
import math
import re
import reprlib
import typing
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta
from msgspec import inspect as kinds

from vggtjax.errors import InputError, one_line, reading

MOST_BYTES = 2**24  # of a file or text, by default
MOST_LEVELS = 64  # of nesting
_BYTES_A_VALUE = 16  # so many values a text may hold: as many as its most bytes by this; each is looked at
_MOST_INT = 2**63

Natural = Annotated[int, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1)]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]

T = TypeVar("T")
_type_info = lru_cache(maxsize=512)(kinds.type_info)

_ANY = kinds.AnyType()
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*"')
_NO_NUMBER = re.compile(rb"[\[:,]\s*(-?(?:NaN|Infinity|nan|inf))\b")  # as Python writes them
_MARK = b"\xef\xbb\xbf"  # of the byte order, which Windows puts first
_ITEMS = (kinds.VarTupleType, kinds.ListType)
_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
_WORDS = {kinds.StrType: "text", kinds.BoolType: "true or false", kinds.NoneType: "null", kinds.DictType: "an object"}
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80


class _MisfitError(Exception):
    """Its arguments: a place in a document, such as .stages[0].steps, and the words that follow it in the sentence."""


def read_json(
    path: str | Path, kind: type[T], what: str, *, most_bytes: int = MOST_BYTES, error: type[InputError] = InputError
) -> T:
    """Read a JSON file; raises `error` for an unreadable file and for the problems of `parse_json`."""
    with reading(path, error), Path(path).open("rb") as file:
        text = file.read(most_bytes + 1)
    return parse_json(text, kind, f"{what} {path}", most_bytes=most_bytes, error=error)


def parse_json(
    text: str | bytes, kind: type[T], what: str, *, most_bytes: int = MOST_BYTES, error: type[InputError] = InputError
) -> T:
    """Return JSON text (bytes are UTF-8) as `kind`: a dataclass, a builtin, or a collection of them.

    The annotations of `kind` give types and ranges. Raises `error`, whose subject is `what` (such as "recipe a.json"),
    for text that is too long or not JSON, more than MOST_LEVELS levels, unknown or missing keys, infinite numbers or
    numbers of more than 64 bits, wrong types, values out of range, and more values than `most_bytes` / 16.
    """
    if len(text) > most_bytes:
        raise error(f"{what} has more than {most_bytes} bytes")
    try:
        value = msgspec.json.decode(text.removeprefix(_MARK) if isinstance(text, bytes) else text)
    except (ValueError, RecursionError) as problem:
        encoded = text if isinstance(text, bytes) else text.encode(errors="replace")
        if found := _NO_NUMBER.search(_TEXT.sub(b'""', encoded)):
            raise error(f"{what} has {found[1].decode()}, which is no number; expected finite numbers") from None
        raise error(f"{what} is not JSON that can be read: {problem}") from None
    try:
        _check_count(value, most_bytes // _BYTES_A_VALUE)
        return _converted(value, kind)
    except _MisfitError as misfit:
        place, words = misfit.args
        colon = ": " if place.startswith((".", "[")) else ""
        raise error(f"{what}{colon}{place.removeprefix('.')} {words}") from None


def check_fields(instance: Any, what: str = "", *, error: type[InputError] = InputError) -> None:
    """Check the fields of a frozen dataclass in its `__post_init__`, and convert them to the annotated types.

    Lists become tuples, whole numbers become floats, and mappings become dataclasses, if so annotated. `what` is the
    prefix of the field in an `error`, such as "optimiser" for "optimiser.b1 is 2; expected ...".
    """
    for name, hint in _hints(type(instance)).items():
        try:
            value = _converted(getattr(instance, name), hint)
        except _MisfitError as misfit:
            place, words = misfit.args
            words = words.removesuffix(" or null")  # which a command line cannot say
            raise error(f"{what}{'.' if what else ''}{name}{place} {words}") from None
        object.__setattr__(instance, name, value)


def without_defaults(values: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    """Return values without those of `later` at their default there: fields that older files do not have."""
    return {name: value for name, value in values.items() if (name, value) not in later.items()}


@lru_cache(maxsize=256)
def _hints(kind: type) -> dict[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _converted(value: Any, kind: Any) -> Any:
    info = _type_info(kind)
    _check(value, info)
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        words, _, place = str(error).removesuffix("`").partition(" - at `$")
        if error.__cause__ is not None:  # raised by a __post_init__
            raise _MisfitError(f"{place}:", str(error.__cause__)) from None
        if missing := re.fullmatch("Object missing required field `(.*?)`?", words):
            raise _MisfitError(place, f"lacks the field {missing[1]!r}") from None
        for step in re.findall(r"\.\w+|\[[^]]*\]", place):
            children = {_step(key): (child, child_info) for key, child, child_info in _children(value, info)}
            if step not in children:  # in a dict, whose key is not in the message
                raise _MisfitError(place, f"is invalid: {words}") from None
            value, info = children[step]
        raise _MisfitError(place, f"is {_short(value)}; expected {_expected(info)}") from None


def _check_count(value: Any, most: int) -> None:
    """Raise _MisfitError for a document of more than `most` values, before they are looked at one by one."""
    count, todo = 1, [value]
    while todo:
        container = todo.pop()
        items = container.values() if isinstance(container, dict) else container if isinstance(container, list) else ()
        count += len(items)
        if count > most:
            raise _MisfitError("", f"holds more than {most} values; expected fewer: cut it into several files")
        todo += [item for item in items if isinstance(item, dict | list)]


def _check(value: Any, info: kinds.Type, keys: tuple[Any, ...] = ()) -> None:
    """Raise _MisfitError for infinite and huge numbers, unknown fields of a dataclass, and too many levels."""
    words = ""
    if len(keys) > MOST_LEVELS:
        raise _MisfitError("", f"is nested more than {MOST_LEVELS} levels deep")
    if isinstance(value, float) and not math.isfinite(value):
        words = f"is {value}; expected a finite number"
    elif isinstance(value, int) and abs(value) > _MOST_INT:
        words = "is a number of more than 64 bits"
    elif isinstance(value, Mapping) and isinstance(info := _option(info, value), kinds.DataclassType):
        known = [field.name for field in info.fields]
        if unknown := sorted(str(key) for key in value if key not in known):
            words = f"has unknown fields {_short(unknown)}; expected some of {known}"
    if words:
        raise _MisfitError("".join(map(_step, keys)), words)
    for key, child, child_info in _children(value, info):
        if type(child) is not str:
            _check(child, child_info, (*keys, key))


def _option(info: kinds.Type, value: Any) -> kinds.Type:
    """Return the option of a union that fits a container; return types other than unions as they are."""
    options = info.types if isinstance(info, kinds.UnionType) else (info,)
    wanted = (kinds.DataclassType, kinds.DictType) if isinstance(value, Mapping) else (kinds.TupleType, *_ITEMS)
    return next((option for option in options if isinstance(option, wanted)), info)


def _children(value: Any, info: kinds.Type) -> Iterator[tuple[Any, Any, kinds.Type]]:
    """Yield key or index, value and type of the items of a container; of other values, nothing."""
    info = _option(info, value)
    if isinstance(value, Mapping):
        fields = {field.name: field.type for field in info.fields} if isinstance(info, kinds.DataclassType) else {}
        other = info.value_type if isinstance(info, kinds.DictType) else _ANY
        yield from ((key, child, fields.get(key, other)) for key, child in value.items())
    elif isinstance(value, list | tuple):
        types = info.item_types if isinstance(info, kinds.TupleType) else ()
        other = info.item_type if isinstance(info, _ITEMS) else _ANY
        yield from ((i, child, types[i] if i < len(types) else other) for i, child in enumerate(value))


def _step(key: object) -> str:
    return f".{key}" if isinstance(key, str) and re.fullmatch(r"\w{1,80}", key) else f"[{_short(key)}]"


def _expected(info: kinds.Type) -> str:
    if isinstance(info, kinds.UnionType):
        return " or ".join(map(_expected, info.types))
    if isinstance(info, kinds.LiteralType):
        return f"one of {info.values}"
    if isinstance(info, kinds.DataclassType):
        return f"an object with the fields of {info.cls.__name__}"
    if isinstance(info, kinds.TupleType):
        return f"a list of {len(info.item_types)} values"
    if isinstance(info, _ITEMS):
        limits = (("at least", info.min_length), ("at most", info.max_length))
        bounds = " and ".join(f"{words} {limit}" for words, limit in limits if limit)
        return f"a list of {bounds} values" if bounds else "a list"
    if isinstance(info, kinds.IntType | kinds.FloatType):
        limits = {words: getattr(info, name) for name, words in _BOUNDS.items()}
        bounds = [f"{words} {limit}" for words, limit in limits.items() if limit is not None]
        whole = "a whole number" if isinstance(info, kinds.IntType) else "a number"
        return whole + (f" of {' and '.join(bounds)}" if bounds else "")
    return _WORDS.get(type(info), type(info).__name__)


def _short(value: Any) -> str:
    return one_line(_SHORT.repr(value))
