"""Fuzzed calls of the ops: valid calls match the reference, invalid calls are refused with the argument's name."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import random
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import blocks
import numpy as np
import torch
from attempts import REFUSED, RIGHT, Failed
from hostile import NUMBERS, TEXTS
from pages import at_page_end
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from voronerf import ops
from voronerf.app.cli.program import NO_MEMORY
from voronerf.ops._core import backends, tolerances

sys.path.append(str(Path(__file__).parents[1] / "ops"))  # for cases
from cases import CASES, SIZES, Draw

DTYPES = (
    *(torch.float16, torch.float32, torch.float64, torch.bfloat16, torch.complex64),
    *(torch.int32, torch.int64, torch.uint8, torch.bool),
)
#: Ops whose reference is a loop over rays.
SLOW = ("render_opaque",)


def called(op: str) -> Callable[..., Any]:
    """Returns the public function of an op."""
    function: Callable[..., Any] = getattr(ops, CASES[op].call or op)
    return function


def valid_call(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Compares a random valid call with the reference, sometimes with gradients, seldom with up to a million rows."""
    op = rng.choice([name for name, case in CASES.items() if case.comparable])
    many = rng.random() < 0.002 and op not in SLOW
    n = int(2 ** rng.uniform(12, 20)) if many else rows(rng)
    case, call = CASES[op], CASES[op].make(Draw(rng.getrandbits(32), free=True), n)
    viewed = call if case.in_place or rng.random() < 0.8 else tree_map(negated, call)
    compare(op, call, viewed, gradients=case.differentiable and rng.random() < 0.3)
    return RIGHT


def rows(rng: random.Random) -> int:
    """Draws a number of rows: few rows, or a number around the block size of a kernel."""
    return rng.choice(SIZES if rng.random() < 0.8 else blocks.sizes(4200))


def compare(op: str, call: dict[str, Any], viewed: dict[str, Any], *, gradients: bool) -> None:
    """Fails if the call ``viewed`` (the same values, maybe as views) differs from the reference."""
    found, slopes = results(op, viewed, "auto", gradients)
    expected, others = results(op, call, "reference", gradients)
    wide = functools.cache(lambda: results(op, tree_map(widened, call), "reference", gradients))
    for place, (part, other) in enumerate(zip(found, expected, strict=True)):
        if tolerances.agree(part, other) or (not CASES[op].in_place and nearer(part, other, wide()[0][place])):
            continue
        raise Failed(f"{op}: differs from the reference: {difference(part, other)}; {describe(call)}")
    if tolerances.agree_gradients(slopes, others):
        return
    near = (tolerances.agree_gradients([s], [o]) or nearer(s, o, w) for s, o, w in zip(slopes, others, wide()[1]))
    if not all(near):
        apart = ", ".join(difference(part, other) for part, other in zip(slopes, others, strict=True))
        raise Failed(f"{op}: gradients differ from the reference's: {apart}; {describe(call)}")


def nearer(part: Tensor, other: Tensor, exact: Tensor) -> bool:
    """Returns whether `part` is at least as close to the float64 result `exact` as the reference's result `other`.

    The reference's float32 result may have lost digits to cancellation.
    """
    if part.shape != other.shape:
        return False
    far, near = ((each.double() - exact).norm(torch.inf) for each in (other, part))
    return bool(near <= far)


def widened(value: Any) -> Any:
    """Converts floating-point tensors to float64."""
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def negated(value: Any) -> Any:
    """Returns the same values as views with the negative bit, as in ``.conj().imag``."""
    return torch._neg_view(-value) if isinstance(value, Tensor) and value.is_floating_point() else value


def results(op: str, call: dict[str, Any], backend: str, gradients: bool) -> tuple[list[Tensor], list[Tensor]]:
    """Returns an op's output tensors (in-place outputs too), and the gradients of their sum if `gradients` is set.

    Contiguous arguments and incoming gradients are copied to the ends of memory pages.
    """
    case = CASES[op]
    own = tree_map(lambda value: value.detach().clone() if isinstance(value, Tensor) and case.in_place else value, call)
    own = tree_map(at_page_end, own)
    leaves = []
    if gradients:

        def leaf(value: Any) -> Any:
            if not (isinstance(value, Tensor) and value.is_floating_point()) or value.is_inference():
                return value
            leaves.append(value.detach().requires_grad_())
            return leaves[-1]

        own = tree_map(leaf, own)
    returned = called(op)(**own, backend=backend)
    found = [part for part in tree_leaves((own, returned) if case.in_place else returned) if isinstance(part, Tensor)]
    smooth = [part for part in found if part.requires_grad and part.numel()]
    if not smooth:
        return found, []
    ones = [at_page_end(torch.ones_like(part)) for part in smooth]
    return found, list(torch.autograd.grad(smooth, leaves, ones, allow_unused=True, materialize_grads=True))


def invalid_call(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Runs a call with an invalid argument, or with an invalid part of an argument, on each backend of the op.

    Either all backends refuse the call with the argument's name, or none does. An accepted call and its gradients must
    not crash.
    """
    op, seed, gradients = rng.choice(list(CASES)), rng.getrandbits(32), rng.random() < 0.3
    said: dict[str, str] = {}
    for backend in (*backends.implemented(op), "auto"):
        generator = random.Random(seed)  # rebuilds the call, since an op may write into its arguments
        torch.manual_seed(seed)
        try:
            call, names = harmed_call(generator, op)
        except (ValueError, TypeError) as error:  # a struct's constructor refused it
            if "\n" in str(error) or len(str(error)) > 500:
                raise Failed(f"{op}: a struct is not refused clearly: {error}") from None
            return REFUSED
        call.setdefault("backend", backend)
        try:
            results(op, call, call.pop("backend"), gradients and CASES[op].differentiable)
            said[backend] = ""
        except backends.BackendUnavailable:
            continue
        except (ValueError, TypeError) as error:
            check_message(op, call, names, error)
            said[backend] = str(error)
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            if huge(call) and any(sign in text for sign in NO_MEMORY):
                return REFUSED
            raise Failed(f"{op} on {backend}: {names} end in {text:.300}; {describe(call)}") from None
    ignored = {"index", "centre_index"}.issuperset(names)  # only the compiled module reads an index of centres
    if "" in said.values() and any(said.values()) and not ignored:
        raise Failed(f"{op}: {names} are refused by some backends: {said}; {describe(call)}")
    return REFUSED if any(said.values()) else RIGHT


def huge(call: dict[str, Any]) -> bool:
    """Returns whether a size or a number in the arguments is so large that a call may need gigabytes."""
    sizes = [leaf.numel() if isinstance(leaf, Tensor) else leaf for leaf in tree_leaves(call)]
    return any(isinstance(size, int) and size > 2**24 for size in sizes)


def harmed_call(rng: random.Random, op: str) -> tuple[dict[str, Any], list[str]]:
    """Returns the arguments of an op, and the names of the invalid arguments."""
    case = CASES[op]
    arguments, other = (case.make(Draw(rng.getrandbits(32), free=True), rows(rng)) for _ in range(2))
    parameters = inspect.signature(called(op)).parameters.values()
    call = {each.name: arguments.get(each.name, each.default) for each in parameters if each.name != "backend"}
    names = rng.sample([*call, "backend"], rng.choice((1, 1, 1, 2)))
    for name in names:
        if name == "backend":
            call[name] = rng.choice(("", "cuda", None, 3, "Native", [], "a" * 10_000))
        elif rng.random() < 0.15:  # the argument of another call
            call[name] = other.get(name, call[name])
        elif call[name] is None:
            tensors = [part for part in tree_leaves(arguments) if isinstance(part, Tensor)]
            few = torch.tensor([rng.choice((0, 1, -1, 5, 1000, 2**31 - 1, -(2**31)))], dtype=torch.int32)
            call[name] = rng.choice((3, "x", [1.0], harmed(rng, rng.choice(tensors)), rng.choice(tensors), few))
        else:
            call[name] = harmed(rng, call[name], counted=name == "steps")
    return call, names


def check_message(op: str, call: dict[str, Any], names: list[str], error: Exception) -> None:
    """Checks that the error is one short line that names an argument and the op (or an op that the op calls)."""
    text = str(error)
    arguments = {*inspect.signature(called(op)).parameters, *named(call)}
    arguments |= {*inspect.signature(ops.routed_mlp).parameters} if "network" in call else set()
    arguments |= {argument.removesuffix("s") for argument in arguments}  # errors name a list's entry
    clear = re.match(rf"({'|'.join(backends.ops())})(: |\(\) ).*\b({'|'.join(arguments)})\b", text)
    if not clear or "\n" in text or len(text) > 500:
        raise Failed(f"{op}: the error for {names} is not clear: {type(error).__name__}: {text:.300}; {describe(call)}")


def named(value: Any) -> set[str]:
    """Returns the field names of all structs in a value, however deeply nested."""
    names = {str(key) for key, _ in parts(value)} if not isinstance(value, (list, tuple)) else set()
    names |= set(getattr(value, "_fields", ()))
    return names.union(*(named(part) for _, part in parts(value)))


def parts(value: Any) -> list[tuple[Any, Any]]:
    """Returns the (key, part) pairs of a list, dict or struct; other values have no parts."""
    if isinstance(value, (list, tuple)):
        return list(enumerate(value))
    if isinstance(value, dict):
        return list(value.items())
    if dataclasses.is_dataclass(value):
        return [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value) if field.init]
    return []


def with_part(value: Any, key: Any, part: Any) -> Any:
    """Returns a list or struct with one part replaced."""
    if dataclasses.is_dataclass(value):
        return dataclasses.replace(value, **{key: part})
    if isinstance(value, dict):
        return {**value, key: part}
    changed = [*value[:key], part, *value[key + 1 :]]
    if hasattr(value, "_make"):
        return type(value)(*changed)
    return type(value)(changed)


def harmed(rng: random.Random, value: Any, counted: bool = False) -> Any:
    """Replaces a value or a part of it by an invalid value.

    A ``counted`` value is a number of iterations, so it gets no large numbers.
    """
    inside = parts(value)
    if inside and rng.random() < 0.8:
        key, part = rng.choice(inside)
        return with_part(value, key, harmed(rng, part))
    if isinstance(value, Tensor):
        return other_tensor(rng, value)
    if isinstance(value, (list, tuple, dict)) and value and rng.random() < 0.7:
        if isinstance(value, dict):
            less = {key: part for key, part in value.items() if key != rng.choice([*value, ""])}
            return rng.choice((less, {**value, rng.choice(("more", "op", 3)): 1}))
        fewer, more = value[:-1], [*value, value[-1]]
        return rng.choice((fewer, more, (*value,), [*value], value[0], iter(value), dict(enumerate(value))))
    if isinstance(value, str):
        return rng.choice((*TEXTS, None, 3, torch.ones(2)))
    if isinstance(value, int) and not counted and rng.random() < 0.3:
        return value + rng.choice((-1, 1, 7))
    numbers = [one for one in NUMBERS if not counted or not isinstance(one, int) or one < 3]
    return rng.choice((*numbers, None, "x", True, torch.ones(2), [1], 1j, np.float32(2), float(2), {}, object()))


def other_tensor(rng: random.Random, tensor: Tensor) -> Any:
    """Returns a tensor of another kind, dtype, shape or device, or a value that is no tensor."""
    kind = rng.randrange(14)
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
        return torch.zeros([*tensor.shape[:dim], size, *tensor.shape[dim + 1 :]], dtype=tensor.dtype)
    if kind == 8:
        makers = lambda: tensor.to_sparse(), lambda: tensor.to("meta"), lambda: tensor.expand(2, *tensor.shape)
        return rng.choice(makers)()
    if kind == 9 and tensor.dim() and tensor.shape[0]:  # more rows than int32 can index, with stride 0
        rows = 2**31 - (tensor.dim() == 1 and not tensor.is_floating_point() and rng.random() < 0.5)
        return tensor[:1].expand(rows, *tensor.shape[1:])
    if kind == 10 and tensor.is_floating_point():
        extreme = rng.choice((torch.nan, torch.inf, -torch.inf, 3e38 if tensor.dtype != torch.float16 else 6e4))
        return tensor.masked_fill(torch.rand(tensor.shape) < 0.3, extreme)
    if kind <= 12 and not tensor.is_floating_point() and tensor.dtype not in (torch.bool, torch.uint8):
        extreme = rng.choice((-1, -(2**31), 2**31 - 1, 100, 7, tensor.shape[0] if tensor.dim() else 1))
        return tensor.masked_fill(torch.rand(tensor.shape) < rng.choice((0.3, 1.0)), extreme)
    with torch.inference_mode():
        return tensor.clone()


def difference(found: Tensor, expected: Tensor) -> str:
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return f"{list(found.shape)} {found.dtype} and {list(expected.shape)} {expected.dtype}"
    apart = (found.detach().double() - expected.detach().double()).abs()
    return f"up to {apart.nan_to_num(torch.inf).max().item():.3g} apart"


def describe(call: dict[str, Any]) -> str:
    """Returns the shapes and dtypes of the arguments as text."""

    def one(value: Any) -> str:
        if isinstance(value, Tensor):
            return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape) if not value.is_nested else ''}"
        return f"[{', '.join(map(one, value))}]" if isinstance(value, list) else f"{value!r:.60}"

    return ", ".join(f"{name}={one(value)}" for name, value in call.items() if value is not None)
