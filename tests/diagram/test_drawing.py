"""Cells drawn at random by their distances, level by level, against the formula for one point at a time."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from voronerf.diagram.drawing import draw_cell

# Diagram 0 has three centres: the first is a leaf, diagram 1 refines the second, and diagram 2 refines the third.
# Diagram 3 refines the second centre of diagram 2. Leaves are numbered depth first.
CHILD_OFFSETS = torch.tensor([0, 3, 5, 7, 10], dtype=torch.int32)
CHILD = torch.tensor([-1, 1, 2, -2, -3, -4, 3, -5, -6, -7], dtype=torch.int32)
DEPTH = 3


def flat(k, device="cpu"):
    """Returns the tables of a diagram without children."""
    return (
        torch.tensor([0, k], dtype=torch.int32, device=device),
        -torch.arange(k, dtype=torch.int32, device=device) - 1,
    )


def draw(points, centres, uniforms, temperature):
    """Draws cells of a diagram without children, with one uniform number for each point."""
    return draw_cell(points, centres, *flat(centres.shape[0], centres.device), uniforms[:, None], temperature)


def slow(points, centres, tables, uniforms, temperature, depth):
    """Returns the leaves by the float64 formula, and how far each uniform number is from the border to another leaf."""
    offsets, child = tables
    leaves, margins = [], []
    for point, own in zip(points.double(), uniforms.double()):
        diagram, margin = 0, math.inf
        for level in range(depth):
            rows = slice(int(offsets[diagram]), int(offsets[diagram + 1]))
            squared = (point - centres[rows].double()).square().sum(-1)
            sums = torch.softmax(-squared.sqrt() / temperature, 0).cumsum(0)
            drawn = min(int((sums < 1 - own[level]).sum()), len(sums) - 1)
            margin = min([margin, *((sums[:-1] - (1 - own[level])).abs().tolist())])
            diagram = int(child[rows][drawn])
            if diagram < 0:
                break
        leaves.append(-diagram - 1)
        margins.append(margin)
    return leaves, margins


def agree(leaves, expected, margins, tolerance):
    """Checks equality, except for uniform numbers within rounding of a border, which must be few."""
    assert leaves.dtype == torch.int32
    clear = [i for i, margin in enumerate(margins) if margin > tolerance]
    assert len(clear) >= 0.95 * len(margins)
    actual = leaves.tolist()
    assert [actual[i] for i in clear] == [expected[i] for i in clear]


@pytest.mark.parametrize("n", [0, 1, 257])
def test_uneven_tree_is_the_formula(device, n):
    points, centres, uniforms = torch.randn(n, 3), torch.randn(10, 3), torch.rand(n, DEPTH)
    arguments = (tensor.to(device) for tensor in (points, centres, CHILD_OFFSETS, CHILD, uniforms))
    leaves = draw_cell(*arguments, temperature=0.4)
    expected = slow(points, centres, (CHILD_OFFSETS, CHILD), uniforms, 0.4, DEPTH)
    agree(leaves.cpu(), *expected, tolerance=1e-5)


@pytest.mark.parametrize(("k", "temperature"), [(1, 2.0), (17, 2.0), (17, 0.05), (1000, 0.05)])
def test_many_cells(device, k, temperature):
    points, centres, uniforms = torch.rand(301, 6)[:, ::2], torch.rand(k, 3), torch.rand(301)
    leaves = draw(points.to(device), centres.to(device), uniforms.to(device), temperature)
    expected = slow(points, centres, flat(k), uniforms[:, None], temperature, 1)
    agree(leaves.cpu(), *expected, tolerance=1e-5)


def test_numbers_at_and_beyond_the_ends(device):
    """Numbers up to 0 and NaN draw the last centre with a nonzero probability, numbers near or above 1 the first."""
    centres = torch.tensor([[50.0, 0, 0], [0, 0, 0], [1, 0, 0], [60, 0, 0]], device=device)
    uniforms = torch.tensor([0.0, -3.0, math.nan, 1 - 2**-24, 1.0, 7.0], device=device)
    leaves = draw(torch.zeros(6, 3, device=device), centres, uniforms, 0.5)
    assert leaves.tolist() == [2, 2, 2, 1, 1, 1]


def test_the_reference_where_sums_do_not_rise(monkeypatch):
    """Padding columns are not drawn if cumulative sums are added in a tree, as on a GPU.

    Rounding then makes the sum at the last padding column larger than the sum at the last centre.
    """

    def tree(values, dim):
        step = 1
        while step < values.shape[dim]:
            values = values + torch.nn.functional.pad(values[:, :-step], (step, 0))
            step *= 2
        return values

    monkeypatch.setattr(Tensor, "cumsum", tree)
    points, centres = torch.rand(5000, 3), torch.rand(32, 3)
    centres[:2] = torch.tensor([[0.0, 0, 0], [1000, 0, 0]])  # no point is near the second centre
    offsets = torch.tensor([0, 2, 9, 32], dtype=torch.int32)
    child = torch.cat([torch.tensor([1, 2]), -1 - torch.arange(30)]).to(torch.int32)
    uniforms = torch.zeros(5000, 2)
    mass = torch.softmax(-(points[:, None] - centres[2:9]).norm(dim=2), 1)
    padded = torch.cat([torch.zeros(5000, 2), mass, torch.zeros(5000, 23)], 1)
    sums = padded.cumsum(1)
    assert bool((sums[:, -1] > sums[:, 8]).any())
    leaves = draw_cell(points, centres, offsets, child, uniforms, 1.0)
    # Each point draws the last of the seven leaves or, because of rounding, the leaf before it.
    assert int(leaves.min()) >= 5 and int(leaves.max()) == 6


def test_points_that_are_not_finite_take_the_first_centre_at_every_level(device):
    points = torch.tensor([[math.nan, 0, 0], [0, math.inf, 0], [1e30, 0, 0]], device=device)
    centres, uniforms = torch.rand(10, 3, device=device), torch.tensor([0.0, 0.5, 0.9], device=device)
    # In this tree the first centre of the root is refined too.
    child = torch.tensor([1, -1, 2, -6, -3, -4, 3, -5, -2, -7], dtype=torch.int32, device=device)
    leaves = draw_cell(
        points, centres, CHILD_OFFSETS.to(device), child, uniforms[:, None].expand(3, DEPTH), temperature=0.2
    )
    assert leaves.tolist() == [5, 5, 5]


def test_many_points_cross_the_pieces_and_do_not_depend_on_their_neighbours(device):
    centres, n = torch.rand(10, 3, device=device), 30_000
    points, uniforms = torch.rand(n, 3, device=device), torch.rand(n, DEPTH, device=device)
    tables = (CHILD_OFFSETS.to(device), CHILD.to(device))

    def run(rows):
        return draw_cell(points[rows], centres, *tables, uniforms[rows], temperature=0.2)

    leaves = run(slice(None))
    expected = slow(points[::97].cpu(), centres.cpu(), (CHILD_OFFSETS, CHILD), uniforms[::97].cpu(), 0.2, DEPTH)
    agree(leaves[::97].cpu(), *expected, tolerance=1e-5)
    # The order in which sums are added may depend on the shape, so a leaf may differ.
    assert int((run(slice(5, 4242)) != leaves[5:4242]).sum()) <= 1
