"""What optimisers keep for the parameters of cells: when cells are split, moved or loaded, and when they are frozen."""

from __future__ import annotations

import functools
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from voronerf.router.grouping import cell_parameters

_OP = "VoronoiRouter"


def check_optimizer(optimizer: torch.optim.Optimizer | None, module: nn.Module, method: str) -> None:
    """Raises ValueError for an optimiser that holds none of a module's parameters."""
    ours, groups = set(map(id, module.parameters())), [] if optimizer is None else optimizer.param_groups
    if groups and ours and ours.isdisjoint(id(parameter) for group in groups for parameter in group["params"]):
        raise ValueError(f"{_OP}.{method}: optimizer must hold the router's parameters, got one of others")


def move_state(
    optimizer: torch.optim.Optimizer, module: nn.Module, parents: Tensor, k: int, fresh: Tensor | None
) -> None:
    """Gives every cell the state of its parent among k cells, int64 [new cells], or zero to cells of ``fresh``, bool.

    The parameters have their new shapes already. A state that is not of cells begins anew.
    """
    lost = False
    for parameter in cell_parameters(module):
        state = optimizer.state.get(parameter, {})
        for key, value in state.items():
            if isinstance(value, Tensor) and value.shape == (k, *parameter.shape[1:]):
                state[key] = value[parents.to(value.device)]
                if fresh is not None:
                    state[key][fresh.to(value.device)] = 0
            else:
                lost |= isinstance(value, list) or (isinstance(value, Tensor) and value.dim() > 0)
    if lost:
        _begin_anew(optimizer)
        warnings.warn(
            f"{_OP}.subdivide: the state of {type(optimizer).__name__} cannot be inherited by cells and begins anew",
            stacklevel=4,
        )


def drop_state(optimizer: torch.optim.Optimizer) -> None:
    """Resets the state of an optimiser where its shapes are not those of the parameters."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            if is_stale(optimizer, parameter):
                optimizer.state.pop(parameter)
                if isinstance(optimizer, torch.optim.Adagrad):  # which makes its state when it is made
                    total = torch.full_like(parameter, group["initial_accumulator_value"])
                    optimizer.state[parameter].update(step=torch.tensor(0.0), sum=total)
    if isinstance(optimizer, torch.optim.LBFGS):
        _begin_anew(optimizer)


def _begin_anew(optimizer: torch.optim.Optimizer) -> None:
    optimizer.state.clear()
    if isinstance(optimizer, torch.optim.LBFGS):
        optimizer._numel_cache = None  # the number of entries of all parameters together


def is_stale(optimizer: torch.optim.Optimizer, parameter: Any) -> bool:
    """Whether an optimiser has a state of another shape than a parameter."""
    state = optimizer.state.get(parameter, {})
    return any(isinstance(v, Tensor) and v.dim() > 0 and v.shape != parameter.shape for v in state.values())


def watch_optimizers(module: nn.Module, line: str) -> Any:
    """Makes an optimiser raise at its next step if it holds state of other cells than a module now has.

    The message says to write ``line``. The handle's ``remove()`` ends the watch.
    """
    watched = {id(parameter): weakref.ref(parameter) for parameter in cell_parameters(module)}

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        held = [p for group in optimizer.param_groups for p in group["params"] if id(p) in watched]
        if any(watched[id(parameter)]() is parameter and is_stale(optimizer, parameter) for parameter in held):
            raise ValueError(
                f"{_OP}: optimizer ({type(optimizer).__name__}) holds the state of other cells than the router "
                f"has; write {line}, or make the optimizer afterwards"
            )
        if held:
            watched.clear()  # torch does not let a hook remove itself

    handle = register_optimizer_step_pre_hook(check)
    weakref.finalize(module, handle.remove)
    return handle


def watch_former(module: nn.Module, former: Sequence[nn.Parameter]) -> None:
    """Warns at the first step of an optimiser of the parameters that a module had before it was routed.

    They get no gradients, so such an optimiser would train nothing.
    """
    watched, routed = {id(parameter): weakref.ref(parameter) for parameter in former}, weakref.ref(module)

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        now = routed()
        if not watched or now is None:
            return
        held: list[Tensor] = [p for group in optimizer.param_groups for p in group["params"]]
        old = [p for p in held if id(p) in watched and watched[id(p)]() is p]
        right = not {id(p) for p in now.parameters()}.isdisjoint(map(id, held))
        if old and not right and all(p.grad is None for p in old):
            warnings.warn(
                f"{_OP}: optimizer ({type(optimizer).__name__}) trains nothing: it holds the parameters that the "
                "module had before it was wrapped; make it of router.parameters()",
                stacklevel=3,
            )
        if old or right:
            watched.clear()  # torch does not let a hook remove itself

    weakref.finalize(module, register_optimizer_step_pre_hook(check).remove)


# Frozen cells ---------------------------------------------------------------------------------------------------------

#: The frozen cells, bool [k], of every routed module that has some, and the runs of the others.
_FROZEN: weakref.WeakKeyDictionary[nn.Module, tuple[Tensor, list[slice]]] = weakref.WeakKeyDictionary()
#: What a step must leave as it is: tensors, their frozen cells, and the values of those before the step.
_HELD: dict[int, list[tuple[Tensor, Tensor, Tensor]]] = {}


def freeze_cells(module: nn.Module, frozen: Tensor | None) -> None:
    """Makes every optimiser leave some cells of a routed module as they are, bool [k]; None for no cells.

    A stacked parameter is one tensor to an optimiser, which moves all of its cells: by weight decay and momentum also
    those without a gradient. What it changed in frozen cells is therefore put back after its step; an optimiser with
    ``leaves_frozen`` passes them over by itself.
    """
    if frozen is None:
        _FROZEN.pop(module, None)
        return
    edges = torch.nn.functional.pad((~frozen).int(), (1, 1)).diff()
    pairs = zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True)
    _FROZEN[module] = frozen, [slice(*pair) for pair in pairs]
    _watch_steps()


@functools.cache
def _watch_steps() -> None:
    register_optimizer_step_pre_hook(_before_step)
    register_optimizer_step_post_hook(_after_step)


def _frozen_parameters(optimizer: torch.optim.Optimizer) -> list[tuple[Tensor, Tensor]]:
    frozen = {id(p): mask for module, (mask, _) in _FROZEN.items() for p in cell_parameters(module)}
    every = (p for group in optimizer.param_groups for p in group["params"]) if frozen else ()
    return [(p, frozen[id(p)]) for p in every if id(p) in frozen]


def _of_cells(optimizer: torch.optim.Optimizer, parameter: Tensor) -> list[Tensor]:
    state = optimizer.state.get(parameter, {}).values()
    return [value for value in state if isinstance(value, Tensor) and value.shape == parameter.shape]


def _before_step(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
    if not _FROZEN or (getattr(optimizer, "leaves_frozen", False)):
        return
    held = []
    for parameter, frozen in _frozen_parameters(optimizer):
        for tensor in (parameter.detach(), *_of_cells(optimizer, parameter)):
            held.append((tensor, frozen, tensor[frozen]))
    if held:
        _HELD[id(optimizer)] = held


@torch.no_grad()
def _after_step(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
    held = _HELD.pop(id(optimizer), None)
    if held is None:
        return
    for tensor, frozen, values in held:
        tensor[frozen] = values
    known = {tensor.data_ptr() for tensor, _, _ in held}
    for parameter, frozen in _frozen_parameters(optimizer):
        for tensor in _of_cells(optimizer, parameter):
            if tensor.data_ptr() not in known:  # made in this step
                tensor[frozen] = 0


def trained_parts(parameters: Sequence[Tensor]) -> list[list[Any]]:
    """For each parameter the parts of its first dimension that an optimiser may change: those of cells not frozen."""
    parts: dict[int, list[Any]] = {}
    for module, (_, own) in _FROZEN.items() if _FROZEN else ():
        parts.update((id(parameter), own) for parameter in cell_parameters(module))
    return [parts.get(id(parameter), [...]) for parameter in parameters]
