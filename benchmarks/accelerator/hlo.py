"""XLA's optimised programs, read from their text: computations, and the instructions of each."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

_BYTES = {
    "pred": 1, "s4": 1, "u4": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "s32": 4, "u32": 4, "s64": 8, "u64": 8,
    "bf16": 2, "f16": 2, "f32": 4, "f64": 8, "c64": 8, "c128": 16,
}  # fmt: skip
_SHAPE = re.compile(r"(\w+)\[([\d,]*)\]")
_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .*\{$")
_INSTRUCTION = re.compile(r"^\s+(ROOT )?%([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*)$")
_NAME = re.compile(r"%([\w.\-]+)")
_CALLED = re.compile(r"(?:calls|to_apply|body|called_computations)=\{?%([\w.\-]+)")


class Shape(NamedTuple):
    """Type and sides of an array."""

    dtype: str
    sides: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of its elements."""
        return math.prod(self.sides)

    @property
    def bytes(self) -> int:
        """Its size in memory."""
        return self.size * _BYTES.get(self.dtype, 0)


@dataclass(frozen=True)
class Instruction:
    """An instruction: `result` are the shapes of its outputs, `operands` the names of its inputs."""

    name: str
    result: tuple[Shape, ...]
    opcode: str
    operands: tuple[str, ...]
    text: str
    is_root: bool

    @property
    def bytes(self) -> int:
        """The size of its outputs."""
        return sum(shape.bytes for shape in self.result)

    @cached_property
    def called(self) -> str | None:
        """The computation that it calls, fuses, or loops over."""
        found = _CALLED.search(self.text)
        return found.group(1) if found else None

    @property
    def branches(self) -> list[str]:
        """The computations of a conditional: those of false and true, or in their order."""
        if found := re.search(r"branch_computations=\{([^}]*)\}", self.text):
            return _NAME.findall(found.group(1))
        sides = (re.search(rf"{side}_computation=%([\w.\-]+)", self.text) for side in ("false", "true"))
        return [found.group(1) for found in sides if found]

    @property
    def trips(self) -> int | None:
        """How often a loop runs; None where XLA does not know."""
        found = re.search(r'"known_trip_count":\{"n":"(\d+)"', self.text)
        return int(found.group(1)) if found else None

    @property
    def origin(self) -> str:
        """What jax calls the operation that it was made from."""
        found = re.search(r'op_name="([^"]*)"', self.text)
        return found.group(1) if found else self.name

    @property
    def library_call(self) -> str:
        """The function of a library that it calls; empty: none."""
        found = re.search(r'custom_call_target="([^"]+)"', self.text)
        return found.group(1) if found else ""


@dataclass(frozen=True)
class Program:
    """All computations by name; instructions by name, in their order."""

    computations: Mapping[str, Mapping[str, Instruction]]
    entry: str

    def operand(self, computation: str, instruction: Instruction, index: int) -> Shape:
        """Return the shape of an operand; that of no elements where it is not an array."""
        if index >= len(instruction.operands):
            return Shape("pred", (0,))
        source = self.computations[computation].get(instruction.operands[index])
        return source.result[0] if source is not None and source.result else Shape("pred", (0,))


def parse(text: str) -> Program:
    """Read the text of an optimised program."""
    computations: dict[str, dict[str, Instruction]] = {}
    entry = current = ""
    for line in text.splitlines():
        if found := _COMPUTATION.match(line):
            current = found.group(2)
            computations[current] = {}
            entry = current if found.group(1) else entry
        elif line.startswith("}"):
            current = ""
        elif current and (found := _INSTRUCTION.match(line)):
            root, name, result, opcode, rest = found.groups()
            shapes = tuple(Shape(dtype, _sides(sides)) for dtype, sides in _SHAPE.findall(result))
            operands = tuple(_NAME.findall(_arguments(rest)))
            computations[current][name] = Instruction(name, shapes, opcode, operands, line, bool(root))
    return Program(computations, entry)


def _sides(text: str) -> tuple[int, ...]:
    return tuple(int(side) for side in text.split(",") if side)


def _arguments(rest: str) -> str:
    """Return the text up to the parenthesis that closes the operands."""
    depth = 1
    for i, letter in enumerate(rest):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return rest[:i]
    return rest
