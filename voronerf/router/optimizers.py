"""Updates the state of optimisers when cells are split, loaded or frozen."""

from __future__ import annotations

import gc
import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.grouping import cell_parameters

_OP = "VoronoiRouter"
#: Names of optimisers' state tensors that hold means or sums of gradients, or of their squares.
MOMENTS = {"exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "momentum_buffer", "grad_avg", "square_avg", "sum"}
AVERAGES = {"average", "ax"}  # names of state tensors that hold averages of the parameter itself
PATIENCE = 64  # calls before a check ends; gradient accumulation makes several calls per step


def check_optimizer(optimizer: torch.optim.Optimizer | None, module: nn.Module, method: str) -> None:
    """Raises ValueError for an optimiser that holds none of a module's parameters."""
    ours, groups = set(map(id, module.parameters())), [] if optimizer is None else optimizer.param_groups
    if groups and ours and ours.isdisjoint(id(parameter) for group in groups for parameter in group["params"]):
        raise ValueError(
            f"{_OP}.{method}: optimizer must hold the router's parameters, got an optimizer of other parameters"
        )


def move_state(
    optimizer: torch.optim.Optimizer, module: nn.Module, parents: Tensor, k: int, shares: Tensor, fresh: Tensor | None
) -> None:
    """Gives every new cell its parent's optimiser state.

    The n children of a cell share its samples: the mean of their gradients is about 1/n of the parent's, and so is the
    variance, but the square of the mean is 1/n^2. Moments are therefore divided by n, and the part of Adam's mean
    squares that is the square of the mean by n^2. Otherwise Adam would make up to n times shorter steps until it has
    forgotten the parent's gradients, for a thousand steps with beta2 = 0.999. With beta2 up to 0.99 it forgets them
    soon enough, and moments stay whole: shorter first steps gain 0.3 and 0.6 dB (Lego, 64 cells).

    The parameters have their new shapes already. If any state tensor does not have one row per cell, all state is
    reset.

    Args:
        optimizer: The optimiser.
        module: The routed module.
        parents: The parent of each new cell among the k old cells, int64 [new cells].
        k: The number of old cells.
        shares: The number n of cells that share the samples of each new cell's parent, int64 [new cells].
        fresh: The mask of new cells whose parameters were drawn, bool [new cells]; None for no cells. Their averages
            become the parameters, and other state becomes 0.
    """
    is_reset, groups = False, {id(p): group for group in optimizer.param_groups for p in group["params"]}
    for parameter in cell_parameters(module):
        state = optimizer.state.get(parameter, {})
        group = groups.get(id(parameter), {})
        steady, forgets = steady_part(state, group), "betas" in group and group["betas"][1] <= 0.99
        for key, value in state.items():
            if isinstance(value, Tensor) and value.shape == (k, *parameter.shape[1:]):
                rows = parents.to(value.device)
                state[key] = value[rows]
                if key in MOMENTS and not forgets:
                    n = shares.to(value).view(-1, *[1] * (value.dim() - 1))
                    state[key] /= n
                    if steady is not None and key.endswith("exp_avg_sq"):
                        state[key] *= 1 - steady[rows] * (1 - 1 / n)
                if fresh is not None:
                    drawn = fresh.to(value.device)
                    state[key][drawn] = parameter.detach()[drawn].to(value) if key in AVERAGES else 0
            else:
                is_reset |= isinstance(value, list) or (isinstance(value, Tensor) and value.dim() > 0)
    if is_reset:
        _begin_anew(optimizer)
        warnings.warn(
            f"{_OP}.subdivide: the state of {type(optimizer).__name__} cannot be inherited by cells and is reset",
            stacklevel=4,
        )


def steady_part(state: dict[str, Any], group: dict[str, Any]) -> Tensor | None:
    """Returns which part of Adam's mean squares is the square of the mean, 0 to 1; None for other optimisers."""
    mean, squares, step = (state.get(key) for key in ("exp_avg", "exp_avg_sq", "step"))
    if "betas" not in group or mean is None or squares is None or step is None or mean.shape != squares.shape:
        return None
    bias1, bias2 = (1 - beta**step for beta in group["betas"])
    return ((mean / bias1).square() / (squares / bias2)).nan_to_num(0.0).clamp(max=1)


def drop_state(optimizer: torch.optim.Optimizer) -> None:
    """Resets the optimiser state of each parameter whose shape does not match the state."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            if is_stale(optimizer, parameter):
                state = optimizer.state.pop(parameter)
                if isinstance(optimizer, torch.optim.Adagrad):  # Adagrad creates its state in its constructor
                    total = torch.full_like(parameter, group["initial_accumulator_value"])
                    optimizer.state[parameter].update(step=torch.zeros_like(state["step"]), sum=total)
    if isinstance(optimizer, torch.optim.LBFGS):
        _begin_anew(optimizer)


def _begin_anew(optimizer: torch.optim.Optimizer) -> None:
    optimizer.state.clear()
    if isinstance(optimizer, torch.optim.LBFGS):
        optimizer._numel_cache = None  # the cached total number of parameter entries


def is_stale(optimizer: torch.optim.Optimizer, parameter: Any) -> bool:
    """Returns whether an optimiser holds state of another shape than the parameter."""
    state = optimizer.state.get(parameter, {})
    return any(isinstance(v, Tensor) and v.dim() > 0 and v.shape != parameter.shape for v in state.values())


def watch_optimizers(module: nn.Module, line: str, given: torch.optim.Optimizer | None) -> list[Any]:
    """Makes a module's optimisers but ``given`` raise at their next step if their state has another number of cells.

    PyTorch's fused optimisers would write past the end of stale state. PyTorch keeps no list of optimisers, so the
    garbage collector's objects are searched. The error suggests the code ``line``. Returns the hooks' handles.
    """
    handles, ours = [], {id(parameter) for parameter in cell_parameters(module)}
    for optimizer in [item for item in gc.get_objects() if issubclass(type(item), torch.optim.Optimizer)]:
        own = [p for group in optimizer.param_groups for p in group["params"] if id(p) in ours]
        if own and optimizer is not given:
            handles.append(optimizer.register_step_pre_hook(_first_step_check(own, line)))
    return handles


def _first_step_check(parameters: list[Tensor], line: str) -> Callable[..., None]:
    """Returns a hook that checks an optimiser's state of some parameters in its first call."""

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        if any(is_stale(optimizer, parameter) for parameter in parameters):
            raise ValueError(
                f"{_OP}: optimizer ({type(optimizer).__name__}) holds the state of other cells than the router "
                f"has; write {line}, or make the optimizer afterwards"
            )
        parameters.clear()  # torch does not let a hook remove itself

    return check


class Untrained:
    """A check for a module that gets gradients, but is not changed by any optimiser.

    The usual cause is an optimiser of the original module's parameters, made before the module was wrapped. The check
    runs in each call, since a hook on a parameter would prevent gradients from being accumulated in place.

    Args:
        module: The routed module.
    """

    def __init__(self, module: nn.Module) -> None:
        self._parameters = [p for p in module.parameters() if p.requires_grad]
        self._initial, self._calls = [_some(p).clone() for p in self._parameters], 0

    def is_over(self, warn: Callable[[str, str], None]) -> bool:
        """Returns whether the check is finished; calls ``warn(topic, message)`` if it fails."""
        self._calls += 1
        if self._calls <= PATIENCE:
            return False
        have = any(parameter.grad is not None for parameter in self._parameters)
        if have and all(torch.equal(_some(p), was) for p, was in zip(self._parameters, self._initial, strict=True)):
            message = (
                f"no optimizer has changed the parameters in {PATIENCE} calls, but they have gradients; construct "
                "it from router.parameters(); the module's parameters from before wrapping are not trained"
            )
            warn("untrained", message)
        return True


def _some(parameter: Tensor) -> Tensor:
    """Returns at most about two thousand of a parameter's values."""
    return parameter.detach().flatten()[:: max(1, parameter.numel() // 1000)]


# Frozen cells ---------------------------------------------------------------------------------------------------------

#: For each routed module with frozen cells: their mask, bool [k], and slices of the other cells.
_FROZEN: weakref.WeakKeyDictionary[nn.Module, tuple[Tensor, list[slice]]] = weakref.WeakKeyDictionary()
#: The optimisers whose steps restore frozen cells.
_KEEPING: weakref.WeakSet[torch.optim.Optimizer] = weakref.WeakSet()


def freeze_cells(module: nn.Module, frozen: Tensor | None) -> None:
    """Records the frozen cells of a routed module, bool [k]; None for no cells.

    A stacked parameter is one tensor to an optimiser, which changes all of its cells: weight decay and momentum also
    change cells without a gradient. An optimiser with an attribute ``leaves_frozen`` skips frozen cells by itself;
    other optimisers need :func:`keep_frozen`.
    """
    if frozen is None:
        _FROZEN.pop(module, None)
        return
    edges = torch.nn.functional.pad((~frozen).int(), (1, 1)).diff()
    pairs = zip((edges > 0).nonzero()[:, 0].tolist(), (edges < 0).nonzero()[:, 0].tolist(), strict=True)
    _FROZEN[module] = frozen, [slice(*pair) for pair in pairs]


def _frozen_modules() -> list[tuple[nn.Module, Tensor, list[slice]]]:
    """Lists the routed modules in ``_FROZEN``, to which another thread may add a module meanwhile."""
    pairs = [(module, _FROZEN.get(module)) for key in _FROZEN.keyrefs() if (module := key()) is not None]
    return [(module, *frozen) for module, frozen in pairs if frozen is not None]


def keep_frozen(optimizer: torch.optim.Optimizer) -> None:
    """Makes each step of an optimiser restore the parameters and the state of frozen cells.

    A wrapper of the optimiser would do the same, but schedulers and scalers accept no wrapper.
    """
    if optimizer in _KEEPING or getattr(optimizer, "leaves_frozen", False):
        return
    _KEEPING.add(optimizer)
    saved: list[tuple[Tensor, Tensor, Tensor]] = []  # (tensor, mask of frozen cells, their values before the step)

    def before(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        saved.clear()
        for parameter, frozen in _frozen_parameters(optimizer):
            for tensor in (parameter.detach(), *_cell_state(optimizer, parameter)):
                saved.append((tensor, frozen, tensor[frozen]))

    @torch.no_grad()
    def after(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        for tensor, frozen, values in saved:
            tensor[frozen] = values
        restored = {tensor.data_ptr() for tensor, _, _ in saved}
        for parameter, frozen in _frozen_parameters(optimizer):
            for tensor in _cell_state(optimizer, parameter):
                if tensor.data_ptr() not in restored:  # state created in this step
                    tensor[frozen] = 0
        saved.clear()

    optimizer.register_step_pre_hook(before)
    optimizer.register_step_post_hook(after)


def _frozen_parameters(optimizer: torch.optim.Optimizer) -> list[tuple[Tensor, Tensor]]:
    frozen = {id(p): mask for module, mask, _ in _frozen_modules() for p in cell_parameters(module)}
    every = (p for group in optimizer.param_groups for p in group["params"]) if frozen else ()
    return [(p, frozen[id(p)]) for p in every if id(p) in frozen]


def _cell_state(optimizer: torch.optim.Optimizer, parameter: Tensor) -> list[Tensor]:
    state = optimizer.state.get(parameter, {}).values()
    return [value for value in state if isinstance(value, Tensor) and value.shape == parameter.shape]


class FrozenRows:
    """A check for frozen cells that are changed by an optimiser which was not passed to ``freeze``.

    Args:
        module: The routed module.
        frozen: The mask of the module's frozen cells, bool [k].
    """

    def __init__(self, module: nn.Module, frozen: Tensor) -> None:
        self._frozen, self._calls = frozen, 0
        self._initial = [(p, p.detach()[frozen]) for p in cell_parameters(module)]

    def is_over(self, warn: Callable[[str, str], None]) -> bool:
        """Returns whether the check is finished; compares the parameters in calls 2, 4, 8 and so on.

        Raises:
            ValueError: If the parameters of frozen cells have changed.
        """
        self._calls += 1
        looks = self._calls > 1 and not self._calls & (self._calls - 1)
        if looks and not all(torch.equal(parameter.detach()[self._frozen], rows) for parameter, rows in self._initial):
            self._calls -= 1
            raise ValueError(
                f"{_OP}.freeze: an optimizer that was not given has changed frozen cells; write "
                "router.freeze(cells, optimizer=optimizer), or unfreeze cells before they are written to"
            )
        return self._calls >= PATIENCE


def trained_parts(parameters: Sequence[Tensor]) -> list[list[Any]]:
    """Lists, for each parameter, the slices of its first dimension that optimisers may change."""
    parts: dict[int, list[Any]] = {}
    for module, _, pieces in _frozen_modules():
        parts.update((id(parameter), pieces) for parameter in cell_parameters(module))
    return [parts.get(id(parameter), [...]) for parameter in parameters]
