"""Validators shared by every public operation.

A validator raises an error of one form, "operation: argument must <rule>, got <value>": ValueError for shapes and
values, TypeError for dtypes and types. Validators check shapes, dtypes and devices; ``check_range`` also checks indices
on the CPU. No other element of a tensor is read, so that ``torch.compile`` can trace an operation and a CUDA graph can
capture it.

The tensors of a call are checked against rules (`TensorRule`). The compiled module checks them, and raises the error
(csrc/bindings/tensor_rules.h). `fit` does so while torch's compiler traces, and without the compiled module.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends

FLOATING = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
INDEX = (torch.int32,)
LIKE_FIRST: tuple[torch.dtype, ...] = ()
"""A placeholder in `TensorRule.dtypes` for the dtype of the first floating-point tensor."""
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


def dtype_under_autocast(dtype: torch.dtype, tensor: Tensor) -> torch.dtype:
    """Returns the dtype in which layers of a dtype run: autocast's on the device of a tensor, except for float64."""
    kind = "cpu" if tensor.is_cpu else tensor.device.type  # reading `type` makes a text, which takes longer
    if torch.is_autocast_enabled(kind) and dtype is not torch.float64:
        return torch.get_autocast_dtype(kind)
    return dtype


def facts(op: str, name: str, tensor: Any) -> tuple[Any, ...]:
    """Returns the shape, strides and dtype of a dense tensor, and the type and index of its device.

    The compiled module checks these facts if torch gives no view of the tensor, for example of a subclass.
    """
    check_tensor(op, name, tensor)
    device = tensor.device
    return tensor.shape, tensor.stride(), tensor.dtype, device.type, device.index or 0


class TensorRule(NamedTuple):
    """The rule of a tensor: its dtypes and shape. All tensors of a call are on one device.

    A letter of a shape is bound at its first use, and means the same number in all tensors of a call.

    Attributes:
        name: the tensor's name, for errors.
        dtypes: the allowed dtypes; `LIKE_FIRST` for the dtype of the first floating-point tensor.
        shape: the numbers and letters of the shape; "k+1" is a letter plus one, "1|k" is 1 or the letter.
        like: the name of a tensor with the same dtype, if the error should name it; else "".
        empty: the rule that the error states if the tensor has no rows; "" if the tensor may be empty.
        wide: whether the dtype of the first floating-point tensor is promoted to at least float32.
        otherwise: the second of two possible shapes, or ().
        condition: the argument that is None if the tensor has the second shape. "" if either shape fits; the two shapes
            then differ in the number of dimensions.
        small: whether the number of elements must fit an int32; else only the number of rows must.
        written: whether an op writes into the tensor's memory, which must then be contiguous and not negated.
    """

    name: str
    dtypes: Sequence[torch.dtype]
    shape: tuple[int | str, ...]
    like: str = ""
    empty: str = ""
    wide: bool = False
    otherwise: tuple[int | str, ...] = ()
    condition: str = ""
    small: bool = False
    written: bool = False

    @property
    def either(self) -> bool:
        """Returns whether the tensor may have either of two shapes."""
        return bool(self.otherwise) and not self.condition


class Default(NamedTuple):
    """The default number of a letter that no earlier tensor has bound."""

    letter: str
    number: int


TensorRules = Sequence[TensorRule | Default]
Others = tuple[Sequence[TensorRule], Sequence[Any]]
"""Additional rules, and one tensor for each rule."""


def check_rules(
    op: str, make: Callable[..., TensorRules], tensors: list[Any], *arguments: Any, smooth: bool = True
) -> dict[str, int]:
    """Checks a list of tensors, such as the tensors of a network, against a list of rules.

    The compiled module reads the rules once for the same ``arguments``, and checks all tensors in one call.

    Args:
        op: the operation's name, for errors.
        make: the function that returns the rules.
        tensors: one tensor for each `TensorRule`, in order.
        arguments: the arguments of ``make``; they must be hashable.
        smooth: whether autograd saves the tensors; if so, inference tensors are refused.

    Returns:
        The number of each letter.

    Raises:
        TypeError: an argument is not a tensor, or has another dtype.
        ValueError: a tensor has another shape or device, or too many rows.
    """
    if not torch.compiler.is_dynamo_compiling() and backends.compiled() is not None:
        found: dict[str, int] | None = _compiled(make, *arguments)(op, tensors, smooth)
        if found is not None:
            return found
    remaining = iter(tensors)
    sizes: dict[str, int] = {}
    others: list[Tensor] = []
    for row in make(*arguments):
        if isinstance(row, Default):
            sizes.setdefault(row.letter, row.number)
        else:
            fit(op, row, next(remaining), sizes, others)
    return sizes


@functools.lru_cache(maxsize=4096)
def _compiled(make: Callable[..., TensorRules], *arguments: Any) -> Any:
    """Returns a compiled function that checks tensors: (op's name, tensors, ``smooth``) -> the letters' sizes."""
    return backends.compiled().TensorRules(make(*arguments))


def fit(
    op: str, rule: TensorRule, tensor: Any, sizes: dict[str, int], others: list[Tensor], second: bool = False
) -> None:
    """Checks a tensor in Python. Unlike the compiled module, it does not tell which part of the rule is broken.

    Args:
        op: the operation's name, for the error.
        rule: the rule.
        tensor: the tensor.
        sizes: the numbers that letters are bound to; unbound letters are added.
        others: the tensors of the call that have been checked; the tensor is added.
        second: whether the tensor has the rule's second shape.
    """
    check_tensor(op, rule.name, tensor)
    shape, dtypes, known = rule.shape, rule.dtypes, dict(sizes)
    if (second and rule.otherwise) or (rule.either and tensor.dim() != len(shape)):
        shape = rule.otherwise
    if not dtypes:
        first = [other.dtype for other in others if other.dtype in FLOATING][0]  # noqa: RUF015  # next cannot be traced
        dtypes = (torch.promote_types(first, torch.float32) if rule.wide else first,)
    right_dtype = tensor.dtype in dtypes
    fits = right_dtype and len(tensor.shape) == len(shape) and all(t.device == tensor.device for t in others[:1])
    for entry, size in zip(shape, tensor.shape):
        if not fits:
            break
        if isinstance(entry, int):
            fits = size == entry
        elif entry[:2] != "1|" or size != 1:
            letter, less = entry.removeprefix("1|").removesuffix("+1"), int(entry[-2:] == "+1")
            fits = less <= size and size - less == sizes.setdefault(letter, size - less)
            fits = fits and (not less or size <= MAX_GROUPS + 1)
    if fits and shape:
        fits = (tensor.numel() if rule.small else tensor.shape[0]) <= MAX_COUNT
        fits = fits and (not rule.empty or tensor.shape[0] > int(str(shape[0]).endswith("+1")))
    if not fits or (rule.written and not tensor.is_contiguous()):
        values = ", ".join(f"{letter} = {number}" for letter, number in known.items())
        text = f"{'|'.join(map(short, dtypes))} [{', '.join(map(str, shape))}]" + (f" with {values}" if values else "")
        text += f" on {others[0].device}" if others else ""
        actual = f"{short(tensor.dtype)} {list(tensor.shape)} on {tensor.device}"
        raise (ValueError if right_dtype else TypeError)(f"{op}: {rule.name} must be {text}, got {actual}")
    others.append(tensor)


def check_shape(
    op: str, name: str, tensor: Any, shape: Sequence[int | str], sizes: Mapping[str, int] | None = None
) -> None:
    """Runs `check_rules` on the shape of one tensor; ``sizes`` are the numbers of letters."""
    check_tensor(op, name, tensor)
    rule = TensorRule(name, (tensor.dtype,), tuple(shape))
    check_rules(op, _one_rule, [tensor], rule, tuple((sizes or {}).items()))


def _one_rule(rule: TensorRule, sizes: Sequence[tuple[str, int]]) -> TensorRules:
    return [*(Default(*size) for size in sizes), rule]


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


def check_number(op: str, name: str, value: float, rule: str = "", ends: Sequence[float] = ()) -> None:
    """Raises TypeError unless ``value`` is a number, ValueError if it overflows a float or breaks a rule.

    The rule is "positive", "" or an interval such as "[0, 1)" or "0 to 1", whose ends are ``ends``.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, torch.SymFloat, torch.SymInt)):
        raise TypeError(f"{op}: {name} must be a number, got {type(value).__name__}")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"{op}: {name} must be at most {sys.float_info.max:.2g}, got a larger integer")
    if rule == "positive" and not value > 0:
        raise ValueError(f"{op}: {name} must be positive, got {value}")
    if ends and not (ends[0] <= value < ends[1] or (value == ends[1] and not rule.endswith(")"))):
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


def short(dtype: torch.dtype) -> str:
    """Returns the name of a dtype without its module."""
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
