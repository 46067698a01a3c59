"""Which cell of a Voronoi diagram a point lies in. n points, k centres, d coordinates."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.checks import FLOATING, Checked
from voronerf.ops._core.declare import declare


@declare(
    native=Implementation(EVERYWHERE, COORDINATES),
    warp=Implementation(EVERYWHERE, COORDINATES),
    filled={"k": "centres must hold at least one centre, got none"},
    compared=["points", "centres"],
)
def nearest_centre(
    points: Annotated[Tensor, "floating [n, d]"],
    centres: Annotated[Tensor, "floating [k, d]"],
    *,
    index: Annotated[Tensor | None, "int32 [w]"] = None,
    backend: str = "auto",
) -> Annotated[Tensor, "int32 [n]"]:
    """Index of the nearest centre of every point: ``argmin_c |x - v_c|``.

    Exact: the direct form of the distance is used, and ties go to the lowest index. A point that is not finite goes to
    cell 0. Not differentiable.

    Args:
        points: n < 2**31, d = 1 to 4. float16 and bfloat16 are compared in float32.
        centres: finite, k >= 1.
        index: what `index_centres` has made of these centres: the time then grows by log k, and cells are the same.
            Without one, the CPU makes one for a call in which that pays, from 2,048 centres and 1,024 points on. Plain
            PyTorch and Warp do without.

    Returns:
        cells int32 [n], in 0 to k - 1.

    Raises:
        ValueError: d above 4, or an index of another number, size or dtype of centres, which a GPU does not look at:
            there all cells are -1.

    Examples:
        >>> import torch
        >>> from voronerf import nearest_centre
        >>> points = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> centres = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest_centre(points, centres)
        tensor([0, 1, 0], dtype=torch.int32)
    """


def index_centres(centres: Tensor) -> Tensor | None:
    """An index of centres, for `nearest_centre`: a tree of boxes that hold 16 others, or up to 16 centres.

    It pays from some thousand centres on that stay for several calls. It has 18 to 36 bytes a centre in three
    coordinates of float32. Making it takes about 0.1 us a centre of one core; for a GPU it is made there and copied.

    Args:
        centres: floating [k, d], d = 1 to 4, finite.

    Returns:
        int32 [w], on the device of the centres; None without the compiled module, and of a meta tensor.

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: another shape, or no centre.

    Examples:
        >>> import torch
        >>> from voronerf.ops import index_centres, nearest_centre
        >>> points, centres = torch.rand(10, 3), torch.rand(5000, 3)
        >>> index = index_centres(centres)
        >>> bool((nearest_centre(points, centres, index=index) == nearest_centre(points, centres)).all())
        True
    """
    given = Checked("index_centres")
    given.tensor("centres", centres, FLOATING, "k", "d")
    check_sizes("index_centres", centres)
    native = backends.compiled()
    if native is None or centres.is_meta:
        return None
    with _disable_current_modes():  # a recorded step has nothing to do with it
        taken = centres.detach().to("cpu", torch.promote_types(centres.dtype, torch.float32)).contiguous()
        k, d = taken.shape
        index = torch.empty(native.compiled.centre_index_words(k, d, taken.itemsize), dtype=torch.int32)
        native.compiled.index_centres(taken, index, k, d, native.cpu().threads)
        return index.to(centres.device)


def check_sizes(op: str, centres: Tensor) -> None:
    """Raises ValueError for no centre, or one of too many coordinates."""
    k, d = centres.shape
    if not 1 <= d <= 4:
        raise ValueError(f"{op}: centres must have shape [k, d], d = 1 to 4, got {list(centres.shape)}")
    if k < 1:
        raise ValueError(f"{op}: centres must hold at least one centre, got none")
