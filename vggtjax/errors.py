"""Exceptions of the public boundary: one clear sentence each; the command line turns them into exit code 2."""

import operator
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec

MOST_LETTERS = 480  # of a message
_LEAST_PROBLEMS = 200  # letters of a message that are left to the problems which it lists


class VggtjaxError(Exception):
    """Base of all exceptions that this library raises on purpose.

    As text it is a `message_line`, whatever a stranger's file put into it.
    """

    def __str__(self) -> str:
        return message_line(super().__str__())


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


class ClusterError(VggtjaxError, RuntimeError):
    """A cluster that is not there, is too small, has died, or runs other code."""


class LoadOrderError(VggtjaxError, ImportError):
    """A library that was imported before this one, and breaks what this one needs."""


class MissingExtraError(VggtjaxError, ImportError):
    """A missing optional dependency; the message names the extra that installs it."""

    def __init__(self, purpose: str, extra: str) -> None:
        remedy = f"in the folder of the vggtjax clone: pip install -e '.[{extra}]'"
        super().__init__(f"{purpose} needs the extra '{extra}'; {remedy}")


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


def share(name: str, value: float) -> float:
    """Return `value` as a float in [0, 1], else raise InputError naming the argument."""
    if not 0 <= value <= 1:
        raise InputError(f"{name} is {value}; expected a number in [0, 1]")
    return float(value)


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Raise InputError, naming the argument, for a value that is not one of the choices."""
    if value not in choices:
        raise InputError(f"{name} is {value!r}; expected one of {', '.join(map(str, choices))}")


@contextmanager
def reading(path: object, error: type[InputError] = InputError) -> Iterator[None]:
    """Turn an OSError of the body into `error`, which names `path` and the reason.

    A pipe or a device is refused before the body: reading one may never end.
    """
    if isinstance(path, str | os.PathLike):
        check_regular(path, error)
    try:
        yield
    except OSError as problem:
        raise error(f"cannot read {path}: {problem.strerror or problem}") from problem


def check_regular(path: str | os.PathLike[str], error: type[InputError] = InputError) -> None:
    """Raise `error` where there is something at `path` that is neither a file nor a folder, such as a named pipe."""
    try:
        mode = os.stat(path).st_mode  # noqa: PTH116 - words that are no path are not looked into
    except (OSError, ValueError):
        return  # the reader says what is wrong
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise error(f"{path} is a pipe, a socket or a device; expected a file: copy its content into one")


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
    return printable(line if len(line) <= most else f"{line[: most - 3]}...")


def message_line(text: str) -> str:
    """Return the text of a message on one printable line of at most MOST_LETTERS letters.

    The middle of a longer message is left out, so that the advice at its end stays.
    """
    line = printable(text)
    if len(line) <= MOST_LETTERS:
        return line
    end = MOST_LETTERS // 3
    return f"{line[: MOST_LETTERS - end - 5]} ... {line[-end:]}"


def printable(text: str) -> str:
    """Return text on one line: a space for each blank letter such as a line's end, ? for others that do not print."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "?" for letter in text)


def problems_sentence(subject: str, problems: Sequence[str]) -> str:
    """Return one sentence with the number of problems, and as many of them as a message has room for."""
    room = max(_LEAST_PROBLEMS, MOST_LETTERS - len(subject) - len(": 1000 problems: ; and 1000 more"))
    shown: list[str] = []
    for problem in problems:
        shown.append(one_line(problem, _LEAST_PROBLEMS))
        room -= len(shown[-1]) + len("; ")
        if room < 0 and len(shown) > 1:
            shown.pop()
            break
    more = f"; and {len(problems) - len(shown)} more" if len(problems) > len(shown) else ""
    return f"{subject}: {len(problems)} {'problem' if len(problems) == 1 else 'problems'}: {'; '.join(shown)}{more}"
