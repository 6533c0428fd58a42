"""Types of options whose help texts tell their defaults in words. Does not import jax."""

from __future__ import annotations

from typing import Annotated, TypeVar

import tyro

T = TypeVar("T")

InWords = Annotated[T, tyro.conf.arg(help_behavior_hint="")]
"""An option whose text tells its default in words: the help adds no "(default: None)"."""

Switch = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")]
"""A flag that is off unless it is given, without a flag to turn it off."""
