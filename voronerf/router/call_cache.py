"""A cache for calls that run as one program.

Calls are of one kind if they have the same key (:func:`call_key`). After the first call of a kind, later calls
neither analyse their arguments nor sort their samples: two operations find the cells and compute the results.

Letters: n samples, k cells, d coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core import backends
from voronerf.ops._core.checks import dtype_under_autocast
from voronerf.ops._core.program import Names
from voronerf.ops._core.unchanged import Stale
from voronerf.ops.network import Network
from voronerf.router.arrange import find_positions
from voronerf.router.fused import HALF, Fused, WholeProgram
from voronerf.router.grouping import Grouping
from voronerf.router.labels import Labels
from voronerf.router.layout import SAMPLE, Call, rebuild, tensors_of
from voronerf.router.watch import Watch, module_dependencies

_NAMES = Names("VoronoiRouter")
_VALUES = {type(None), bool, int, float, str}


def call_key(method: str, training: bool, args: Sequence[Any], kwargs: dict[str, Any], coords: Any) -> Any:
    """Returns the cache key of a call; None if the call cannot be cached.

    The key does not depend on the first dimension of the tensors. A call cannot be cached if it has no tensor argument,
    or an argument that is neither a plain tensor nor a number, text, bool or None.
    """
    key: list[Any] = [method, training, torch.is_grad_enabled(), coords is None, *kwargs]
    tensor, values = None, (*args, *kwargs.values()) if kwargs else args
    if coords is not None:
        values = (*values, coords.cells if type(coords) is Labels else coords)
    for value in values:
        value_type = type(value)
        plain = value_type is Tensor or value_type is nn.Parameter
        if plain or (isinstance(value, Tensor) and torch.compiler.is_exporting()):
            tensor = value
            key += (value.shape[1:], value.dtype, value.device, value.layout, value.requires_grad)
        elif value_type in _VALUES:
            key += (value_type, value)
        else:
            return None
    return None if tensor is None else (*key, dtype_under_autocast(torch.float32, tensor))


class CachedCall:
    """A program for all calls with one key, made from the first of these calls.

    Args:
        fused: The traced module.
        whole_program: The program of the call.
        most: The maximum number of samples.
        call: The first call.
        grouping: The samples of the first call by cell.
        dependencies: Everything in the module that the program depends on.
    """

    def __init__(
        self, fused: Fused, whole_program: WholeProgram, most: int, call: Call, grouping: Grouping, dependencies: Any
    ) -> None:
        (program, reads, results), arguments = whole_program, (*call.args, *call.kwargs.values())
        self.dependencies, self._most, self._method = dependencies, most, call.method
        self._tensors = [i for i, value in enumerate(arguments) if isinstance(value, Tensor)]
        self._reads = [self._tensors[number] for number in reads]
        self._records = torch.is_grad_enabled()
        self._learns = self._records and any(arguments[i].requires_grad for i in self._reads)
        self._leading, device = len(call.layout.lead), grouping.device
        half = torch.is_autocast_enabled(device.type) or any(arguments[i].dtype in HALF for i in self._tensors)
        ones, self._result = 0 if call.layout.flat else self._leading - 1, fused.result
        # Programs give float32 [n, w]. `_tails` is None if all results have this shape, `_dtypes` if all are float32.
        is_flat = self._leading == 1 and all(len(shape) == 1 for shape, _ in results)
        self._tails = None if is_flat else [shape[ones:] for shape, _ in results]
        dtypes = [dtype if half and dtype in HALF else torch.float32 for _, dtype in results]
        self._dtypes = None if {*dtypes} == {torch.float32} else dtypes
        self._fused, self._program, self._is_compilable = fused, program, not fused.computes
        fused.parameters(grouping.k, device, grouping.backend)  # fills a cached property, which torch.compile cannot
        self._made = cast("tuple[Any, Network | None]", (Stale(), None))  # what the network depends on, and the network

    @staticmethod
    def of(fused: Fused, watch: Watch, most: int, call: Call, grouping: Grouping) -> CachedCall | None:
        """Makes the cached form of a call; None if the compiled module cannot run the call as one program."""
        layout, program = call.layout, fused.whole_program
        if isinstance(program, str) or fused.module is not call.module:
            return None
        if not layout.n or fused.inputs.sources or set(call.kinds.values()) != {SAMPLE}:
            return None
        ones = (1,) * (0 if layout.flat else len(layout.lead) - 1)
        is_flat = all(shape[: len(ones)] == ones for shape, _ in program.results)
        if not is_flat or any(x.dtype not in (torch.float32, *HALF) for x in tensors_of((call.args, call.kwargs))):
            return None
        if backends.chosen("grouped_program", grouping.device, torch.float32, backend=grouping.backend) != "native":
            return None
        return CachedCall(fused, program, most, call, grouping, watch.note(module_dependencies(call.module)))

    def run(
        self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | Labels | None, compiles: bool
    ) -> Any:
        """Returns the results of a call of a router; None if this call cannot run in the cached form.

        ``compiles`` tells whether torch's compiler traces the call.
        """
        arguments = (*args, *kwargs.values()) if kwargs else args
        positions = find_positions(router, args, kwargs, coords)
        lead = positions.shape[:-1]
        n = lead[0] if len(lead) == 1 else math.prod(lead)
        if not self._fits(router, arguments, lead, n, compiles):
            return None
        rows = [self._rows(arguments[i], n) for i in self._reads]
        network = self._network(router, rows[0].device, compiles)
        places = router.places(positions, self._method)
        results, _ = network.run(rows, places, backend="native", dtype=torch.float32)  # rounded below under autocast
        if self._tails is not None:
            results = [out.reshape(*lead, *tail) for out, tail in zip(results, self._tails)]
        if self._dtypes is not None:
            results = [out.to(dtype) for out, dtype in zip(results, self._dtypes)]
        return rebuild(self._result, results)

    def _network(self, router: Any, device: torch.device, compiles: bool) -> Network:
        """Returns the network of the last call; makes a new one if parameters have changed, or during compilation."""
        same, network = self._made
        if compiles or network is None or not same.holds():
            same = None if compiles else self._fused.same_parameters()  # first, since another thread may assign some
            parameters = self._fused.parameters(router.num_cells, device, router.backend)
            network = Network(self._program, parameters, names=_NAMES)
            if not compiles and not isinstance(same, Stale):
                self._made = same, network
        return network

    def _fits(self, router: Any, arguments: tuple[Any, ...], lead: torch.Size, n: int, compiles: bool) -> bool:
        """Returns whether a call with leading dimensions ``lead`` of n samples can run in the cached form."""
        if len(lead) != self._leading or not 0 < n <= self._most:
            return False
        if self._learns and router.frozen_cells is not None:  # samples of frozen cells need no backward pass
            return False
        if compiles:
            drawn = router.assignment == "stochastic" and router.training
            if drawn or router.methods or not self._is_compilable:
                return False
        for i in self._tensors:
            shape = (x := arguments[i]).shape
            if not shape or shape[0] != lead[0] or (self._records and not compiles and x.is_inference()):
                return False
        return True

    def _rows(self, x: Tensor, n: int) -> Tensor:
        """Returns the rows of an argument, float32 [n, w]."""
        rows = x if x.dim() == 2 else x.reshape(n, -1)
        rows = rows if rows.dtype is torch.float32 else rows.float()
        # The operation gets a view instead of a leaf, because in torch.autograd.grad the engine can tell the backward
        # pass whether a view's gradient is used, but not whether a leaf's is (`needed_gradients`).
        return rows.view_as(rows) if rows.requires_grad and self._learns else rows
