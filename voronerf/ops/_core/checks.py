"""Validators shared by every public operation.

A validator raises an error of one form, "operation: argument must <rule>, got <value>": ValueError for shapes and
values, TypeError for dtypes and types. Validators check shapes, dtypes and devices; ``check_range`` also checks indices
on the CPU. No other element of a tensor is read, so that ``torch.compile`` can trace an operation and a CUDA graph can
capture it.

Dimension letters in a rule ("n", "k+1") are bound at their first use. If several checks share a ``sizes`` dictionary, a
letter means the same number in all of them.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends

FLOATING = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
INDEX = (torch.int32,)
LIKE_FIRST: tuple[torch.dtype, ...] = ()
"""A placeholder in `Checked.tensor` for the dtype of the first floating-point tensor."""
MAX_COUNT = 2**31 - 1
"""The largest number of rows in one call, because index tensors are int32."""
MAX_GROUPS = 2**27
"""The largest number of cells or rays in an offsets tensor."""


def check_tensor(op: str, name: str, value: object) -> None:
    """Raises TypeError unless ``value`` is a dense, strided tensor: not sparse, nested or quantized."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{op}: {name} must be a tensor, got {type(value).__name__}")
    if value.layout is not torch.strided or value.is_nested or value.is_quantized:
        kind = "nested" if value.is_nested else "quantized" if value.is_quantized else str(value.layout)
        raise TypeError(f"{op}: {name} must be a dense tensor, got a {kind.removeprefix('torch.')} one")


def to_common_dtype(points: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Returns both tensors, detached, in one dtype for all backends: float64 if either is float64, else float32."""
    if points.dtype is centres.dtype is torch.float32 and not (points.requires_grad or centres.requires_grad):
        return points, centres
    dtype = torch.promote_types(torch.promote_types(points.dtype, centres.dtype), torch.float32)
    return points.detach().to(dtype), centres.detach().to(dtype)


def check_shape(
    op: str, name: str, tensor: Tensor, shape: Sequence[int | str], sizes: dict[str, int] | None = None
) -> None:
    """Checks a tensor against a shape such as ``("n", 3)`` or ``("k+1",)``.

    Args:
        op: the operation's name, for the error.
        name: the argument's name, for the error.
        tensor: the tensor to check.
        shape: for every dimension a number, a letter, or a letter plus one.
        sizes: the numbers that letters are bound to; unbound letters are added.

    Raises:
        TypeError: ``tensor`` is not a tensor.
        ValueError: ``tensor`` has another shape, or more rows than an int32 can number.
    """
    check_tensor(op, name, tensor)
    bound = {} if sizes is None else sizes
    bound_before, actual = len(bound), tensor.shape
    fits = len(actual) == len(shape)
    if fits:
        # Each size is read once: a few dozen checks take as long as a small network.
        for entry, size in zip(shape, actual):
            if isinstance(entry, int):
                fits = size == entry
            elif entry in bound:
                fits = size == bound[entry]
            elif entry[-2:] == "+1":
                fits = size >= 1 and size - 1 == bound.setdefault(entry[:-2], size - 1)
                if size > MAX_GROUPS + 1:
                    raise ValueError(f"{op}: {name} must have at most {MAX_GROUPS + 1} entries, got {size}")
            else:
                bound[entry] = size
            if not fits:
                break
    if not fits:
        # The text is built only after a failed check, because torch.compile cannot format a symbolic size.
        entries = [str(entry) for entry in shape]
        letters = dict.fromkeys(entry.removesuffix("+1") for entry in entries)
        values = ", ".join(f"{letter} = {bound[letter]}" for letter in letters if letter in list(bound)[:bound_before])
        rule = f"[{', '.join(entries)}]" + (f" with {values}" if values else "")
        raise ValueError(f"{op}: {name} must have shape {rule}, got {list(tensor.shape)}")
    if actual and actual[0] > MAX_COUNT:
        check_count(op, name, actual[0])


def check_dtype(op: str, name: str, tensor: Tensor, dtypes: Sequence[torch.dtype] = FLOATING) -> None:
    """Raises TypeError unless the tensor's dtype is one of ``dtypes``."""
    if not isinstance(tensor, Tensor) or tensor.dtype not in dtypes:
        check_tensor(op, name, tensor)
        names = [_short(dtype) for dtype in dtypes]
        rule = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
        raise TypeError(f"{op}: {name} must have dtype {rule}, got {_short(tensor.dtype)}")


def check_same_dtype(op: str, **tensors: Tensor | None) -> None:
    """Raises TypeError unless all named tensors share the dtype of the first; None is skipped."""
    first: tuple[str, torch.dtype] | None = None
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if first is None:
            first = (name, tensor.dtype)
        elif tensor.dtype != first[1]:
            raise TypeError(
                f"{op}: {name} must have the dtype of {first[0]}, {_short(first[1])}, got {_short(tensor.dtype)}"
            )


def check_same_device(op: str, **tensors: Tensor | None) -> None:
    """Raises ValueError unless all named tensors are on the device of the first; None is skipped."""
    first: tuple[str, torch.device] | None = None
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if first is None:
            first = (name, tensor.device)
        elif tensor.device != first[1]:
            raise ValueError(f"{op}: {name} must be on the device of {first[0]}, {first[1]}, got {tensor.device}")


class Checked:
    """The tensors of one call, checked one after another.

    Args:
        op: the operation's name, for errors.

    Attributes:
        sizes: the numbers that the letters of the shapes are bound to.
        tensors: the checked tensors, by name.
    """

    def __init__(self, op: str) -> None:
        self.op = op
        self.sizes: dict[str, int] = {}
        self.tensors: dict[str, Tensor] = {}
        self._device: torch.device | None = None
        self._float: tuple[str, Tensor] | None = None

    def tensor(self, name: str, tensor: Tensor, dtypes: Sequence[torch.dtype], *shape: int | str) -> None:
        """Checks a tensor's shape and dtype, its device (the first tensor's), and that an int32 can number its rows.

        Args:
            name: the argument's name.
            tensor: the argument's value.
            dtypes: the allowed dtypes; `LIKE_FIRST` for the dtype of the first floating-point tensor.
            shape: the shape's entries, see `check_shape`.

        Raises:
            TypeError: ``tensor`` is not a tensor, or has another dtype.
            ValueError: ``tensor`` has another shape or device, or too many rows.
        """
        check_shape(self.op, name, tensor, shape, self.sizes)
        dtype = tensor.dtype
        if not dtypes and self._float is not None:
            if dtype != self._float[1].dtype:
                check_same_dtype(self.op, **{self._float[0]: self._float[1], name: tensor})
        elif dtype not in dtypes:
            check_dtype(self.op, name, tensor, dtypes)
        if self._float is None and dtype in FLOATING:
            self._float = name, tensor
        if self._device is None:
            self._device = tensor.device
        elif tensor.device != self._device:
            check_same_device(self.op, **self.tensors, **{name: tensor})
        self.tensors[name] = tensor

    def first_float(self) -> Tensor:
        """Returns the first floating-point tensor."""
        assert self._float is not None
        return self._float[1]

    def no_inference(self) -> None:
        """Runs `check_no_inference` on all tensors."""
        if torch.is_grad_enabled() and not torch.compiler.is_compiling():
            for tensor in self.tensors.values():
                if tensor.is_inference():
                    check_no_inference(self.op, **self.tensors)


class TensorRule(NamedTuple):
    """The rule of a tensor: the arguments of `Checked.tensor`.

    Attributes:
        name: the tensor's name, for errors.
        dtypes: the allowed dtypes.
        shape: the numbers and letters of the shape; "1|k" is 1 or the letter.
        like: the name of a tensor with the same dtype, if the error should name it; else "".
        empty: the rule that the error states if the tensor has no rows; "" if the tensor may be empty.
    """

    name: str
    dtypes: Sequence[torch.dtype]
    shape: tuple[int | str, ...]
    like: str = ""
    empty: str = ""


class Default(NamedTuple):
    """The default number of a letter that no earlier tensor has bound."""

    letter: str
    number: int


TensorRules = Sequence[TensorRule | Default]
Others = tuple[Sequence[TensorRule], Sequence[Any]]
"""Additional rows, and one tensor for each row."""


def check_rules(
    op: str, make: Callable[..., TensorRules], tensors: list[Any], *arguments: Any, smooth: bool = True
) -> dict[str, int]:
    """Checks each tensor against one row of a table; the number of rows depends on the network.

    The compiled module reads the rows once and then checks all tensors of the network. If a tensor breaks a rule,
    Python repeats the check and raises the error.

    Args:
        op: the operation's name, for errors.
        make: the function that returns the rows.
        tensors: one tensor for each row.
        arguments: the arguments of ``make``; they must be hashable.
        smooth: whether autograd saves the tensors; if so, inference tensors are refused.

    Returns:
        The number of each letter; 0 for an unbound letter.

    Raises:
        TypeError: an argument is not a tensor, or has another dtype.
        ValueError: a tensor has another shape or device, or too many rows.
    """
    if not torch.compiler.is_dynamo_compiling():
        letters, compiled = _compiled(make, *arguments)
        numbers = compiled(tensors)
        if numbers is not None:
            return dict(zip(letters, numbers))
    checked, by_name, remaining, rows = Checked(op), {}, iter(tensors), make(*arguments)
    for row in rows:
        if isinstance(row, Default):
            checked.sizes.setdefault(row.letter, row.number)
            continue
        tensor = by_name[row.name] = next(remaining)
        shape = row.shape
        if shape and isinstance(shape[0], str) and shape[0].startswith("1|"):
            check_tensor(op, row.name, tensor)
            shape = (1 if tensor.shape[:1] == (1,) else shape[0].removeprefix("1|"), *shape[1:])
        if row.like:
            check_shape(op, row.name, tensor, shape, checked.sizes)
            check_same_dtype(op, **{row.like: by_name[row.like], row.name: tensor})
        checked.tensor(row.name, tensor, row.dtypes, *shape)
        if row.empty and tensor.shape[0] < 1 + str(shape[0]).endswith("+1"):
            raise ValueError(f"{op}: {row.name} {row.empty}, got {list(tensor.shape)}")
    if smooth:
        checked.no_inference()
    return {**dict.fromkeys(_letters(rows), 0), **checked.sizes}


@functools.lru_cache(maxsize=4096)
def _compiled(make: Callable[..., TensorRules], *arguments: Any) -> tuple[list[str], Callable[[list[Any]], Any]]:
    """Returns the letters of the rows, and a compiled function.

    The function returns the sizes of the letters for tensors, or None if a tensor breaks a rule.
    """
    rows = make(*arguments)
    letters = _letters(rows)
    native = backends.compiled()
    if native is None:
        return letters, lambda tensors: None
    rules: list[Any] = []
    for row in rows:
        rules.append(
            row
            if isinstance(row, Default)
            else ([_short(dtype) for dtype in row.dtypes], "filled" if row.empty else "", row.shape, None)
        )
    return letters, native.TensorRules([tuple(row) for row in rules], letters)


def alike(lists: Sequence[Any], written: Sequence[bool], scalars: list[Any]) -> bool:
    """Returns whether several lists of tensors match, so that the compiled module can work on them.

    The tensors at one index of the lists must have one shape. All tensors, and ``scalars`` of shape [], must be float32
    and on one device, and tensors of the ``written`` lists must be contiguous. The result is also False if only
    Python can check the tensors.
    """
    native = None if torch.compiler.is_dynamo_compiling() else backends.compiled()
    return native is not None and native.alike(lists, written, scalars)


def _letters(rows: TensorRules) -> list[str]:
    shapes = [[row.letter] if isinstance(row, Default) else row.shape for row in rows]
    entries = [entry for shape in shapes for entry in shape if isinstance(entry, str)]
    return [*dict.fromkeys(entry.removesuffix("+1").removeprefix("1|") for entry in entries)]


def check_writable(op: str, name: str, tensor: Tensor) -> None:
    """Raises ValueError unless an op can write into a tensor's memory: a contiguous tensor without the negative bit.

    The memory of a tensor with the negative bit, such as ``x.conj().imag``, holds negated values.
    """
    if not tensor.is_contiguous():
        raise ValueError(f"{op}: {name} must be contiguous, got strides {tensor.stride()}")
    if not torch.compiler.is_compiling() and tensor.is_neg():  # is_neg cannot be traced
        raise ValueError(f"{op}: {name} must not be a negative view: clone it")


def check_no_inference(op: str, **tensors: Tensor | None) -> None:
    """Raises TypeError if autograd records and a named tensor is an inference tensor, which autograd cannot save."""
    if not torch.is_grad_enabled() or torch.compiler.is_compiling():
        return
    present = [(name, tensor) for name, tensor in tensors.items() if tensor is not None]
    if any(tensor.requires_grad for _, tensor in present):
        for name, tensor in present:
            if tensor.is_inference():
                raise TypeError(f"{op}: {name} must not be an inference tensor while gradients are recorded: clone it")


def check_count(op: str, name: str, count: int) -> None:
    """Raises ValueError when a batch has more rows than an int32 index can number."""
    if count > MAX_COUNT:
        raise ValueError(f"{op}: {name} must have fewer than 2**31 rows, got {count}: split the batch")


def check_range(op: str, name: str, index: Tensor, count: int) -> None:
    """Raises ValueError for an index on the CPU outside 0 to ``count - 1``.

    Indices on a GPU are not checked, since reading them would synchronise, nor are indices while ``torch.compile``
    traces.
    """
    if index.device.type != "cpu" or index.numel() == 0 or torch.compiler.is_compiling():
        return
    low, high = (int(bound) for bound in index.aminmax())
    if low < 0 or high >= count:
        raise ValueError(f"{op}: {name} must lie in 0 to {count - 1}, got values from {low} to {high}")


def check_integer(op: str, name: str, value: int, minimum: int, maximum: int = MAX_COUNT) -> None:
    """Raises TypeError unless ``value`` is an int, ValueError when it is below ``minimum`` or above ``maximum``."""
    if isinstance(value, bool) or not isinstance(value, (int, torch.SymInt)):
        raise TypeError(f"{op}: {name} must be an integer, got {type(value).__name__}")
    if value < minimum:
        raise ValueError(f"{op}: {name} must be at least {minimum}, got {value}")
    if value > maximum:
        raise ValueError(f"{op}: {name} must be at most {maximum}, got {value}")


def check_number(op: str, name: str, value: float) -> None:
    """Raises TypeError unless ``value`` is a number, ValueError for an integer that overflows a float."""
    if isinstance(value, bool) or not isinstance(value, (int, float, torch.SymFloat, torch.SymInt)):
        raise TypeError(f"{op}: {name} must be a number, got {type(value).__name__}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"{op}: {name} must be at most {sys.float_info.max:.2g}, got a larger integer")


def check_positive(op: str, name: str, value: float) -> None:
    """Runs `check_number`, and raises ValueError unless ``value`` is above 0."""
    check_number(op, name, value)
    if not value > 0:
        raise ValueError(f"{op}: {name} must be positive, got {value}")


def check_interval(op: str, name: str, value: float, low: float, high: float, rule: str) -> None:
    """Runs `check_number`, and raises ValueError for a value outside an interval; ``rule`` is "[0, 1)" or "0 to 1"."""
    check_number(op, name, value)
    if not (low <= value < high or (value == high and not rule.endswith(")"))):
        raise ValueError(f"{op}: {name} must lie in {rule}, got {value}")


def check_kind(op: str, name: str, value: object, kind: type) -> None:
    """Raises TypeError unless ``value`` is an instance of a class of this library.

    Raises ValueError for a named tuple with fewer entries than its class, as ``tuple.__new__`` makes it.
    """
    article = "" if kind.__name__.endswith("s") else "an " if kind.__name__[0] in "AEIOM" else "a "
    if not isinstance(value, kind):
        raise TypeError(f"{op}: {name} must be {article}{kind.__name__}, got {type(value).__name__}")
    fields = getattr(kind, "_fields", ())
    if fields and isinstance(value, tuple) and len(value) != len(fields):
        raise ValueError(
            f"{op}: {name} must have the {len(fields)} entries of {article}{kind.__name__}, got {len(value)}"
        )


def check_flag(op: str, name: str, value: bool) -> None:
    """Raises TypeError unless ``value`` is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{op}: {name} must be True or False, got {type(value).__name__}")


def check_choice(op: str, name: str, value: object, choices: Sequence[str]) -> None:
    """Raises ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{op}: {name} must be one of {', '.join(choices)}, got {value!r:.60}")


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def physical_memory() -> int:
    """Returns the bytes of this machine's memory, or the process's limit (``ulimit -v``) if it is lower.

    On Windows, where Python cannot tell, it returns ``sys.maxsize``, so that no size is refused.
    """
    if not hasattr(os, "sysconf"):
        return sys.maxsize
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        import resource
    except ImportError:  # not on POSIX
        return installed
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return installed if limit == resource.RLIM_INFINITY else min(installed, limit)


def available_memory() -> int:
    """Returns the bytes that this process can still allocate, given the free memory and its container's limit."""
    free = physical_memory()
    with contextlib.suppress(OSError, ValueError):
        match = re.search(r"^MemAvailable: +(\d+) kB$", Path("/proc/meminfo").read_text(), re.MULTILINE)
        free = int(match[1]) * 1024 if match else free
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")  # cgroup v2, as seen from inside a container; memory.max may be "max"
        free = min(free, int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return max(free, 0)
