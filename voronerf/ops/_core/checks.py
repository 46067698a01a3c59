"""Validators shared by every public operation.

Each raises at once with a message of one form, "operation: argument must <rule>, got <what came>": ValueError for
shapes and values, TypeError for dtypes and kinds. Only shapes, dtypes and devices are checked, and by ``check_range``
indices on the CPU. No other element of a tensor is read, so that an operation can be traced by ``torch.compile`` and
captured in a CUDA graph.

Dimension letters in a rule ("n", "k+1") bind at their first use. Passing the same ``sizes`` dictionary to several
checks makes a letter mean the same number in all of them.
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
"""For `Checked`: the dtype of the first floating-point tensor."""
MAX_COUNT = 2**31 - 1
"""Rows of one call: index tensors are int32."""
MAX_GROUPS = 2**27
"""Cells or rays that offsets speak of."""


def check_tensor(op: str, name: str, value: object) -> None:
    """Raises TypeError unless ``value`` is a tensor whose elements lie at strides: not sparse, nested or quantized."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{op}: {name} must be a tensor, got {type(value).__name__}")
    if value.layout is not torch.strided or value.is_nested or value.is_quantized:
        kind = "nested" if value.is_nested else "quantized" if value.is_quantized else str(value.layout)
        raise TypeError(f"{op}: {name} must be a dense tensor, got a {kind.removeprefix('torch.')} one")


def of_one_dtype(points: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """What is compared, in one type for all backends: float64 where either is, float32 otherwise."""
    if points.dtype is centres.dtype is torch.float32 and not (points.requires_grad or centres.requires_grad):
        return points, centres
    dtype = torch.promote_types(torch.promote_types(points.dtype, centres.dtype), torch.float32)
    return points.detach().to(dtype), centres.detach().to(dtype)


def check_shape(
    op: str, name: str, tensor: Tensor, shape: Sequence[int | str], sizes: dict[str, int] | None = None
) -> None:
    """Checks a tensor against a shape such as ``("n", 3)`` or ``("k+1",)``.

    Args:
        op: operation named in the error.
        name: argument named in the error.
        tensor: what to check; anything but a tensor is a TypeError.
        shape: a number, a letter, or a letter plus one, for every dimension.
        sizes: what the letters are bound to so far; letters met for the first time are added.

    Raises:
        TypeError: not a tensor.
        ValueError: another shape, or more rows than an int32 can number.
    """
    check_tensor(op, name, tensor)
    known = {} if sizes is None else sizes
    before, came = len(known), tensor.shape
    fits = len(came) == len(shape)
    if fits:
        # Each size is read once: a small network takes no longer than a few dozen checks.
        for entry, size in zip(shape, came):
            if isinstance(entry, int):
                fits = size == entry
            elif entry in known:
                fits = size == known[entry]
            elif entry[-2:] == "+1":
                fits = size >= 1 and size - 1 == known.setdefault(entry[:-2], size - 1)
                if size > MAX_GROUPS + 1:
                    raise ValueError(f"{op}: {name} must have at most {MAX_GROUPS + 1} entries, got {size}")
            else:
                known[entry] = size
            if not fits:
                break
    if not fits:
        # Only in case of an error, because torch.compile cannot turn a symbolic size into text.
        wanted = [str(entry) for entry in shape]
        letters = dict.fromkeys(entry.removesuffix("+1") for entry in wanted)
        values = ", ".join(f"{letter} = {known[letter]}" for letter in letters if letter in list(known)[:before])
        rule = f"[{', '.join(wanted)}]" + (f" with {values}" if values else "")
        raise ValueError(f"{op}: {name} must have shape {rule}, got {list(tensor.shape)}")
    if came and came[0] > MAX_COUNT:
        check_count(op, name, came[0])


def check_dtype(op: str, name: str, tensor: Tensor, dtypes: Sequence[torch.dtype] = FLOATING) -> None:
    """Raises TypeError unless the tensor's dtype is one of ``dtypes``."""
    if not isinstance(tensor, Tensor) or tensor.dtype not in dtypes:
        check_tensor(op, name, tensor)
        names = [_short(dtype) for dtype in dtypes]
        rule = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
        raise TypeError(f"{op}: {name} must have dtype {rule}, got {_short(tensor.dtype)}")


def check_same_dtype(op: str, **tensors: Tensor | None) -> None:
    """Raises TypeError unless all named tensors (None is passed over) share the dtype of the first."""
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
    """Raises ValueError unless all named tensors (None is passed over) are on the device of the first."""
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
        op: operation named in errors.

    Attributes:
        sizes: what the letters of the shapes stand for.
        tensors: those that are there, by name.
    """

    def __init__(self, op: str) -> None:
        self.op = op
        self.sizes: dict[str, int] = {}
        self.tensors: dict[str, Tensor] = {}
        self._device: torch.device | None = None
        self._float: tuple[str, Tensor] | None = None

    def tensor(self, name: str, tensor: Tensor, dtypes: Sequence[torch.dtype], *shape: int | str) -> None:
        """Checks shape, dtype, that it is on the device of the first tensor, and that an int32 can number its rows.

        Args:
            name: of the argument.
            tensor: its value; anything but a tensor is a TypeError.
            dtypes: what it may have; `LIKE_FIRST` for that of the first floating-point tensor.
            shape: as in `check_shape`.

        Raises:
            TypeError: not a tensor, another dtype.
            ValueError: another shape or device, too many rows.
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
        """The first floating-point tensor."""
        assert self._float is not None
        return self._float[1]

    def no_inference(self) -> None:
        """`check_no_inference` of all tensors."""
        if torch.is_grad_enabled() and not torch.compiler.is_compiling():
            for tensor in self.tensors.values():
                if tensor.is_inference():
                    check_no_inference(self.op, **self.tensors)


class Row(NamedTuple):
    """The rule of a tensor, as `Checked.tensor` has it.

    Attributes:
        name: in errors.
        dtypes: that it may have.
        shape: of numbers and letters; "1|k" is 1 or the letter.
        like: the tensor whose dtype it must have, where an error is to name that.
        empty: what an error says where the letter of its rows is 0; without it that may be.
    """

    name: str
    dtypes: Sequence[torch.dtype]
    shape: tuple[int | str, ...]
    like: str = ""
    empty: str = ""


class Default(NamedTuple):
    """The number of a letter that no tensor before has bound."""

    letter: str
    number: int


Rows = Sequence[Row | Default]
Others = tuple[Sequence[Row], Sequence[Any]]
"""Rows, and as many tensors."""


def check_rows(
    op: str, make: Callable[..., Rows], tensors: list[Any], *given: Any, smooth: bool = True
) -> dict[str, int]:
    """Checks tensors by the rows of a table: those of a network, which tells how many there are.

    The compiled module reads the rows once, and checks all later tensors of the network by itself. Where one breaks a
    rule, Python says which.

    Args:
        op: operation named in errors.
        make: gives the rows of the tensors.
        tensors: one for each row.
        given: the arguments of ``make``, which are hashed.
        smooth: whether autograd keeps the tensors, which it cannot of inference tensors.

    Returns:
        What the letters stand for; 0 for one that no tensor has bound.

    Raises:
        TypeError: not a tensor, another dtype.
        ValueError: another shape or device, too many rows.
    """
    if not torch.compiler.is_dynamo_compiling():
        letters, compiled = _compiled(make, *given)
        found = compiled(tensors)
        if found is not None:
            return dict(zip(letters, found))
    checked, by_name, there, rows = Checked(op), {}, iter(tensors), make(*given)
    for row in rows:
        if isinstance(row, Default):
            checked.sizes.setdefault(row.letter, row.number)
            continue
        tensor = by_name[row.name] = next(there)
        shape = row.shape
        if shape and isinstance(shape[0], str) and shape[0].startswith("1|"):
            check_tensor(op, row.name, tensor)
            shape = (1 if tensor.shape[:1] == (1,) else shape[0].removeprefix("1|"), *shape[1:])
        if row.like:
            check_shape(op, row.name, tensor, shape, checked.sizes)
            check_same_dtype(op, **{row.like: by_name[row.like], row.name: tensor})
        checked.tensor(row.name, tensor, row.dtypes, *shape)
        if row.empty and checked.sizes[str(shape[0]).removesuffix("+1")] < 1:
            raise ValueError(f"{op}: {row.name} {row.empty}, got {list(tensor.shape)}")
    if smooth:
        checked.no_inference()
    return {**dict.fromkeys(_letters(rows), 0), **checked.sizes}


@functools.lru_cache(maxsize=4096)
def _compiled(make: Callable[..., Rows], *given: Any) -> tuple[list[str], Callable[[list[Any]], Any]]:
    """The letters of rows, and what checks tensors by them in the compiled module, or gives None."""
    rows = make(*given)
    letters = _letters(rows)
    native = backends.compiled()
    if native is None:
        return letters, lambda tensors: None
    told: list[Any] = []
    for row in rows:
        told.append(
            row
            if isinstance(row, Default)
            else ([_short(dtype) for dtype in row.dtypes], "filled" if row.empty else "", row.shape, None)
        )
    return letters, native.Rules([tuple(row) for row in told], letters)


def alike(lists: Sequence[Any], written: Sequence[bool], scalars: list[Any]) -> bool:
    """Whether tensors at one place of several lists have one shape, all are float32 and on one device, those of lists
    that are written lie in order, and scalars are tensors [] like them. False also where only Python can tell."""
    native = None if torch.compiler.is_dynamo_compiling() else backends.compiled()
    return native is not None and native.alike(lists, written, scalars)


def _letters(rows: Rows) -> list[str]:
    shapes = [[row.letter] if isinstance(row, Default) else row.shape for row in rows]
    entries = [entry for shape in shapes for entry in shape if isinstance(entry, str)]
    return [*dict.fromkeys(entry.removesuffix("+1").removeprefix("1|") for entry in entries)]


def check_writable(op: str, name: str, tensor: Tensor) -> None:
    """Raises ValueError unless memory holds a tensor's values in order and as they are, so that an op can write there.

    The negative bit, of ``x.conj().imag``, says that memory holds them negated.
    """
    if not tensor.is_contiguous():
        raise ValueError(f"{op}: {name} must be contiguous, got strides {tensor.stride()}")
    if not torch.compiler.is_compiling() and tensor.is_neg():  # which cannot be traced
        raise ValueError(f"{op}: {name} must be a tensor of its own (clone), got a negative view")


def check_no_inference(op: str, **tensors: Tensor | None) -> None:
    """Raises TypeError where gradients are recorded and a named tensor was made in ``torch.inference_mode``, which
    autograd cannot keep."""
    if not torch.is_grad_enabled() or torch.compiler.is_compiling():
        return
    there = [(name, tensor) for name, tensor in tensors.items() if tensor is not None]
    if any(tensor.requires_grad for _, tensor in there):
        for name, tensor in there:
            if tensor.is_inference():
                raise TypeError(f"{op}: {name} must be a copy where gradients are recorded, got an inference tensor")


def check_count(op: str, name: str, count: int) -> None:
    """Raises ValueError when a batch has more rows than an int32 index can number."""
    if count > MAX_COUNT:
        raise ValueError(f"{op}: {name} must have fewer than 2**31 rows, got {count}: split the batch")


def check_range(op: str, name: str, index: Tensor, count: int) -> None:
    """Raises ValueError for an index on the CPU that is not 0 to ``count - 1``.

    Elsewhere the values are not read, since that would wait for the device, nor while ``torch.compile`` traces.
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
    """Raises TypeError unless ``value`` is a number, ValueError for an integer beyond those of floating point."""
    if isinstance(value, bool) or not isinstance(value, (int, float, torch.SymFloat, torch.SymInt)):
        raise TypeError(f"{op}: {name} must be a number, got {type(value).__name__}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"{op}: {name} must be at most {sys.float_info.max:.2g}, got an integer of more digits")


def check_positive(op: str, name: str, value: float) -> None:
    """`check_number`, and ValueError unless it is above 0."""
    check_number(op, name, value)
    if not value > 0:
        raise ValueError(f"{op}: {name} must be positive, got {value}")


def check_interval(op: str, name: str, value: float, low: float, high: float, rule: str) -> None:
    """`check_number`, and ValueError outside of an interval that ``rule`` writes, "[0, 1)" or "0 to 1"."""
    check_number(op, name, value)
    if not (low <= value < high or (value == high and not rule.endswith(")"))):
        raise ValueError(f"{op}: {name} must lie in {rule}, got {value}")


def check_kind(op: str, name: str, value: object, kind: type) -> None:
    """Raises TypeError unless ``value`` is an instance of a class of this library."""
    if not isinstance(value, kind):
        article = "" if kind.__name__.endswith("s") else "an " if kind.__name__[0] in "AEIOM" else "a "
        raise TypeError(f"{op}: {name} must be {article}{kind.__name__}, got {type(value).__name__}")


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
    """Bytes of memory of this machine, or fewer where the process may have no more (``ulimit -v``).

    On Windows, where Python does not know, it is the largest number, so that nothing is refused for its size.
    """
    if not hasattr(os, "sysconf"):
        return sys.maxsize
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        import resource
    except ImportError:  # not on POSIX
        return there
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return there if limit == resource.RLIM_INFINITY else min(there, limit)


def available_memory() -> int:
    """Bytes of memory that this process can still take: what is free, or the rest of its container's limit."""
    free = physical_memory()
    with contextlib.suppress(OSError, ValueError):
        found = re.search(r"^MemAvailable: +(\d+) kB$", Path("/proc/meminfo").read_text(), re.MULTILINE)
        free = int(found[1]) * 1024 if found else free
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")  # version 2, as a container sees its own; its limit may be the word max
        free = min(free, int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return max(free, 0)
