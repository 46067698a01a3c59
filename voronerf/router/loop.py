"""The loop over cells: a module without a grouped form on the contiguous rows of each cell."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from voronerf.router.arguments import map_result, narrow, tensors_of
from voronerf.router.checkpointing import rerun_in
from voronerf.router.functions import RANDOM
from voronerf.router.grouping import Grouping
from voronerf.router.parameters import in_place_of_parameters, owned_parameters


class NoRandomness(TorchFunctionMode):
    """Random numbers are 0 and dropout does nothing, so that two calls can be compared."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func not in RANDOM:
            return func(*args, **kwargs)
        if "dropout" in getattr(func, "__name__", ""):
            return args[0] if args else kwargs["input"]
        return func(*args, **kwargs).zero_()


def run_cells(
    module: nn.Module,
    call: Callable[..., Any],
    args: Sequence[Any],
    kwargs: dict[str, Any],
    grouping: Grouping,
    rows: Callable[[Tensor], bool],
    check: bool,
) -> tuple[Any, bool]:
    """A module's results for sorted rows, one call for each cell that has any.

    Args:
        module: with stacked parameters.
        call: its method.
        args: as the module sees them, sorted.
        kwargs: likewise.
        grouping: of the rows.
        rows: whether a tensor among the arguments has rows.
        check: whether to find out first if the module mixes samples.

    Returns:
        The results, with tensors [rows of all cells, ...], and whether the check could be made.

    Raises:
        TypeError: when the module mixes samples.
        ValueError: for a result without a row for each sample.
    """
    parameters = {id(p): p for _, _, p in owned_parameters(module)}
    pieces = {key: parameter.unbind(0) for key, parameter in parameters.items()}

    def on_cell(cell: int, first: int, last: int) -> Any:
        part = narrow((tuple(args), kwargs), rows, first, last)
        own = {key: values[cell] for key, values in pieces.items()}

        @contextlib.contextmanager
        def again() -> Iterator[Callable[[Tensor], Any]]:
            with in_place_of_parameters(module, own):
                yield lambda _: None

        with in_place_of_parameters(module, own), rerun_in(again, lambda _: False):
            return call(*part[0], **part[1])

    occupied = grouping.occupied()
    checked = False
    if check:
        cell, first, last = max(occupied, key=lambda bounds: bounds[2] - bounds[1])
        if last - first >= 2:
            with NoRandomness():  # with gradients, which the module may take inside
                _check_rows(module, on_cell, cell, first, last)
            checked = True
    results = [on_cell(*bounds) for bounds in occupied]
    counts = [last - first for _, first, last in occupied]
    return _join(results, counts), checked


def _check_rows(module: nn.Module, on_cell: Callable[[int, int, int], Any], cell: int, first: int, last: int) -> None:
    middle = (first + last) // 2
    whole = [a for a in tensors_of(on_cell(cell, first, last)) if a.dim() and a.shape[0] == last - first]
    pairs = [(a[: middle - first], b) for a, b in zip(whole, tensors_of(on_cell(cell, first, middle)))]
    pairs += [(a[middle - first :], b) for a, b in zip(whole, tensors_of(on_cell(cell, middle, last)))]
    for a, b in pairs:
        if a.shape != b.shape or not same(a, b):
            raise TypeError(
                f"VoronoiRouter: module must treat samples one by one, but {type(module).__name__} gives other results "
                "for a sample when other samples are left out: it mixes samples (attention or statistics over a batch)"
            )


def same(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors are equal up to what the order of sums may change."""
    a, b = a.detach(), b.detach()
    if not a.is_floating_point():
        return torch.equal(a, b)
    return torch.allclose(a.double(), b.double(), rtol=1e-2, atol=1e-2 * _scale(a), equal_nan=True)


def _scale(values: Tensor) -> float:
    finite = values[values.isfinite()]
    return float(finite.abs().max()) if finite.numel() else 0.0


def _join(results: Sequence[Any], counts: Sequence[int]) -> Any:
    """The results of cells as one."""
    parts = [tensors_of(result) for result in results]
    if any(len(part) != len(parts[0]) for part in parts):
        raise ValueError("VoronoiRouter: module must return as many tensors for every cell, got different numbers")
    joined = iter([_join_tensors(pieces, counts) for pieces in zip(*parts, strict=True)])
    return map_result(results[0], lambda _: next(joined))


def _join_tensors(pieces: Sequence[Tensor], counts: Sequence[int]) -> Tensor:
    if all(piece.dim() > 0 and piece.shape[0] == count for piece, count in zip(pieces, counts, strict=True)):
        return torch.cat(list(pieces))
    raise ValueError(
        f"VoronoiRouter: results must have a row for each sample, got {list(pieces[0].shape)} for {counts[0]} samples"
    )
