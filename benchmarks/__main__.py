"""The benchmarks' command line: python -m benchmarks NAME ..."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro

from benchmarks.approximations import approximations
from benchmarks.batch import batch
from benchmarks.cluster import cluster
from benchmarks.demo_model import demo_model
from benchmarks.determinism import determinism
from benchmarks.devices import devices
from benchmarks.embed import embed
from benchmarks.first_run import first_run
from benchmarks.fuzz import fuzz
from benchmarks.gpu_day.command import gpu_day
from benchmarks.gradient import gradient
from benchmarks.kills import kills
from benchmarks.known import known
from benchmarks.leads import leads
from benchmarks.long_clips import long_clips
from benchmarks.masks import masks
from benchmarks.mutants import mutants
from benchmarks.peak_memory import peak_memory
from benchmarks.point_clouds import point_clouds
from benchmarks.refine_cameras import refine_cameras
from benchmarks.refinement import refinement
from benchmarks.resolution import resolution
from benchmarks.second_pass import second_pass
from benchmarks.speed import speed
from benchmarks.suite.command import suite
from benchmarks.suite.gpu_targets import gpu_targets
from benchmarks.suite.memory import memory
from benchmarks.training_step import training_step
from benchmarks.viewer import viewer
from testing.make_checkpoint import main as make_checkpoint
from vggtjax.errors import VggtjaxError

COMMANDS = {
    "approximations": approximations,
    "batch": batch,
    "cluster": cluster,
    "demo-model": demo_model,
    "determinism": determinism,
    "devices": devices,
    "embed": embed,
    "first-run": first_run,
    "gpu-day": gpu_day,
    "fuzz": fuzz,
    "gpu-targets": gpu_targets,
    "gradient": gradient,
    "kills": kills,
    "known": known,
    "leads": leads,
    "long-clips": long_clips,
    "make-checkpoint": make_checkpoint,
    "masks": masks,
    "memory": memory,
    "mutants": mutants,
    "peak-memory": peak_memory,
    "point-clouds": point_clouds,
    "refine-cameras": refine_cameras,
    "refinement": refinement,
    "resolution": resolution,
    "second-pass": second_pass,
    "speed": speed,
    "suite": suite,
    "training-step": training_step,
    "viewer": viewer,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; return the exit code: 0, or 2 for bad input or output."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="python -m benchmarks",
            description="Measurements of vggtjax, and the files that they need.",
            args=arguments,
        )
    except VggtjaxError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
