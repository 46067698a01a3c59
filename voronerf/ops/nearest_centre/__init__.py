"""The cell of a point in a Voronoi diagram. n points, k centres, d coordinates."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.checks import FLOATING, TensorRule, check_rules, to_common_dtype
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    return (*to_common_dtype(arguments.points, arguments.centres), arguments.index)


@declare(
    native=Implementation(EVERYWHERE, COORDINATES),
    warp=Implementation(EVERYWHERE, COORDINATES),
    filled={"k": "centres must hold at least one centre, got none"},
    prepare=_prepare,
    compared=["points", "centres"],
)
def nearest_centre(
    points: Annotated[Tensor, "floating [n, d]"],
    centres: Annotated[Tensor, "floating [k, d]"],
    *,
    index: Annotated[Tensor | None, "int32 [w]"] = None,
    backend: str = "auto",
) -> Annotated[Tensor, "int32 [n]"]:
    """Returns the index of the nearest centre of every point: ``argmin_c |x - v_c|``.

    Exact: distances are computed in the direct form, and ties go to the lowest index. A point that is not finite goes
    to cell 0. Not differentiable.

    Args:
        points: the points to locate, n < 2**31, d = 1 to 4. float16 and bfloat16 are compared in float32.
        centres: the centres of the cells, finite, k >= 1.
        index: the result of `index_centres` for these centres. The time then grows with log k, and the cells are the
            same. Without an index, the CPU makes one for the call if there are at least 2,048 centres and 1,024 points
            or, in four dimensions, 64 points. The reference and Warp backends ignore the index.

    Returns:
        int32 [n], the cell of each point, 0 to k - 1.

    Raises:
        ValueError: d above 4; an index for another k, d or dtype (not checked on a GPU, where all cells are -1 for a
            wrong index).

    Examples:
        >>> import torch
        >>> from voronerf import nearest_centre
        >>> points = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> centres = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest_centre(points, centres)
        tensor([0, 1, 0], dtype=torch.int32)
    """


def index_centres(centres: Tensor) -> Tensor | None:
    """Returns an index of centres for `nearest_centre`: a tree of boxes, each with 16 boxes or up to 16 centres.

    The index pays off if several calls use it and there are at least a few thousand centres. It takes 18 to 36 bytes
    per centre for three float32 coordinates. Its construction takes about 0.1 us per centre on one core; for a GPU it
    is made on the CPU and copied.

    Args:
        centres: floating [k, d], d = 1 to 4, finite.

    Returns:
        int32 [w], on the device of the centres; None without the compiled module, and for a meta tensor.

    Raises:
        TypeError: centres that are not a floating-point tensor.
        ValueError: centres of another shape, or no centre.

    Examples:
        >>> import torch
        >>> from voronerf.ops import index_centres, nearest_centre
        >>> points, centres = torch.rand(10, 3), torch.rand(5000, 3)
        >>> index = index_centres(centres)
        >>> bool((nearest_centre(points, centres, index=index) == nearest_centre(points, centres)).all())
        True
    """
    check_rules("index_centres", _rules, [centres])
    check_sizes("index_centres", centres)
    native = backends.compiled()
    if native is None or centres.is_meta:
        return None
    with _disable_current_modes():  # a recording of a step does not record this
        rows = centres.detach().to("cpu", torch.promote_types(centres.dtype, torch.float32)).contiguous()
        k, d = rows.shape
        words = native.compiled.centre_index_words(k, d, rows.itemsize)
        index = torch.empty(words, dtype=torch.int32, device="cpu")
        native.compiled.index_centres(rows, index, k, d, native.cpu().threads)
        return index.to(centres.device)


def _rules() -> list[TensorRule]:
    return [TensorRule("centres", FLOATING, ("k", "d"))]


def check_sizes(op: str, centres: Tensor) -> None:
    """Raises ValueError if there is no centre, or if the centres have too many coordinates."""
    k, d = centres.shape
    if not 1 <= d <= 4:
        raise ValueError(f"{op}: centres must have shape [k, d], d = 1 to 4, got {list(centres.shape)}")
    if k < 1:
        raise ValueError(f"{op}: centres must hold at least one centre, got none")
