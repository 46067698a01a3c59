"""The heaviest samples of a batch. n samples, q of them kept."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.checks import Checked, check_integer

_OP = backends.declare("select_heaviest")


def select_heaviest(points: Tensor, importance: Tensor, count: int, *, backend: str = "auto") -> tuple[Tensor, Tensor]:
    """The `count` samples of largest importance, heaviest first; no device value is read on the host.

    A sample counts if its importance is positive and finite and its point is finite. The order of equally heavy samples
    is not specified. Not differentiable.

    Args:
        points: float32 [n, 3].
        importance: float32 [n].
        count: at least 1.
        backend: "auto" or "reference".

    Returns:
        (points float32 [q, 3], importance float32 [q]) with q = min(count, n); the last rows are 0 if fewer samples
        count.

    Raises:
        ValueError: shapes, devices, count or an unknown backend.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import select_heaviest
        >>> points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
        >>> heaviest, importance = select_heaviest(points, torch.tensor([0.5, 3.0, 2.0]), 2)
        >>> heaviest[:, 0], importance
        (tensor([1., 2.]), tensor([3., 2.]))
    """
    given = Checked(_OP)
    given.tensor("points", points, (torch.float32,), "n", 3)
    given.tensor("importance", importance, (torch.float32,), "n")
    check_integer(_OP, "count", count, 1)
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=points.dtype)
    kept_points, kept = run(points.detach(), importance.detach(), count)
    return kept_points, kept
