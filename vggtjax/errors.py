"""Exceptions of the public boundary: one clear sentence each; the command line turns them into exit code 2."""

import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec

_MOST_PROBLEMS = 20  # in full, in one message


class VggtjaxError(Exception):
    """Base of all exceptions that this library raises on purpose."""


class InputError(VggtjaxError, ValueError):
    """An argument with an invalid value."""


class ClipError(InputError):
    """Frames or video that cannot be read or used as a clip."""


class CheckpointError(InputError):
    """Weights that cannot be read, or do not fit the configuration of their model."""


class ResultError(InputError):
    """A folder or file that is not a result of this library."""


class OutputError(VggtjaxError, OSError):
    """Results that cannot be written."""


class DeviceMemoryError(VggtjaxError, MemoryError):
    """A clip that does not fit in the memory of the device."""


class MissingExtraError(VggtjaxError, ImportError):
    """A missing optional dependency; the message names the extra that installs it."""

    def __init__(self, purpose: str, extra: str) -> None:
        super().__init__(f"{purpose} needs the extra '{extra}': pip install 'vggtjax[{extra}]'")


def check_extra(purpose: str, extra: str, *modules: str) -> None:
    """Raise MissingExtraError unless all modules of an extra are installed; call it before long work."""
    if not all(find_spec(module) for module in modules):
        raise MissingExtraError(purpose, extra)


def whole_number(name: str, value: object, lowest: int) -> int:
    """Return `value` as an int of at least `lowest`, else raise InputError naming the argument."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or number < lowest:
        raise InputError(f"{name} is {value!r}; expected a whole number of at least {lowest}")
    return number


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Raise InputError, naming the argument, for a value that is not one of the choices."""
    if value not in choices:
        raise InputError(f"{name} is {value!r}; expected one of {', '.join(map(str, choices))}")


@contextmanager
def reading(path: object, error: type[InputError] = InputError) -> Iterator[None]:
    """Turn an OSError of the body into `error`, which names `path` and the reason."""
    try:
        yield
    except OSError as problem:
        raise error(f"cannot read {path}: {problem.strerror or problem}") from problem


@contextmanager
def device_memory_errors(advice: str, frames: int, height: int, width: int) -> Iterator[None]:
    """Raise DeviceMemoryError with one sentence, which ends with `advice`, where the device runs out of memory."""
    try:
        yield
    except RuntimeError as error:  # jax's own error is one; this module does not import jax
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise DeviceMemoryError(
            f"{frames} frames of {width} x {height} pixels do not fit in the memory of the device; take {advice}"
        ) from error


def one_line(text: str, most: int = 300) -> str:
    """Return text for one line of a terminal, a table or a page: printable, at most `most` letters."""
    line = " ".join(text[: 4 * most].split())
    line = line if len(line) <= most else f"{line[: most - 3]}..."
    return "".join(letter if letter.isprintable() else "?" for letter in line)


def problems_sentence(subject: str, problems: Sequence[str]) -> str:
    """Return one sentence with the number of problems and the text of the first ones."""
    shown = "; ".join(map(one_line, problems[:_MOST_PROBLEMS]))
    more = f"; and {len(problems) - _MOST_PROBLEMS} more" if len(problems) > _MOST_PROBLEMS else ""
    return f"{subject}: {len(problems)} {'problem' if len(problems) == 1 else 'problems'}: {shown}{more}"
