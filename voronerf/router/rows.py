"""Running a module's own ``forward`` once for all cells, and knowing at each step what the rows of a tensor are.

A module written for the samples of one network is run on the samples of all cells, sorted by cell, with
:class:`PerCell` in the place of its parameters. :class:`RowMode` sees every PyTorch function on the way. It serves
those that meet a parameter (``voronerf.router.rules``), and it keeps track of rows: a marked tensor has n * m rows of
which rows ``r * m`` to ``(r + 1) * m`` belong to sorted sample r and depend on nothing else. That is what makes a
product with the parameters of the sample's cell right, and what may be put back in the original order at the end.
Functions known to work element by element keep the mark; any other is tried on a few random rows, once for each
combination of shapes: if it gives for a part of the rows what it gives for all, it keeps the mark. Where the mark is
lost the tensor may still be looked at, but it can neither meet a parameter nor be a result: :class:`Ungroupable` then
sends the call to the loop over cells, which is right by definition.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from voronerf.router.functions import CREATE, ELEMENTWISE, METADATA, RANDOM, VIEWS, name_of
from voronerf.router.grouping import Grouping, PerCell

if TYPE_CHECKING:
    from voronerf.router.recording import Recorder

_MARK = "_voronerf_mark"
_TRIED_ROWS = 6
_CACHE_LIMIT = 4096
_AFTER = " and what follows"


class Ungroupable(Exception):
    """A module cannot be run on the samples of all cells at once; the message says where."""


class Mark:
    """What is known of a tensor in a routed pass.

    Attributes:
        grouping: the assignment that its rows are sorted by.
        lost: empty where dimension 0 is the rows, else the function that made them something else.
    """

    __slots__ = ("grouping", "lost")

    def __init__(self, grouping: Grouping, lost: str = "") -> None:
        self.grouping, self.lost = grouping, lost


class Trials:
    """What a router remembers between calls: the functions that were tried, and what has been said.

    Copies of a router begin anew.
    """

    def __init__(self) -> None:
        self.tried: dict[Any, bool] = {}
        self.said: set[str] = set()

    def __deepcopy__(self, memo: Any) -> Trials:
        return Trials()

    def __reduce__(self) -> tuple[type[Trials], tuple[()]]:
        return Trials, ()

    def say_once(self, topic: str, message: str) -> None:
        """Warns, the first time that a topic comes up."""
        if topic not in self.said:
            self.said.add(topic)
            warnings.warn(message, stacklevel=2)


def tensors_in(value: Any) -> Iterator[Tensor]:
    """The tensors among a function's arguments or results, in lists, tuples and dicts as well."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from tensors_in(item)
    elif isinstance(value, dict):
        for item in value.values():
            yield from tensors_in(item)


def replace(value: Any, change: Callable[[Any], Any]) -> Any:
    """The same structure of lists, tuples and dicts with every other value changed."""
    if isinstance(value, (list, tuple)) and not isinstance(value, torch.Size):
        items = [replace(item, change) for item in value]
        return items if isinstance(value, list) else type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    if isinstance(value, dict):
        return {key: replace(item, change) for key, item in value.items()}
    return change(value)


class RowMode(TorchFunctionMode):
    """Active while a module runs on sorted rows.

    Args:
        grouping: of the samples; two at least, so that rows can be told from sizes of 1.
        memory: of the router.
        recorder: takes down what is done.

    Attributes:
        failed: why the pass is not valid, also where the module caught the error; empty if it is.
    """

    def __init__(self, grouping: Grouping, memory: Trials, recorder: Recorder | None = None) -> None:
        super().__init__()
        assert grouping.n >= 2
        self.grouping, self.memory, self.n, self.recorder = grouping, memory, grouping.n, recorder
        if recorder is not None:
            recorder.n = grouping.n
        self.failed = ""
        self._rows = Mark(grouping)

    # Marks ------------------------------------------------------------------------------------------------------------

    def mark(self, tensor: Tensor, lost: str = "") -> Tensor:
        """Notes that dimension 0 of a tensor is the rows, or why it is not."""
        setattr(tensor, _MARK, Mark(self.grouping, lost) if lost else self._rows)
        return tensor

    def mark_of(self, tensor: Tensor) -> Mark | None:
        """What is known of a tensor; None for one that does not depend on the samples."""
        mark = getattr(tensor, _MARK, None)
        return mark if mark is not None and mark.grouping is self.grouping else None

    def is_rows(self, tensor: Tensor) -> bool:
        """Whether dimension 0 of a tensor is the rows."""
        mark = self.mark_of(tensor)
        return mark is not None and not mark.lost

    def rows_each(self, tensor: Tensor) -> int:
        """m of a tensor of rows."""
        return tensor.shape[0] // self.n

    def fail(self, reason: str) -> Ungroupable:
        """The error to raise where the pass cannot go on."""
        self.failed = self.failed or reason
        return Ungroupable(reason)

    # Functions --------------------------------------------------------------------------------------------------------

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs one PyTorch function of the module."""
        kwargs = kwargs or {}
        if func in METADATA:
            return func(*args, **kwargs)
        operands = list(tensors_in((args, kwargs)))
        marked = [tensor for tensor in operands if self.mark_of(tensor) is not None]
        if any(isinstance(tensor, PerCell) for tensor in operands):
            from voronerf.router import rules

            lost = next((mark.lost for t in marked if (mark := self.mark_of(t)) is not None and mark.lost), "")
            if lost:
                raise self.fail(
                    f"after {lost} rows are no longer single samples, and meet parameters in {name_of(func)}"
                )
            return rules.run(self, func, args, kwargs)
        if func is torch.autograd.grad:
            return self._gradients(func, args, kwargs)
        sizes = [tensor.shape for tensor in marked]
        result = func(*args, **kwargs)
        self.mark_results(func, args, kwargs, result, operands, sizes)
        return result

    def mark_results(
        self, func: Any, args: Any, kwargs: Any, result: Any, operands: list[Tensor], sizes: list[torch.Size]
    ) -> None:
        """Finds out what the rows of a function's results are."""
        marks = [mark for tensor in operands if (mark := self.mark_of(tensor)) is not None]
        results = list(tensors_in(result))
        if not marks:
            if func in CREATE:
                for tensor in results:
                    if tensor.dim() > 0 and tensor.shape[0] == self.n:
                        self.mark(tensor)
                        if self.recorder is not None:
                            self.recorder.step(func, args, kwargs, result, [])
            if self.recorder is not None and func in RANDOM:
                self.recorder.refuse("random numbers")
            return
        name = getattr(func, "__name__", "")
        changed = [operands[0]] if name == "__setitem__" or (name.endswith("_") and not name.startswith("__")) else []
        if isinstance(kwargs.get("out"), Tensor):
            changed.append(kwargs["out"])
        if not results and not changed:
            self._check_read(func, result, marks[0])
            return
        lost = next((mark.lost for mark in marks if mark.lost), "")
        if lost and not lost.endswith(_AFTER):
            lost += _AFTER  # a sum is a sum no longer once it is divided, nor "any" what it was once it is inverted
        if not lost and not self._keeps_rows(func, args, kwargs, result, results, operands):
            lost = name_of(func)
        for tensor in (*results, *changed):
            self.mark(tensor, lost)
        if self.recorder is not None:
            if not lost:
                self.recorder.step(func, args, kwargs, result, changed)
            elif changed:
                self.recorder.refuse("a tensor that is written to")

    def _check_read(self, func: Any, result: Any, mark: Mark) -> None:
        """Refuses values of samples on the host, which a loop over cells would read for each cell alone."""
        if result is None or isinstance(result, (str, torch.dtype, torch.device, torch.Size)):
            return
        # What is true of no sample is true of none in every cell, and what of all of all.
        if isinstance(result, bool) and mark.lost.endswith("all" if result else "any"):
            if self.recorder is not None:
                self.recorder.refuse("a decision by values of the samples")
            return
        raise self.fail(f"it reads values of the samples with {name_of(func)}")

    def _keeps_rows(
        self, func: Any, args: Any, kwargs: Any, result: Any, results: list[Tensor], operands: list[Tensor]
    ) -> bool:
        if any(tensor.dim() == 0 or tensor.shape[0] % self.n or not tensor.shape[0] for tensor in results):
            return False
        if isinstance(result, Tensor):
            if func in ELEMENTWISE and all(self._aligned(tensor, result) for tensor in operands):
                return True
            if func in VIEWS and len(operands) == 1:
                source = operands[0]
                if result.numel() == source.numel():
                    return True
                if result.shape[0] == source.shape[0] and result.dim() == source.dim():
                    return True
            if func in CREATE:
                return result.shape[0] == self.n
        if func in RANDOM and func not in ELEMENTWISE:
            return False
        return self.tried(func, args, kwargs, len(results))

    def _aligned(self, tensor: Tensor, result: Tensor) -> bool:
        """Whether an elementwise function reads of an argument the row of its result, or what is common to all."""
        if self.is_rows(tensor):
            return tensor.dim() == result.dim() and tensor.shape[0] == result.shape[0]
        return tensor.dim() < result.dim() or (tensor.dim() == result.dim() and tensor.shape[0] == 1)

    # Trying a function on a few rows ----------------------------------------------------------------------------------

    def tried(self, func: Any, args: Any, kwargs: Any, results: int) -> bool:
        """Whether a function gives for some of the rows what it gives for all of them; remembered by shapes."""
        try:
            key = (func, self._describe(args), self._describe(tuple(sorted(kwargs.items()))), results)
            known = self.memory.tried.get(key)
        except TypeError:
            key, known = None, None
        if known is not None:
            return known
        keeps = self._try(func, args, kwargs, False) or self._try(func, args, kwargs, True)
        # What holds for a constant with as many rows as there are samples depends on its values.
        if key is not None and not any(self._suspect(tensor) for tensor in tensors_in((args, kwargs))):
            if len(self.memory.tried) >= _CACHE_LIMIT:
                self.memory.tried.clear()
            self.memory.tried[key] = keeps
        return keeps

    def _suspect(self, tensor: Tensor) -> bool:
        return not isinstance(tensor, PerCell) and self.mark_of(tensor) is None and tensor.shape[:1] == (self.n,)

    def _describe(self, value: Any) -> Any:
        """A hashable description of arguments that does not depend on the number of samples."""
        if isinstance(value, PerCell):
            return ("cell", value.shape, value.dtype)
        if isinstance(value, Tensor):
            if self.is_rows(value):
                return ("rows", self.rows_each(value), value.shape[1:], value.dtype)
            return ("constant", value.shape, value.dtype, value.stride())
        if isinstance(value, (list, tuple)):
            return (type(value), *[self._describe(item) for item in value])
        if isinstance(value, slice):
            return ("slice", self._describe(value.start), self._describe(value.stop), self._describe(value.step))
        if isinstance(value, int) and not isinstance(value, bool) and value >= self.n and value % self.n == 0:
            return ("n", value // self.n, value if value < 512 else 0)
        hash(value)
        return (type(value), value)

    def _try(self, func: Any, args: Any, kwargs: Any, scaled: bool) -> bool:
        """Runs the function on a few random rows and on two parts of them.

        ``scaled``: numbers that are a multiple of n are taken for sizes and shrink with the rows, and constants with
        n equal rows for rows.
        """
        rows = min(self.n, _TRIED_ROWS)
        half = rows // 2
        generator = torch.Generator().manual_seed(0)
        whole: dict[int, Tensor] = {}
        given_rows: list[Tensor] = []

        def sample(value: Any, first: int, last: int) -> Any:
            if isinstance(value, PerCell):
                return value.stacked[self._some_cell()].detach()
            if isinstance(value, Tensor):
                if self.is_rows(value):
                    m = self.rows_each(value)
                    if id(value) not in whole:
                        whole[id(value)] = _random(value, rows * m, generator)
                    given_rows.append(whole[id(value)][first * m : last * m].clone())
                    return given_rows[-1]
                if scaled and self._suspect(value) and _equal_rows(value):
                    return value[: last - first].detach().clone()
                return value.detach().clone() if value.requires_grad else value
            if isinstance(value, slice):
                return slice(*[sample(part, first, last) for part in (value.start, value.stop, value.step)])
            if isinstance(value, torch.Size):
                return torch.Size([sample(part, first, last) for part in value])
            if scaled and isinstance(value, int) and not isinstance(value, bool):
                return value // self.n * (last - first) if value >= self.n and value % self.n == 0 else value
            return value

        def outcome(first: int, last: int) -> list[Tensor]:
            given_rows.clear()
            given = replace((args, kwargs), lambda value: sample(value, first, last))
            out = func(*given[0], **given[1])
            return [*tensors_in(out), *given_rows]  # the arguments as well: the function may write to them

        try:
            with torch.no_grad():
                full, parts = outcome(0, rows), (outcome(0, half), outcome(half, rows))
        except Exception:
            return False
        if any(len(part) != len(full) for part in parts):
            return False
        return all(_joined(whole, pieces, rows, half) for whole, *pieces in zip(full, *parts, strict=True))

    def _some_cell(self) -> int:
        return max(self.grouping.occupied(), key=lambda cell: cell[2] - cell[1])[0]

    # Gradients taken inside of the module -----------------------------------------------------------------------------

    def _gradients(self, func: Any, args: Any, kwargs: Any) -> Any:
        """``torch.autograd.grad``: of rows, or of their sum, with respect to rows."""
        if self.recorder is not None:
            self.recorder.refuse("gradients taken inside")
        names = ("outputs", "inputs", "grad_outputs")
        given = {**dict(zip(names, args, strict=False)), **kwargs}
        result = func(*args, **kwargs)
        sources = [*tensors_in(given.get("outputs")), *tensors_in(given.get("grad_outputs"))]
        marks = [mark for tensor in sources if (mark := self.mark_of(tensor)) is not None]
        lost = next((mark.lost for mark in marks if mark.lost not in ("", "torch.sum", "torch.Tensor.sum")), "")
        for gradient, tensor in zip(result, tensors_in(given.get("inputs")), strict=True):
            if gradient is not None:
                self.mark(gradient, lost if self.is_rows(tensor) else lost or "torch.autograd.grad")
        return result


def _random(like: Tensor, rows: int, generator: torch.Generator) -> Tensor:
    """Random rows in the shape and dtype of a tensor's; integers, which may be indices, are the tensor's own."""
    if like.is_floating_point():
        values = torch.rand(rows, *like.shape[1:], generator=generator, dtype=torch.float64) * 0.8 + 0.1
        return values.to(like.device, like.dtype)
    if like.dtype == torch.bool:
        return (torch.rand(rows, *like.shape[1:], generator=generator) < 0.5).to(like.device)
    return like[:rows].detach().clone()


def _equal_rows(constant: Tensor) -> bool:
    if constant.stride(0) == 0:
        return True
    return bool((constant == constant[:1]).all())


def _joined(whole: Tensor, parts: Sequence[Tensor], rows: int, half: int) -> bool:
    """Whether two results for parts of the rows are the result for all rows, cut where the rows are."""
    first, second = parts
    if whole.dim() == 0 or first.dim() != whole.dim() or whole.shape[0] % rows:
        return False
    m = whole.shape[0] // rows
    if first.shape[0] != half * m or second.shape[0] != (rows - half) * m or first.shape[1:] != whole.shape[1:]:
        return False
    joined = torch.cat([first, second])
    if joined.dtype != whole.dtype:
        return False
    if not whole.is_floating_point():
        return bool((joined == whole).all())
    tolerance = max(1e-4, 8 * math.sqrt(torch.finfo(whole.dtype).eps)) if whole.dtype.itemsize < 4 else 1e-4
    return torch.allclose(joined.double(), whole.double(), rtol=tolerance, atol=tolerance, equal_nan=True)
