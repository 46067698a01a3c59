"""How a routed call is carried out: chosen once for a kind of call, and admitted by one comparison with the loop.

The loop over cells (:mod:`voronerf.router.loop`) defines the result. The faster ways are the module's own ``forward``
once for the rows of all cells (:mod:`voronerf.router.grouped`) and, where the user said ``fuse=True``, one operation
(:mod:`voronerf.router.fused`). A field that describes itself by a layer table needs none of this.
"""

from __future__ import annotations

import inspect
import os
import threading
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from voronerf.backends import BackendUnavailable
from voronerf.diagram.blending import Mixture
from voronerf.layers import MLP
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.grouped import Ungroupable, run_grouped
from voronerf.router.grouping import Grouping
from voronerf.router.layout import Call, Results, rebuild, tensors_of
from voronerf.router.loop import Choice, Trial, admitted, flattened, run_cells

_OP = "VoronoiRouter"
_FEWEST = 8  # samples below which nothing is found out about a kind of call, and the loop runs
_GAIN = "about 1.5 times as fast at width 64 and 65,536 samples"
_KINDS = 256  # kinds of calls that are remembered
_OWN = tuple(str(Path(file).absolute().parents[up]) + os.sep for file, up in ((str(torch.__file__), 0), (__file__, 1)))


class Choices:
    """What a router has found out about its module. Copies of a router begin anew.

    Attributes:
        lock: Held during a call: stand-ins are in the place of the module's parameters.
        kinds: What was found for each kind of call.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.forget()

    def forget(self) -> None:
        """Begins anew, after a change of dtype, device or parameters' names."""
        self.kinds: dict[Any, Choice] = {}
        self._said: set[str] = set()
        self._latest: dict[str, dict[str, str]] = {}

    def kind(self, call: Call, device: torch.device, fuse: bool) -> Any:
        """What tells kinds of calls apart: types and sizes of the arguments but for the number of samples, and modes.

        Numbers count by what they are only where they would go into a fused network.
        """
        autocast = torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None
        modes = (call.method, call.module.training, torch.is_grad_enabled(), autocast)
        d, values = len(call.layout.lead), (*call.args, *call.kwargs.values())
        return *modes, tuple(call.kwargs), d, *[_description(value, d, fuse) for value in values]

    def note(self, call: Call, choice: Choice) -> None:
        """For :meth:`explain`: how a method was carried out."""
        self._latest.setdefault(call.method, {})[choice.way] = choice.why

    def explain(self, methods: tuple[str, ...]) -> str:
        """How each method has been carried out so far, and why."""
        lines = []
        for method in methods:
            ways = self._latest.get(method, {"not called yet": ""})
            lines += [f"{method}: {way}{f': {why}' if why else ''}" for way, why in ways.items()]
        return "\n".join(lines)

    def say_once(self, topic: str, message: str) -> None:
        """Warns, the first time that a topic comes up, at the line that called the router."""
        if topic in self._said:
            return
        self._said.add(topic)
        level, frame = 1, inspect.currentframe()
        while frame is not None and frame.f_code.co_filename.startswith(_OWN):
            level, frame = level + 1, frame.f_back
        warnings.warn(f"{_OP}: {message}", stacklevel=level)

    def __reduce__(self) -> tuple[type[Choices], tuple[()]]:
        return Choices, ()


def _description(value: Any, d: int, fuse: bool) -> Any:
    if isinstance(value, Tensor):
        ones = tuple(size == 1 for size in value.shape[:d])
        return tuple(value.shape[d:]), value.dim(), value.dtype, value.requires_grad, ones
    if value is None or isinstance(value, (bool, str)) or (fuse and isinstance(value, (int, float))):
        return value
    return type(value)


# Carrying out ---------------------------------------------------------------------------------------------------------


def evaluate(call: Call, grouping: Grouping, mixture: Mixture | None, choices: Choices, *, fuse: bool) -> Any:
    """What a method of a module returns for the samples of all cells, mixed with what other cells return for some.

    Where there are no samples, ``grouping`` is of two placeholders.
    """
    choice = _choose(call, grouping, choices, fuse)
    results, choice = _carry_out(call, grouping, choices, choice)
    order = grouping if choice.program is None or not call.layout.n else None
    own = results.restored(call.layout, order, choice.flat)
    if mixture is None:
        return own
    n, where, tensors = mixture.rows.shape[0], {"cells": mixture.cells}, tensors_of(own)
    entries = Grouping(where, n, grouping.k, grouping.device, grouping.backend, rows=mixture.rows)
    results, _ = _carry_out(call, entries, choices, choice)
    for i, tensor in enumerate(results.tensors):
        if results.rows[i]:
            tensors[i] = mixture.mix(tensors[i], entries.unsort(tensor.reshape(n, -1)))
    return rebuild(own, tensors)


def _carry_out(call: Call, grouping: Grouping, choices: Choices, choice: Choice) -> tuple[Results, Choice]:
    """Results sorted by cell; of a fused network in the original order, but for entries and placeholders."""
    if choice.program is not None:
        choices.note(call, choice)
        rows = call.arranged(None if call.layout.n and grouping.rows is None else grouping)
        return choice.program.run(rows, grouping), choice
    if choice.way == "grouped" and grouping.k > 1:
        try:
            results, _ = run_grouped(call, call.arranged(grouping), grouping, choice.piece)
            choices.note(call, choice)
            return results, choice
        except Exception as error:
            lacking = (BackendUnavailable, MemoryError, torch.OutOfMemoryError)
            if isinstance(error, lacking) or "can't allocate memory" in str(error):
                raise
            why = error if isinstance(error, Ungroupable) else f"its forward fails ({error})"
            choice = replace(choice, way="cell by cell", why=f"for some batches, since {why}")
    try:
        results = run_cells(call, call.arranged(grouping), grouping.occupied, again=choice.again)
    except Exception as error:
        if hasattr(error, "add_note") and len(call.layout.lead) > 1 and not call.layout.flat:  # since Python 3.11
            error.add_note(f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]")
        raise
    one = Choice("the module itself", "there is one cell")
    choices.note(call, choice if grouping.k > 1 or choice.way != "grouped" else one)
    if grouping.k > 1 and choice.why and call.layout.n >= _FEWEST:
        choices.say_once(f"cells {call.method}", f"{call.name} runs cell by cell: {choice.why}")
    return results, choice


def _choose(call: Call, grouping: Grouping, choices: Choices, fuse: bool) -> Choice:
    layout, kind = call.layout, choices.kind(call, grouping.device, fuse)
    choice = choices.kinds.get(kind)
    if choice is not None and not choice.open:
        return choice
    if layout.n < _FEWEST:
        return Choice("cell by cell", f"for fewer than {_FEWEST} samples") if choice is None else choice
    call.changed(lambda tensor, kind: tensor)  # arguments that are refused are so before anything is found out
    devices = [grouping.device] if grouping.device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        rays = len(layout.lead) > 1 and layout.lead[-1] > 1 and not layout.flat
        flat = choice.flat if choice is not None else flattened(call) if rays else ()
        trial = Trial(call, grouping)
        if choice is not None and not trial.is_groupable():
            return choice
        found = replace(admitted(trial, fuse), flat=flat)
    if len(choices.kinds) >= _KINDS:
        choices.kinds.clear()
    choices.kinds[kind] = found
    if found.fusable and all(known.fusable for known in choices.kinds.values()):
        choices.say_once(
            f"fuse {call.method}",
            f"{call.name} runs grouped; its network is a layer table, and VoronoiRouter(..., fuse=True) runs it as one "
            f"operation, {_GAIN}, if its forward does the same in every call",
        )
    return found


# Fields with a layer table --------------------------------------------------------------------------------------------


@runtime_checkable
class LayeredField(Protocol):
    """A field that describes its network by a layer table, like :class:`voronerf.fields.NeRF`. It runs fused.

    Where the table has a hash grid, the field has a parameter ``features``, [e, f], as :class:`voronerf.HashGridField`.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.router import LayeredField
        >>> isinstance(NeRF(width=16, depth=2), LayeredField)
        True
    """

    layers: MLP

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the table's order."""
        ...

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Turns the table's outputs [n, out] into what the field returns."""
        ...


def described_by_table(field: nn.Module) -> bool:
    """Whether the table, the weights and ``activate`` of a field describe all that it computes.

    They do not if a class has its own ``forward`` without its own ``linears`` and ``activate``, or if hooks or
    parametrisations, such as weight normalisation, change inputs, outputs or weights of layers.
    """
    first = {}
    for name in ("forward", "linears", "activate"):
        first[name] = next((i for i, base in enumerate(type(field).__mro__) if name in vars(base)), 0)
    if first["forward"] < max(first["linears"], first["activate"]) or "forward" in vars(field):
        return False
    return not any(
        part._forward_hooks
        or part._forward_pre_hooks
        or part._backward_hooks
        or part._backward_pre_hooks
        or "parametrizations" in part._modules
        for part in field.modules()
    )


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    names = ("positions", "directions", "ray_index")
    positions, directions, index = ((dict(zip(names, args)) | kwargs).get(name) for name in names)
    if directions is None or index is None:
        return args, kwargs
    others = {name: value for name, value in kwargs.items() if name not in names}
    return (positions, directions.index_select(0, index), None, *args[3:]), others
