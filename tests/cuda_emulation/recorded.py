"""Records the kernel calls of the ops' cases as data, for a process without torch (sanitize.py).

A call is the function's name, its arguments, and their arrays before and after the call. An argument is a number, a
text, None, a list, ("array", index), ("struct", type name, field names and values), or ("plan", name of the function
that makes it, (), its arguments).
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from emulated import emulated
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import ops
from voronerf.ops._core import backends
from voronerf.ops._core import native as _native
from voronerf.ops.cell_sort.native import sort as sort_cells

sys.path.append(str(Path(__file__).parents[1] / "ops"))  # for cases
from cases import CASES, Draw

# The precision of products, and KiB of shared memory. The ops' cases have 227 KiB, where each warp has its own rows.
# With less memory, four warps share rows or, if even these do not fit, values are in the workspace (device memory).
NETWORKS = (("bfloat16", 40), ("float16", 12), ("float32", 12))


class Recorder:
    """A wrapper of the compiled module, which records the calls of its kernels."""

    def __init__(self, compiled: Any, kernels: Any) -> None:
        self._compiled, self._kernels, self.calls = compiled, kernels, []
        self.plans: dict[int, tuple[Any, Any]] = {}  # by address; kept alive, so that addresses stay unique

    def __getattr__(self, name: str) -> Any:
        entry = getattr(self._compiled, name)
        if name == "ProgramCall":
            return self._make_program_call
        if isinstance(entry, type) or not callable(entry) or not hasattr(self._kernels, name):
            return entry

        def call(*arguments: Any) -> Any:
            tensors: dict[int, tuple[int, Tensor]] = {}
            packed = [as_data(argument, tensors, self.plans) for argument in arguments]
            before = [as_array(tensor) for _, tensor in tensors.values()]
            result = entry(*arguments)
            if type(result).__name__ == "PyCapsule":
                self.plans[id(result)] = result, ("plan", name, (), packed)
                return result
            after = [as_array(tensor) for _, tensor in tensors.values()]
            self.calls.append((name, packed, before, after))
            return result

        return call

    def _make_program_call(self, *arguments: Any) -> Any:
        packed = [as_data(argument, {}, self.plans) for argument in arguments[:-1]]
        made = self._compiled.ProgramCall(*arguments)
        self.plans[id(made)] = made, ("plan", "ProgramCall", (), [*packed, None])  # results are never on huge pages
        return made


def as_data(value: Any, tensors: dict[int, tuple[int, Tensor]], plans: dict[int, tuple[Any, Any]]) -> Any:
    if id(value) in plans:
        return plans[id(value)][1]
    if isinstance(value, Tensor):
        return "array", tensors.setdefault(id(value), (len(tensors), value))[0], str(value.dtype).removeprefix("torch.")
    if hasattr(value, "_fields"):
        fields = [as_data(part, tensors, plans) for part in value]
        return "struct", type(value).__name__, value._fields, fields
    if isinstance(value, (list, tuple)):
        parts = [as_data(part, tensors, plans) for part in value]
        return parts if isinstance(value, list) else ("tuple", parts)
    assert value is None or isinstance(value, (bool, int, float, str)), value
    return value


def as_array(tensor: Tensor) -> np.ndarray:
    tensor = tensor.detach().contiguous().clone()
    return (tensor.view(torch.int16) if tensor.dtype in (torch.float16, torch.bfloat16) else tensor).numpy()


def call_case(op: str, pins: dict[str, Any], n: int) -> None:
    """Runs a call of an op's declared case, and its gradients."""
    case = CASES[op]
    given = tree_map_only(Tensor, Tensor.clone, case.make(Draw(1, **pins), n))
    leaves = [x for x in tree_leaves(given) if isinstance(x, Tensor) and x.is_floating_point()]
    for leaf in leaves if case.differentiable else ():
        leaf.requires_grad_()
    out = getattr(ops, case.call or op)(**given, backend="native")
    smooth = [x for x in tree_leaves(out) if isinstance(x, Tensor) and x.requires_grad]
    if smooth:
        torch.autograd.grad(sum(x.square().sum() for x in smooth), leaves, allow_unused=True)


def record_calls() -> list[tuple[int, str, list[Any]]]:
    """Returns each case's bytes of shared memory, kind of hostile arguments (`Case.hostile`), and calls."""
    records = []

    def record(op: str, run: Any, *arguments: Any, shared: int = 227) -> None:
        with emulated(shared_bytes=shared * 1024) as loaded:
            recorder = Recorder(_native.compiled, loaded)
            with mock.patch.object(_native, "compiled", recorder):
                run(*arguments)
        records.append((shared * 1024, CASES[op].hostile, recorder.calls))

    for op in backends.ops("native", "cuda"):
        # Sanitizers cost time for every thread, so kinds with a lookup by an index are left out. The cases
        # ``on_devices`` of nearest_centre have such lookups.
        kinds = (pins for kind, pins in CASES[op].kinds.items() if kind != "by an index")
        for pins in (*kinds, *CASES[op].on_devices):
            record(op, call_case, op, pins, CASES[op].device_rows)
    for (precision, shared), kind in itertools.product(NETWORKS, ("", "hashed")):
        pins = {**CASES["grouped_mlp"].kinds[kind], "dtype": getattr(torch, precision)}
        record("grouped_mlp", call_case, "grouped_mlp", pins, 64, shared=shared)
    # These are counting and radix sorts. Keys of 4 bytes would need 65,535 cells with a thread each: too many for a
    # sanitizer.
    for n, k, way in ((3000, 5, "automatic"), (9000, 2, "counting"), (600, 3, "radix"), (300, 1100, "automatic")):
        cells = torch.randint(-1, k + 1, (n,), dtype=torch.int32)
        memory = torch.full_like(cells, -7), cells.new_full((k + 1,), -7)
        record("cell_sort", sort_cells, cells, *memory, "cell_sort", way)
    return records
