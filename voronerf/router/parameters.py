"""The parameters of a routed module: stacked for all cells, taken apart for one, carried over to finer diagrams.

k cells; ``[k, ...]`` under the module's own names.
"""

from __future__ import annotations

import contextlib
import copy
import fnmatch
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parameter import UninitializedParameter
from torch.nn.utils import parametrizations

from voronerf.backends import BACKENDS
from voronerf.router.layout import accepted_names
from voronerf.router.trees import map_tree, tensors_of

_OP = "VoronoiRouter"
_SHARED, _ALIASES = "_voronerf_shared", "_voronerf_aliases"  # names that parts of a routed module carry
_OWN = frozenset(vars(nn.Module())) | {_SHARED, _ALIASES}


def owned_parameters(module: nn.Module) -> list[tuple[nn.Module, str, nn.Parameter]]:
    """(owner, name, parameter) of every parameter of a module tree; one that is used twice comes twice."""
    return [
        (owner, name, parameter)
        for owner in module.modules()
        for name, parameter in list(owner._parameters.items())
        if parameter is not None
    ]


def cell_parameters(module: nn.Module) -> list[tuple[nn.Module, str, nn.Parameter]]:
    """Those of :func:`owned_parameters` that are stacked, [k, ...]; not those that all cells share."""
    return [owned for owned in owned_parameters(module) if not is_shared(owned[0], owned[1])]


def is_shared(owner: nn.Module, name: str) -> bool:
    """Whether a parameter is one for all cells."""
    return name in vars(owner).get(_SHARED, ())


def clone_module(module: Any, memo: dict[int, Any] | None = None) -> Any:
    """A deep copy, also of a module that keeps results of its last call (which torch refuses to copy)."""
    memo = {} if memo is None else memo
    detach_results(module, memo)
    return copy.deepcopy(module, memo)


def detach_results(module: nn.Module, memo: dict[int, Any]) -> None:
    """Has ``copy.deepcopy`` take copies without a graph of the results that a module keeps."""
    for part in module.modules():
        for value in vars(part).values():
            if isinstance(value, Tensor) and not value.is_leaf:
                memo[id(value)] = value.detach().clone()


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
    registered = {id(parameter) for parameter in module.parameters()}
    for name, part in module.named_modules():
        reason = _refusal(part, registered)
        if reason:
            where = f"`{name}`, a {type(part).__name__}," if name else f"a {type(part).__name__}"
            raise TypeError(f"{_OP}: module must treat samples one by one, but {where} {reason}")


def _refusal(part: nn.Module, registered: set[int]) -> str:
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
    for name, value in _containers(part):
        if any(isinstance(item, nn.Parameter) and id(item) not in registered for item in tensors_of(value)):
            return f"keeps parameters in the plain {type(value).__name__} `{name}` (use nn.ParameterList)"
    return ""


def _containers(part: nn.Module) -> list[tuple[str, Any]]:
    """The plain lists, tuples and dicts among a module's attributes."""
    return [
        (name, value)
        for name, value in vars(part).items()
        if isinstance(value, (list, tuple, dict)) and not name.endswith("_hooks") and name not in _OWN
    ]


def check_options(
    module: nn.Module,
    coords: Any,
    lists: dict[str, Any],
    layout: str,
    assignment: str,
    temperature: float,
    backend: str,
    blend: float,
) -> None:
    """Raises ValueError or TypeError for an option of the router that is wrong; ``lists`` are per_ray and the like."""
    if assignment not in ("nearest", "stochastic"):
        raise ValueError(f"{_OP}: assignment must be 'nearest' or 'stochastic', got {assignment!r}")
    if not temperature > 0:
        raise ValueError(f"{_OP}: temperature must be positive, got {temperature}")
    if not 0 <= blend < float("inf"):
        raise ValueError(f"{_OP}: blend must be finite and at least 0, got {blend}")
    if layout not in ("rays", "flat"):
        raise ValueError(f"{_OP}: layout must be 'rays' or 'flat', got {layout!r}")
    if backend not in ("auto", *BACKENDS):
        raise ValueError(f"{_OP}: backend must be auto, {', '.join(BACKENDS)}, got {backend!r}")
    if not (coords is None or coords == "first3" or isinstance(coords, slice) or callable(coords)):
        raise ValueError(f"{_OP}: coords must be 'first3', a slice or a function, got {coords!r}")
    for name, value in lists.items():
        if isinstance(value, (str, int)):
            raise TypeError(f"{_OP}: {name} must be a list, got {value!r}")
    kind = type(module).__name__
    for name in lists["methods"]:
        if not callable(getattr(module, name, None)):
            raise ValueError(f"{_OP}: methods must name methods of {kind}, got {name!r}")
    known = accepted_names([module.forward, *(getattr(module, name) for name in lists["methods"])])
    for item in (*(lists["per_ray"] or ()), *lists["shared"]):
        if isinstance(item, str) and known is not None and item.split(".")[0] not in known:
            raise ValueError(
                f"{_OP}: per_ray and shared must name arguments of {kind}, one of {', '.join(known)}, got {item!r}"
            )


def stack_parameters(module: nn.Module, k: int, share: Sequence[str]) -> None:
    """Gives every parameter of a module k equal entries, in place, but for those that the patterns ``share`` name.

    Raises:
        ValueError: For a pattern that no parameter has.
    """
    names = [name for name, _ in module.named_parameters(remove_duplicate=False)]
    for pattern in share:
        if not fnmatch.filter(names, pattern):
            raise ValueError(
                f"{_OP}: share must name parameters of {type(module).__name__}, such as {', '.join(names[:3])}, got "
                f"{pattern!r}"
            )
    shared = {
        id(parameter)
        for name, parameter in module.named_parameters(remove_duplicate=False)
        if any(fnmatch.fnmatchcase(name, pattern) for pattern in share)
    }
    stacked: dict[int, nn.Parameter] = {}
    for owner, name, parameter in owned_parameters(module):
        if id(parameter) in shared:
            vars(owner)[_SHARED] = (*vars(owner).get(_SHARED, ()), name)
            continue
        if id(parameter) not in stacked:
            values = parameter.detach().expand(k, *parameter.shape).clone()
            stacked[id(parameter)] = nn.Parameter(values, requires_grad=parameter.requires_grad)
        owner.register_parameter(name, stacked[id(parameter)])
    for part in module.modules():
        aliases = [name for name, value in _containers(part) if any(id(t) in stacked for t in tensors_of(value))]
        if aliases:
            vars(part)[_ALIASES] = tuple(aliases)
            _point_aliases(part, stacked)


def _point_aliases(part: nn.Module, values: Mapping[int, Tensor]) -> dict[str, Any]:
    """Puts other tensors into plain lists and the like that hold parameters; returns the lists as they were."""
    before = {name: vars(part)[name] for name in vars(part).get(_ALIASES, ())}
    for name, value in before.items():
        vars(part)[name] = map_tree(value, lambda _, tensor, nested: values.get(id(tensor), tensor))
    return before


def take_cell(module: nn.Module, index: int) -> nn.Module:
    """A plain copy of one cell's module."""
    single = {
        id(parameter): nn.Parameter(parameter.detach()[index].clone(), requires_grad=parameter.requires_grad)
        for _, _, parameter in cell_parameters(module)
    }
    plain = clone_module(module, single)
    for part in plain.modules():
        for name in (_SHARED, _ALIASES):
            vars(part).pop(name, None)
    return plain


@torch.no_grad()
def fill_cell(routed: nn.Module, index: int, module: nn.Module, op: str) -> None:
    """Puts a plain module's parameters into one cell.

    Raises:
        ValueError: names, shapes or buffers that are not those of the routed module.
    """
    ours, theirs = dict(routed.named_parameters()), dict(module.named_parameters())
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise ValueError(f"{op}: module must have the parameters of the routed one, got a difference in {odd[0]!r}")
    stacked = {id(parameter) for _, _, parameter in cell_parameters(routed)}
    for name, parameter in theirs.items():
        own = id(ours[name]) in stacked
        shape = ours[name].shape[1:] if own else ours[name].shape
        if parameter.shape != shape:
            raise ValueError(f"{op}: module's {name} must have shape {list(shape)}, got {list(parameter.shape)}")
        if not own and not torch.equal(parameter.to(ours[name]), ours[name]):
            raise ValueError(f"{op}: module's {name} must be that of the routed one, since cells share it")
    buffers = dict(module.named_buffers())
    for name, buffer in routed.named_buffers():
        if name not in buffers or not torch.equal(buffers[name].to(buffer.device), buffer):
            raise ValueError(f"{op}: module's buffer {name} must be that of the routed one, since cells share buffers")
    for name, parameter in theirs.items():
        if id(ours[name]) in stacked:
            ours[name][index] = parameter.to(ours[name])


@contextlib.contextmanager
def in_place_of_parameters(module: nn.Module, values: Mapping[int, Tensor]) -> Iterator[None]:
    """Lets a module find other tensors where its parameters are; ``values`` by the id of the parameter."""
    owned = cell_parameters(module)
    parts = list(module.modules())
    # Hooks such as that of torch.nn.utils.weight_norm leave tensors made of parameters behind.
    attributes = [(part, dict(vars(part))) for part in parts if part._forward_pre_hooks]
    aliases = [(part, _point_aliases(part, values)) for part in parts if _ALIASES in vars(part)]
    for owner, name, parameter in owned:
        owner._parameters[name] = values[id(parameter)]  # type: ignore[assignment]
    try:
        yield
    finally:
        for owner, name, parameter in owned:
            owner._parameters[name] = parameter
        for part, before in aliases:
            vars(part).update(before)
        for owner, before in attributes:
            for name, value in list(vars(owner).items()):
                if isinstance(value, Tensor) and value is not before.get(name):
                    vars(owner)[name] = before.get(name)


@torch.no_grad()
def inherit_parameters(module: nn.Module, parents: Tensor, fresh: Sequence[Tensor] | None, new: Tensor) -> None:
    """Replaces the values of k cells by those of their children; the parameter objects stay.

    Args:
        module: With stacked parameters, changed in place.
        parents: int64 [children], the cell that each child comes from.
        fresh: For each of ``owned_parameters`` values [children, ...] for the cells that ``new`` names, or None.
        new: bool [children].
    """
    stacked = {id(parameter) for _, _, parameter in cell_parameters(module)}
    done: set[int] = set()
    for index, (_, _, parameter) in enumerate(owned_parameters(module)):
        if id(parameter) in done or id(parameter) not in stacked:
            continue
        done.add(id(parameter))
        with torch.inference_mode(False):
            values = parameter.detach()[parents.to(parameter.device)]
            if fresh is not None:
                values[new.to(values.device)] = fresh[index][new].to(values)
            # A graph of an earlier call that is still held remembers the old shape of the parameter, and would have the
            # gradients of the new cells summed to it. With another dtype in between torch forgets it.
            if values.is_floating_point():
                other = torch.float32 if values.dtype == torch.float64 else torch.float64
                parameter.data = values.new_empty(0, dtype=other)
            parameter.data, parameter.grad = values, None


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
