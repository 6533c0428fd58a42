"""The parts of gpu-day, in their order."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from benchmarks.gpu_day.kernels import kernels
from benchmarks.gpu_day.lines import Lines
from benchmarks.gpu_day.parity import parity
from benchmarks.gpu_day.paths import attention_paths
from benchmarks.gpu_day.speed import speed
from benchmarks.suite.cases import Size


class Part(NamedTuple):
    """A part: what it tells, its share of the time, and the function that tells it."""

    about: str
    share: float
    run: Callable[[Size, Lines], None]


PARTS = {
    "parity": Part("Are the numbers those of the public code, in float32 and in bfloat16?", 0.28, parity),
    "attention": Part("Has every way of attention the CPU's numbers, and how fast is it?", 0.16, attention_paths),
    "speed": Part("How long do the parts take, how much memory, and are the targets met?", 0.40, speed),
    "kernels": Part("Where does the time of both passes go?", 0.16, kernels),
}  # fmt: skip
