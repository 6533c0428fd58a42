"""What the kernels of an optimised program cost at least: a roofline of each, loops by their trips.

A kernel takes the longer of its products and of its bytes, and the time of a launch. Slices count as slices, and
updates in place as updates. A conditional counts each branch by how often it is taken. This is a bound for the program
as compiled, not a time: a real kernel reaches a part of it, and nothing overlaps here.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from benchmarks.accelerator.hlo import Instruction, Program, Shape
from benchmarks.accelerator.targets import Target

LAUNCH = 2e-6  # seconds between kernels
COLLECTIVES = ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter")
_FREE = {
    "parameter", "constant", "get-tuple-element", "tuple", "bitcast", "after-all", "partition-id", "replica-id",
    "optimization-barrier", "opt-barrier",
}  # fmt: skip
_ALIASES = {"bitcast", "convert", "copy", "transpose", "reshape"}
_SCOPES = re.compile(r"jit\([^)]*\)/|while/body/|closed_call/|checkpoint/|shard_map/")
_HALVES = ("bf16", "f16")
_BACKWARD = 2.5  # products of the gradient of fused attention, over those of attention

Flop = Counter[str]  # "bfloat16", "tf32" or "float32" -> operations, two per multiply-add
Shares = Mapping[str, float]  # named scope -> how often the flag of its conditional or loop is true


@dataclass
class Kernels:
    """All runs of one kernel."""

    origin: str
    opcode: str
    launches: float = 0.0
    seconds: float = 0.0
    bytes: float = 0.0
    flop: Flop = field(default_factory=Counter)


@dataclass
class Count:
    """A program's kernels, what it calls, and loops whose trips XLA does not know, which count once."""

    kernels: dict[tuple[str, str], Kernels] = field(default_factory=dict)
    library_calls: Counter[str] = field(default_factory=Counter)
    collectives: Counter[str] = field(default_factory=Counter)
    unknown_loops: int = 0

    @property
    def seconds(self) -> float:
        """The bound."""
        return sum(kernels.seconds for kernels in self.kernels.values())

    @property
    def launches(self) -> float:
        """The number of kernels that run."""
        return sum(kernels.launches for kernels in self.kernels.values())

    @property
    def bytes(self) -> float:
        """Bytes read and written."""
        return sum(kernels.bytes for kernels in self.kernels.values())

    @property
    def flop(self) -> Flop:
        """Operations of all products."""
        return sum((kernels.flop for kernels in self.kernels.values()), Counter())

    def longest(self, most: int) -> list[Kernels]:
        """Return the kernels that cost most."""
        return sorted(self.kernels.values(), key=lambda kernels: -kernels.seconds)[:most]


def count(program: Program, target: Target, shares: Shares) -> Count:
    """Count a program's kernels. Conditionals outside the scopes of `shares` count by their longest branch."""
    return _Counter(program, target, shares).run()


class _Counter:
    """The walk over a program."""

    def __init__(self, program: Program, target: Target, shares: Shares) -> None:
        self._program, self._target, self._shares = program, target, shares
        default = "tf32" if target.platform == "cuda" else "bfloat16"  # of float32 products without a precision
        self._kinds = {"DEFAULT": default, "HIGH": "tf32"}

    def run(self) -> Count:
        total = Count()
        self._visit(self._program.entry, 1.0, total)
        return total

    def _visit(self, name: str, times: float, total: Count) -> None:
        for instruction in self._program.computations[name].values():
            opcode = instruction.opcode
            if opcode in _FREE or opcode.endswith("-done"):
                continue
            if opcode == "while":
                trips = self._share(instruction) if instruction.trips is None else instruction.trips
                total.unknown_loops += trips is None
                if instruction.trips is None:  # its condition is a kernel, once more than its body
                    condition = re.search(r"condition=%([\w.\-]+)", instruction.text)
                    self._visit(condition.group(1) if condition else "", times * (1 + (trips or 1)), total)
                body = re.search(r"body=%([\w.\-]+)", instruction.text)
                self._visit(body.group(1) if body else "", times * (1 if trips is None else trips), total)
            elif opcode == "conditional":
                for branch, share in self._taken(instruction):
                    self._visit(branch, times * share, total)
            elif opcode == "call" and instruction.called:
                self._visit(instruction.called, times, total)
            else:
                self._kernel(name, instruction, times, total)

    def _taken(self, instruction: Instruction) -> list[tuple[str, float]]:
        """Return the branches of a conditional, and how often each is taken."""
        branches, share = instruction.branches, self._share(instruction)
        if share is not None and len(branches) == 2:
            return [(branches[0], 1 - share), (branches[1], share)]
        lengths = []
        for branch in branches:
            alone = Count()
            self._visit(branch, 1.0, alone)
            lengths.append(alone.seconds)
        return [(branches[lengths.index(max(lengths))], 1.0)]

    def _share(self, instruction: Instruction) -> float | None:
        """Return how often the flag of the innermost known scope is true; None outside of them."""
        scopes = reversed(instruction.origin.split("/"))
        return next((self._shares[scope] for scope in scopes if scope in self._shares), None)

    def _kernel(self, name: str, instruction: Instruction, times: float, total: Count) -> None:
        opcode = instruction.opcode.removesuffix("-start")
        if opcode in COLLECTIVES:
            total.collectives[opcode] += 1
        if opcode == "custom-call":
            total.library_calls[instruction.library_call] += 1
        flop, moved = self._flop(name, instruction), self._moved(name, instruction)
        key = (_SCOPES.sub("", instruction.origin), opcode)
        kernels = total.kernels.setdefault(key, Kernels(*key))
        kernels.launches += times
        kernels.seconds += times * (self._target.seconds(flop, moved) + LAUNCH)
        kernels.bytes += times * moved
        kernels.flop.update({kind: times * amount for kind, amount in flop.items()})

    # Operations.

    def _flop(self, name: str, instruction: Instruction) -> Flop:
        match instruction.opcode:
            case "dot":
                return self._dot(name, instruction)
            case "convolution":
                return self._convolution(name, instruction, instruction.result[0])
            case "fusion":
                return self._inside(instruction.called)
            case "custom-call":
                return self._library(name, instruction)
        return Counter()

    def _inside(self, name: str | None) -> Flop:
        total: Flop = Counter()
        for instruction in self._program.computations.get(name or "", {}).values():
            total.update(self._flop(name or "", instruction))
        return total

    def _library(self, name: str, instruction: Instruction) -> Flop:
        call = instruction.library_call
        if "cublas" in call:
            return self._dot(name, instruction)
        if "fmha" in call:
            return self._attention(name, instruction)
        if "conv" in call:
            gradient = self._program.operand(name, instruction, 1 if "BackwardFilter" in call else 0)
            return self._convolution(name, instruction, gradient if "Backward" in call else instruction.result[0])
        return Counter()

    def _dot(self, name: str, instruction: Instruction) -> Flop:
        left = self._program.operand(name, instruction, 0)
        found = re.search(r'lhs_contracting_dim(?:ension)?s"?[=:][\[{]([^\]}]*)', instruction.text)
        summed = 1
        for axis in re.findall(r"\d+", found.group(1) if found else ""):
            summed *= left.sides[int(axis)]
        return Counter({self._kind(left, instruction.text): 2.0 * instruction.result[0].size * summed})

    def _convolution(self, name: str, instruction: Instruction, output: Shape) -> Flop:
        """Count a convolution by its output, or a gradient by the gradient that it reads."""
        labels = re.search(r"dim_labels=\w+_(\w+)->", instruction.text)
        call = instruction.library_call
        kernel = instruction.result[0] if "BackwardFilter" in call else self._program.operand(name, instruction, 1)
        if labels is None or "o" not in labels.group(1) or len(kernel.sides) != len(labels.group(1)):
            return Counter()
        summed = kernel.size / max(kernel.sides[labels.group(1).index("o")], 1)
        read = self._program.operand(name, instruction, 0)
        return Counter({self._kind(read, instruction.text): 2.0 * output.size * summed})

    def _attention(self, name: str, instruction: Instruction) -> Flop:
        products = self._attended(name, instruction)
        return Counter({"bfloat16": products * (_BACKWARD if "Backward" in instruction.library_call else 1)})

    def _attended(self, name: str, instruction: Instruction) -> float:
        """Count both products of attention, whose operands are [B, T, N, D] and [B, K, N, D]."""
        queries, keys = (self._program.operand(name, instruction, i) for i in (0, 1))
        return 4.0 * queries.size * keys.sides[1]

    def _kind(self, read: Shape, text: str) -> str:
        """Return in which type a product is computed, by what it reads and by its precision."""
        if read.dtype in _HALVES:
            return "bfloat16"
        found = re.search(r'operand_precision"?[=:][\[{]"?(\w+)', text)
        return self._kinds.get(found.group(1).upper() if found else "DEFAULT", "float32")

    # Bytes.

    def _moved(self, name: str, instruction: Instruction) -> float:
        operands = [self._program.operand(name, instruction, i) for i in range(len(instruction.operands))]
        match instruction.opcode:
            case "dynamic-slice" | "slice" | "gather":
                return 2 * instruction.bytes
            case "dynamic-update-slice":
                return 2 * operands[1].bytes
            case "fusion":
                read, written = self._fused(instruction)
                whole = sum(shape.bytes if read.get(i) is None else read[i] for i, shape in enumerate(operands))
                return whole + (instruction.bytes if written is None else written)
            case "custom-call":  # not its scratch memory
                results = [shape for shape in instruction.result if shape.dtype not in ("u8", "s8")]
                return sum(shape.bytes for shape in (*operands, *results))
        return instruction.bytes + sum(shape.bytes for shape in operands)

    def _fused(self, instruction: Instruction) -> tuple[dict[int, float], float | None]:
        """Return bytes read of the operands that are read in part, and bytes written where they are an update's."""
        computation = self._program.computations.get(instruction.called or "", {})
        alias: dict[str, str] = {}
        number: dict[str, int] = {}
        reads: dict[str, list[float | None]] = {}
        written: float | None = None
        for inner in computation.values():
            if inner.opcode == "parameter":
                index = re.search(r"parameter\((\d+)\)", inner.text)
                number[inner.name], alias[inner.name], reads[inner.name] = int(index.group(1)), inner.name, []  # type: ignore[union-attr]
            elif inner.opcode in _ALIASES and inner.operands and inner.operands[0] in alias and not inner.is_root:
                alias[inner.name] = alias[inner.operands[0]]
        for inner in computation.values():
            if inner.name in alias:
                continue
            for position, operand in enumerate(inner.operands):
                if operand in alias:
                    reads[alias[operand]].append(_part(inner, position))
            if inner.opcode in ("dynamic-update-slice", "scatter") and (
                inner.is_root or _only_converted(computation, inner)
            ):
                update = inner.operands[1 if inner.opcode == "dynamic-update-slice" else -1]
                written = float(computation[update].bytes) if update in computation else None
        parts = {
            number[name]: sum(r for r in found if r is not None)
            for name, found in reads.items()
            if found and None not in found
        }
        return parts, written


def _part(inner: Instruction, position: int) -> float | None:
    """Return how many bytes an instruction reads of an operand; None for all of them."""
    if position == 0 and inner.opcode in ("dynamic-slice", "slice", "gather"):
        return float(inner.bytes)
    if position == 0 and inner.opcode in ("dynamic-update-slice", "scatter"):
        return 0.0
    return None


def _only_converted(computation: Mapping[str, Instruction], inner: Instruction) -> bool:
    """Return whether a fusion's output is the instruction's own, in another type or order."""
    root = next((found for found in computation.values() if found.is_root), None)
    return root is not None and root.opcode in _ALIASES and root.operands[:1] == (inner.name,)
