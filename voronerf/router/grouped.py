"""Running a module's own ``forward`` once for the samples of all cells.

The rows are sorted by cell and :class:`PerCell` tensors stand in the place of the module's parameters.
:class:`GroupedRun` sees every PyTorch function on the way. A function that meets a parameter is served by a rule
(:func:`register`); a function of parameters alone runs for all cells at once; any other runs as it is. Which tensors
depend on the samples is noted on the way, so that a rule knows rows from constants, and a value of samples that is read
on the host is found. Where a step has no rule, :class:`Ungroupable` says which, and the call is a loop over cells.

Letters: n samples, k cells; a tensor of rows is [n * m, ...], the m entries of a sample next to each other.
"""

from __future__ import annotations

import inspect
import linecache
import os
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from voronerf.router.double import Double
from voronerf.router.grouping import Grouping, cell_parameters, cells_of
from voronerf.router.layout import Call, Results, map_tensors, split_rows, tensors_of
from voronerf.router.norms import EXACT

_TORCH, _HERE = (os.path.dirname(os.path.abspath(file)) + os.sep for file in (torch.__file__, __file__))
_INPLACE = {f"__i{name}__" for name in ("add", "sub", "mul", "truediv", "div", "floordiv", "mod", "pow", "and", "or")}
_MARK = "_voronerf_rows"

Rule = Callable[..., Any]
_RULES: dict[Any, Rule] = {}


def find(names: str, *places: Any) -> frozenset[Any]:
    """The functions of these names that modules or classes have."""
    functions = (getattr(place, name, None) for place in places for name in names.split())
    return frozenset(function for function in functions if function is not None)


_VALUES = {"T", "H", "mT", "mH", "data", "grad", "real", "imag", "_base"}
METADATA = frozenset(
    getattr(torch.Tensor, name).__get__
    for name in dir(torch.Tensor)
    if type(getattr(torch.Tensor, name)).__name__ in ("getset_descriptor", "property") and name not in _VALUES
) | find(
    """
    size dim ndimension numel nelement stride is_contiguous is_floating_point is_complex element_size get_device
    storage_offset is_signed is_same_size is_inference data_ptr __len__ __hash__ __repr__ __dir__ __reduce_ex__
    is_tensor is_storage register_hook retain_grad requires_grad is_pinned
    """,
    torch,
    torch.Tensor,
)
"""What reads no value: shapes, dtypes, devices."""
RANDOM = find(
    """
    rand_like randn_like randint_like bernoulli normal_ uniform_ bernoulli_ exponential_ random_ cauchy_ log_normal_
    geometric_ dropout dropout_ alpha_dropout feature_alpha_dropout rrelu rand randn randint randperm normal multinomial
    """,
    torch,
    torch.Tensor,
    torch.nn.functional,
)
"""What draws random numbers."""
CREATE = find("zeros ones full empty rand randn randint", torch)
"""New tensors of given sizes; with n of them in front they are rows."""


class Exact(TorchFunctionMode):
    """A mode that replaces functions whose higher derivatives are wrong in PyTorch."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return EXACT.get(func, func)(*args, **(kwargs or {}))


class NoRandomness(TorchFunctionMode):
    """Random numbers are 0 and dropout does nothing, so that two calls can be compared."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return without_randomness(func, args, kwargs or {})


def without_randomness(func: Any, args: Any, kwargs: Any) -> Any:
    """What a function returns where random numbers are 0."""
    if func not in RANDOM:
        return func(*args, **kwargs)
    if "dropout" in getattr(func, "__name__", ""):
        return args[0] if args else kwargs["input"]
    return func(*args, **kwargs).zero_()


def register(function: Any, rule: Rule) -> None:
    """Registers how a function that takes parameters runs for all cells at once.

    Without a rule, a call of a module that uses the function is a loop over cells.

    Args:
        function: What PyTorch's function modes see, such as ``torch.nn.functional.linear``, an operator of
            ``torch.ops``, or a function of your own that calls ``torch.overrides.handle_torch_function``.
        rule: ``rule(run, *args, **kwargs)`` with the :class:`GroupedRun` and the function's own arguments: tensors of
            rows are sorted by cell, and a parameter is a :class:`PerCell`, whose ``stacked`` is [k, ...]. It returns
            rows, or ``NotImplemented`` for arguments that it does not serve.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> from voronerf.router import register
        >>> def shift(rows, offset):  # a function of yours that PyTorch's function modes see
        ...     if torch.overrides.has_torch_function((rows, offset)):
        ...         return torch.overrides.handle_torch_function(shift, (rows, offset), rows, offset)
        ...     return rows + offset.exp()
        >>> def shift_in_cells(run, rows, offset):
        ...     return rows + run.rows_of(offset).exp()
        >>> register(shift, shift_in_cells)
        >>> class Field(torch.nn.Linear):
        ...     def forward(self, x):
        ...         return shift(x @ self.weight.T, self.bias)
        >>> router = VoronoiRouter(Field(3, 2), torch.randn(4, 3), coords="first3", way="grouped")
        >>> router(torch.randn(64, 3)).shape
        torch.Size([64, 2])
        >>> print(router.explain())
        forward: grouped
    """
    _RULES[function] = rule


class Ungroupable(Exception):
    """A module cannot be run on the samples of all cells at once; the message says where."""

    def __init__(self, reason: str, of_batch: bool = False) -> None:
        super().__init__(reason)
        self.of_batch = of_batch  # it may be otherwise for other samples


class PerCell(torch.Tensor):
    """k tensors, one for each cell, that look like one of them: what a routed module finds in place of a parameter.

    It has the shape of a single cell's tensor and no storage.

    Attributes:
        stacked: [k, ...], one entry for each cell.
        origin: The tensor of more cells that ``stacked`` is a part of, and its first cell there.
    """

    stacked: Tensor
    origin: tuple[Tensor, int]
    # Shape and dtype are answered by the wrapper itself.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, stacked: Tensor, origin: tuple[Tensor, int] | None = None) -> PerCell:
        """Wraps [k, ...]."""
        wrapper: PerCell = torch.Tensor._make_wrapper_subclass(
            cls, stacked.shape[1:], dtype=stacked.dtype, device=stacked.device, requires_grad=stacked.requires_grad
        )
        wrapper.stacked, wrapper.origin = stacked, origin or (stacked, 0)
        return wrapper

    @property
    def _version(self) -> int:  # type: ignore[override]
        return self.stacked._version

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        """Raises TypeError for functions outside of a routed call."""
        raise TypeError(
            f"VoronoiRouter: {func} met the parameters of all cells outside of a routed call; call the router, or take "
            "one cell's module with cell(i)"
        )


def for_all_cells(func: Any, args: Any, kwargs: Any, fail: Callable[[str], Exception] = Ungroupable) -> Any:
    """A function of parameters and constants alone, for all cells at once; results are :class:`PerCell`."""
    stacks = [leaf.stacked for leaf in tensors_of((args, kwargs)) if isinstance(leaf, PerCell)]
    if func is torch.autograd.grad:
        raise fail("it differentiates with respect to parameters")
    function = _weight_norm if func is torch._weight_norm else func

    def on_one(*single: Tensor) -> Any:
        following = iter(single)
        arguments = map_tensors((args, kwargs), lambda value: next(following) if isinstance(value, PerCell) else value)
        return function(*arguments[0], **arguments[1])

    try:
        return map_tensors(torch.vmap(on_one, randomness="different")(*stacks), PerCell)
    except Exception as error:
        raise fail(f"{name_of(func)} of parameters fails for all cells at once: {error}") from error


def _weight_norm(v: Tensor, g: Tensor, dim: int = 0) -> Tensor:
    """``torch._weight_norm`` of functions that can be mapped over cells."""
    others = [d for d in range(v.dim()) if d != dim]
    return v * (g / torch.linalg.vector_norm(v, dim=others, keepdim=True))


def name_of(function: Any) -> str:
    """A function's name for messages."""
    if isinstance(owner := getattr(function, "__self__", None), type):  # such as apply of a function of autograd
        return f"{owner.__name__}.{function.__name__}"
    resolved = torch.overrides.resolve_name(function)
    return resolved or getattr(function, "__qualname__", None) or str(function)


def writes_in_place(function: Any) -> bool:
    """Whether a function writes to its first argument."""
    name = getattr(function, "__name__", "")
    return name == "__setitem__" or name in _INPLACE or (name.endswith("_") and not name.startswith("__"))


def user_frame() -> FrameType | None:
    """The frame of the routed module's code on the stack."""
    frame, inside = inspect.currentframe(), False
    while frame is not None:
        file = frame.f_code.co_filename
        ours = file.startswith(_HERE)
        if ours and inside:
            return None  # the router that called the module
        inside = inside or not ours
        if inside and not ours and not file.startswith(_TORCH):
            return frame
        frame = frame.f_back
    return None


def line_of(frame: FrameType | None) -> str:
    """File, line and code of a frame, or an empty text."""
    if frame is None:
        return ""
    file = frame.f_code.co_filename
    code = linecache.getline(file, frame.f_lineno).strip()
    return f" ({os.path.basename(file)}:{frame.f_lineno}{f': {code}' if code else ''})"


class GroupedRun(TorchFunctionMode):
    """Active while a module runs on the n sorted rows of all cells; what a rule is given.

    Attributes:
        tables: Those that parts of the call have looked up.
        failed: Why the results are not valid, also where the module caught the error; None where they are.
        widest: Bytes of the largest tensor of rows that was made.
    """

    def __init__(self, grouping: Grouping, tables: dict[Any, Any], quiet: bool = False) -> None:
        super().__init__()
        self.quiet = quiet  # random numbers are 0
        self.grouping, self.n, self.tables = grouping, grouping.n, tables
        self.failed: Ungroupable | None = None
        self.widest = 1
        self._token = object()

    # For rules --------------------------------------------------------------------------------------------------------

    def is_rows(self, value: Any) -> bool:
        """Whether a value is a tensor that depends on the samples."""
        return isinstance(value, Tensor) and getattr(value, _MARK, (None,))[0] is self._token

    def entries(self, rows: Tensor) -> int:
        """m of a tensor of rows [n * m, ...]."""
        if rows.dim() == 0 or not rows.shape[0] or rows.shape[0] % self.n:
            shape = list(rows.shape)
            reason = f"parameters meet a tensor of shape {shape}, which has no row for each of {self.n} samples"
            raise self.fail(reason, of_batch=True)
        return rows.shape[0] // self.n

    def rows_of(self, parameter: PerCell, m: int = 1) -> Tensor:
        """[n * m, ...]: for each row the parameter of its cell."""
        return self.grouping.expand(parameter.stacked, m)

    # Marks ------------------------------------------------------------------------------------------------------------

    def mark(self, tensor: Tensor, tag: str = "") -> Tensor:
        """Marks a tensor as dependent on samples; ``tag`` is "any" or "all" for such a reduction of them."""
        setattr(tensor, _MARK, (self._token, tag))
        self.widest = max(self.widest, tensor.numel() * tensor.element_size())
        return tensor

    def fail(self, reason: str, of_batch: bool = False) -> Ungroupable:
        """The error to raise where the run cannot go on."""
        self.failed = self.failed or Ungroupable(reason + line_of(user_frame()), of_batch)
        return self.failed

    # Functions --------------------------------------------------------------------------------------------------------

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs one PyTorch function of the module."""
        kwargs = kwargs or {}
        if func in METADATA:
            return func(*args, **kwargs)
        operands = tensors_of((args, kwargs))
        marked = [tensor for tensor in operands if self.is_rows(tensor)]
        if any(type(tensor) is PerCell for tensor in operands):
            return self._with_parameters(func, args, kwargs, operands, marked)
        exact = EXACT.get(func, func)
        result = without_randomness(exact, args, kwargs) if self.quiet else exact(*args, **kwargs)
        outputs = tensors_of(result)
        if marked:
            if writes_in_place(func):
                self.mark(operands[0])
            name = getattr(func, "__name__", "")
            for tensor in outputs:
                self.mark(tensor, name if name in ("any", "all") else "")
            if not outputs:
                self._check_read(func, result, marked[0])
        elif func in CREATE:
            for tensor in outputs:
                if tensor.shape[:1] == (self.n,):
                    self.mark(tensor)
        return result

    def _check_read(self, func: Any, result: Any, source: Tensor) -> None:
        """Raises for values of samples read on the host, which a loop over cells reads for each cell alone."""
        if result is None or isinstance(result, (str, torch.dtype, torch.device, torch.Size)):
            return
        # If no sample of all has a property, then no sample of any cell has it; if all have, all of each cell have.
        if isinstance(result, bool) and getattr(source, _MARK)[1] == ("all" if result else "any"):
            return
        raise self.fail(f"{name_of(func)} reads values of the samples", of_batch=True)

    def _with_parameters(self, func: Any, args: Any, kwargs: Any, operands: list[Tensor], marked: list[Tensor]) -> Any:
        for tensor in operands:
            unseen = type(tensor) is not PerCell and not hasattr(tensor, _MARK) and tensor.shape[:1] == (self.n,)
            if unseen and not isinstance(tensor, torch.nn.Parameter):
                raise self.fail(f"{name_of(func)} takes rows that no PyTorch function was seen to make")
        rule = _RULES.get(func)
        result = NotImplemented if rule is None else rule(self, *args, **kwargs)
        if result is NotImplemented:
            if marked:
                raise self.fail(f"{name_of(func)} meets parameters and has no rule for all cells at once")
            return for_all_cells(func, args, kwargs, self.fail)
        for tensor in tensors_of(result):
            if type(tensor) is not PerCell:
                self.mark(tensor)
        return result


class Way(Protocol):
    """One way to run a call.

    Attributes:
        name: "fused", "grouped" or "cell by cell".
        why: Why no faster one runs, or empty.
    """

    name: str
    why: str

    def run(self, call: Call, grouping: Grouping) -> Results:
        """The results of a call with the parameters of its module."""
        ...


@dataclass
class Grouped:
    """The module's own ``forward`` once for the rows of all cells.

    On a CPU it runs on pieces of rows, so that the cache holds their tensors.
    """

    piece: int = 1 << 16  # rows
    name: str = "grouped"
    why: str = ""
    quiet: bool = False  # random numbers are 0, so that two runs can be compared
    widest: int = 1  # bytes of the largest tensor of rows that the last call made

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Results in the order of the grouping; raises :class:`Ungroupable`."""
        arguments = call.arranged(grouping)
        parts = grouping.parts(self.piece) if grouping.device.type == "cpu" else [grouping]
        # Parameters are split once for all parts: their gradient is then put together once, where that of a slice would
        # fill a tensor of all cells for each part. Parts of one cell have the same piece.
        sizes, pieces = {part.start: part.k for part in parts}, []
        for p in cell_parameters(call.module):
            pieces.append((p, dict(zip(sizes, p.split(list(sizes.values())) if len(sizes) > 1 else (p,), strict=True))))
        values, widest, tables, double = [], 1, dict[Any, Any](), Double(call.module)
        for part, rows in zip(parts, split_rows(arguments, [part.n for part in parts]), strict=True):
            run = GroupedRun(part, tables, self.quiet)
            for tensor in rows:
                run.mark(tensor)
            origin = part.start
            stand_ins = {id(p): PerCell(piece[origin], (p, origin)) for p, piece in pieces}
            with run:
                values.append(double.run(call, rows, stand_ins))
            if run.failed is not None:
                raise run.failed
            if any(isinstance(tensor, PerCell) for tensor in tensors_of(values[-1])):
                raise Ungroupable("a result is made of parameters alone")
            widest = max(widest, run.widest)
        self.widest = widest
        return Results.joined(values, [part.n for part in parts], grouping)


@dataclass
class Loop:
    """The module once for each cell that has samples: the definition of a routed call.

    Where its code runs ``again`` in the backward pass (``torch.utils.checkpoint``), every cell has a double of the
    module, which keeps the cell's parameters.
    """

    why: str = ""
    again: bool = False
    name: str = "cell by cell"

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Results in the order of the grouping."""
        return self.on(call, grouping, grouping.occupied)

    def on(self, call: Call, grouping: Grouping, bounds: list[tuple[int, int, int]]) -> Results:
        """The same with one call of the module for each (cell, first row, row behind the last)."""
        module, counts = call.module, [last - first for _, first, last in bounds]
        pieces = {id(p): cells_of(p) for p in cell_parameters(module)}
        values, double = [], Double(module)
        arguments = call.arranged(grouping)
        mode = Exact() if torch.is_grad_enabled() and not self.again else None
        for (cell, _, _), part in zip(bounds, split_rows(arguments, counts), strict=True):
            double = Double(module) if self.again else double
            values.append(double.run(call, part, {key: piece[cell] for key, piece in pieces.items()}, mode))
        if not self.again:
            double.end()
        return Results.joined(values, counts, grouping)
