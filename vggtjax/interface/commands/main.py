"""The command line: a table of commands; an error becomes one sentence and an exit code. Does not import jax."""

from __future__ import annotations

import atexit
import contextlib
import difflib
import errno
import functools
import gc
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import tyro

from vggtjax import __version__
from vggtjax.errors import InputError, VggtjaxError, message_line, one_line, printable
from vggtjax.interface.commands.app import app
from vggtjax.interface.commands.batch import batch
from vggtjax.interface.commands.calibrate_cues import calibrate_cues
from vggtjax.interface.commands.check_weights import check_weights
from vggtjax.interface.commands.convert import convert
from vggtjax.interface.commands.demo import demo
from vggtjax.interface.commands.doctor import doctor
from vggtjax.interface.commands.evaluate import evaluate
from vggtjax.interface.commands.export import export
from vggtjax.interface.commands.extend import extend
from vggtjax.interface.commands.fit_fusion import fit_fusion
from vggtjax.interface.commands.flags import REGISTRY
from vggtjax.interface.commands.import_result import import_result
from vggtjax.interface.commands.info import info
from vggtjax.interface.commands.reconstruct import reconstruct
from vggtjax.interface.commands.render import render
from vggtjax.interface.commands.scenes import scenes
from vggtjax.interface.commands.train import train
from vggtjax.interface.commands.view import view
from vggtjax.storage.cache import enable_compilation_cache
from vggtjax.storage.interruption import message as message_of_interruption
from vggtjax.storage.process import check_limits, give_devices_threads, keep_freed_memory


class Command(NamedTuple):
    """A row of the table of commands, whose groups stand together."""

    run: Callable[..., int | None]  # an exit code other than 0; tyro makes its flags and its help
    group: str  # its title on the page
    says: str  # its line on the page


_START, _RESULTS, _MODELS = "Start", "Look at results, and pass them on", "Models"
_MEASURE, _COMPUTER = "Measure", "This computer"

COMMANDS = {
    "demo": Command(demo, _START, "reconstruct the clip that comes with the package, and measure it"),
    "reconstruct": Command(reconstruct, _START, "cameras, depth, masks and a 4-D point cloud of a clip"),
    "batch": Command(batch, _START, "the same for many clips; resumes where it was interrupted"),
    "extend": Command(extend, _START, "add frames of the same place to a finished result"),
    "view": Command(view, _RESULTS, "play results in a browser, or write them as one page"),
    "render": Command(render, _RESULTS, "films of a result: around it, or along its cameras"),
    "app": Command(app, _RESULTS, "a page to drop a video on"),
    "export": Command(export, _RESULTS, "write a result for another program, such as COLMAP or Blender"),
    "import": Command(import_result, _RESULTS, "convert a result of another program, such as MonST3R"),
    "info": Command(info, _MODELS, "what a model is: configuration, size; or a clip: frames, lens"),
    "convert": Command(convert, _MODELS, "convert PyTorch weights to one .safetensors"),
    "check-weights": Command(check_weights, _MODELS, "compare a model's outputs with those of the public PyTorch code"),
    "train": Command(train, _MODELS, "train a model on generated scenes, or finetune one"),
    "calibrate-cues": Command(calibrate_cues, _MODELS, "choose a model's motion cues"),
    "fit-fusion": Command(fit_fusion, _MODELS, "fit a rule that fuses the depth of the two passes"),
    "evaluate": Command(evaluate, _MEASURE, "score methods on a data set with ground truth"),
    "scenes": Command(scenes, _MEASURE, "generate clips with exact ground truth"),
    "doctor": Command(doctor, _COMPUTER, "versions, devices, memory, the longest clips, extras, the cache"),
}

_OUT_OF_MEMORY = (
    "out of memory; close other programs, or give the command less work, such as fewer frames (--max-frames, --stride) "
    "or a smaller --size where it has these options"
)
_OLD_FLAGS = {"--mode": "--preprocess"}  # still understood
_GONE = {  # a command, or one with a flag, or with a flag and its value: what to take instead
    "app --token": "--password sets what people sign in with, as the user vggtjax",
    "app --max-results": "results are removed after a day, and at the end of the app; leave it out",
    "export-model": "jax.export writes a model as a program, in the 25 lines of docs/how-to/jax-export.md",
    "train --workers": "a run takes one process; leave it out",
    "view --format viser": "vggtjax view RESULT --export PAGE.html writes a page that opens offline",
    "export --to viser": "--to rerun writes a recording, and vggtjax view RESULT --export PAGE.html a page",
}


class _OneLine(logging.Formatter):
    """A message on one printable line, whatever names of files are in it; a traceback on printable lines below it."""

    def format(self, record: logging.LogRecord) -> str:
        lines = [f"vggtjax: {message_line(record.getMessage())}"]
        if record.exc_info:
            lines += map(printable, self.formatException(record.exc_info).split("\n"))
        return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    0, 1 if nobody reads the output or a check does not hold, 2 for errors, 130 if interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # redirected, it may have a code page without a folder's letters
            stream.reconfigure(errors="replace")
    keep_freed_memory(training=list(arguments[:1]) == ["train"])
    give_devices_threads()
    atexit.register(gc.freeze)  # at the end there is nothing to collect, and a last collection takes half a second
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine())
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    for chatty in ("jax", "absl", "orbax", "matplotlib", "httpx", "httpx2", "huggingface_hub", "websockets", "numexpr"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.showwarning = lambda message, *_, **__: logging.getLogger("vggtjax").warning("%s", message)
    if "jax" not in sys.modules:  # else a program calls this function, which decides for itself
        enable_compilation_cache()  # after showwarning is set, which it replaces for some warnings
    code = 0
    try:
        if list(arguments) in (["--version"], ["-V"]):
            sys.stdout.write(f"vggtjax {__version__}\n")
        elif list(arguments) in (["--help"], ["-h"]):
            sys.stdout.write(overview(COMMANDS))
        elif not arguments:
            sys.stderr.write(overview(COMMANDS))
            return 2
        elif arguments[0] in COMMANDS and {"-h", "--help"} & set(arguments[1:]):
            print_help(arguments[0])
        else:
            command = _parsed(arguments)
            check_limits()
            code = command() or 0
        sys.stdout.flush()  # a broken pipe is noticed here
        return code
    except VggtjaxError as error:
        message, code = _with_flag(str(error), arguments), 2
    except MemoryError:  # of the host
        message, code = _OUT_OF_MEMORY, 2
    except RuntimeError as error:  # jax's own error is one
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        message, code = _OUT_OF_MEMORY, 2
    except BrokenPipeError:  # the reader of our output, such as head, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the last flush of the interpreter
        return 1
    except OSError as error:  # of a file that no other message covers
        text = f"{error.filename or 'a file'}: {error.strerror or error}"
        message, code = _OUT_OF_MEMORY if error.errno == errno.ENOMEM else text, 2
    except KeyboardInterrupt:
        message, code = message_of_interruption(), 130
    sys.stderr.write(f"vggtjax: {message_line(message)}\n")
    return code


def overview(commands: Mapping[str, Command]) -> str:
    """Return the page of `vggtjax --help`: the commands in the order of use, a line each."""
    width = max(map(len, commands))
    page = ["usage: vggtjax COMMAND ...", "", "4-D reconstruction of monocular video of a moving world.", ""]
    for title, rows in groupby(commands.items(), key=lambda row: row[1].group):
        page += [title, *(f"  {name:<{width}}  {command.says}" for name, command in rows), ""]
    page += ["vggtjax COMMAND --help tells the options of a command; --version prints the version.", ""]
    return "\n".join(page)


def _with_flag(message: str, arguments: Sequence[str]) -> str:
    """Return a message about fields ("mask_pairs is ...") with the flags that the user gave ("--mask-pairs is ...")."""
    flags = {argument.split("=")[0] for argument in arguments}

    def named(field: re.Match[str]) -> str:
        flag = f"--{field[0].replace('_', '-')}"
        return flag if flag in flags else field[0]

    return re.sub(r"(?:^|(?<= and ))\w+(?= is )", named, message)


def _renamed(argument: str) -> str:
    flag, equals, value = argument.partition("=")
    return f"{_OLD_FLAGS.get(flag, flag)}{equals}{value}"


def _refuse_gone(name: str, arguments: Sequence[str]) -> None:
    given = f" {' '.join(arguments)} ".replace("=", " ").replace("_", "-")
    for gone, instead in _GONE.items():
        command, _, flag = gone.partition(" ")
        if name.replace("_", "-") == command and (not flag or f" {flag} " in given):
            raise InputError(f"{gone} is no longer there: {instead}")


def _parsed(arguments: Sequence[str]) -> Callable[[], int | None]:
    """Return the command with its arguments, ready to be called.

    tyro prints errors of the option dataclasses in a box. Find the error in the chain of exceptions and raise it.
    """
    name, *others = arguments
    _refuse_gone(name, others)
    if name not in COMMANDS:
        similar = difflib.get_close_matches(name, COMMANDS, n=1)
        guess = f"did you mean {similar[0]}? " if similar else ""
        raise InputError(f"there is no command {one_line(name, 40)!r}; {guess}vggtjax --help lists all")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return _read_by_tyro(name, [_renamed(argument) for argument in others])
    except SystemExit as stop:
        error: BaseException | None = stop
        while error is not None:
            if isinstance(error, VggtjaxError):
                raise error from None
            error = error.__context__
        sys.stderr.write("\n".join(map(printable, complaint.getvalue().split("\n"))))
        raise


def _read_by_tyro(name: str, arguments: Sequence[str]) -> Callable[[], int | None]:
    """Return the command with its arguments, as tyro reads them.

    tyro reads the command's signature through `ready`. An option that all commands take is one more parameter in
    `ready.__signature__` and `ready.__annotations__`, which `ready` takes out of `options`.
    """
    command = COMMANDS[name].run

    @functools.wraps(command)
    def ready(*positional: object, **options: object) -> Callable[[], int | None]:
        return functools.partial(command, *positional, **options)

    config = (tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
    return tyro.cli(ready, prog=f"vggtjax {name}", args=arguments, config=config, registry=REGISTRY)


def print_help(name: str) -> None:
    """Print the help of a command, at the width of the terminal."""
    with contextlib.suppress(SystemExit):
        _read_by_tyro(name, ["--help"])
