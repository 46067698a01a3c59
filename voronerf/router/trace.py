"""Traces one call of a module as a graph of functions.

A function mode records every PyTorch function with the line that called it. A profile function of the thread records
custom autograd functions.
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
from torch import Tensor, fx, nn
from torch.fx.node import map_aggregate, map_arg
from torch.overrides import TorchFunctionMode

from voronerf.router.axes import Axis, SampleCount, axis_of
from voronerf.router.double import Double
from voronerf.router.grouped import (
    LIKE,
    METADATA,
    CallAxes,
    Recorder,
    converted,
    find,
    is_random,
    line_of,
    name_of,
    steps_of,
    user_frame,
    with_counts,
    writes_in_place,
)
from voronerf.router.grouping import cell_parameters, owned_parameters, parts_of
from voronerf.router.layout import Call, rebuild, tensors_of
from voronerf.router.watch import Inputs, lookup

CONSTANTS, CELLS, SAMPLES = range(3)  # dependence of a value: the maximum over its operands
_ROWS = (37, 41, 31, 29)  # numbers of samples of a trace, see `rows_for`
_TOTALS = find("any all sum", torch, torch.Tensor)  # scalar results are allowed as inputs of autograd.grad only


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


def rows_for(module: nn.Module, tensors: list[Tensor]) -> int:
    """Returns a number of samples that divides no size of the module or its arguments, if there is one."""
    sizes = {size for tensor in (*module.parameters(), *module.buffers()) for size in tensor.shape}
    sizes.update(size for tensor in tensors for size in tensor.shape[1:])
    return next((rows for rows in _ROWS if all(size % rows or not size for size in sizes)), _ROWS[0])


def _remedy(usual: str) -> str:
    """Returns the remedy for an error: ``usual``, or another one while torch.distributions checks arguments."""
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__") != "torch.distributions.distribution":
        frame = frame.f_back
    return usual if frame is None else "pass validate_args=False to the distribution"


class Trace(TorchFunctionMode):
    """Records the functions that the routed module calls with its first cell's parameters.

    The ``meta`` of a node has:

    - ``value``: the value of the node;
    - ``axis``: the :class:`Axis` of the samples of a tensor; None for a tensor without rows;
    - ``on``: the kind of data on which the value depends: CONSTANTS, CELLS or SAMPLES;
    - ``line``: the line of the module that called the function;
    - ``grad``: whether gradients were on;
    - ``inplace``: whether the function writes to its first argument; this argument is then the value;
    - ``counts``: whether the value holds numbers derived from the number of samples, and no rows, such as
      ``torch.tensor(x.shape)``.

    ``tensors`` are rows of the arguments, at least 41; ``inputs`` are the values that each call looks up, and ``reads``
    are the attributes that were read. Two runs with different numbers of samples precede the trace (:class:`Recorder`).
    Raises :class:`Unfusable` for a function that cannot be repeated for other samples.
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
        self.rows = rows_for(module, tensors)
        tensors = [tensor[: self.rows] for tensor in tensors]
        self.n = self._new(self.rows)
        self.inputs = [self._new(tensor, axis=Axis(0)) for tensor in tensors]
        self.shared = [self._new(tensor, on=CONSTANTS) for tensor in call.shared()]
        self.reads = set[tuple[int, str]]()
        double, parts = Double(module, self.reads), list(parts_of(module).values())
        self.places = [source for source in inputs.sources if not isinstance(source, str)]
        for place, name in self.places:
            value = inputs.tensor(lookup(parts[place], name), tensors[0].device)
            double.replace(place, name, value)
            self.shared.append(self._new(value, on=CONSTANTS))
        counts, runs = (self.rows, self.rows // 2 + 1), (Recorder(), Recorder())
        results = [
            tensors_of(double.run(call, [tensor[:count] for tensor in tensors], single, recorder))
            for count, recorder in zip(counts, runs, strict=True)
        ]
        self._steps = iter(steps_of(runs, counts))
        self.reads.clear()
        with self._custom_functions(), self:
            result = double.run(call, tensors, single)
        self._separate_gradients()
        self.result = rebuild(result, [tensor.detach() for tensor in tensors_of(result)])
        self.outputs = [self._argument(tensor) for tensor in tensors_of(result)]
        for node, *pair in zip(self.outputs, *results, strict=True):
            if isinstance(node, fx.Node):
                node.meta["axis"] = axis_of(pair[0].shape, pair[1].shape, counts)
                if "mixes" in node.meta:
                    raise Unfusable(node.meta["mixes"])

    def _new(self, value: Any, node: fx.Node | None = None, on: int = SAMPLES, axis: Axis | None = None) -> fx.Node:
        """Assigns a node to a value; without ``node``, adds a new input of the graph."""
        node = self.graph.placeholder("given") if node is None else node
        node.meta.update(value=value, on=on, axis=axis)
        if isinstance(value, Tensor):
            self._nodes[id(value)] = node
            if on == SAMPLES and not node.meta.get("counts") and axis is None and not is_custom(node):
                remedy = _remedy("keep a row for each, as torch.where does")
                node.meta["mixes"] = (
                    f"{name_of(node.target)}{node.meta.get('line', '')} gives a tensor of shape {list(value.shape)}, "
                    f"which has no row for each of {self.rows} samples: it mixes or selects them; {remedy}"
                )
                if value.dim() or node.target not in _TOTALS:
                    raise Unfusable(node.meta["mixes"])
        return node

    def _argument(self, value: Any) -> Any:
        """Returns the node of an argument, or the argument itself if it is a constant."""
        if isinstance(value, SampleCount):
            return self._new(int(value), self.graph.call_function(operator.mul, (self.n, value // self.rows)))
        if not isinstance(value, Tensor) or id(value) in self._nodes:
            return self._nodes.get(id(value), value)
        if id(value) in self._places:
            node = self._new(value, on=CELLS if id(value) in self._cell_ids else CONSTANTS)
            self.parameters[node] = self._places[id(value)]
            return node
        if value.requires_grad:
            raise self._unrecorded()
        return value

    def _unrecorded(self) -> Unfusable:
        """Returns the error for a tensor that no recorded function has computed."""
        names = self._compiled()
        remedy = (
            f"perhaps {names}, which torch.jit has compiled; use what it was compiled from"
            if names
            else "write it with functions of PyTorch, or call it in a torch.autograd.Function"
        )
        return Unfusable(f"a tensor was not computed by a PyTorch function{self._line}, {remedy}")

    def _compiled(self) -> str:
        """Returns the names of submodules and called functions that ``torch.jit`` has compiled."""
        names, namespace = self._code
        compiled = torch.jit.ScriptModule
        parts = [f"part {name!r}" for name, part in self._module.named_modules() if isinstance(part, compiled)]
        return ", ".join(parts + [name for name in names if isinstance(namespace.get(name), torch.jit.ScriptFunction)])

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Calls a function and records it."""
        if func in METADATA:
            return func(*args, **(kwargs or {}))
        step = next(self._steps, None)
        if step is None or step.function != func:
            raise Unfusable(f"{name_of(func)}{line_of(user_frame())} is not called in every call of the forward")
        if self._running:  # in a custom function of autograd
            return func(*args, **(kwargs or {}))
        begun = self._begin(func, args, kwargs or {}, step)
        self._running = True  # inner functions are not recorded
        try:
            result = begun.function(*begun.args, **begun.kwargs)
        finally:
            self._running = False
        self._end(begun, result, step)
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

    def _begin(self, func: Any, args: Any, kwargs: Any, step: CallAxes | None = None) -> _Begun:
        """Records a function before its call; returns the node with the function and arguments to call.

        ``step`` is the recorded call; None for a custom function of autograd.
        """
        frame = user_frame()
        self._line = line = line_of(frame)
        self._code = (frame.f_code.co_names, frame.f_globals) if frame else ((), {})
        operands = tensors_of((args, kwargs))
        if step and step.varies:
            raise Unfusable(f"{name_of(func)}{line} gets a size that depends on, but is no multiple of, the samples")
        for tensor, axis in zip(operands, step.axes if step else ()):
            if id(tensor) in self._nodes:
                self._nodes[id(tensor)].meta["axis"] = axis
            elif axis is not None and id(tensor) not in self._places:
                raise self._unrecorded()
        if step and step.counts:
            args, kwargs = with_counts((args, kwargs), iter(step.counts))
        func, args = converted(func, args)
        if func is torch.autograd.grad:  # all cells share one graph, while a loop makes one each
            kwargs = {**kwargs, "retain_graph": True}
        node = self.graph.call_function(func, *map_aggregate((args, kwargs), self._argument))
        node.meta["inplace"] = writes_in_place(func) or bool(kwargs.get("inplace"))
        node.meta["line"], node.meta["grad"] = line, torch.is_grad_enabled()
        return _Begun(node, func, args, kwargs, operands)

    def _end(self, begun: _Begun, result: Any, step: CallAxes | None = None) -> None:
        """Records the results of a function."""
        node, func, _, kwargs, operands = begun
        inplace, line = node.meta["inplace"], node.meta["line"]
        outputs = operands[:1] if inplace else tensors_of(result)
        used = node.all_input_nodes
        if used and is_random(func, begun.args, kwargs):
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
        axes = (None,) * len(outputs) if step is None else step.axes[:1] if inplace else step.results
        is_constant = func in LIKE and axes == (None,)
        if not used or is_constant or not outputs or (not inplace and any(result is tensor for tensor in operands)):
            self.graph.erase_node(node)
            return
        nodes, on = [node], max(value.meta["on"] for value in used)
        if not inplace and not isinstance(result, Tensor):
            nodes = [self.graph.call_function(operator.getitem, (node, i)) for i in range(len(outputs))]
        node.meta["results"] = nodes
        for value, tensor, axis in zip(nodes, outputs, axes, strict=True):
            value.meta["counts"] = counts and axis is None
            self._new(tensor, value, on, axis)
        node.meta["on"] = on

    def _separate_gradients(self) -> None:
        """Inserts a `differentiable` node after each tensor by which ``torch.autograd.grad`` differentiates.

        PyTorch computes this node between subprograms. All functions that used the tensor use the node instead.
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


def is_custom(node: fx.Node) -> bool:
    """Returns whether a node is a ``torch.autograd.Function`` of the module, or one of its results."""
    target = (
        node.args[0].target if node.target is operator.getitem and isinstance(node.args[0], fx.Node) else node.target
    )
    return getattr(target, "__name__", "") == "apply"
