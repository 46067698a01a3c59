"""Labels: the cells of a call's samples, passed instead of positions."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.router.layout import as_plain
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

    def widen(self, args: tuple[Any, ...]) -> tuple[Any, ...]:
        """Returns the arguments; if the first one has a single row, it is expanded to one row for each label.

        Raises:
            ValueError: If the shape of the labels does not fit the first argument.
        """
        first, lead = args[0] if args else None, self.cells.shape[:-1]
        if not isinstance(first, Tensor) or first.dim() < len(lead):
            return args
        if any(1 != a != b != 1 for a, b in zip(lead, first.shape)):
            got = f"{list(lead)} beside {list(first.shape)}"
            raise ValueError(f"{_RULE} have the leading shape of the samples, got {got}")
        if any(size != 1 for size in first.shape[: len(lead)]) or all(size == 1 for size in lead):
            return args
        return (first.expand(*lead, *first.shape[len(lead) :]), *args[1:])


def _check_values(cells: Tensor, k: int) -> None:
    with outside():
        values = unwrapped(cells)
        if values.is_cuda and values.numel():
            values = torch.stack(values.aminmax()).cpu()
        check_range("VoronoiRouter", "cells", values, k)
