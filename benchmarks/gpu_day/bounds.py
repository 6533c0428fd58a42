"""The bound of a program that was measured: what `accelerator` counts, in the very program and for the device there."""

from __future__ import annotations

from benchmarks.accelerator.count import count
from benchmarks.accelerator.hlo import parse
from benchmarks.accelerator.programs import shares_of
from benchmarks.accelerator.targets import TARGETS
from vggtjax.config import VGGTConfig
from vggtjax.errors import one_line


def bound(text: str, config: VGGTConfig, device: str) -> float | str:
    """Return the seconds that a program's kernels take at least, or why they are unknown.

    Args:
        text: the optimised program.
        config: its model.
        device: kind of the device, as its maker spells it.
    """
    target = next((target for target in TARGETS.values() if target.name == device), None)
    if target is None:
        return "no bound: unknown device"
    try:
        return count(parse(text), target, shares_of(config)).seconds
    except Exception as error:  # compilers change how they write programs; the time stands without a bound
        return f"no bound: {type(error).__name__}: {one_line(str(error), 100)}"
