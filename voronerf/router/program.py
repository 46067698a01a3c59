"""What a routed call computes, as one program: one that a field says of itself, or that of a module that was traced.

n samples, r rays, k cells, w columns.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core.checks import check_shape
from voronerf.ops._core.layers import MLP
from voronerf.ops._core.program import Builder, Program
from voronerf.ops._core.tolerances import agree
from voronerf.ops._core.unchanged import Never, unchanged
from voronerf.ops.grouped_program import grouped_program
from voronerf.ops.routed_program import routed_program
from voronerf.router.double import Double
from voronerf.router.grouping import cell_parameters, parts_of
from voronerf.router.labels import Labels
from voronerf.router.layout import AS_TENSOR, as_plain, tensors_of
from voronerf.router.lower import Lowering, NotAStep
from voronerf.router.transforms import outside
from voronerf.router.watch import HOOKS, Inputs, Watch

_OP = "VoronoiRouter"
_ROWS = (37, 31)  # samples of a trace; one of them divides no width


class CellProgram(NamedTuple):
    """What a call computes, where that is one program.

    Attributes:
        program: Its outputs are the tensors that the call returns, in their order, [n, w] each.
        reads: Of each input of the program, the number of the argument of the call whose rows it is.
        shapes: Of each tensor that the call returns, for one sample.
        parameters: [k, ...], or without k where all cells share it: the module's own, or views of these; of a module
            that was traced also made of them.
        activate: Turns the outputs into what the call returns; None where they are that.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.rand(8, 3))
        >>> known = router.program(torch.rand(2, 3), torch.rand(2, 3))  # of positions and directions
        >>> known.reads, known.shapes, known.parameters[0].shape
        ((0, 1), ((3,), ()), torch.Size([8, 16, 63]))
    """

    program: Program
    reads: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    parameters: list[Tensor]
    activate: Callable[..., Any] | None = None


def layered_program(
    layers: MLP, linears: Sequence[nn.Linear], activate: Callable[[Tensor], Any], features: Tensor | None = None
) -> CellProgram:
    """The program of a field that is a layer table, for its method ``program``.

    Args:
        layers: The table, of positions and, if it reads them, directions.
        linears: The linear layers in its order.
        activate: Turns its outputs [n, out] into what ``forward`` returns, sample by sample.
        features: The table of its hash grid, or None.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer, VoronoiRouter
        >>> from voronerf.router import layered_program
        >>> class Field(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.linear = torch.nn.Linear(3, 4)
        ...     def program(self):
        ...         table = MLP((Layer(("positions",), 4),), outputs=(0,))
        ...         return layered_program(table, [self.linear], torch.sigmoid)
        ...     def forward(self, positions):
        ...         return torch.sigmoid(self.linear(positions))
        >>> router = VoronoiRouter(Field(), torch.rand(8, 3))
        >>> router(torch.rand(5, 3)).shape, router.explain()
        (torch.Size([5, 4]), 'forward: fused')
    """
    weights, biases = [layer.weight for layer in linears], [layer.bias for layer in linears]
    parameters = [*weights, *(bias for bias in biases if bias is not None), *([] if features is None else [features])]
    biased, reads = tuple(bias is not None for bias in biases), (0, 1) if layers.uses_directions else (0,)
    program = layers.program(6 if layers.integrated else 3, 3 if layers.uses_directions else 0, None, biased)
    return CellProgram(program, reads, ((layers.out_features,),), parameters, activate)


def _steps_of(function: Callable[..., Any], width: int) -> tuple[Program, tuple[tuple[int, ...], ...]]:
    """A function of rows [n, width] as a program, and the shapes of its results for one row."""
    rows = next(rows for rows in _ROWS if width % rows)
    x = torch.linspace(-2, 2, rows * width).reshape(width, rows).t().contiguous()
    lowering = Lowering(rows)
    entries = lowering.input(None, x.shape, 0)
    result, _, entries_of = lowering.run(function, (x,), {}, lambda tensor: entries if tensor is x else None)
    made = [lowering.order(entries_of(tensor).codes)[1] for tensor in tensors_of(result)]
    program = lowering.builder.program([lowering.operand(numbers) for numbers in made])
    if program.parameters:
        raise NotAStep("a function with constants of its own")
    offsets = torch.tensor([0, rows], dtype=torch.int32)
    again = grouped_program([x], [], offsets, program=program, backend="reference")
    if not all(agree(a.reshape(b.shape), b) for a, b in zip(again, tensors_of(result), strict=True)):
        raise NotAStep("a function that gives something else as steps")
    return program, tuple(tuple(tensor.shape[1:]) for tensor in tensors_of(result))


class Given:
    """The program that a field says of itself, by a method ``program`` that gives a :class:`CellProgram`.

    It describes ``forward(positions, directions=None, ray_index=None)``, whichever of these there are, unless a class
    has a ``forward`` of its own without a ``program``, or hooks or parametrisations (weight normalisation) change what
    layers compute.
    """

    def __init__(self) -> None:
        self._known: CellProgram | str = "its program is not known before its first call"
        self._field: nn.Module | None = None  # of which that was found
        self._by_ray: Program | None = None  # with a direction for each ray
        self._unchanged: Any = Never()
        self._asked: Any = None  # field, activation and columns, of which these are
        self._steps: tuple[Program, tuple[tuple[int, ...], ...]] | None = None  # with the shapes of their results
        self._watch: Watch | None = None  # of what the activation reads
        self._steps_unchanged: Any = Never()

    def __reduce__(self) -> tuple[type[Given], tuple[()]]:
        return Given, ()

    @staticmethod
    def of(field: nn.Module) -> Given | None:
        """Makes one for a field that has the method, without arguments; None for any other."""
        method = getattr(type(field), "program", None)
        needed = [None] * 2 if not callable(method) else list(inspect.signature(method).parameters)
        return Given() if len(needed) == 1 else None

    def look(self, field: nn.Module) -> CellProgram | str:
        """The program of a field's layers, with its activation; or why that is not known."""
        if torch.compiler.is_compiling():  # then what was found holds
            return self._known
        if field is not self._field or not self._unchanged.holds():
            self._field = field
            name, kind, parts = type(field).__name__, cast(Any, type(field)), [*parts_of(field).values()]
            self._known = f"{name} does more than its program says"
            if _describes(kind) and "forward" not in vars(field) and all(map(_is_plain, parts)):
                self._known = _checked(name, cast(Any, field).program())
                read = {id(p if p._base is None else p._base) for p in self._known.parameters}
                if any(id(p) not in read for p in cell_parameters(field)):
                    self._known = f"{name} has parameters of cells that are none of its program"
            if isinstance(self._known, CellProgram):
                self._by_ray = _by_ray(self._known.program.text, self._known.reads)
            self._unchanged = guard = unchanged()
            guard.attributes(kind, ["forward", "program"])
            for part in parts:
                guard.contents(vars(part))
                for value in vars(part).values():
                    if isinstance(value, (dict, list, set)):  # parameters, parts and hooks among them
                        guard.contents(value)
        return self._known

    def whole(self, field: nn.Module) -> CellProgram | str:
        """The same with the steps of its activation; or why that is no program."""
        known = self.look(field)
        if isinstance(known, str) or known.activate is None:
            return known
        asked = field, known.activate, known.shapes
        if asked != self._asked or (not self._steps_unchanged.holds() and cast(Watch, self._watch).changed()):
            self._asked, self._steps, reads = asked, None, set[tuple[int, str]]()
            with contextlib.suppress(Exception), outside():  # of any code: PyTorch computes it
                double = cast(Any, Double(field, reads).module).program()
                reads.clear()
                found, parts = _steps_of(double.activate, known.shapes[0][0]), [*parts_of(field).values()]
                if not any(name in parts[place]._parameters for place, name in reads):
                    self._steps = found
            self._watch, self._steps_unchanged = Watch.of(field, reads, Inputs()), Never()
        if not self._steps_unchanged.holds():
            self._steps_unchanged = unchanged()
            cast(Watch, self._watch).note(self._steps_unchanged)
        if self._steps is None:
            return f"activate of {type(field).__name__} computes more than steps of a program"
        steps, shapes = self._steps
        return CellProgram(_with_steps(known.program.text, steps.text), known.reads, shapes, known.parameters)

    def run(self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | Labels | None) -> Any:
        """The results of a call; coords are those that it was given, or labels. None where the program is not known."""
        known = self.look(router.module)
        if isinstance(known, str) or len(args) > len(_NAMES) or kwargs.keys() - set(_NAMES):
            return None
        given = {**dict.fromkeys(_NAMES), **dict(zip(_NAMES, args)), **kwargs}
        positions, directions, ray_index = map(as_plain, given.values())
        program, width = known.program, known.program.inputs[0]
        if not isinstance(positions, Tensor):
            raise TypeError(f"{_OP}: positions must be a tensor, got {type(positions).__name__}; {AS_TENSOR}")
        if positions.ndim != 2 or positions.shape[1] != width:
            raise ValueError(f"{_OP}: positions must have shape [n, {width}], got {list(positions.shape)}")
        if 1 not in known.reads:
            ray_index = None
        elif directions is None:
            raise ValueError(f"{_OP}: directions must be given, since {type(router.module).__name__} reads them")
        elif ray_index is None:
            check_shape(_OP, "directions", directions, ("n", 3), {"n": positions.shape[0]})
        else:
            program = cast(Program, self._by_ray)
        k, parameters = router.num_cells, known.parameters
        if all(p.dim() == len(shape) for p, shape in zip(parameters, program.parameters)):  # all cells share all
            parameters = [parameters[0].expand(k, *parameters[0].shape), *parameters[1:]]
        rows = [(positions, directions)[number] for number in known.reads]
        places = router.places(positions, router._positions(args, kwargs, coords))
        results, _ = routed_program(program, rows, parameters, ray_index=ray_index, **places, backend=router.backend)
        if known.activate is not None:
            return known.activate(*results)
        results = [out.reshape(-1, *shape) for out, shape in zip(results, known.shapes)]
        return results[0] if len(results) == 1 else tuple(results)


_NAMES = ("positions", "directions", "ray_index")
"""Arguments of a field's ``forward``."""


def _checked(name: str, found: Any) -> CellProgram:
    """Checks what a method ``program`` has given; raises TypeError or ValueError where it cannot be run."""
    if not isinstance(found, CellProgram):
        raise TypeError(f"{_OP}: program of {name} must give a CellProgram, got {type(found).__name__}")
    if found.reads not in ((0,), (0, 1)) or not found.parameters:
        rule = "read positions, or these and directions, and have parameters"
        raise ValueError(f"{_OP}: program of {name} must {rule}, got reads {found.reads}")
    return found


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """The arguments for a field's own ``forward``, with a direction for each sample in the place of one for each ray;
    None where they are as they should be."""
    positions, directions, index = ((dict(zip(_NAMES, args)) | kwargs).get(name) for name in _NAMES)
    if directions is None or index is None:
        return None
    others = {name: value for name, value in kwargs.items() if name not in _NAMES}
    return (positions, directions.index_select(0, index), None, *args[3:]), others


def _describes(kind: type[nn.Module]) -> bool:
    """Whether the program of a class is that of its ``forward``: none has been written since for one alone."""
    first = [
        next((i for i, base in enumerate(kind.__mro__) if name in vars(base)), 0) for name in ("forward", "program")
    ]
    return first[0] >= first[1]


def _is_plain(part: nn.Module) -> bool:
    return "parametrizations" not in part._modules and not any(vars(part)[key] for key in HOOKS)


@functools.lru_cache(maxsize=64)
def _by_ray(text: str, reads: tuple[int, ...]) -> Program:
    """A program with one row of the directions for each ray."""
    program, b = Program.parse(text), Builder()
    inputs = {i: b.input(width, ray=reads[i] == 1) for i, width in enumerate(program.inputs)}
    return b.program(b.replay(program, inputs))


@functools.lru_cache(maxsize=64)
def _with_steps(text: str, steps: str) -> Program:
    """A program of one output and the steps behind it, both by their texts."""
    program, b = Program.parse(text), Builder()
    inputs = {number: b.input(width) for number, width in enumerate(program.inputs)}
    return b.program(b.replay(Program.parse(steps), {0: b.replay(program, inputs)[0]}))
