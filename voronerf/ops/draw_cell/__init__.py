"""Leaves of a tree of Voronoi diagrams drawn by their distances. n points, m centres of all diagrams together, g
diagrams."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.checks import FLOATING, check_number
from voronerf.ops.locate_cell import check_tree
from voronerf.ops.nearest_centre import of_one_dtype

_OP = backends.declare("draw_cell")


def draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    *,
    temperature: float,
    depth: int,
    weights: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """A leaf for every point, drawn at random by its distances to the centres, level by level.

    On each level, centre i of the current diagram is drawn with a probability in proportion to

        exp(-d_i / temperature),    d_i = |x - c_i|,    with power weights d_i = sqrt(|x - c_i|^2 + max_j w_j - w_i),

    by the inverse of the cumulative distribution: the first centre up to which the probabilities sum to at least 1 - u,
    where u is the uniform number of the point for that level. The arithmetic is float64 if points, centres or weights
    are, else float32. A point that is not finite, or whose squared distances overflow, goes to the first centre on
    every level. Not differentiable.

    Args:
        points: [n, 3] floating point, n < 2**31. float16 and bfloat16 are taken as float32.
        centres: [m, 3] floating point, finite, m >= 1; every diagram has at least one.
        child_offsets: int32 [g + 1], g >= 1, and
        child: int32 [m]: the tree, as in `locate_cell`.
        uniforms: [n, depth] floating point, in 0 to 1; other values are clamped, and NaN counts as 0.
        temperature: above 0, finite, in scene units.
        depth: levels of the tree, 1 for a flat diagram.
        weights: [m] floating point or None: power diagrams (squared scene units), finite.
        backend: "auto" or "reference".

    Returns:
        leaf int32 [n].

    Raises:
        ValueError: shapes, devices, temperature, depth or an unknown backend; on the CPU also tables that are not a
            tree.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf import draw_cell
        >>> centres = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
        >>> child_offsets = torch.tensor([0, 2], dtype=torch.int32)  # a flat diagram
        >>> child = torch.tensor([-1, -2], dtype=torch.int32)
        >>> points = torch.tensor([[0.5, 0, 0], [0.5, 0, 0], [0.1, 0, 0]])
        >>> uniforms = torch.tensor([[0.8], [0.2], [0.2]])  # the first two points lie on the border
        >>> draw_cell(points, centres, child_offsets, child, uniforms, temperature=0.1, depth=1)
        tensor([0, 1, 0], dtype=torch.int32)
    """
    given = check_tree(_OP, points, centres, child_offsets, child, depth, weights)
    given.sizes["depth"] = depth
    given.tensor("uniforms", uniforms, FLOATING, "n", "depth")
    check_number(_OP, "temperature", temperature)
    if not 0.0 < temperature < float("inf"):
        raise ValueError(f"{_OP}: temperature must be positive and finite, got {temperature}")
    points, centres, weights = of_one_dtype(points, centres, weights)
    uniforms = uniforms.detach().to(points.dtype)
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=points.dtype)
    host = _on_host(points)
    if host:
        _check_tree(child_offsets, child)
    leaf: Tensor = run(points, centres, child_offsets, child, uniforms, float(temperature), depth, weights)
    if host and bool((leaf < 0).any()):
        raise ValueError(f"{_OP}: depth must be the number of levels of the tree, got {depth}, which is too few")
    return leaf


def _on_host(points: Tensor) -> bool:
    """Whether values can be looked at without waiting for a device."""
    return points.device.type == "cpu" and not torch.compiler.is_compiling()


def _check_tree(child_offsets: Tensor, child: Tensor) -> None:
    if int(child_offsets[0]) != 0 or int(child_offsets[-1]) != len(child):
        ends = child_offsets[[0, -1]].tolist()
        raise ValueError(f"{_OP}: child_offsets must go from 0 to the number of centres, got {ends}")
    if bool((child_offsets.diff() < 1).any()):
        raise ValueError(f"{_OP}: child_offsets must increase, got a diagram without centres")
    if bool((child >= len(child_offsets) - 1).any()):
        raise ValueError(f"{_OP}: child must name a diagram, got {int(child.max())}")
