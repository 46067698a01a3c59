"""What a routed call computes, as one program: one that a field says of itself, or that of a module that was traced.

n samples, r rays, k cells, w columns.
"""

from __future__ import annotations

import functools
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
from voronerf.router.grouping import owned_parameters, parts_of
from voronerf.router.layout import AS_TENSOR, as_plain, tensors_of
from voronerf.router.lower import Lowering, NotAStep
from voronerf.router.transforms import outside
from voronerf.router.watch import Inputs, Watch

_OP = "VoronoiRouter"
_ROWS = (37, 31)  # samples of a trace; one of them divides no width
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


class CellProgram(NamedTuple):
    """What a call computes, where that is one program.

    Attributes:
        program: Its outputs are the tensors that the call returns, in their order, [n, w] each.
        reads: Of each input of the program, the number of the argument of the call whose rows it is.
        shapes: Of each tensor that the call returns, for one sample.
        parameters: [k, ...], or without k where all cells share it: the module's own, or made of them.

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


def layered_program(
    layers: MLP, linears: Sequence[nn.Linear], activate: Callable[[Tensor], Any], features: Tensor | None = None
) -> CellProgram:
    """The program of a field that is a layer table, for its method ``program``.

    Args:
        layers: The table, of positions and, if it reads them, directions.
        linears: The linear layers in its order.
        activate: Turns its outputs [n, out] into what ``forward`` returns, sample by sample.
        features: The table of its hash grid, or None.

    Raises:
        NotAStep: An ``activate`` that does more than steps of a program.

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
    steps, shapes = _steps_of(activate, layers.out_features)
    program = _with_steps(layers.text, tuple(bias is not None for bias in biases), steps.text)
    return CellProgram(program, (0, 1) if layers.uses_directions else (0,), shapes, parameters)


@functools.lru_cache(maxsize=64)
def _with_steps(text: str, biased: tuple[bool, ...], steps: str) -> Program:
    """The program of a layer table and the steps behind it, both by their texts."""
    layers = MLP.parse(text)
    table = layers.program(6 if layers.integrated else 3, 3 if layers.uses_directions else 0, None, biased)
    b = Builder()
    inputs = {number: b.input(width) for number, width in enumerate(table.inputs)}
    return b.program(b.replay(Program.parse(steps), {0: b.replay(table, inputs)[0]}))


def _steps_of(function: Callable[..., Any], width: int) -> tuple[Program, tuple[tuple[int, ...], ...]]:
    """A function of rows [n, width] as a program, and the shapes of its results for one row."""
    rows = next(rows for rows in _ROWS if width % rows)
    x = torch.linspace(-2, 2, rows * width).reshape(width, rows).t().contiguous()
    lowering = Lowering(rows)
    entries = lowering.input(None, x.shape, 0)
    result, _, entries_of = lowering.run(function, (x,), {}, lambda tensor: entries if tensor is x else None)
    made = [lowering.order(entries_of(tensor).codes)[1] for tensor in tensors_of(result)]
    program = lowering.builder.program([lowering.operand(numbers) for numbers in made])
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

    name = "fused"

    def __init__(self) -> None:
        self._unchanged: Any = Never()
        self._watch: Watch | None = None
        self._known: CellProgram | str = ""
        self._plain = False  # without hooks and parametrisations, and of a class whose program is that of its forward
        self._places: list[tuple[dict[str, Any], str]] = []  # where its parameters are

    def __reduce__(self) -> tuple[type[Given], tuple[()]]:
        return Given, ()

    @staticmethod
    def of(field: nn.Module) -> Given | None:
        """That of a field that has the method."""
        return Given() if callable(getattr(type(field), "program", None)) else None

    def look(self, field: nn.Module) -> CellProgram | str:
        """The program of a field, with its parameters; or why that is not known."""
        if not torch.compiler.is_compiling() and not self._unchanged.holds():  # while it compiles, what was found holds
            kind, parts = cast(Any, type(field)), parts_of(field).values()
            plain = _describes(kind) and "forward" not in vars(field) and all(map(_is_plain, parts))
            if self._watch is None or plain != self._plain or self._watch.changed():
                self._look_anew(field, plain)
            self._unchanged = unchanged()
            self._unchanged.entries(vars(field), ["forward"])
            for part in parts:
                for hooks in (vars(part)[key] for key in _HOOKS):
                    self._unchanged.contents(hooks)
            cast(Watch, self._watch).note(self._unchanged)
        if isinstance(self._known, str):
            return self._known
        return self._known._replace(parameters=[registry[name] for registry, name in self._places])

    def _look_anew(self, field: nn.Module, plain: bool) -> None:
        name, reads = type(field).__name__, set[tuple[int, str]]()
        found: CellProgram | str = f"{name} does more than its program says"
        if plain:
            try:
                with outside():
                    found = cast(Any, Double(field, reads).module).program()
            except NotAStep:
                found = f"activate of {name} computes more than steps of a program"
        if isinstance(found, CellProgram):
            places = {id(p): (part._parameters, key) for part, key, p in owned_parameters(field)}
            if any(id(p) not in places for p in found.parameters):
                raise ValueError(f"{_OP}: program of {name} must give parameters of the field as they are")
            self._places = [places[id(p)] for p in found.parameters]
        self._known, self._plain, self._watch = found, plain, Watch.of(field, reads, Inputs())

    def run(self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | None) -> Any:
        """The results of a call; coords [..., d] are those that it was given. None where the program is not known."""
        known = self.look(router.module)
        if isinstance(known, str):
            return None
        positions, directions, ray_index = map(as_plain, _arguments(*args, **kwargs))
        program, width = known.program, known.program.inputs[known.reads.index(0)]
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
            program = _by_ray(program.text, known.reads)
        dtype = torch.promote_types(known.parameters[0].dtype, torch.float32)
        rows = [(positions, directions)[number].to(dtype) for number in known.reads]
        parameters = [p.to(dtype) for p in known.parameters]
        places = router.places(positions, router._positions(args, kwargs, coords))
        outputs, _ = routed_program(program, rows, parameters, ray_index=ray_index, **places, backend=router.backend)
        results = [out.reshape(-1, *shape).to(dtype) for out, shape in zip(outputs, known.shapes)]
        return results[0] if len(results) == 1 else tuple(results)


def _arguments(positions: Any, directions: Any = None, ray_index: Any = None) -> tuple[Any, Any, Any]:
    """Those of a field's ``forward``."""
    return positions, directions, ray_index


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """The arguments for a field's own ``forward``, with a direction for each sample in the place of one for each ray;
    None where they are as they should be."""
    names = ("positions", "directions", "ray_index")
    positions, directions, index = ((dict(zip(names, args)) | kwargs).get(name) for name in names)
    if directions is None or index is None:
        return None
    others = {name: value for name, value in kwargs.items() if name not in names}
    return (positions, directions.index_select(0, index), None, *args[3:]), others


@functools.cache
def _describes(kind: type[nn.Module]) -> bool:
    """Whether the program of a class is that of its ``forward``: none has been written since for one alone."""
    first = {name: next((i for i, base in enumerate(kind.__mro__) if name in vars(base)), 0) for name in _BOTH}
    return first["forward"] >= first["program"]


_BOTH = ("forward", "program")


def _is_plain(part: nn.Module) -> bool:
    return "parametrizations" not in part._modules and not any(vars(part)[key] for key in _HOOKS)


@functools.lru_cache(maxsize=64)
def _by_ray(text: str, reads: tuple[int, ...]) -> Program:
    """A program with one row of the directions for each ray."""
    program, b = Program.parse(text), Builder()
    inputs = {i: b.input(width, ray=reads[i] == 1) for i, width in enumerate(program.inputs)}
    return b.program(b.replay(program, inputs))
