"""The benchmarks' command line: python -m benchmarks NAME; docs/benchmarks.md says who runs which, and what for."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro

from benchmarks.accelerator.command import accelerator
from benchmarks.approximations import approximations
from benchmarks.demo_model import demo_model
from benchmarks.embed import embed
from benchmarks.gpu_day.command import gpu_day
from benchmarks.known import known
from benchmarks.long_clips import long_clips
from benchmarks.memory import memory
from benchmarks.refine_cameras import refine_cameras
from benchmarks.second_pass import second_pass
from benchmarks.speed import speed
from benchmarks.static_mesh import mesh_distance
from benchmarks.suite.command import suite
from vggtjax.errors import VggtjaxError

COMMANDS = {
    "accelerator": accelerator,
    "approximations": approximations,
    "demo-model": demo_model,
    "embed": embed,
    "gpu-day": gpu_day,
    "known": known,
    "long-clips": long_clips,
    "memory": memory,
    "refine-cameras": refine_cameras,
    "second-pass": second_pass,
    "speed": speed,
    "static-mesh": mesh_distance,
    "suite": suite,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; return the exit code: 0, or 2 for bad input or output."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="python -m benchmarks", description="Measurements of vggtjax.", args=arguments
        )
    except VggtjaxError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
