"""Traces one call of a module as a graph of functions.

A function mode records every PyTorch function with the line that called it. A profile function of the thread records
custom autograd functions. Two traces with different numbers of samples (:func:`trace`) tell sizes that count samples
from sizes of the module.
"""

from __future__ import annotations

import contextlib
import inspect
import operator
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, fx
from torch.fx.node import map_aggregate, map_arg
from torch.overrides import TorchFunctionMode

from voronerf.router.axes import axis_of, multiple
from voronerf.router.double import Double
from voronerf.router.grouped import (
    LIKE,
    METADATA,
    RANDOM,
    converted,
    find,
    line_of,
    name_of,
    user_frame,
    writes_in_place,
)
from voronerf.router.grouping import cell_parameters, owned_parameters, parts_of
from voronerf.router.layout import Call, rebuild, tensors_of
from voronerf.router.watch import Inputs, lookup

CONSTANTS, CELLS, SAMPLES = range(3)  # dependence of a value: the maximum over its operands
_PAIRS = ((37, 31), (29, 23), (19, 17))  # numbers of samples of two traces, tried in turn
_TOTALS = find("any all sum", torch, torch.Tensor)  # their scalar results may be used for a gradient only


def differentiable(value: Tensor) -> Tensor:
    """Returns a tensor with the same values, by which later results can be differentiated.

    The tensor is a view if ``value`` requires a gradient, else a new leaf.
    """
    return value.view_as(value) if value.requires_grad else value.detach().requires_grad_()


class Unfusable(Exception):
    """An error for a module that cannot be fused; the message names the line and a remedy."""


class _Begun(NamedTuple):
    """A function that has begun, and whose results are not recorded yet."""

    node: fx.Node
    function: Any
    args: Any
    kwargs: Any
    operands: list[Tensor]


def trace(call: Call, tensors: list[Tensor], inputs: Inputs) -> Trace:
    """Traces a call on rows of its arguments, at least 37 of each.

    The ``meta`` of each node with a tensor gets ``axis``, the :class:`Axis` of its samples or None. Raises
    :class:`Unfusable`.
    """
    error: Unfusable | None = None
    for pair in _PAIRS:
        try:
            first, second = (Trace(call, [tensor[:rows] for tensor in tensors], inputs) for rows in pair)
            _compare(first, second)
            return first
        except Unfusable as caught:
            error = error or caught
    assert error is not None
    raise error


def _compare(first: Trace, second: Trace) -> None:
    """Stores the axis of each value; raises Unfusable if the traces differ, or if another size is a multiple of n."""
    counts, nodes = (first.rows, second.rows), (list(first.graph.nodes), list(second.graph.nodes))
    if len(nodes[0]) != len(nodes[1]):
        raise Unfusable("its forward calls other functions for another number of samples")
    for node, other in zip(*nodes, strict=True):
        (arguments, shapes), (other_arguments, other_shapes) = _sizes(node), _sizes(other)
        pairs = [pair for a, b in zip(shapes, other_shapes) for pair in zip(a, b)]
        same = node.target == other.target and arguments == other_arguments
        same = same and list(map(len, shapes)) == list(map(len, other_shapes))
        if not same or any(a != b and not multiple((a, b), counts) for a, b in pairs):
            line = node.meta.get("line", "")
            raise Unfusable(f"{name_of(node.target)}{line} gets or gives other sizes for another number of samples")
        if any(a == b and a and not (a % counts[0] and a % counts[1]) for a, b in pairs):
            raise Unfusable(f"a size of the module is a multiple of {counts[0]} or {counts[1]}")
        if isinstance(node.meta.get("value"), Tensor):
            node.meta["axis"] = axis_of(shapes[0], other_shapes[0], counts)


def _sizes(node: fx.Node) -> tuple[list[str], list[list[int]]]:
    """Returns the names of the nodes in a node's arguments, and the sizes of its value and of other arguments."""
    names: list[str] = []
    shapes = [list(value.shape)] if isinstance(value := node.meta.get("value"), Tensor) else []

    def note(leaf: Any) -> Any:
        if isinstance(leaf, fx.Node):
            names.append(leaf.name)
        elif isinstance(leaf, Tensor) or type(leaf) is int:
            shapes.append(list(leaf.shape) if isinstance(leaf, Tensor) else [leaf])
        return leaf

    map_aggregate((node.args, node.kwargs), note)
    return names, shapes


def _remedy(usual: str) -> str:
    """Returns how to avoid a refusal: the usual way, or another one while a distribution checks its arguments."""
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__") != "torch.distributions.distribution":
        frame = frame.f_back
    return usual if frame is None else "pass validate_args=False to the distribution"


class Trace(TorchFunctionMode):
    """Records the functions that the routed module calls with its first cell's parameters.

    The ``meta`` of a node has:

    - ``value``: the value of the node;
    - ``on``: the kind of data on which the value depends: CONSTANTS, CELLS or SAMPLES;
    - ``line``: the line of the module that called the function;
    - ``grad``: whether gradients were on;
    - ``inplace``: whether the function writes to its first argument; this argument is then the value;
    - ``counts``: whether the value holds numbers derived from the number of samples, and no rows, such as
      ``torch.tensor(x.shape)``.

    ``tensors`` are rows of the arguments, ``inputs`` are the values that each call looks up, and ``reads`` are the
    attributes that were read. Raises :class:`Unfusable` for a step that cannot be repeated for other samples.
    """

    def __init__(self, call: Call, tensors: list[Tensor], inputs: Inputs) -> None:
        super().__init__()
        self._module = module = call.module
        single = {id(p): p.detach()[0].requires_grad_(p.requires_grad) for p in cell_parameters(module)}
        self._cell_ids = set(map(id, single.values()))
        self._places = {id(single.get(id(p), p)): i for i, (_, _, p) in enumerate(owned_parameters(module))}
        self.graph = fx.Graph()
        self.parameters: dict[fx.Node, int] = {}  # the index of each parameter in ``owned_parameters``
        self._running, self._line = False, ""
        self._code: tuple[tuple[str, ...], dict[str, Any]] = (), {}  # the line's code: its names and its globals
        self._nodes: dict[int, fx.Node] = {}  # by the id of the node's tensor, which ``meta`` keeps alive
        self.rows = len(tensors[0])
        self.n = self._new(self.rows)
        self.inputs = [self._new(tensor) for tensor in tensors]
        self.shared = [self._new(tensor, on=CONSTANTS) for tensor in call.shared()]
        self.reads = set[tuple[int, str]]()
        double, parts = Double(module, self.reads), list(parts_of(module).values())
        self.places = [source for source in inputs.sources if not isinstance(source, str)]
        for place, name in self.places:
            value, part = inputs.tensor(lookup(parts[place], name), tensors[0].device), double.parts[place]
            (vars(part) if name in vars(part) else part._buffers)[name] = value
            self.shared.append(self._new(value, on=CONSTANTS))
        self.reads.clear()
        with self._custom_functions(), self:
            result = double.run(call, tensors, single)
        self._separate_gradients()
        self.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
        self.outputs = [self._argument(tensor) for tensor in tensors_of(result)]
        for node in self.outputs:
            if isinstance(node, fx.Node) and "mixes" in node.meta:
                raise Unfusable(node.meta["mixes"])

    def _new(self, value: Any, node: fx.Node | None = None, on: int = SAMPLES) -> fx.Node:
        """Assigns a node to a value; without ``node``, adds a new input of the graph."""
        node = self.graph.placeholder("given") if node is None else node
        node.meta.update(value=value, on=on)
        if isinstance(value, Tensor):
            self._nodes[id(value)] = node
            if on == SAMPLES and not node.meta.get("counts") and not self._has_rows(value):
                remedy = _remedy("keep a row for each, as torch.where does")
                node.meta["mixes"] = (
                    f"{name_of(node.target)}{node.meta.get('line', '')} gives a tensor of shape {list(value.shape)}, "
                    f"which has no row for each of {self.rows} samples: it mixes or selects them; {remedy}"
                )
                if value.dim() or node.target not in _TOTALS:
                    raise Unfusable(node.meta["mixes"])
        return node

    def _has_rows(self, value: Tensor) -> bool:
        return any(size and size % self.rows == 0 for size in value.shape)

    def _argument(self, value: Any) -> Any:
        """Returns the node of an argument, or the argument itself if it is a constant."""
        if type(value) is int and value and value % self.rows == 0:
            return self._new(value, self.graph.call_function(operator.mul, (self.n, value // self.rows)))
        if not isinstance(value, Tensor) or id(value) in self._nodes:
            return self._nodes.get(id(value), value)
        if id(value) in self._places:
            node = self._new(value, on=CELLS if id(value) in self._cell_ids else CONSTANTS)
            self.parameters[node] = self._places[id(value)]
            return node
        if value.requires_grad or value.shape[:1] == (self.rows,):
            names = self._compiled()
            remedy = (
                f"perhaps {names}, which torch.jit has compiled; use what it was compiled from"
                if names
                else "write it with functions of PyTorch, or call it in a torch.autograd.Function"
            )
            raise Unfusable(f"a tensor was not computed by a PyTorch function{self._line}, {remedy}")
        return value

    def _compiled(self) -> str:
        """Returns the names of submodules and called functions that ``torch.jit`` has compiled."""
        names, namespace = self._code
        compiled = torch.jit.ScriptModule
        parts = [f"part {name!r}" for name, part in self._module.named_modules() if isinstance(part, compiled)]
        return ", ".join(parts + [name for name in names if isinstance(namespace.get(name), torch.jit.ScriptFunction)])

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Calls a function and records it."""
        if self._running or func in METADATA:
            return func(*args, **(kwargs or {}))
        begun = self._begin(func, args, kwargs or {})
        self._running = True  # inner functions are not recorded
        try:
            result = begun.function(*begun.args, **begun.kwargs)
        finally:
            self._running = False
        self._end(begun, result)
        return result

    @contextlib.contextmanager
    def _custom_functions(self) -> Iterator[None]:
        """Records the custom functions of autograd that this thread calls."""
        code, calls = torch.autograd.Function.apply.__func__.__code__, dict[FrameType, _Begun]()  # type: ignore[attr-defined]
        old_profile: Any = sys.getprofile()
        in_c = old_profile is not None and not callable(old_profile)  # cProfile has methods to stop and resume
        if in_c and not hasattr(old_profile, "enable"):
            yield
            return

        def record(frame: FrameType, event: str, value: Any) -> None:
            if frame.f_code is not code:
                return
            if event == "call" and not self._running:
                members, self._running = frame.f_locals, True
                calls[frame] = self._begin(members["cls"].apply, members["args"], members["kwargs"])
            elif event == "return" and frame in calls:
                self._end(calls.pop(frame), value)
                self._running = False

        if in_c:
            old_profile.disable()
        sys.setprofile(record)
        try:
            yield
        finally:
            sys.setprofile(None if in_c else old_profile)
            if in_c:
                old_profile.enable()

    def _begin(self, func: Any, args: Any, kwargs: Any) -> _Begun:
        """Records a function before its call; returns the node with the function and arguments to call."""
        frame = user_frame()
        self._line = line = line_of(frame)
        self._code = (frame.f_code.co_names, frame.f_globals) if frame else ((), {})
        operands = tensors_of((args, kwargs))
        func, args = converted(func, args)
        if func is torch.autograd.grad:  # all cells have one graph; in a loop, each has its own
            kwargs = {**kwargs, "retain_graph": True}
        node = self.graph.call_function(func, *map_aggregate((args, kwargs), self._argument))
        node.meta["inplace"] = writes_in_place(func) or bool(kwargs.get("inplace"))
        node.meta["line"], node.meta["grad"] = line, torch.is_grad_enabled()
        return _Begun(node, func, args, kwargs, operands)

    def _end(self, begun: _Begun, result: Any) -> None:
        """Records the results of a function."""
        node, func, _, kwargs, operands = begun
        inplace, line = node.meta["inplace"], node.meta["line"]
        outputs = operands[:1] if inplace else tensors_of(result)
        used = node.all_input_nodes
        is_identity = func is F.dropout and not (kwargs["training"] and kwargs["p"])
        if used and func in RANDOM and not is_identity:
            raise Unfusable(f"{name_of(func)} draws random numbers{line}; pass them as an argument")
        counts = all(s.meta.get("counts") or type(s.meta["value"]) is int for s in used)
        from_n = counts and type(result) is int and result and result % self.rows == 0  # becomes a node at its use
        if used and not outputs and result is not None and not from_n:
            name = "the truth value of a tensor" if isinstance(result, bool) else name_of(node.target)
            remedy = _remedy("write it with torch.where")
            raise Unfusable(f"{name} is read{line}, so the module's control flow depends on values; {remedy}")
        for source in used:
            if "mixes" in source.meta and func is not torch.autograd.grad:
                raise Unfusable(source.meta["mixes"])
        is_constant = func in LIKE and not self._has_rows(outputs[0])
        if not used or is_constant or not outputs or (not inplace and any(result is tensor for tensor in operands)):
            self.graph.erase_node(node)
            return
        nodes, on = [node], max(value.meta["on"] for value in used)
        if not inplace and not isinstance(result, Tensor):
            nodes = [self.graph.call_function(operator.getitem, (node, i)) for i in range(len(outputs))]
        node.meta["results"] = nodes
        for value, tensor in zip(nodes, outputs, strict=True):
            value.meta["counts"] = counts and not self._has_rows(tensor)
            self._new(tensor, value, on)
        node.meta["on"] = on

    def _separate_gradients(self) -> None:
        """Inserts a `differentiable` node after each tensor by which ``torch.autograd.grad`` differentiates.

        PyTorch computes this node between runs. All functions that used the tensor use the node instead.
        """
        for node in list(self.graph.nodes):
            if node.target is not torch.autograd.grad:
                continue
            sources: list[fx.Node] = []
            map_arg(node.args[1] if len(node.args) > 1 else node.kwargs["inputs"], sources.append)
            for source in sources:
                if source.target is not differentiable and source.meta["on"] == SAMPLES:
                    with self.graph.inserting_after(source):
                        new = self.graph.call_function(differentiable, (source,))
                    for user in [user for user in source.users if user is not new]:
                        user.replace_input_with(source, new)
                    new.meta.update(source.meta, results=[new], inplace=False, grad=True, line=node.meta["line"])
