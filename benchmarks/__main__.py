"""The benchmarks' command line: python -m benchmarks NAME; docs/benchmarks.md says who runs which, and what for."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from pkgutil import resolve_name

import tyro

from vggtjax.errors import InputError, VggtjaxError

COMMANDS = {  # imported where it is called, so that one command needs no other's packages
    "accelerator": "benchmarks.accelerator.command:accelerator",
    "consistent-depth": "benchmarks.consistent_depth:consistent_depth",
    "demo-model": "benchmarks.demo_model:demo_model",
    "embed": "benchmarks.embed:embed",
    "extend": "benchmarks.extend:extend",
    "gpu-day": "benchmarks.gpu_day.command:gpu_day",
    "masked-pixels": "benchmarks.masked_pixels:masked_pixels",
    "memory": "benchmarks.memory:memory",
    "speed": "benchmarks.speed:speed",
    "static-mesh": "benchmarks.static_mesh:mesh_distance",
    "suite": "benchmarks.suite.command:suite",
}
_PROGRAM = "python -m benchmarks"
_GONE = ("approximations", "known", "long-clips", "refine-cameras", "second-pass")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; return the exit code: 0, or 2 for bad input or output."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if given and given[0] in _GONE:
            raise InputError(f"{given[0]} is no longer there; commit 2922dfe is the last that has it")
        if given and given[0] in COMMANDS:
            tyro.cli(_command(given[0]), prog=f"{_PROGRAM} {given[0]}", args=given[1:])
        else:
            every = {name: _command(name) for name in COMMANDS}
            about = "Measurements of vggtjax."
            tyro.extras.subcommand_cli_from_dict(every, prog=_PROGRAM, description=about, args=given)
    except VggtjaxError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 2
    finally:
        logging.disable(logging.NOTSET)  # some commands disable warnings
    return 0


def _command(name: str) -> Callable[..., None]:
    return resolve_name(COMMANDS[name])


if __name__ == "__main__":
    sys.exit(main())
