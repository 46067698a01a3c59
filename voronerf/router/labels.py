"""Labels: the cells of a call's samples, passed instead of positions."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.router.layout import AS_TENSOR, as_plain, tensors_of
from voronerf.router.transforms import outside, unwrapped

_RULE = "VoronoiRouter: cells must"


class Labels(NamedTuple):
    """The cells of a call's samples.

    Attributes:
        cells: The labels as int32 [..., 1], passed on instead of positions [..., d].
        checked: Whether all labels are known to lie in 0 to k - 1.
    """

    cells: Tensor
    checked: bool

    @staticmethod
    def of(cells: Any, k: int, device: torch.device) -> Labels:
        """Checks the labels of a call; on a GPU this waits for the device.

        Compiled and captured graphs do not check the labels here. In such a graph, the operations raise for invalid
        labels on the CPU, and return 0 on a GPU.

        Args:
            cells: The labels, int32 or int64 [...], one for each sample, 0 to k - 1.
            k: The number of networks.
            device: The device of the networks' parameters.

        Raises:
            TypeError: If ``cells`` is not an int32 or int64 tensor.
            ValueError: If ``cells`` has no dimensions, is on another device, or has labels out of range.
        """
        if not isinstance(cells, Tensor) or cells.dtype not in (torch.int32, torch.int64):
            got = cells.dtype if isinstance(cells, Tensor) else type(cells).__name__
            raise TypeError(f"{_RULE} be an int32 or int64 tensor, got {got}")
        if not cells.dim():
            raise ValueError(f"{_RULE} have the leading shape of the samples, such as [n], got []")
        if cells.device != device:
            raise ValueError(f"{_RULE} be on the device of the parameters, {device}, got {cells.device}")
        if torch.compiler.is_compiling() or (cells.is_cuda and torch.cuda.is_current_stream_capturing()):
            inside = torch.where(cells < k, cells, -1).clamp(min=-1)  # invalid labels become -1: no cell
            return Labels(inside.int().unsqueeze(-1), False)
        _check_values(cells, k)
        return Labels(as_plain(cells).int().unsqueeze(-1), True)

    def ensure(self, k: int) -> None:
        """Raises ValueError for labels out of range; checks them only if a graph left them unchecked."""
        if not self.checked:
            _check_values(self.cells, k)

    def widen(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...]:
        """Returns the arguments; if the first one has a single row, it is expanded to one row for each label.

        Raises:
            TypeError: If no argument is or holds a tensor.
            ValueError: If the labels do not have the leading shape of any tensor among the arguments.
        """
        first: Any = args[0] if args else None
        lead = self.cells.shape[:-1]
        if not _fits(first, lead):
            tensors = tensors_of((args, kwargs))
            if not tensors:
                got = ", ".join(type(value).__name__ for value in (*args, *kwargs.values())) or "no argument"
                raise TypeError(
                    "VoronoiRouter: the arguments of a call with cells must include a tensor with a row for each "
                    f"sample, got {got}; {AS_TENSOR}"
                )
            if not any(_fits(tensor, lead) for tensor in tensors):
                got = f"{list(lead)} beside {list(tensors[0].shape)}"
                raise ValueError(f"{_RULE} have the leading shape of the samples, such as [n] for [n, f], got {got}")
            return args
        if any(size != 1 for size in first.shape[: len(lead)]) or all(size == 1 for size in lead):
            return args
        return (first.expand(*lead, *first.shape[len(lead) :]), *args[1:])


def _fits(value: Any, lead: torch.Size) -> bool:
    """Returns whether a tensor has a row, or a single row, for each label."""
    if not isinstance(value, Tensor) or value.dim() < len(lead):
        return False
    return all(size in (1, labels) for size, labels in zip(value.shape, lead))


def _check_values(cells: Tensor, k: int) -> None:
    with outside():
        values = unwrapped(cells)
        if values.is_cuda and values.numel():
            values = torch.stack(values.aminmax()).cpu()
        check_range("VoronoiRouter", "cells", values, k)
