"""What does one step of a cloth do, by the compiled program, and how fast could it be at a given bandwidth?

    python -m benchmarks.kernels [--quick]

Cloths of n x n nodes (structural, shear and bend springs), symplectic Euler, float32. Nothing is timed: the optimised program of a rollout
is read, the loop over its steps found, and its kernels counted. Read, per step: `kernels`, and how many of them are `copies`, `pads` and
`clocks` (of single numbers); `bytes` per node that the kernels read and write, every operand once for each kernel that reads it; `needed`,
the bytes per node that no program can do without where nothing is kept in a cache: positions and velocities once in and out, two constants
a spring once in; `flops` per node, an expression counted once however often its loop computes it anew for shifted slices. `xla_bytes` is
the compiler's own count of the whole program with every loop's body once, in bytes per node. Then the limits that a bandwidth gives, in
million node-steps a second, by the bytes that the kernels move and by those that are needed. Where a cloth fits a cache, what counts is the
bandwidth of that cache.
"""

from __future__ import annotations

import re
from typing import Any

from . import explicit, scenes
from .measure import arguments, show, write

# Bandwidth [GB/s]: triad on one core and on two of the machine that docs/benchmarks.md names, its second-level caches, NVIDIA's H200.
BANDWIDTHS = {"one core": 40.0, "two cores": 71.0, "L2, two cores": 330.0, "H200": 4800.0}
SIZE_OF = {"pred": 1, "s8": 1, "u8": 1, "s32": 4, "u32": 4, "f32": 4, "s64": 8, "u64": 8, "f64": 8}
# What moves no memory of its own.
FREE = {"parameter", "get-tuple-element", "tuple", "constant", "bitcast", "after-all"}
ARITHMETIC = {"add", "subtract", "multiply", "divide", "maximum", "minimum", "rsqrt", "sqrt", "negate", "abs"}
INSTRUCTION = re.compile(r"^\s*(?:ROOT )?(%[\w.-]+) = (\w+)\[([\d,]*)\]\S* ([\w-]+)\((.*)$")


class Instruction:
    """One line of a computation: its name, what it does, how many entries of which size it gives, its operands and what it calls."""

    def __init__(self, match: re.Match[str]):
        self.name, kind, shape, self.operation, rest = match.groups()
        self.entries = 1
        for length in filter(None, shape.split(",")):
            self.entries *= int(length)
        self.bytes = self.entries * SIZE_OF[kind]
        self.operands = re.findall(r"%[\w.-]+", rest.split(")")[0])
        called = re.search(r"(?:calls|to_apply)=(%[\w.-]+)", rest)
        self.calls = called[1] if called else ""


def computations(text: str) -> dict[str, list[Instruction]]:
    """Instructions that give one array, by the name of their computation."""
    found: dict[str, list[Instruction]] = {}
    for part in re.split(r"\n}\n", text):
        head = re.search(r"^(?:ENTRY )?(%[\w.-]+) \(", part, re.M)
        if head:
            lines = part[head.end() :].splitlines()
            found[head[1]] = [Instruction(match) for line in lines if (match := INSTRUCTION.match(line))]
    return found


def step_of(text: str) -> tuple[list[Instruction], dict[str, list[Instruction]]]:
    """The body of the loop over steps: of the loops that hold no other, one that moves most; and all computations."""
    found = computations(text)
    outer = {head for part in re.split(r"\n}\n", text) if " while(" in part for head in re.findall(r"^(%[\w.-]+) \(", part, re.M)}
    bodies = set(re.findall(r"body=(%[\w.-]+)", text)) - outer
    return max((found[name] for name in bodies), key=moved), found


def kernels(body: list[Instruction]) -> list[Instruction]:
    """What is launched: everything that is not free."""
    return [one for one in body if one.operation not in FREE]


def moved(body: list[Instruction]) -> int:
    """Bytes that the kernels of a body read and write."""
    size = {one.name: one.bytes for one in body}
    return sum(one.bytes + sum(size.get(name, 0) for name in one.operands) for one in kernels(body))


def flops(body: list[Instruction], found: dict[str, list[Instruction]]) -> int:
    """Arithmetic of a body and of what it calls."""
    inner = sum(flops(found.get(one.calls, []), found) for one in body)
    return inner + sum(one.entries for one in body if one.operation in ARITHMETIC)


def row(n: int) -> dict[str, Any]:
    """One size."""
    system, state = scenes.sheet(n)
    function, given = scenes.program(system, state, explicit.DT, 100)
    program = function.lower(*given).compile()
    body, found = step_of(program.as_text())
    launched, nodes = kernels(body), n * n
    return {
        "n": n,
        "kernels": len(launched),
        "copies": sum(one.operation == "copy" for one in launched),
        "pads": sum("pad" in one.name for one in launched),
        "clocks": sum(one.entries == 1 for one in launched),
        "bytes": moved(body) / nodes,
        "needed": 4 * (12 + 2 * system.net.n_springs / nodes),
        "flops": flops(body, found) / nodes,
        "xla_bytes": program.cost_analysis()["bytes accessed"] / nodes,
    }


def limits(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Million node-steps a second at each bandwidth."""
    largest = rows[-1]
    return [
        {"bandwidth": name, "GB/s": rate, "by_bytes": rate * 1e3 / largest["bytes"], "by_needed": rate * 1e3 / largest["needed"]}
        for name, rate in BANDWIDTHS.items()
    ]


def main() -> None:
    """Read, print and write."""
    quick = arguments(__doc__).quick
    rows = [row(n) for n in ((32, 128) if quick else (32, 128, 512, 1024))]
    bounds = limits(rows)
    show("one step, by the compiled program", rows)
    show(f"limits at n = {rows[-1]['n']}, million node-steps / s", bounds)
    write("kernels", {"dtype": "float32"}, {"steps": rows, "limits": bounds})


if __name__ == "__main__":
    main()
