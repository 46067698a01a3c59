"""Fuzzed calls of the ops: a valid one gives what the reference gives, an invalid one is refused by name."""

from __future__ import annotations

import inspect
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attempts import REFUSED, RIGHT, Failed
from hostile import NUMBERS, TEXTS
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from voronerf import MLP, HashGrid, Layer, ops
from voronerf.app.cli.main import NO_MEMORY
from voronerf.ops._core import backends, tolerances
from voronerf.ops._core.cases import SIZES, Draw, cases
from voronerf.ops.grouped_mlp.case import layer_table
from voronerf.ops.hash_encode.case import hash_grid

DTYPES = (
    *(torch.float16, torch.float32, torch.float64, torch.bfloat16, torch.complex64),
    *(torch.int32, torch.int64, torch.uint8, torch.bool),
)
CASES = cases()


def called(op: str) -> Callable[..., Any]:
    """The public function of an op."""
    function: Callable[..., Any] = getattr(ops, CASES[op].call or op)
    return function


def valid_call(rng: random.Random, folder: Path, given: Path) -> str:
    """A call that keeps to the contract, with gradients now and then."""
    op = rng.choice([name for name, case in CASES.items() if case.comparable])
    case, call = CASES[op], CASES[op].make(Draw(rng.getrandbits(32), free=True), rng.choice(SIZES))
    gradients = case.differentiable and rng.random() < 0.3
    viewed = call if case.in_place or rng.random() < 0.8 else tree_map(negated, call)
    found, slopes = results(op, viewed, "auto", gradients)
    expected, others = results(op, call, "reference", gradients)
    for part, other in zip(found, expected, strict=True):
        if not tolerances.agree(part, other):
            raise Failed(f"{op}: not what the reference gives: {difference(part, other)}; {describe(call)}")
    if not tolerances.agree_gradients(slopes, others):
        apart = ", ".join(difference(part, other) for part, other in zip(slopes, others, strict=True))
        raise Failed(f"{op}: not the gradients of the reference: {apart}; {describe(call)}")
    return RIGHT


def negated(value: Any) -> Any:
    """The same values in a view with the negative bit, as ``.conj().imag`` gives."""
    return torch._neg_view(-value) if isinstance(value, Tensor) and value.is_floating_point() else value


def results(op: str, call: dict[str, Any], backend: str, gradients: bool) -> tuple[list[Tensor], list[Tensor]]:
    """The tensors that an op returns or has written into, and the gradients of their sum where they are asked for."""
    case = CASES[op]
    own = tree_map(lambda value: value.detach().clone() if isinstance(value, Tensor) and case.in_place else value, call)
    leaves = []
    if gradients:

        def leaf(value: Any) -> Any:
            if not (isinstance(value, Tensor) and value.is_floating_point()):
                return value
            leaves.append(value.detach().requires_grad_())
            return leaves[-1]

        own = tree_map(leaf, own)
    returned = called(op)(**own, backend=backend)
    found = [part for part in tree_leaves((own, returned) if case.in_place else returned) if isinstance(part, Tensor)]
    smooth = [part for part in found if part.requires_grad and part.numel()]
    if not smooth:
        return found, []
    total = sum(part.double().sum() for part in smooth)
    return found, list(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))


def invalid_call(rng: random.Random, folder: Path, given: Path) -> str:
    """A call of which one argument is not what it must be; where it is one that the op takes, nothing may break."""
    op = rng.choice(list(CASES))
    call = CASES[op].make(Draw(rng.getrandbits(32), free=True), rng.choice(SIZES[1:]))
    name = rng.choice([*call, "backend"])
    call.setdefault("backend", "auto")
    if name == "backend":
        call["backend"] = rng.choice(("", "cuda", None, 3, "warp", "Native"))
    else:
        call[name] = other_argument(rng, op, name, call[name])
    try:
        called(op)(**call)
    except (ValueError, TypeError, backends.BackendUnavailable) as error:
        check_message(op, call, name, error)
        return REFUSED
    except (RuntimeError, MemoryError) as error:
        if any(sign in str(error) for sign in NO_MEMORY) or isinstance(error, MemoryError):
            return REFUSED
        raise Failed(f"{op}: {name} is no argument for it: {type(error).__name__}: {error}; {describe(call)}") from None
    return RIGHT


def check_message(op: str, call: dict[str, Any], name: str, error: Exception) -> None:
    """The error names the op, or one that it is composed of, and an argument, in a line of some length."""
    text = str(error)
    arguments = set(inspect.signature(called(op)).parameters)
    arguments |= {argument.removesuffix("s") for argument in arguments}  # an entry of a list
    arguments |= {field for value in call.values() for field in getattr(value, "_fields", ())}
    named = re.match(rf"({'|'.join(backends.ops())})(: |\(\) ).*\b({'|'.join(arguments)})\b", text)
    if not named or "\n" in text or len(text) > 500:
        raise Failed(f"{op}: the error for {name} is not clear: {type(error).__name__}: {text:.300}; {describe(call)}")


def other_argument(rng: random.Random, op: str, name: str, value: Any) -> Any:
    """Something else in the place of an argument."""
    if isinstance(value, Tensor):
        return other_tensor(rng, value)
    if isinstance(value, list):
        kind = rng.randrange(5)
        if kind == 0:
            return value[:-1]
        if kind == 1:
            return [*value, value[-1]]
        if kind == 2:
            return rng.choice((None, value[0], "x", 3))
        at = rng.randrange(len(value))
        there = value[at] if isinstance(value[at], Tensor) else torch.ones(2)
        return [*value[:at], other_tensor(rng, there), *value[at + 1 :]]
    if isinstance(value, (MLP, HashGrid)):
        others = (
            None,
            "x",
            3,
            layer_table(Draw(rng.getrandbits(32), free=True)),
            hash_grid(Draw()),
            Layer((-1,), 3),
            {},
        )
        return rng.choice(others)
    if isinstance(value, str):
        return rng.choice((*TEXTS, None, 3, torch.ones(2)))
    if value is None:
        return rng.choice((3, "x", other_tensor(rng, torch.ones(2, 3)), [1.0]))
    # A count of steps is worked off, however large.
    numbers = [one for one in NUMBERS if name != "steps" or not isinstance(one, int) or one < 3]
    return rng.choice((*numbers, None, "x", True, torch.ones(2), [1], 1j, np.float32(2), float(2)))


def other_tensor(rng: random.Random, tensor: Tensor) -> Any:
    """A tensor of another kind, dtype, shape or place, or something that is none."""
    kind = rng.randrange(12)
    if kind == 0:
        return rng.choice((None, "x", 3, tensor.tolist(), tensor.float().numpy(), torch.float32, object()))
    if kind <= 3:
        return tensor.to(rng.choice(DTYPES))
    if kind == 4:
        return tensor[None]
    if kind == 5 and tensor.dim():
        return tensor.select(rng.randrange(tensor.dim()), 0) if min(tensor.shape) else tensor[..., None]
    if kind <= 7 and tensor.dim():
        dim = rng.randrange(tensor.dim())
        size = max(0, tensor.shape[dim] + rng.choice((-tensor.shape[dim], -1, 1, 5)))
        shape = [*tensor.shape[:dim], size, *tensor.shape[dim + 1 :]]
        return torch.zeros(shape, dtype=tensor.dtype)
    if kind == 8:
        return rng.choice(
            (lambda: tensor.to_sparse(), lambda: tensor.to("meta"), lambda: tensor.expand(2, *tensor.shape))
        )()
    if kind == 9 and tensor.is_floating_point():
        return tensor.masked_fill(
            torch.rand(tensor.shape) < 0.3,
            rng.choice((torch.nan, torch.inf, -torch.inf, 3e38 if tensor.dtype != torch.float16 else 6e4)),
        )
    if kind == 10 and not tensor.is_floating_point() and tensor.dtype not in (torch.bool, torch.uint8):
        return tensor.masked_fill(torch.rand(tensor.shape) < 0.3, rng.choice((-1, -(2**31), 2**31 - 1, 100, 7)))
    with torch.inference_mode():
        return tensor.clone()


def difference(found: Tensor, expected: Tensor) -> str:
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return f"{list(found.shape)} {found.dtype} and {list(expected.shape)} {expected.dtype}"
    apart = (found.detach().double() - expected.detach().double()).abs()
    return f"up to {apart.nan_to_num(torch.inf).max().item():.3g} apart"


def describe(call: dict[str, Any]) -> str:
    """Shapes and dtypes of the arguments."""

    def one(value: Any) -> str:
        if isinstance(value, Tensor):
            return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape) if not value.is_nested else ''}"
        return f"[{', '.join(map(one, value))}]" if isinstance(value, list) else f"{value!r:.60}"

    return ", ".join(f"{name}={one(value)}" for name, value in call.items() if value is not None)
