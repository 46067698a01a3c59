"""Parameters of all cells in the place of a module's own, and functions of parameters alone.

Letters: k cells.
"""

from __future__ import annotations

import inspect
import linecache
import os
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.router.trees import map_tree, tensors_of

_TORCH, _HERE = (os.path.dirname(os.path.abspath(file)) + os.sep for file in (torch.__file__, __file__))
_WRITES = ("requires_grad_", "register_hook", "retain_grad", "backward", "__set__", "__setitem__")


class Ungroupable(Exception):
    """A module cannot be run on the samples of all cells at once; the message says where.

    Attributes:
        of_batch: Whether it may be otherwise for other samples.
    """

    def __init__(self, reason: str, of_batch: bool = False) -> None:
        super().__init__(reason)
        self.of_batch = of_batch


class PerCell(torch.Tensor):
    """k tensors, one for each cell, that look like one of them: what a routed module finds in place of a parameter.

    It has the shape of a single cell's tensor and no storage.

    Attributes:
        stacked: [k, ...], one entry for each cell.
        origin: The tensor of more cells that ``stacked`` is a part of, and its first cell there.
    """

    stacked: Tensor
    origin: tuple[Tensor, int]
    # Shape and dtype are answered by the wrapper itself.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, stacked: Tensor, is_parameter: bool = False, origin: tuple[Tensor, int] | None = None) -> PerCell:
        """Wraps [k, ...]; ``is_parameter`` makes it an instance of ``nn.Parameter``."""
        wrapper: PerCell = torch.Tensor._make_wrapper_subclass(
            cls,
            stacked.shape[1:],
            dtype=stacked.dtype,
            device=stacked.device,
            requires_grad=stacked.requires_grad and stacked.is_floating_point(),
        )
        wrapper.stacked, wrapper.origin = stacked, origin or (stacked, 0)
        wrapper._is_param = is_parameter
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        """Refuses what did not pass through the mode."""
        raise TypeError(
            f"VoronoiRouter: {func} met the parameters of all cells outside of a routed call; call the router, or take "
            "one cell's module with cell(i)"
        )


def for_all_cells(func: Any, args: Any, kwargs: Any, fail: Callable[[str], Exception] = Ungroupable) -> Any:
    """A function of parameters and constants alone, for all cells at once; results are :class:`PerCell`.

    Args:
        func: Of PyTorch.
        args: With a PerCell for each parameter.
        kwargs: Likewise.
        fail: Makes the error of a reason.
    """
    stacks = [leaf.stacked for leaf in tensors_of((args, kwargs)) if isinstance(leaf, PerCell)]

    if func is torch.autograd.grad:
        raise fail("it differentiates with respect to parameters")
    if getattr(func, "__name__", "") in _WRITES:
        raise fail(f"it calls {name_of(func)} on a parameter")
    if func is torch.Tensor.data.__get__:  # type: ignore[attr-defined]
        return PerCell(stacks[0].detach())
    function = _weight_norm if func is torch._weight_norm else func

    def on_one(*single: Tensor) -> Any:
        following = iter(single)
        given = map_tree((args, kwargs), lambda n, value, _: next(following) if isinstance(value, PerCell) else value)
        return function(*given[0], **given[1])

    try:
        result = torch.vmap(on_one, randomness="different")(*stacks)
    except Exception:
        try:
            singles = [on_one(*single) for single in zip(*[stack.unbind(0) for stack in stacks], strict=True)]
        except Exception as error:
            raise fail(f"{name_of(func)} of parameters fails: {error}") from error
        result = _stack(func, singles, fail)
    return map_tree(result, lambda name, value, nested: PerCell(value))


def _weight_norm(v: Tensor, g: Tensor, dim: int = 0) -> Tensor:
    """``torch._weight_norm`` of functions that can be mapped over cells."""
    others = [d for d in range(v.dim()) if d != dim]
    return v * (g / torch.linalg.vector_norm(v, dim=others, keepdim=True))


def _stack(func: Any, singles: Sequence[Any], fail: Callable[[str], Exception]) -> Any:
    first = singles[0]
    if isinstance(first, Tensor) and all(single.shape == first.shape for single in singles):
        return torch.stack(list(singles))
    if isinstance(first, (list, tuple)):
        return tuple(_stack(func, parts, fail) for parts in zip(*singles, strict=True))
    if not isinstance(first, Tensor) and all(single == first for single in singles):
        return first
    raise fail(f"{name_of(func)} reads values of parameters, which differ between cells")


def name_of(function: Any) -> str:
    """A function's name for messages."""
    resolved = torch.overrides.resolve_name(function)
    return resolved or getattr(function, "__qualname__", None) or str(function)


def is_inside(file: str, package: bool = False) -> bool:
    """Whether a file is one of PyTorch or the router, or of this package."""
    return file.startswith((_TORCH, os.path.dirname(_HERE[:-1]) if package else _HERE))


def user_line() -> str:
    """Where the routed module is just now: file, line and code; empty where no code of its own is on the stack."""
    frame, inside = inspect.currentframe(), False
    while frame is not None:
        file = frame.f_code.co_filename
        ours = file.startswith(_HERE)
        if ours and inside:
            break  # the router that called the module
        inside = inside or not ours
        if inside and not ours and not file.startswith(_TORCH):
            code = linecache.getline(file, frame.f_lineno).strip()
            return f" ({os.path.basename(file)}:{frame.f_lineno}{f': {code}' if code else ''})"
        frame = frame.f_back
    return ""
