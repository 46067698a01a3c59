"""The cells of a routed module: stacking parameters, reading and writing one cell, making cells from their parents.

A stacked parameter of k cells is ``[k, ...]`` under the module's own name. When cells are split or loaded, parameters
stay the same objects and get another shape.
"""

from __future__ import annotations

import contextlib
import copy
import fnmatch
import functools
import types
from collections.abc import Callable, Sequence
from numbers import Number
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.router.double import moved
from voronerf.router.grouping import CHANGES, HIDDEN, HOLDERS, SHARED, cell_parameters, owned_parameters, parts_of
from voronerf.router.layout import reachable

_OP = "VoronoiRouter"
_REGISTRIES = ("_parameters", "_buffers", "_modules")
_PRIVATE = {*vars(nn.Module()), SHARED, HIDDEN, HOLDERS, CHANGES, "_flat_weight_refs"}


def clone_module(module: Any, memo: dict[int, Any] | None = None) -> Any:
    """Returns a deep copy. Unlike ``deepcopy``, it accepts a module that keeps results of its last call."""
    memo = {} if memo is None else memo
    detach_results(module, memo)
    initial = dict(memo)
    try:
        return copy.deepcopy(module, memo)
    except Exception as error:
        for name, part in module.named_modules():
            for attribute, value in vars(part).items():
                if attribute not in _REGISTRIES and not _is_copied(value, dict(initial)):
                    raise TypeError(
                        f"{_OP}: module must support copy.deepcopy, but {_named(name, part)} keeps in "
                        f"`{attribute}` a {type(value).__name__}, which cannot be copied ({error}); make it outside of "
                        "the module, or give its class __deepcopy__"
                    ) from error
        raise


def _is_copied(value: Any, memo: dict[int, Any]) -> bool:
    try:
        copy.deepcopy(value, memo)
    except Exception:
        return False
    return True


def _named(name: str, part: nn.Module) -> str:
    return f"`{name}`, a {type(part).__name__}," if name else f"a {type(part).__name__}"


def detach_results(module: nn.Module, memo: dict[int, Any]) -> None:
    """Adds to ``memo``, for ``copy.deepcopy``, a detached copy of each result of a call that the module keeps."""
    for part in module.modules():
        for item in reachable(vars(part)):
            if isinstance(item, Tensor) and not item.is_leaf:
                memo[id(item)] = item.detach().clone()


def check_module(module: nn.Module) -> None:
    """Raises TypeError for a module that cannot be one network for each cell."""
    if not isinstance(module, nn.Module):
        raise TypeError(f"{_OP}: module must be an nn.Module, got {type(module).__name__}")
    for part in parts_of(module).values():
        if type(part).__hash__ is None:
            raise TypeError(
                f"{_OP}: module must be hashable, as torch requires, but a {type(part).__name__} is not; "
                "define it by @dataclass(eq=False), or with __hash__ beside __eq__"
            )
    registered = set(map(id, module.parameters()))
    for name, part in module.named_modules():
        reason = _refusal(part, registered)
        if reason:
            raise TypeError(f"{_OP}: module must treat samples one by one, but {_named(name, part)} {reason}")
    _check_reach(module, registered)


def hide_parts(module: nn.Module) -> None:
    """Stores the names of attributes that hold parameters or submodules (HOLDERS), and unregistered parts (HIDDEN)."""
    registered, waiting = set(map(id, module.parameters())), list(parts_of(module).values())
    while waiting:
        part, known = waiting.pop(), parts_of(module)
        holders, hidden = list[str](), dict[int, nn.Module]()
        for name, value in vars(part).items():
            for item in () if name in _REGISTRIES else reachable(value):
                is_module = isinstance(item, nn.Module)
                if is_module and id(item) not in known and any(id(p) in registered for p in item.parameters()):
                    hidden[id(item)] = item
                if id(item) in registered or id(item) in known or id(item) in hidden:
                    holders.append(name)
        if holders:
            vars(part).update({HOLDERS: (*dict.fromkeys(holders),), HIDDEN: [*hidden.values()]})
            waiting += hidden.values()


def _check_reach(module: nn.Module, registered: set[int]) -> None:
    """Raises TypeError if code accesses parameters other than by name, since calls replace parameters by name."""
    owner = {address: name for name, p in module.named_parameters() if (address := _address(p))}
    objects = {id(p): f"parameter `{name}`" for name, p in module.named_parameters()}
    objects |= {id(part): f"part `{name}`" if name else "module" for name, part in module.named_modules()}
    for name, part in module.named_modules():
        members = {key: value for key, value in vars(part).items() if key not in _REGISTRIES}
        for attribute, value in (members | dict(part.named_buffers(recurse=False))).items():
            for leaf in reachable(value):
                reason = ""
                if isinstance(leaf, Tensor) and id(leaf) not in registered and _address(leaf) in owner:
                    reason = (
                        f"a view of the parameter `{owner[_address(leaf)]}`, which cells replace (make it in forward)"
                    )
                elif isinstance(leaf, types.FunctionType) and (target := _held_by(leaf, objects)):
                    reason = f"a function that refers to the {target}, which differs for each cell (make it a method)"
                if reason:
                    raise TypeError(
                        f"{_OP}: module must reach parameters by name, but {_named(name, part)} keeps in `{attribute}` "
                        f"{reason}"
                    )


def _address(tensor: Tensor) -> int:
    """Returns the address of a tensor's memory; 0 if it has none."""
    try:
        return tensor.untyped_storage().data_ptr()
    except (RuntimeError, NotImplementedError):  # sparse, or without values
        return 0


def _held_by(function: types.FunctionType, objects: dict[int, str]) -> str:
    """Returns the description of the first of the objects that a function refers to; "" if it refers to none.

    A copy of the module would still refer to this object, since ``copy.deepcopy`` does not copy functions.

    Args:
        function: The function, with its globals, closure and defaults.
        objects: The descriptions of parameters and submodules, by the id of the object.
    """
    names = function.__code__.co_names
    values = [function.__globals__[name] for name in names if name in function.__globals__]
    for cell in function.__closure__ or ():
        with contextlib.suppress(ValueError):  # a closure cell that is still empty
            values.append(cell.cell_contents)
    values += [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    for held in values:
        for item in (*held, held) if isinstance(held, (list, tuple)) else (held,):
            item = item.__self__ if isinstance(item, types.MethodType) else item
            if id(item) in objects:
                return objects[id(item)]
    return ""


def _refusal(part: nn.Module, registered: set[int]) -> str:
    """Returns why a module with this submodule cannot be copied for each cell, or "".

    ``registered`` are the ids of the parameters.
    """
    if isinstance(part, torch.jit.ScriptModule) and next(part.parameters(), None) is not None:
        return "is compiled by torch.jit, and cannot take the parameters of a cell (wrap the Python module)"
    if any(type(one).__name__.endswith("SpectralNorm") for one in (part, *part._forward_pre_hooks.values())):
        return "keeps a state for each weight (spectral norm) that cells cannot share"
    for name, value in vars(part).items():
        for item in () if name in _REGISTRIES else reachable(value):
            own = [item] if isinstance(item, nn.Parameter) else item.parameters() if isinstance(item, nn.Module) else ()
            if any(p.requires_grad and id(p) not in registered for p in own):
                kind = "parameters" if isinstance(item, nn.Parameter) else f"a {type(item).__name__}"
                return (
                    f"keeps {kind} in `{name}`, a {type(value).__name__}, where parameters() does not find them (use "
                    "nn.ParameterList or nn.ModuleList, or requires_grad_(False) if they are constants)"
                )
    return ""


def refuse_statistics(parts: Sequence[nn.Module]) -> None:
    """Raises TypeError for normalisation layers that use statistics of the batch."""
    for part in parts:
        if part.training or getattr(part, "running_mean", None) is None:
            raise TypeError(
                f"{_OP}: module must treat samples one by one, but a {type(part).__name__} mixes the samples of a "
                "batch in training (use LayerNorm, or call router.eval() if it is not trained)"
            )


def stack_parameters(module: nn.Module, k: int, share: Sequence[str]) -> None:
    """Replaces every parameter of a module by a stack of k copies, except parameters that match ``share``."""
    hide_parts(module)
    named = list(module.named_parameters(remove_duplicate=False))
    for pattern in share:
        if not any(fnmatch.fnmatchcase(name, pattern) for name, _ in named):
            raise ValueError(
                f"{_OP}: share must name parameters of {type(module).__name__}, such as "
                f"{', '.join(name for name, _ in named[:3])}, got {pattern!r}"
            )
    shared = {id(p) for name, p in named if any(fnmatch.fnmatchcase(name, pattern) for pattern in share)}
    stacked: dict[int, nn.Parameter] = {}
    for owner, name, parameter in owned_parameters(module):
        if id(parameter) in shared:
            vars(owner)[SHARED] = (*vars(owner).get(SHARED, ()), name)
            continue
        if id(parameter) not in stacked:
            values = parameter.detach().expand(k, *parameter.shape).clone()
            stacked[id(parameter)] = nn.Parameter(values, requires_grad=parameter.requires_grad)
        owner.register_parameter(name, stacked[id(parameter)])
    for part in parts_of(module).values():
        for name, value in list(vars(part).items()):
            if name not in _REGISTRIES and any(id(item) in stacked for item in reachable(value)):
                vars(part)[name] = moved(value, stacked)


@torch.no_grad()
def fill_cell(routed: nn.Module, index: int, module: nn.Module, op: str) -> None:
    """Copies a plain module's parameters into one cell; raises ValueError if the modules differ in anything else."""
    module = getattr(module, "_orig_mod", module)
    stacked = {id(parameter) for parameter in cell_parameters(routed)}
    ours, theirs = routed.state_dict(keep_vars=True), module.state_dict()
    odd = sorted(ours.keys() ^ theirs.keys())
    if odd:
        raise ValueError(f"{op}: module must have the parameters of the routed module, got a difference in {odd[0]!r}")
    for name, tensor in ours.items():
        shape, value = tensor.shape[id(tensor) in stacked :], theirs[name]
        if value.shape != shape:
            raise ValueError(f"{op}: module's {name} must have shape {list(shape)}, got {list(value.shape)}")
        if id(tensor) not in stacked and not _equal(value.to(tensor), tensor):
            raise ValueError(f"{op}: module's {name} must equal the router's, since all cells share it")
    if other := _difference(routed, module):
        raise ValueError(f"{op}: module's {other} must equal the router's, since all cells share it")
    for name, tensor in ours.items():
        if id(tensor) in stacked:
            tensor[index] = theirs[name].to(tensor)


def _difference(ours: nn.Module, theirs: nn.Module, seen: dict[int, Any] | None = None) -> str:
    """Returns the name of a submodule of another class, or of an attribute of another value; "" if there is none."""
    others, seen = dict(theirs.named_modules()), {} if seen is None else seen
    for name, part in ours.named_modules():
        other, prefix = cast(nn.Module, others.get(name)), f"{name}." if name else ""
        if _class_of(other) != _class_of(part):
            return f"{name or 'class'}, a {type(other).__name__} instead of a {type(part).__name__},"
        if id(part) in seen:
            continue
        seen[id(part)] = part
        ours_by_name, theirs_by_name = _attributes(part), _attributes(other)
        for key in sorted(ours_by_name.keys() | theirs_by_name.keys()):
            if not _same(ours_by_name.get(key), theirs_by_name.get(key), seen):
                return f"{prefix}{key}"
    return ""


def _class_of(value: Any) -> tuple[str, str]:
    """Returns module and name of a value's class; the class itself may differ, as factories make one per object."""
    return type(value).__module__, type(value).__qualname__


def _attributes(part: nn.Module) -> dict[str, Any]:
    """Returns the attributes that may change a submodule's results, except its ``state_dict`` and its submodules.

    Also excludes attributes that weight norm or pruning computes, such as ``weight`` from ``weight_v``.
    """
    computed = {name.rpartition("_")[0] for name in part._parameters}
    members = {name: value for name, value in vars(part).items() if name not in _PRIVATE and name not in computed}
    members |= {name: part._buffers[name] for name in part._non_persistent_buffers_set}
    return members | {name: [*vars(part)[name].values()] for name in ("_forward_hooks", "_forward_pre_hooks")}


def _same(a: Any, b: Any, seen: dict[int, Any]) -> bool:
    """Returns whether two attributes are equal. Parameters, and tensors that a call has computed, equal any value."""
    if a is b or any(isinstance(x, Tensor) and (x.requires_grad or not x.is_leaf) for x in (a, b)):
        return True
    if isinstance(a, Number) and isinstance(b, Number):
        return bool(a == b or (a != a and b != b))  # NaN
    if _class_of(a) != _class_of(b):
        return False
    if isinstance(a, nn.Module):
        return not _difference(a, b, seen)
    if isinstance(a, Tensor) or hasattr(a, "__array__"):
        return _equal(a, b)
    ours, theirs = _parts(a, b), _parts(b, a)
    if ours is None or theirs is None:
        return bool(a == b)
    if id(a) in seen:
        return True
    seen[id(a)] = a  # keeps the object alive, and so its id
    return len(ours) == len(theirs) and all(_same(x, y, seen) for x, y in zip(ours, theirs, strict=True))


def _equal(a: Any, b: Any) -> bool:
    """Returns whether two tensors or arrays have the same shape and numbers; NaN equals NaN."""
    if a.shape != b.shape:
        return False
    a, b = (x.detach().to_dense().cpu() if isinstance(x, Tensor) and x.layout != torch.strided else x for x in (a, b))
    b = b.to(a.device) if isinstance(a, Tensor) else b
    return bool(((a == b) | ((a != a) & (b != b))).all())


def _parts(value: Any, other: Any) -> list[Any] | None:
    """Returns the objects that define a function, a container or an object; None for a value that compares itself.

    Tensors that a call may have added to only one of the containers, under further keys or at the end, are left out.
    """
    if isinstance(value, types.FunctionType):
        options, cells = value.__kwdefaults__ or {}, value.__closure__ or ()
        return [value.__code__, value.__defaults__, *options.values(), *(cell.cell_contents for cell in cells)]
    if isinstance(value, types.MethodType):
        return [value.__func__, *([] if isinstance(value.__self__, nn.Module) else [value.__self__])]
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    if isinstance(value, dict):
        kept = {key: item for key, item in value.items() if key in other or not isinstance(item, Tensor)}
        return [part for key in sorted(kept, key=repr) for part in (key, kept[key])]
    if isinstance(value, (list, tuple)):
        return [item for at, item in enumerate(value) if at < len(other) or not isinstance(item, Tensor)]
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    if (slots or hasattr(value, "__dict__")) and not isinstance(value, type):
        return [getattr(value, "__dict__", None), *(getattr(value, name, None) for name in slots)]
    compares = callable(value) or type(value).__dict__.get("__eq__", object.__eq__) is not object.__eq__
    return None if compares else []  # an object without attributes, such as a lock, equals others


def _replace_values(parameter: nn.Parameter, values: Tensor) -> None:
    """Gives a parameter values of another shape.

    A gradient accumulator from an earlier call, if still alive, would reduce new gradients to the old shape. A
    temporary change of dtype makes torch drop the accumulator.
    """
    if values.is_floating_point():
        other = torch.float32 if values.dtype == torch.float64 else torch.float64
        parameter.data = values.new_empty(0, dtype=other)
    parameter.data, parameter.grad = values, None
    torch.autograd.graph.increment_version(parameter)  # backward of an earlier call refuses the new values


def draw_parameters(routed: nn.Module, k: int, generator: torch.Generator | None) -> dict[str, Tensor]:
    """Draws the parameters of k cells of a routed module; returns them as [k, ...], by name. Shared ones stay."""
    template, ours = plain_cell(routed, 0), {id(parameter) for parameter in cell_parameters(routed)}
    parts = {"": template} if hasattr(template, "reset_parameters") else dict(template.named_modules())
    for name, part in parts.items():
        if not hasattr(part, "reset_parameters") and any(p is not None for p in part._parameters.values()):
            raise ValueError(
                f"{_OP}.subdivide: inherit=False needs a field with reset_parameters(), or layers that have it; "
                f"`{name}`, a {type(part).__name__}, has none"
            )
    names = [name for name, parameter in routed.named_parameters() if id(parameter) in ours]
    draws: dict[str, list[Tensor]] = {name: [] for name in names}
    # fork_rng also saves the GPUs' states, because manual_seed changes them. Without a generator, torch's is used.
    with torch.random.fork_rng() if generator is not None else contextlib.nullcontext():
        if generator is not None:
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator, device=generator.device)))
        for _ in range(k):
            for part in parts.values():
                if hasattr(part, "reset_parameters"):
                    part.reset_parameters()  # type: ignore[operator]
            for name in names:
                draws[name].append(template.get_parameter(name).detach().clone())
    return {name: torch.stack(values) for name, values in draws.items()}


def plain_cell(routed: nn.Module, index: int) -> nn.Module:
    """Returns a plain copy of one cell's module, with parameters of its own."""
    copies = {id(p): nn.Parameter(p.detach()[index].clone(), p.requires_grad) for p in cell_parameters(routed)}
    plain: nn.Module = clone_module(routed, copies)
    for part in plain.modules():
        vars(part).pop(SHARED, None)
    return plain


def apply_to_cells(routed: nn.Module, k: int, function: Callable[[nn.Module], Any]) -> None:
    """Applies a function to the modules of each of k cells, and keeps the changes of parameters and buffers.

    Shared parameters and buffers get their values from the first cell.
    """
    stacked = {id(parameter) for parameter in cell_parameters(routed)}
    for index in range(k):
        changed = plain_cell(routed, index).apply(function).state_dict()
        with torch.no_grad():
            for name, tensor in routed.state_dict(keep_vars=True).items():
                if changed.get(name) is None or changed[name].shape != tensor.shape[id(tensor) in stacked :]:
                    raise ValueError(f"{_OP}.apply: fn must keep names and shapes of parameters, got another {name!r}")
                if id(tensor) in stacked:
                    tensor[index] = changed[name].to(tensor)
                elif index == 0:
                    tensor.copy_(changed[name])


def renew_cells(
    routed: nn.Module, parents: Tensor, fresh: dict[str, Tensor] | None = None, new: Tensor | None = None
) -> None:
    """Replaces the cells of a routed module by copies of their parents; parameters stay the same objects.

    Args:
        routed: The module with stacked parameters.
        parents: The old cell from which each new cell is copied, int64 [new cells].
        fresh: Values [new cells, ...] by parameter name, for the cells of ``new``; None if all cells are copies.
        new: The mask of the new cells that get ``fresh`` values, bool [new cells].
    """
    names = {id(p): name for name, p in routed.named_parameters()}
    for parameter in cell_parameters(routed):
        with torch.inference_mode(False):
            # index_select, because indexing a meta tensor would import torch's compiler.
            values = parameter.detach().index_select(0, parents.to(parameter.device))
            if fresh is not None and new is not None:
                values[new.to(values.device)] = fresh[names[id(parameter)]][new].to(values)
            _replace_values(parameter, values)
