"""Draws valid arguments of ``grouped_program`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.program import HASH, PARAMETER, Builder, Columns, Program


def every_step() -> Program:
    """Returns a program with every kind of step and of operand."""
    b = Builder()
    x, y = b.input(5), b.input(3)
    weight, vector = b.parameter(7, 8), b.parameter(7)
    h = b.linear(x, weight, 7, add=Columns(PARAMETER, vector, 0, 7))
    h = b.linear(y, weight, 7, 5, add=h)
    h = b.apply("relu", h)
    scaled = b.binary("mul", h, Columns(PARAMETER, vector, 0, 7))
    shifted = b.binary("add", scaled, Columns(PARAMETER, vector, 2, 7, True))
    back = b.linear(shifted, weight, 6, 1, transposed=True)
    total = b.total(back, 3)
    one = b.total(back, 6)
    squared = b.apply("power", one._replace(width=6, spread=True), 2.0)
    share = b.binary("div", back, b.apply("affine", squared, 1.0, 3.0))
    moved = b.move(12, [(share.part(1, 4), 0), (y, 5), (total, 8), (one, 11)])
    added = b.move(4, [(moved.part(0, 3), 1), (share.part(2, 3), 0)])
    gated = b.binary("gate", added, b.apply("step", x.part(0, 4)))  # inputs are not rounded, so the jump is exact
    return b.program([b.binary("sub", gated, moved.part(7, 4)), shifted, one])


def smooth(width: int = 9) -> Program:
    """Returns a program of layers with smooth activations and a skip connection."""
    b = Builder()
    x = b.input(4)
    h = b.apply("softplus", b.linear(x, b.parameter(width, 4), width), 5.0, 20.0)
    h = b.apply("gelu", b.linear(b.move(width + 4, [(h, 0), (x, width)]), b.parameter(3, width + 4), 3))
    return b.program([b.apply("tanh", b.linear(h, b.parameter(2, 3), 2))])


GRID = HashGrid(levels=2, features=2, log2_entries=10, base=3, finest=12)


def encoded(width: int = 9) -> Program:
    """Returns a program with every encoding, directions of rays, and outputs by row and by ray."""
    b = Builder()
    x, gaussians, direction = b.input(3), b.input(4), b.input(3, ray=True)
    parts = [b.encode(HASH, x, b.grid(GRID.text), b.parameter(*GRID.table_shape))]
    for name, encoding in ENCODINGS.items():
        raw = direction if not encoding.positions else x if encoding.fits(3, 2) else gaussians
        parts.append(b.encode(name, raw, 2))
    places = [sum(part.width for part in parts[:i]) for i in range(len(parts))]
    total = sum(part.width for part in parts)
    h = b.linear(b.move(total, list(zip(parts, places))), b.parameter(width, total), width)
    h = b.linear(b.apply("softplus", h, 1.0, 20.0), b.parameter(3, width), 3)
    return b.program([h, b.binary("mul", h, direction)], by_ray=[1])


def _make(draw: Draw, n: int) -> Arguments:
    k, kind = draw.among("k", 3, 1, 2, 17), draw.among("program", "steps", "smooth", "encoded")
    jumps = kind == "steps"
    width = draw.number("w", 9, 1, 70)
    program = every_step() if jumps else smooth(width) if kind == "smooth" else encoded(width)
    dtype = torch.float32 if jumps else draw.dtype()  # in half precision a value may cross a jump
    r = draw.number("rays", 4, 1, 9)
    inputs = [draw.uniform(r if i in program.rays else n, w, dtype=dtype) for i, w in enumerate(program.inputs)]
    if kind != "encoded":
        inputs = [draw.normal(n, w, dtype=dtype) for w in program.inputs]
    parameters = []
    for i, shape in enumerate(program.parameters):
        few = draw.among("shared", k, 1)
        of = draw.among("table's dtype", dtype, torch.bfloat16) if i in program.tables else dtype
        parameters.append((draw.normal(few, *shape, dtype=torch.float64) / shape[-1] ** 0.5).to(of))
    order = torch.randperm(n, generator=torch.Generator().manual_seed(n)).int()
    return {
        "inputs": inputs,
        "parameters": parameters,
        "offsets": draw.offsets(n, k),
        "program": program,
        "order": order if draw.among("ordered", False, True) else None,
        "ray_index": draw.integers(0, r, n) if program.rays else None,
    }


CASE = Case(
    _make,
    {
        "": {},
        "shared, in any order": {"shared": 1, "ordered": True},
        "smooth": {"program": "smooth"},
        "encoded": {"program": "encoded"},
        "encoded, shared, in any order": {"program": "encoded", "shared": 1, "ordered": True},
    },
    refused={
        "program must be a Program, got str": {"program": "x"},
        "inputs must have 2 tensors, got 0": {"inputs": []},
        "parameters must have 2 tensors, got 0": {"parameters": []},
        "inputs[0] must have shape [n, 5], got [6, 3]": {"inputs": [torch.ones(6, 3), torch.ones(6, 3)]},
        "parameters[0] must have shape [k, 7, 8] with k = 3, got [4, 7, 8]": {
            "parameters": [torch.ones(4, 7, 8), torch.ones(3, 7)]
        },
        "parameters[1] must have the dtype of parameters[0], float64, got float32": {
            "parameters": [torch.ones(3, 7, 8).double(), torch.ones(3, 7)]
        },
        "order must have shape [n] with n = 6, got [3]": {"order": torch.zeros(3, dtype=torch.int32)},
        "ray_index must be None for a program without inputs of rays, got an index": {
            "ray_index": torch.zeros(6, dtype=torch.int32)
        },
    },
    differentiable=True,
    hostile="indices",
)
