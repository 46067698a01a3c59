"""The whole route in one operation. n samples, r rays, k cells, m centres of all diagrams together, g diagrams, p and q
features of a position and a direction."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import (
    INDEX,
    check_count,
    check_dtype,
    check_integer,
    check_no_inference,
    check_same_device,
    check_shape,
)
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp.checks import check_network
from voronerf.ops.nearest_centre import of_one_dtype
from voronerf.ops.routed_mlp.reference import Operations, Where
from voronerf.ops.routed_mlp.reference import routed_mlp as compose

_OP = backends.declare("routed_mlp", native=Implementation(EVERYWHERE, FLOATS))
_DEFAULTS: dict[str, Any] = {
    **dict.fromkeys(("layers", "directions", "direction_index", "features", "frozen")),
    **Where._field_defaults,
}


def routed_mlp(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    centres: Tensor | None = None,
    child_offsets: Tensor | None = None,
    child: Tensor | None = None,
    depth: int = 1,
    cells: Tensor | None = None,
    coords: Tensor | None = None,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    frozen: Tensor | None = None,
    rows: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Evaluates every sample by the network of the cell it lies in; results are in the order of the samples.

    Equivalent to ``locate_cell``, ``cell_sort``, permuting the inputs, ``grouped_mlp``, and undoing the permutation.
    The native CPU implementation gathers and scatters rows inside the tiles of the network: it makes no permuted copy,
    and keeps only the order (int32) for the backward pass, and of hashed positions their features. Gradients of every
    order to positions, directions, features, weights and biases; none through the choice of the cell. A sample whose
    coordinates are not finite goes to the first cell, as in ``locate_cell``. A network of one cell (k = 1) needs no
    tables, and is neither located nor sorted.

    Args:
        positions: [n, p] floating point, n < 2**31: the input of the layers, as in ``grouped_mlp``.
        weights: one [k, o, i] for each layer, all of one dtype.
        biases: one [k, o] or None for each layer.
        layers: the layer table.
        centres: [m, 3], the centres of the tree as in ``locate_cell``; without ``child_offsets`` and ``child``, the
            centres of a flat diagram, [k, 3].
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram. The leaves are the cells, 0 to k - 1.
        depth: levels of the tree.
        cells: int32 [n], the cell of each sample, 0 to k - 1, instead of the tables: a stochastic assignment, or one
            that is reused.
        coords: [n, 3] floating point, the locations of the samples; None uses the first three features of the
            positions.
        directions: [n, q], or [r, q] with ``direction_index``; None where no layer reads directions.
        direction_index: int32 [n], values 0 to r - 1: the row of ``directions`` of each sample.
        features: the table of the hash encoding, as in ``grouped_mlp``; None without a grid.
        frozen: bool [k], the cells whose samples have no gradient to anything, or None. On the CPU they take no part in
            the backward pass, unless positions or directions have gradients.
        rows: int32 [1], how many of the samples count; None for all. Those behind them have outputs of 0, no gradient
            and no cell: -1. On CUDA the host does not wait for the number, which `march_rays` with a capacity gives.
        backend: "auto", "reference" or "native". If there is no fused implementation, "auto" calls the separate
            operations, each on the backend it chooses.

    Returns:
        The output [n, layers.out_features] in the dtype of the weights (of autocast, where it is on), and cells int32
        [n].

    Raises:
        ValueError: on the CPU tables that are not a tree, cells outside 0 to k - 1 and a direction_index outside 0
            to r - 1.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer, routed_mlp
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))  # one linear layer, no encoding
        >>> weights = [torch.tensor([[[1.0, 0, 0]], [[100.0, 0, 0]]])]
        >>> positions = torch.tensor([[0.9, 0, 0], [0.1, 0, 0], [0.8, 0, 0]])
        >>> centres = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
        >>> out, cells = routed_mlp(positions, weights, [None], layers=table, centres=centres)
        >>> cells
        tensor([1, 0, 1], dtype=torch.int32)
        >>> out.flatten().round(decimals=4)  # in the order of the positions
        tensor([90.0000,  0.1000, 80.0000])
    """
    network = check_routed(
        _OP,
        positions,
        weights,
        biases,
        layers=layers,
        centres=centres,
        child_offsets=child_offsets,
        child=child,
        depth=depth,
        cells=cells,
        coords=coords,
        directions=directions,
        direction_index=direction_index,
        features=features,
        frozen=frozen,
        rows=rows,
    )
    device, dtype = positions.device, weights[0].dtype
    run: Callable[..., tuple[Tensor, Tensor]]
    if backend == "auto" and _is_composed(device.type, device.index, dtype):
        run = functools.partial(compose, operations=_operations(device, dtype, network["coords"]))
    else:
        run = backends.resolve(_OP, backend=backend, device=device, dtype=dtype)
    frozen = network.pop("frozen")
    out, found = run(**network)
    return (out if frozen is None else hold(out, of_samples(frozen, found))), found


def of_samples(frozen: Tensor, cells: Tensor) -> Tensor:
    """bool [n, 1], whether the cell of each sample is frozen; a sample in no cell, -1, is as the first."""
    return frozen.index_select(0, cells.clamp(min=0))[:, None]


def hold(out: Tensor, rows: Tensor) -> Tensor:
    """The same values, with gradients of zero in rows bool [n, 1]; rows of zeros leave the backward pass of native."""
    return _Hold.apply(out, rows) if out.requires_grad else out


class _Hold(torch.autograd.Function):
    @staticmethod
    def forward(out: Tensor, rows: Tensor) -> Tensor:
        return out.view_as(out)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient.masked_fill(ctx.saved_tensors[0], 0), None


def check_routed(
    op: str, positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], **given: Any
) -> dict[str, Any]:
    """All arguments of `routed_mlp` but for the backend, checked; what is compared has one dtype."""
    network = {**_DEFAULTS, **given}
    if network.keys() != _DEFAULTS.keys():
        raise TypeError(f"{op}: unknown arguments {', '.join(network.keys() - _DEFAULTS.keys())}")
    tables = {name: network[name] for name in ("centres", "child_offsets", "child", "cells")}
    frozen = network["frozen"]
    read = {name: network[name] for name in ("directions", "direction_index", "features")}
    coords, centres = network["coords"], network["centres"]
    sizes: dict[str, int] = {}
    check_shape(op, "positions", positions, ("n", "p"), sizes)
    check_dtype(op, "positions", positions)
    check_count(op, "positions", sizes["n"])
    check_network(op, weights, biases, network["layers"], **read, sizes=sizes)
    _check_tables(op, **tables, depth=network["depth"], sizes=sizes)
    if frozen is not None:
        check_shape(op, "frozen", frozen, ("k",), sizes)
        check_dtype(op, "frozen", frozen, (torch.bool,))
    rows = network["rows"]
    if rows is not None:
        check_shape(op, "rows", rows, (1,))
        check_dtype(op, "rows", rows, INDEX)
    if coords is not None:
        if centres is None:
            raise ValueError(f"{op}: coords must come with centres, got none to compare them with")
        check_shape(op, "coords", coords, ("n", 3), sizes)
        check_dtype(op, "coords", coords)
    elif centres is not None and sizes["p"] < 3:
        raise ValueError(f"{op}: coords must be given for positions of less than 3 features, got {sizes['p']}")
    device, tables["rows"] = positions.device, rows
    every = positions, coords, frozen, *tables.values(), *read.values(), *weights, *biases
    if torch.compiler.is_compiling() or any(t is not None and (t.device != device or t.is_inference()) for t in every):
        tensors = {  # named for an error alone
            "positions": positions,
            "coords": coords,
            "frozen": frozen,
            **tables,
            **read,
            **{f"weights[{index}]": weight for index, weight in enumerate(weights)},
            **{f"biases[{index}]": bias for index, bias in enumerate(biases)},
        }
        check_same_device(op, **tensors)
        check_no_inference(op, **tensors)
    if centres is not None:
        points = positions[:, :3] if coords is None else coords
        network["coords"], network["centres"] = of_one_dtype(points, centres)
    return {"positions": positions, "weights": weights, "biases": biases, **network}


def _check_tables(
    op: str,
    centres: Tensor | None,
    child_offsets: Tensor | None,
    child: Tensor | None,
    depth: int,
    cells: Tensor | None,
    sizes: dict[str, int],
) -> None:
    if cells is not None:
        if centres is not None:
            raise ValueError(f"{op}: centres must be None where cells are given, got both")
        check_shape(op, "cells", cells, ("n",), sizes)
        check_dtype(op, "cells", cells, INDEX)
    if centres is None:
        for name, value in (("child_offsets", child_offsets), ("child", child)):
            if value is not None:
                raise ValueError(f"{op}: {name} must come with centres, got no centres")
        if cells is None and sizes["k"] != 1:
            raise ValueError(f"{op}: centres or cells must be given for {sizes['k']} cells, got neither")
        return
    if (child_offsets is None) != (child is None):
        missing = "child_offsets" if child_offsets is None else "child"
        raise ValueError(f"{op}: child_offsets and child must come together, got no {missing}")
    check_shape(op, "centres", centres, ("k" if child is None else "m", 3), sizes)
    check_dtype(op, "centres", centres)
    check_integer(op, "depth", depth, 1)
    if child_offsets is None or child is None:
        if depth != 1:
            raise ValueError(f"{op}: depth must be 1 for a flat diagram, got {depth}")
        return
    check_shape(op, "child_offsets", child_offsets, ("g+1",), sizes)
    check_dtype(op, "child_offsets", child_offsets, INDEX)
    check_shape(op, "child", child, ("m",), sizes)
    check_dtype(op, "child", child, INDEX)
    if sizes["m"] < 1 or sizes["g"] < 1:
        count = f"{sizes['m']} centres in {sizes['g']} diagrams"
        raise ValueError(f"{op}: centres must hold at least one centre of one diagram, got {count}")


def _operations(device: torch.device, weights: torch.dtype, coords: Tensor | None) -> Operations:
    """Each operation on the backend that "auto" gives it."""
    where = torch.float32 if coords is None else coords.dtype
    dtypes = {"nearest_centre": where, "locate_cell": where, "cell_sort": torch.int32, "grouped_mlp": weights}
    return Operations(
        **{op: backends.resolve(op, backend="auto", device=device, dtype=dtype) for op, dtype in dtypes.items()}
    )


# torch.compile runs this while tracing and keeps the answer.
@constant_result
def _is_composed(device: str, index: int | None, dtype: torch.dtype) -> bool:
    where = torch.device(device) if index is None else torch.device(device, index)
    return all(backends.why_not(_OP, backend, where, dtype) is not None for backend in ("native", "warp"))
