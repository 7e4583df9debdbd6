"""Counts what a program executes: a compiled program's instructions and bytes, a traced program's matrix products."""

import re
from collections import Counter
from typing import NamedTuple

import numpy as np

_FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "partition-id", "replica-id"}
_BYTES = {"pred": 1, "s8": 1, "u8": 1, "f16": 2, "bf16": 2, "s16": 2, "u16": 2, "f64": 8, "s64": 8, "u64": 8}


class Instruction(NamedTuple):
    """A line of a compiled program."""

    shape: str
    opcode: str
    operands: list[str]
    line: str
    root: bool


def parse(text: str) -> tuple[dict[str, dict[str, Instruction]], str]:
    """Computations of a compiled program's text, instructions by name, and the entry's name."""
    computations: dict[str, dict[str, Instruction]] = {}
    entry, current = "", {}
    for line in text.splitlines():
        if line.endswith("{") and (header := re.match(r"(ENTRY )?%?([\w.\-]+) \(", line)):
            current = computations.setdefault(header[2], {})
            entry = header[2] if header[1] else entry
        elif made := re.match(r"\s+(ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*)", line):
            operands = re.findall(r"%([\w.\-]+)", made[5].split("), ", 1)[0])
            current[made[2]] = Instruction(made[3], made[4], operands, line, bool(made[1]))
    return computations, entry


def size(shape: str) -> int:
    """Bytes of a shape such as ``f32[3,4]{1,0}``, or of a tuple of them."""
    found = re.findall(r"(\w+)\[([\d,]*)\]", re.sub(r"/\*.*?\*/", "", shape))
    return sum(_BYTES.get(kind, 4) * int(np.prod([int(n) for n in dims.split(",") if n])) for kind, dims in found)


def executed(text: str) -> tuple[Counter[str], float]:
    """Instructions that a compiled program executes, by kind, and the bytes that they write.

    A loop of unknown length counts once, and of a branch the longer side.
    """
    computations, entry = parse(text)
    known: dict[str, tuple[Counter[str], float]] = {}

    def called(line: str, attribute: str) -> list[str]:
        found = re.search(attribute + r"=(?:\{([^}]*)\}|(%?[\w.\-]+))", line)
        return [name.lstrip("%") for name in (found[1] or found[2]).split(", ")] if found else []

    def written(instruction: Instruction, inside: dict[str, Instruction]) -> float:
        if instruction.opcode == "fusion":
            body = computations[called(instruction.line, "calls")[0]]
            root = next(i for i in body.values() if i.root)
            return written(root, body) if root.opcode in ("dynamic-update-slice", "scatter") else size(root.shape)
        # In place: what is new.
        if instruction.opcode in ("dynamic-update-slice", "scatter"):
            new = inside.get(instruction.operands[1 if instruction.opcode == "dynamic-update-slice" else -1])
            return size(new.shape) if new else 0.0
        return size(instruction.shape)

    def of(name: str) -> tuple[Counter[str], float]:
        if name in known:
            return known[name]
        count: Counter[str] = Counter()
        total = 0.0
        for instruction in computations[name].values():
            if instruction.opcode in _FREE or instruction.opcode.endswith("-done"):
                continue
            if instruction.opcode == "while":
                trips = re.search(r'"known_trip_count":\{"n":"(\d+)"', instruction.line)
                parts = [of(n) for key in ("body", "condition") for n in called(instruction.line, key)]
                times = int(trips[1]) if trips else 1
            elif instruction.opcode == "conditional":
                sides = ("branch_computations", "true_computation", "false_computation")
                names = [name for key in sides for name in called(instruction.line, key)]
                parts, times = [max((of(n) for n in names), key=lambda part: part[0].total())], 1
            elif instruction.opcode == "call":
                parts, times = [of(n) for n in called(instruction.line, "to_apply")], 1
            else:
                parts, times = [(Counter([instruction.opcode.removesuffix("-start")]), 0.0)], 1
                total += written(instruction, computations[name])
            for counted, moved in parts:
                count.update({kind: times * n for kind, n in counted.items()})
                total += times * moved
        known[name] = count, total
        return known[name]

    return of(entry)


def products(jaxpr) -> float:
    """Floating-point operations of the matrix products in a traced program; a loop of unknown length counts once."""
    from jax.extend.core import ClosedJaxpr, Jaxpr

    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            total += 2.0 * np.prod(equation.outvars[0].aval.shape) * np.prod([left[i] for i in contracted])
        inner = [p for value in equation.params.values() for p in (value if isinstance(value, tuple) else (value,))]
        inner = [p.jaxpr if isinstance(p, ClosedJaxpr) else p for p in inner]
        below = [products(p) for p in inner if isinstance(p, Jaxpr)]
        if below:
            most = max(below) if equation.primitive.name == "cond" else sum(below)
            total += equation.params.get("length", 1) * most if equation.primitive.name == "scan" else most
    return total
