"""The program of a routed call: given by the field's method ``program``, or traced from a module.

Letters: n samples, r rays, k cells, w columns.
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
from voronerf.ops._core.program import Builder, Names, Program
from voronerf.ops._core.tolerances import agree
from voronerf.ops._core.unchanged import Stale, unchanged
from voronerf.ops.grouped_program import grouped_program
from voronerf.ops.network import Network
from voronerf.router.arrange import find_positions
from voronerf.router.axes import Axis
from voronerf.router.double import Double
from voronerf.router.grouping import cell_parameters, parts_of
from voronerf.router.labels import Labels
from voronerf.router.layout import AS_TENSOR, as_plain, tensors_of
from voronerf.router.lower import Lowering, NotAStep
from voronerf.router.transforms import outside
from voronerf.router.watch import HOOKS, Inputs, Watch

_OP = "VoronoiRouter"
_ROWS = (37, 31)  # numbers of samples of a trace; at least one of them does not divide the width


class CellProgram(NamedTuple):
    """The program of a call, with the arguments that it reads, the shapes of its results, and its parameters.

    Attributes:
        program: The program. Its outputs are the tensors that the call returns, in their order, [n, w] each.
        reads: For each input of the program, the index of the call's argument that it reads.
        shapes: The shape, for one sample, of each tensor that the call returns.
        parameters: The parameters [k, ...], or [...] if all cells share them: the module's own parameters or views of
            them. For a traced module, they may also be computed from the module's parameters.
        activate: A function from the outputs to the call's results; None if the outputs are the results.

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
    """Returns the program of a field that is a layer table; the field's method ``program`` can return it.

    Args:
        layers: The layer table, which reads positions and possibly directions.
        linears: The linear layers, in the table's order.
        activate: A function from the table's outputs [n, out] to the results of ``forward``, sample by sample.
        features: The feature table of the hash grid of ``layers``, or None.

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
    """Traces a function of rows [n, width]; returns its program, and the shapes of its results for one row."""
    rows = next(rows for rows in _ROWS if width % rows)
    x = torch.linspace(-2, 2, rows * width, dtype=torch.float32, device="cpu").reshape(width, rows).t().contiguous()
    lowering = Lowering(rows)
    entries = lowering.input(None, x.shape, Axis(0), 0)
    result, _, entries_of = lowering.run(function, (x,), {}, lambda tensor: entries if tensor is x else None)
    columns = [lowering.order(entries_of(tensor).codes)[1] for tensor in tensors_of(result)]
    program = lowering.builder.program([lowering.operand(numbers) for numbers in columns])
    if program.parameters:
        raise NotAStep("a function with constants of its own")
    offsets = torch.tensor([0, rows], dtype=torch.int32, device="cpu")
    results = grouped_program([x], [], offsets, program=program, backend="reference")
    if not all(agree(a.reshape(b.shape), b) for a, b in zip(results, tensors_of(result), strict=True)):
        raise NotAStep("a function whose steps give other results")
    return program, tuple(tuple(tensor.shape[1:]) for tensor in tensors_of(result))


class _Looked(NamedTuple):
    """The result of :meth:`FieldProgram.look`, replaced as a whole since other threads may read it.

    Attributes:
        field: The field; None before the first call.
        program: The program, or the reason why it is unknown.
        ray_program: The program with a direction for each ray.
        dependencies: The field's attributes and submodules.
    """

    field: nn.Module | None
    program: CellProgram | str
    ray_program: Program | None
    dependencies: Any


class _Activation(NamedTuple):
    """The activation of a field, replaced as a whole since other threads may read it.

    Attributes:
        key: The field, its activation, and the shapes of the activation's arguments.
        steps: The activation's program and the shapes of its results; None if there is none.
        watch: The attributes that the activation reads.
    """

    key: Any
    steps: tuple[Program, tuple[tuple[int, ...], ...]] | None
    watch: Watch


class FieldProgram:
    """The program of a field with a method ``program``, which returns a :class:`CellProgram`.

    The program describes ``forward(positions, directions=None, ray_index=None)`` or a ``forward`` with some of these
    arguments. It is not used if a subclass overrides ``forward`` alone, or if hooks or parametrisations (weight
    normalisation) change what layers compute.
    """

    def __init__(self) -> None:
        self._looked = _Looked(None, "its program is unknown until the first call", None, Stale())
        self._activation: _Activation | None = None

    def __reduce__(self) -> tuple[type[FieldProgram], tuple[()]]:
        return FieldProgram, ()

    @staticmethod
    def of(field: nn.Module) -> FieldProgram | None:
        """Returns a FieldProgram if the field has a method ``program`` without arguments, else None."""
        method = getattr(type(field), "program", None)
        parameters = [None] * 2 if not callable(method) else list(inspect.signature(method).parameters)
        return FieldProgram() if len(parameters) == 1 else None

    def look(self, field: nn.Module) -> CellProgram | str:
        """Returns the program of a field's layers, with its activation, or the reason why it is unknown."""
        return self._look(field).program

    def _look(self, field: nn.Module) -> _Looked:
        looked = self._looked
        if torch.compiler.is_compiling():  # the last program is assumed to hold
            return looked
        if field is not looked.field or not looked.dependencies.holds():
            name, field_type, parts = type(field).__name__, cast(Any, type(field)), [*parts_of(field).values()]
            program: CellProgram | str = f"{name} computes more than its program"
            ray_program, dependencies = None, unchanged()
            if _describes(field_type) and "forward" not in vars(field) and all(map(_is_plain, parts)):
                with torch.inference_mode(False):  # also enables gradients, for views in later calls
                    program = _checked(name, cast(Any, field).program())
                ids = {id(p if p._base is None else p._base) for p in program.parameters}
                if any(id(p) not in ids for p in cell_parameters(field)):
                    program = f"{name} has cell parameters that its program does not use"
            if isinstance(program, CellProgram):
                ray_program = _by_ray(program.program.text, program.reads)
                for p in program.parameters:
                    if p._base is not None:  # a view keeps the memory that `p.data = values` replaces
                        dependencies.layout(p._base)
            dependencies.attributes(field_type, ["forward", "program"])
            for part in parts:
                dependencies.contents(vars(part))
                for value in vars(part).values():
                    if isinstance(value, (dict, list, set)):  # such as parameters, submodules and hooks
                        dependencies.contents(value)
            looked = self._looked = _Looked(field, program, ray_program, dependencies)
        return looked

    def with_activation(self, field: nn.Module) -> CellProgram | str:
        """Returns the program with the activation as steps, or the reason why there is none."""
        layers = self.look(field)
        if isinstance(layers, str) or layers.activate is None:
            return layers
        key, known = (field, layers.activate, layers.shapes), self._activation
        if known is None or key != known.key or known.watch.changed():
            steps: tuple[Program, tuple[tuple[int, ...], ...]] | None = None
            reads = set[tuple[int, str]]()
            with contextlib.suppress(Exception), outside():  # if tracing fails, PyTorch computes the activation
                double = cast(Any, Double(field, reads).module).program()
                reads.clear()
                traced, parts = _steps_of(double.activate, layers.shapes[0][0]), [*parts_of(field).values()]
                if not any(name in parts[place]._parameters for place, name in reads):
                    steps = traced
            known = self._activation = _Activation(key, steps, Watch(field, reads, Inputs()))
        if known.steps is None:
            return f"activate of {type(field).__name__} cannot be written as steps of a program"
        program, shapes = known.steps
        return CellProgram(_with_steps(layers.program.text, program.text), layers.reads, shapes, layers.parameters)

    def run(self, router: Any, args: tuple[Any, ...], kwargs: dict[str, Any], coords: Tensor | Labels | None) -> Any:
        """Returns the results of a call with its ``coords`` or labels; None if the program is unknown."""
        looked = self._look(router.module)
        layers = looked.program
        if isinstance(layers, str) or len(args) > len(_NAMES) or kwargs.keys() - set(_NAMES):
            return None
        named = {**dict.fromkeys(_NAMES), **dict(zip(_NAMES, args)), **kwargs}
        positions, directions, ray_index = map(as_plain, named.values())
        program, width = layers.program, layers.program.inputs[0]
        if not isinstance(positions, Tensor):
            raise TypeError(f"{_OP}: positions must be a tensor, got {type(positions).__name__}; {AS_TENSOR}")
        if positions.ndim != 2 or positions.shape[1] != width:
            raise ValueError(f"{_OP}: positions must have shape [n, {width}], got {list(positions.shape)}")
        if 1 not in layers.reads:
            ray_index = None
        elif directions is None:
            raise ValueError(f"{_OP}: directions must be given, since {type(router.module).__name__} reads them")
        elif ray_index is None:
            check_shape(_OP, "directions", directions, ("n", 3), {"n": positions.shape[0]})
        else:
            program = cast(Program, looked.ray_program)
        rows = [(positions, directions)[number] for number in layers.reads]
        places = router.places(find_positions(router, args, kwargs, coords))
        network = Network(program, layers.parameters, names=Names(_OP))
        results, _ = network(rows, places, ray_index=ray_index, backend=router.backend)
        if layers.activate is not None:
            return layers.activate(*results)
        results = [out.reshape(-1, *shape) for out, shape in zip(results, layers.shapes)]
        return results[0] if len(results) == 1 else tuple(results)


_NAMES = ("positions", "directions", "ray_index")
"""The arguments of a field's ``forward``."""


def _checked(field_name: str, program: Any) -> CellProgram:
    """Checks the result of a method ``program``; raises TypeError or ValueError if it cannot run."""
    if not isinstance(program, CellProgram):
        raise TypeError(f"{_OP}: program of {field_name} must give a CellProgram, got {type(program).__name__}")
    if program.reads not in ((0,), (0, 1)) or not program.parameters:
        rule = "read positions, or positions and directions, and have parameters"
        raise ValueError(f"{_OP}: program of {field_name} must {rule}, got reads {program.reads}")
    return program


def each_direction(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """Returns the arguments with a direction for each sample instead of each ray; None if there is no ray index."""
    positions, directions, index = ((dict(zip(_NAMES, args)) | kwargs).get(name) for name in _NAMES)
    if directions is None or index is None:
        return None
    rest = {name: value for name, value in kwargs.items() if name not in _NAMES}
    return (positions, directions.index_select(0, index), None, *args[3:]), rest


def _describes(field_type: type[nn.Module]) -> bool:
    """Returns whether the method ``program`` describes ``forward``: no later subclass overrides ``forward`` alone."""
    places = [
        next((i for i, base in enumerate(field_type.__mro__) if name in vars(base)), 0)
        for name in ("forward", "program")
    ]
    return places[0] >= places[1]


def _is_plain(part: nn.Module) -> bool:
    return "parametrizations" not in part._modules and not any(vars(part)[key] for key in HOOKS)


@functools.lru_cache(maxsize=64)
def _by_ray(text: str, reads: tuple[int, ...]) -> Program:
    """Returns a program whose directions are given per ray instead of per sample.

    Args:
        text: The program with a direction for each sample, as text.
        reads: The argument that each input of the program reads; 1 for the directions.
    """
    program, b = Program.parse(text), Builder()
    inputs = {i: b.input(width, ray=reads[i] == 1) for i, width in enumerate(program.inputs)}
    return b.program(b.replay(program, inputs))


@functools.lru_cache(maxsize=64)
def _with_steps(text: str, steps: str) -> Program:
    """Returns the program ``text``, which has one output, continued by the program ``steps``."""
    program, b = Program.parse(text), Builder()
    inputs = {number: b.input(width) for number, width in enumerate(program.inputs)}
    return b.program(b.replay(Program.parse(steps), {0: b.replay(program, inputs)[0]}))
