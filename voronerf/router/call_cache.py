"""A cache for calls that run as one program.

Calls are of one kind if they have the same key (:func:`call_key`). After the first call of a kind, later calls
neither analyse their arguments nor sort their samples: two operations find the cells and compute the results.

Letters: n samples, k cells, d coordinates.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.ops._core import backends
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops.network import Names, Network
from voronerf.router.fused import HALF, Fused, WholeProgram
from voronerf.router.grouping import Grouping
from voronerf.router.labels import Labels
from voronerf.router.layout import SAMPLE, Call, rebuild, tensors_of
from voronerf.router.plan import CallPlan

_NAMES = Names("VoronoiRouter")
_VALUES = {type(None), bool, int, float, str}


def call_key(method: str, training: bool, args: Sequence[Any], kwargs: dict[str, Any], coords: Any) -> Any:
    """Returns the cache key of a call; None if the call cannot be cached.

    The key does not depend on the first dimension of the tensors. A call cannot be cached if it has no tensor argument,
    or an argument that is neither a plain tensor nor a number, text, bool or None.
    """
    key: list[Any] = [method, training, torch.is_grad_enabled(), *kwargs]
    device = None
    for value in (*args, *kwargs.values(), coords):
        value = value.cells if type(value) is Labels else value
        value_type = type(value)
        if (
            value_type is Tensor
            or value_type is nn.Parameter
            or (isinstance(value, Tensor) and torch.compiler.is_exporting())
        ):
            device = value.device
            key += (value.shape[1:], value.dtype, device, value.layout, value.requires_grad)
        elif value_type in _VALUES:
            key += (value_type, value)
        else:
            return None
    if device is None:
        return None
    if torch.is_autocast_enabled(device.type):
        key.append(torch.get_autocast_dtype(device.type))
    return tuple(key)


class CachedCall:
    """The cached form of all calls of one kind, made from the first call and its plan.

    Attributes:
        unchanged: A guard that detects changes of the module since the first call.
    """

    unchanged: Any

    def __init__(
        self, plan: CallPlan, fused: Fused, whole_program: WholeProgram, call: Call, grouping: Grouping
    ) -> None:
        (program, reads, results), arguments = whole_program, (*call.args, *call.kwargs.values())
        self._tensors = [i for i, value in enumerate(arguments) if isinstance(value, Tensor)]
        self._reads = [self._tensors[number] for number in reads]
        self._learns = torch.is_grad_enabled() and any(arguments[i].requires_grad for i in self._reads)
        self.module = call.module
        self.plan, self._method, self._program = plan, call.method, program
        self._leading, device = len(call.layout.lead), grouping.device
        half = torch.is_autocast_enabled(device.type) or any(arguments[i].dtype in HALF for i in self._tensors)
        ones = 0 if call.layout.flat else self._leading - 1
        self._results = [(shape[ones:], dtype if half and dtype in HALF else torch.float32) for shape, dtype in results]
        is_plain = all(len(tail) == 1 and dtype is torch.float32 for tail, dtype in self._results)
        self._is_plain = self._leading == 1 and is_plain
        self._parameters, self._is_compilable = fused.parameters, not fused.computes
        in_half = functools.partial(torch.autocast, device.type, enabled=False)  # results are rounded at the end
        self._precision: Callable[[], Any] = (
            in_half if torch.is_autocast_enabled(device.type) else contextlib.nullcontext
        )
        value = fused.result
        self._value: Callable[[list[Tensor]], Any] = functools.partial(rebuild, value)
        if isinstance(value, Tensor):
            self._value = lambda results: results[0]
        elif type(value) in (list, tuple) and all(isinstance(part, Tensor) for part in value):
            self._value = type(value)

    @staticmethod
    def of(plan: CallPlan, call: Call, grouping: Grouping) -> CachedCall | None:
        """Makes the cached form of a call; None if the compiled module cannot run the call as one program."""
        fused, layout, device = plan.fused, call.layout, grouping.device
        whole_program = "" if fused is None else fused.whole_program
        if fused is None or isinstance(whole_program, str) or fused.module is not call.module:
            return None
        if not layout.n or fused.inputs.sources or set(call.kinds.values()) != {SAMPLE}:
            return None
        ones = (1,) * (0 if layout.flat else len(layout.lead) - 1)
        is_flat = all(shape[: len(ones)] == ones for shape, _ in whole_program.results)
        if not is_flat or any(x.dtype not in (torch.float32, *HALF) for x in tensors_of((call.args, call.kwargs))):
            return None
        chosen = backends.chosen("grouped_program", device, torch.float32, backend=grouping.backend)
        return CachedCall(plan, fused, whole_program, call, grouping) if chosen == "native" else None

    def run(self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | Labels | None) -> Any:
        """Returns the results of a call of a router; None if this call cannot run in the cached form."""
        arguments = (*args, *kwargs.values()) if kwargs else args
        compiles = torch.compiler.is_compiling()
        if coords is None and type(router.coords) is str:  # the router's own `coords`, as in the first call
            positions, d = arguments[self._tensors[0]], router._d
            shape = positions.shape
            positions = positions if shape[-1] == d else positions[..., :d]
            if router._positions_unchecked and not compiles:
                router._check_positions(positions, args, kwargs, coords)
        else:
            positions = router._positions(args, kwargs, coords)
            shape = positions.shape
        lead, k = shape[:-1], router.num_cells
        n = lead[0] if len(lead) == 1 else math.prod(lead)
        if len(lead) != self._leading or not 0 < n <= MAX_COUNT or router._modules["module"] is not self.module:
            return None
        if self._learns and router.frozen_cells is not None:  # samples of frozen cells need no backward pass
            return None
        if compiles:
            drawn = router.assignment == "stochastic" and router.training
            if drawn or router.methods or not self._is_compilable:
                return None
        elif not self.plan.is_ready(n):
            return None
        for i in self._tensors:
            shape = (x := arguments[i]).shape
            if not shape or shape[0] != lead[0] or (not compiles and x.is_inference() and torch.is_grad_enabled()):
                return None
        rows = []
        for i in self._reads:
            x = arguments[i] if arguments[i].dim() == 2 else arguments[i].reshape(n, -1)
            x = x if x.dtype is torch.float32 else x.float()
            # The operation gets a view instead of a leaf, because in torch.autograd.grad the engine can tell the
            # backward pass whether a view's gradient is used, but not whether a leaf's is (`needed_gradients`).
            rows.append(x.view_as(x) if x.requires_grad and self._learns else x)
        parameters = self._parameters(k, rows[0].device, router.backend)
        network, cells = Network(self._program, parameters, names=_NAMES), router._places_of(self._method, positions)
        with self._precision():
            results, _ = network.run(rows, cells, backend="native")
        if not self._is_plain:
            results = [rows.reshape(*lead, *tail).to(dtype) for rows, (tail, dtype) in zip(results, self._results)]
        return self._value(results)
