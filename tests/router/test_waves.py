"""Frequency encodings, as codebases write them, become an encoding step that gives the same numbers."""

import math

import pytest
import torch
import torch.nn.functional as F
from router_loop import equals_loop
from torch import nn

from voronerf import VoronoiRouter
from voronerf.ops._core.program import PARAMETER, Builder, Columns
from voronerf.router.waves import with_encodings


def in_turns(x):  # nerf-pytorch
    return torch.cat([x] + [f(2.0**octave * x) for octave in range(4) for f in (torch.sin, torch.cos)], -1)


def of_bands(x):  # mip-NeRF's order: all sines, then all cosines
    bands = 2.0 ** torch.linspace(0.0, 4.0, 5) * math.pi
    angles = (x[..., None] * bands).flatten(-2)
    return torch.cat([angles.sin(), angles.cos(), x], -1)


def of_shifted(x):  # nerfstudio
    angles = (2 * math.pi * x)[..., None] * 2.0 ** torch.arange(4)
    angles = angles.view(*angles.shape[:-2], -1)
    return torch.sin(torch.cat([angles, angles + math.pi / 2], -1))


def with_a_start(x):  # BARF: weighted octaves
    weights = torch.tensor([1.0, 1.0, 0.5, 0.0])
    parts = [w * f(2.0**i * 3.0 * x) for i, w in enumerate(weights.tolist()) for f in (torch.sin, torch.cos)]
    return torch.cat([x, *parts], -1)


ENCODINGS = {
    "in turns": (in_turns, 1),
    "of bands": (of_bands, 1),
    "shifted": (of_shifted, 1),
    "with a start": (with_a_start, 1),
    "no octaves": (lambda x: torch.cat([torch.sin(f * x) + torch.cos(f * x) for f in (1.0, 3.0, 5.0)], -1), 1),
    "sines alone": (lambda x: torch.cat([torch.sin(2.0**i * x) for i in range(3)], -1), 0),
    "of a layer": (lambda x: (lambda y: torch.cat([y.sin(), y.cos()], -1))(x @ torch.ones(3, 3)), 1),
    "two columns": (lambda x: torch.cat([in_turns(x[:, :2]), x[:, 2:]], -1), 1),
}


class Encoded(nn.Module):
    def __init__(self, encode):
        super().__init__()
        self.encode = encode
        width = encode(torch.rand(2, 3)).shape[1]
        self.first, self.second = nn.Linear(width, 8), nn.Linear(8 + width, 2)

    def forward(self, x):
        x = self.encode(x)
        return self.second(torch.cat([F.relu(self.first(x)), x], -1))


@pytest.mark.parametrize(
    ("name", "backend"),
    [("in turns", "reference"), *(pytest.param(name, "native", marks=pytest.mark.native) for name in ENCODINGS)],
)
def test_gives_the_same(name, backend):
    encode, encodings = ENCODINGS[name]
    router = VoronoiRouter(Encoded(encode), torch.rand(3, 3), coords="first3", fuse=True, backend=backend)
    x = torch.rand(40, 3).requires_grad_()
    steps = [step.op for step in router.program(x, trace=True).program.steps]
    assert steps.count("encode") == encodings
    equals_loop(router, x, by=[x])
    assert router.explain() == "forward: fused"


def test_nothing_is_copied_that_lies_in_order():
    router = VoronoiRouter(Encoded(in_turns), torch.rand(3, 3), coords="first3", fuse=True)
    program = router.program(torch.rand(40, 3), trace=True).program
    assert [step.op for step in program.steps] == ["input", "encode", "linear", "function", "linear", "linear"]


def test_numbers_that_are_learnt_are_left():
    b = Builder()
    x, scale = b.input(3), b.parameter(3)
    angles = b.binary("mul", x, Columns(PARAMETER, scale, 0, 3))
    program = b.program([b.apply("sine", angles, 1.0), b.apply("sine", angles, 1.0, math.pi / 2)])
    programs = [with_encodings(program, constants) for constants in ({}, {scale: [3.0, 3.0, 3.0]})]
    assert [step.numbers for step in programs[0].steps if step.op == "encode"] == [(1, 0, 0, 0)]  # x * scale
    assert programs[0].steps[1].name == "mul" and [step.name for step in programs[1].steps] == [
        "",
        "affine",
        "frequency",
    ]
