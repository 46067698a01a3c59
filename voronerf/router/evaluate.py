"""How a routed call is carried out: chosen once for a kind of call, and admitted by one comparison with the loop.

The loop over cells (:mod:`voronerf.router.loop`) is the definition of the result. The faster ways are the module's own
``forward`` once for the rows of all cells (:mod:`voronerf.router.grouped`) and, where the user said ``fuse=True``, one
fused operation (:mod:`voronerf.router.fused`). Before a kind of call takes one of them, both run on a few samples of
the batch, in cells whose parameters are made different, and have to give the same results and gradients. A field that
describes itself by a layer table needs none of this: it is one fused operation at once.
"""

from __future__ import annotations

import inspect
import threading
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from voronerf import ops
from voronerf.backends import BackendUnavailable
from voronerf.diagram.blending import Mixture
from voronerf.layers import MLP
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.grouped import Ungroupable, is_inside, run_grouped
from voronerf.router.grouping import Grouping
from voronerf.router.layout import Call, Results, rebuild, tensors_of
from voronerf.router.loop import Choice, Trial, admitted, flattened, run_cells

_OP = "VoronoiRouter"
_FEWEST = 8  # samples below which nothing is found out about a kind of call, and the loop runs
_GAIN = "about 1.5 times as fast at width 64 and 65,536 samples"
_KINDS = 256  # kinds of calls that are remembered


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
        d = len(call.layout.lead)
        return (
            *modes,
            tuple(call.kwargs),
            d,
            *[_description(value, d, fuse) for value in (*call.args, *call.kwargs.values())],
        )

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
        while frame is not None and is_inside(frame.f_code.co_filename, package=True):
            level, frame = level + 1, frame.f_back
        warnings.warn(f"{_OP}: {message}", stacklevel=level)

    def __deepcopy__(self, memo: Any) -> Choices:
        return Choices()

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


def evaluate(call: Call, grouping: Grouping, choices: Choices, *, fuse: bool) -> tuple[Any, Choice]:
    """What a method of a module returns for the samples of all cells, and how that was found.

    Where there are no samples, ``grouping`` is of two placeholders.
    """
    choice = _choose(call, grouping, choices, fuse)
    results, choice = _carry_out(call, grouping, choices, choice)
    order = grouping if choice.program is None or not call.layout.n else None
    return results.restored(call.layout, order, choice.flat), choice


def mixed(own: Any, call: Call, mixture: Mixture, grouping: Grouping, choices: Choices, choice: Choice) -> Any:
    """The blended results of a call that returned ``own`` for all samples in their own cells."""
    n, where = mixture.rows.shape[0], {"cells": mixture.cells}
    entries = Grouping(where, n, grouping.k, grouping.device, grouping.backend, rows=mixture.rows)
    results, _ = _carry_out(call, entries, choices, choice)
    tensors = tensors_of(own)
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
        except BackendUnavailable:
            raise
        except Ungroupable as error:
            choice = replace(choice, way="cell by cell", why=f"for some batches, since {error}")
        except Exception as error:
            if isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "can't allocate memory" in str(error):
                raise
            choice = replace(choice, way="cell by cell", why=f"for some batches, since its forward fails ({error})")
    results = _by_cells(call, grouping, choice)
    one = Choice("the module itself", "there is one cell")
    choices.note(call, choice if grouping.k > 1 or choice.way != "grouped" else one)
    if grouping.k > 1 and choice.why and call.layout.n >= _FEWEST:
        choices.say_once(f"cells {call.method}", f"{call.name} runs cell by cell: {choice.why}")
    return results, choice


def _by_cells(call: Call, grouping: Grouping, choice: Choice) -> Results:
    """The loop over cells."""
    try:
        return run_cells(call, call.arranged(grouping), grouping.occupied, again=choice.again)
    except Exception as error:
        if hasattr(error, "add_note") and len(call.layout.lead) > 1 and not call.layout.flat:  # since Python 3.11
            error.add_note(f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]")
        raise


def _choose(call: Call, grouping: Grouping, choices: Choices, fuse: bool) -> Choice:
    layout, kind = call.layout, choices.kind(call, grouping.device, fuse)
    choice = choices.kinds.get(kind)
    if choice is not None and not choice.open:
        return choice
    if layout.n < _FEWEST:
        return Choice("cell by cell", f"for fewer than {_FEWEST} samples") if choice is None else choice
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


def coords_by_rule(rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The positions that decide the cells, by a router's rule; None for those of the samples themselves."""
    if isinstance(rule, slice):
        return (args[0] if args else kwargs["positions"])[..., rule]
    return rule(*args, **kwargs) if callable(rule) else None


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments for a field's own ``forward``: a direction for each sample, in the place of one for each ray."""
    given = dict(zip(("positions", "directions", "ray_index"), args)) | kwargs
    directions, index = given.get("directions"), given.get("ray_index")
    if directions is None or index is None:
        return args, kwargs
    changed = {"directions": directions.index_select(0, index), "ray_index": None}
    placed = (*args[:1], *list(changed.values())[: max(len(args) - 1, 0)], *args[3:])
    return placed, {name: changed.get(name, value) for name, value in kwargs.items()}


def evaluate_table(
    field: LayeredField,
    where: Callable[[Tensor, Tensor | None], dict[str, Any]],
    k: int,
    backend: str,
    mixture_at: Callable[[Tensor], Mixture | None],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    *,
    coords: Tensor | None = None,
    raw: bool = False,
) -> Any:
    """What a field with stacked parameters and a layer table gives: colour [n, 3] and density [n].

    Args:
        field: Whose ``activate`` gives the results; they are mixed behind it.
        where: What tells ``routed_mlp`` the cells, for positions and coords.
        k: The number of cells.
        backend: Of the operation.
        mixture_at: Other cells that some samples are evaluated in too, or None.
        positions: [n, 3] in scene units; [n, 6], means and variances, where the table integrates over Gaussians.
        directions: unit vectors, [n, 3], or [r, 3] together with ``ray_index``.
        ray_index: int32 [n], the row of ``directions`` that belongs to each sample.
        coords: [n, 3] or None, positions that decide the cells in the place of ``positions`` (of Gaussians, the means).
        raw: Gives the outputs of the network, [n, out], in the place of what ``activate`` makes of them.

    Raises:
        ValueError: For shapes that disagree, or directions that the field needs and did not get.
        TypeError: For coords that are no floating-point tensor.
    """
    table, n = field.layers, positions.shape[0]
    features = 6 if table.integrated else 3
    if positions.ndim != 2 or positions.shape[1] != features:
        raise ValueError(f"VoronoiRouter: positions must have shape [n, {features}], got {list(positions.shape)}")
    if coords is not None:
        if not isinstance(coords, Tensor):
            raise TypeError(f"VoronoiRouter: coords must be a tensor, got {type(coords).__name__}")
        if coords.shape != (n, 3):
            raise ValueError(f"VoronoiRouter: coords must have shape [{n}, 3], got {list(coords.shape)}")
        if not coords.is_floating_point():
            raise TypeError(f"VoronoiRouter: coords must be floating-point, got {coords.dtype}")
    if not table.uses_directions:
        directions = ray_index = None
    if directions is not None and ray_index is None and directions.shape[0] != n:
        raise ValueError(
            "VoronoiRouter: directions must have a row for each position, or come with ray_index, got "
            f"{directions.shape[0]} rows for {n} positions"
        )
    linears = field.linears()
    # A parameter that all cells share has no dimension of cells; the operation takes one for each.
    weights = [w if w.dim() == 3 else w.expand(k, -1, -1) for w in [layer.weight for layer in linears]]
    biases = [b if b is None or b.dim() == 2 else b.expand(k, -1) for b in [layer.bias for layer in linears]]
    hashed = {} if table.grid is None else {"features": field.features}  # type: ignore[attr-defined]

    def run(x: Tensor, d: Tensor | None, index: Tensor | None, cells: dict[str, Any]) -> Any:
        given = {"directions": d, "direction_index": index, "backend": backend, **hashed, **cells}
        outputs = ops.routed_mlp(x, weights, biases, layers=table, **given)[0]
        return outputs if raw else field.activate(outputs)

    own = run(positions, directions, ray_index, where(positions, coords))
    if raw:
        return own
    mixture = mixture_at(positions[:, :3] if coords is None else coords)
    if mixture is None:
        return own
    if ray_index is not None:
        ray_index = ray_index[mixture.rows]
    elif directions is not None:
        directions = directions[mixture.rows]
    others = run(positions[mixture.rows], directions, ray_index, {"cells": mixture.cells})
    return mixture.mix(own[0], others[0]), mixture.mix(own[1], others[1])
