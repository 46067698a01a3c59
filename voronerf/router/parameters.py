"""The parameters of a routed module: stacked for all cells, taken apart for one, carried over to finer diagrams.

k cells; ``[k, ...]`` under the module's own names.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parameter import UninitializedParameter
from torch.nn.utils import parametrizations

from voronerf.router.grouping import PerCell

_OP = "VoronoiRouter"
_ELEMENTWISE_OPTIMIZERS = (
    torch.optim.Adam,
    torch.optim.AdamW,
    torch.optim.RAdam,
    torch.optim.NAdam,
    torch.optim.Adamax,
    torch.optim.SGD,
    torch.optim.RMSprop,
    torch.optim.Adagrad,
    torch.optim.Adadelta,
    torch.optim.Rprop,
    torch.optim.ASGD,
)
"""Optimisers whose state is of the parameter's shape, entry by entry, or a number."""


def owned_parameters(module: nn.Module) -> list[tuple[nn.Module, str, nn.Parameter]]:
    """(owner, name, parameter) of every parameter of a module tree; one that is used twice comes twice."""
    return [
        (owner, name, parameter)
        for owner in module.modules()
        for name, parameter in list(owner._parameters.items())
        if parameter is not None
    ]


def clone_module(module: Any, memo: dict[int, Any] | None = None) -> Any:
    """A deep copy, also of a module that keeps results of its last call (which torch refuses to copy)."""
    memo = {} if memo is None else memo
    for part in module.modules():
        for value in vars(part).values():
            if isinstance(value, Tensor) and not value.is_leaf:
                memo[id(value)] = value.detach().clone()
    return copy.deepcopy(module, memo)


def check_module(module: nn.Module) -> None:
    """Refuses modules that cannot be one network for each cell.

    Raises:
        TypeError: for anything but a module, for layers that mix samples, keep a state of their own for each weight or
            have no sizes yet, and for parameters that are not registered.
    """
    if not isinstance(module, nn.Module):
        raise TypeError(f"{_OP}: module must be an nn.Module, got {type(module).__name__}")
    if isinstance(module, torch.jit.ScriptModule):
        raise TypeError(f"{_OP}: module must be an ordinary nn.Module, got the script {type(module).__name__}")
    for name, part in module.named_modules():
        reason = _refusal(part)
        if reason:
            where = f"`{name}`, a {type(part).__name__}," if name else f"a {type(part).__name__}"
            raise TypeError(f"{_OP}: module must treat samples one by one, but {where} {reason}")


def _refusal(part: nn.Module) -> str:
    if isinstance(part, nn.modules.batchnorm._BatchNorm):
        return "mixes the samples of a batch (use LayerNorm or GroupNorm)"
    if isinstance(part, nn.modules.instancenorm._InstanceNorm) and part.track_running_stats:
        return "keeps statistics of the samples of a batch (set track_running_stats=False)"
    if isinstance(part, nn.RNNBase):
        return "is recurrent, with weights that cannot be one set for each cell"
    hooks = part._forward_pre_hooks.values()
    if isinstance(part, parametrizations._SpectralNorm) or any(type(hook).__name__ == "SpectralNorm" for hook in hooks):
        return "keeps a state for each weight (spectral norm) that cells cannot share"
    if any(isinstance(parameter, UninitializedParameter) for parameter in part._parameters.values()):
        return "has no sizes yet (run it once, so that lazy layers get their parameters)"
    for name, value in vars(part).items():
        if name not in ("_parameters", "_modules") and isinstance(value, (list, tuple, dict)):
            items = value.values() if isinstance(value, dict) else value
            if any(isinstance(item, nn.Parameter) for item in items):
                return f"keeps parameters in the plain {type(value).__name__} `{name}` (use nn.ParameterList)"
    return ""


def stack_parameters(module: nn.Module, k: int) -> None:
    """Gives every parameter of a module k equal entries, in place."""
    stacked: dict[int, nn.Parameter] = {}
    for owner, name, parameter in owned_parameters(module):
        if id(parameter) not in stacked:
            values = parameter.detach().expand(k, *parameter.shape).clone()
            stacked[id(parameter)] = nn.Parameter(values, requires_grad=parameter.requires_grad)
        owner.register_parameter(name, stacked[id(parameter)])


def take_cell(module: nn.Module, index: int) -> nn.Module:
    """A plain copy of one cell's module."""
    plain: nn.Module = clone_module(module)
    single: dict[int, nn.Parameter] = {}
    for owner, name, parameter in owned_parameters(plain):
        if id(parameter) not in single:
            single[id(parameter)] = nn.Parameter(
                parameter.detach()[index].clone(), requires_grad=parameter.requires_grad
            )
        owner.register_parameter(name, single[id(parameter)])
    return plain


@torch.no_grad()
def fill_cell(stacked: nn.Module, index: int, module: nn.Module, op: str) -> None:
    """Puts a plain module's parameters into one cell.

    Raises:
        ValueError: names, shapes or buffers that are not those of the routed module.
    """
    ours, theirs = dict(stacked.named_parameters()), dict(module.named_parameters())
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise ValueError(f"{op}: module must have the parameters of the routed one, got a difference in {odd[0]!r}")
    for name, parameter in theirs.items():
        if parameter.shape != ours[name].shape[1:]:
            raise ValueError(
                f"{op}: module's {name} must have shape {list(ours[name].shape[1:])}, got {list(parameter.shape)}"
            )
    buffers = dict(module.named_buffers())
    for name, buffer in stacked.named_buffers():
        if name not in buffers or not torch.equal(buffers[name].to(buffer.device), buffer):
            raise ValueError(f"{op}: module's buffer {name} must be that of the routed one, since cells share buffers")
    for name, parameter in theirs.items():
        ours[name][index] = parameter.to(ours[name])


@contextlib.contextmanager
def in_place_of_parameters(module: nn.Module, values: dict[int, Tensor]) -> Iterator[None]:
    """Lets a module find other tensors where its parameters are; ``values`` by the id of the parameter."""
    owned = owned_parameters(module)
    # Hooks such as that of torch.nn.utils.weight_norm leave tensors made of parameters behind.
    attributes = [(owner, dict(vars(owner))) for owner in module.modules() if owner._forward_pre_hooks]
    for owner, name, parameter in owned:
        owner._parameters[name] = values[id(parameter)]  # type: ignore[assignment]
    try:
        yield
    finally:
        for owner, name, parameter in owned:
            owner._parameters[name] = parameter
        for owner, before in attributes:
            for name, value in list(vars(owner).items()):
                if isinstance(value, Tensor) and value is not before.get(name):
                    vars(owner)[name] = before.get(name)


def as_per_cell(module: nn.Module) -> dict[int, Tensor]:
    """A :class:`PerCell` for every parameter, by its id."""
    return {
        id(parameter): PerCell(parameter, is_parameter=True)
        for parameter in {id(p): p for _, _, p in owned_parameters(module)}.values()
    }


def inherit_parameters(
    module: nn.Module, parents: Tensor, fresh: Sequence[Tensor] | None, new: Tensor
) -> dict[Tensor, nn.Parameter]:
    """Replaces parameters of k cells by those of their children; returns old -> new.

    Args:
        module: with stacked parameters, changed in place.
        parents: int64 [children], the cell that each child comes from.
        fresh: for each of ``owned_parameters`` values [children, ...] for the cells that ``new`` names, or None.
        new: bool [children].
    """
    replaced: dict[Tensor, nn.Parameter] = {}
    for index, (owner, name, parameter) in enumerate(owned_parameters(module)):
        if parameter not in replaced:
            values = parameter.detach()[parents.to(parameter.device)]
            if fresh is not None:
                values[new.to(values.device)] = fresh[index][new].to(values)
            replaced[parameter] = nn.Parameter(values, requires_grad=parameter.requires_grad)
        owner.register_parameter(name, replaced[parameter])
    return replaced


def check_optimizer(optimizer: torch.optim.Optimizer, module: nn.Module) -> None:
    """Raises ValueError for an optimiser that holds none of a module's parameters."""
    ours = {id(parameter) for parameter in module.parameters()}
    if ours and not any(id(parameter) in ours for group in optimizer.param_groups for parameter in group["params"]):
        raise ValueError(f"{_OP}.subdivide: optimizer must hold the router's parameters, got one of others")


def move_state(
    optimizer: torch.optim.Optimizer, replaced: dict[Tensor, nn.Parameter], parents: Tensor, fresh: Tensor | None
) -> str:
    """Puts the new parameters in the place of the old in an optimiser, their state copied from the parent cell.

    The state of the cells that the mask ``fresh`` names is zero instead.

    Returns:
        Empty, or the name of an optimiser whose state could not be carried over, and begins anew.
    """
    for group in optimizer.param_groups:
        # The list stays the same object: LBFGS, for one, has taken it elsewhere.
        group["params"][:] = [replaced.get(parameter, parameter) for parameter in group["params"]]
    known = isinstance(optimizer, _ELEMENTWISE_OPTIMIZERS)
    lost = ""
    for old, new in replaced.items():
        state = optimizer.state.pop(old, None)
        if not state:
            continue
        if not known:
            lost = type(optimizer).__name__
            continue
        for key, value in state.items():
            moved = copy.deepcopy(value)
            if isinstance(value, Tensor) and value.shape == old.shape:
                moved = value[parents.to(value.device)]
                if fresh is not None:
                    moved[fresh.to(value.device)] = 0
            optimizer.state[new][key] = moved
    if not known:
        # Some keep what is not a parameter's own, such as the last flattened gradient; nothing of it fits any more.
        optimizer.state.clear()
        if isinstance(optimizer, torch.optim.LBFGS):
            optimizer._numel_cache = None  # the number of entries of all parameters together
    return lost


def warn_fresh_state(name: str) -> None:
    """Says that an optimiser begins anew."""
    warnings.warn(f"{_OP}.subdivide: the state of {name} cannot be inherited by cells and begins anew", stacklevel=3)


def draw_parameters(template: nn.Module, k: int, generator: torch.Generator | None) -> list[Tensor]:
    """Newly drawn parameters [k, ...] of every parameter of a plain module, in the order of ``owned_parameters``.

    Raises:
        ValueError: when the module has parameters, but no ``reset_parameters()`` in itself or its layers.
    """
    resets = [template] if hasattr(template, "reset_parameters") else list(_layers_with_reset(template))
    drawn: list[list[Tensor]] = []
    # Of GPUs as well, which manual_seed reaches. Without a generator torch's own goes on.
    with torch.random.fork_rng() if generator is not None else contextlib.nullcontext():
        if generator is not None:
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator, device=generator.device)))
        for _ in range(k):
            for part in resets:
                part.reset_parameters()  # type: ignore[operator]
            drawn.append([p.detach().clone() for _, _, p in owned_parameters(template)])
    return [torch.stack(values) for values in itertools.zip_longest(*drawn)]


def _layers_with_reset(template: nn.Module) -> Iterator[nn.Module]:
    for name, part in template.named_modules():
        if hasattr(part, "reset_parameters"):
            yield part
        elif any(parameter is not None for parameter in part._parameters.values()):
            raise ValueError(
                f"{_OP}.subdivide: inherit=False needs a field with reset_parameters(), or layers that have it; "
                f"`{name}`, a {type(part).__name__}, has not"
            )
