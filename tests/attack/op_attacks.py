"""Fuzzed calls of the ops: a valid one gives what the reference gives, an invalid one is refused by name."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import blocks
import numpy as np
import torch
from attempts import REFUSED, RIGHT, Failed
from hostile import NUMBERS, TEXTS
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from voronerf import ops
from voronerf.app.cli.program import NO_MEMORY
from voronerf.ops._core import backends, tolerances
from voronerf.ops._core.cases import SIZES, Draw, cases

DTYPES = (
    *(torch.float16, torch.float32, torch.float64, torch.bfloat16, torch.complex64),
    *(torch.int32, torch.int64, torch.uint8, torch.bool),
)
CASES = cases()
#: Ops whose reference is a loop over rays.
SLOW = ("render_opaque",)


def called(op: str) -> Callable[..., Any]:
    """The public function of an op."""
    function: Callable[..., Any] = getattr(ops, CASES[op].call or op)
    return function


def valid_call(rng: random.Random, folder: Path, given: Path) -> str:
    """A call that keeps to the contract, with gradients now and then, and seldom with up to a million rows."""
    op = rng.choice([name for name, case in CASES.items() if case.comparable])
    many = rng.random() < 0.002 and op not in SLOW
    n = int(2 ** rng.uniform(12, 20)) if many else rows(rng)
    case, call = CASES[op], CASES[op].make(Draw(rng.getrandbits(32), free=True), n)
    viewed = call if case.in_place or rng.random() < 0.8 else tree_map(negated, call)
    compare(op, call, viewed, gradients=case.differentiable and rng.random() < 0.3)
    return RIGHT


def rows(rng: random.Random) -> int:
    """A number of rows: few, or about some blocks of a kernel."""
    return rng.choice(SIZES if rng.random() < 0.8 else blocks.sizes(4200))


def compare(op: str, call: dict[str, Any], viewed: dict[str, Any], *, gradients: bool) -> None:
    """Fails where a call, or the same values in other memory, gives anything but what the reference gives."""
    found, slopes = results(op, viewed, "auto", gradients)
    expected, others = results(op, call, "reference", gradients)
    wide = functools.cache(lambda: results(op, tree_map(widened, call), "reference", gradients))
    for place, (part, other) in enumerate(zip(found, expected, strict=True)):
        if tolerances.agree(part, other) or (not CASES[op].in_place and nearer(part, other, wide()[0][place])):
            continue
        raise Failed(f"{op}: not what the reference gives: {difference(part, other)}; {describe(call)}")
    if tolerances.agree_gradients(slopes, others):
        return
    near = (tolerances.agree_gradients([s], [o]) or nearer(s, o, w) for s, o, w in zip(slopes, others, wide()[1]))
    if not all(near):
        apart = ", ".join(difference(part, other) for part, other in zip(slopes, others, strict=True))
        raise Failed(f"{op}: not the gradients of the reference: {apart}; {describe(call)}")


def nearer(part: Tensor, other: Tensor, exact: Tensor) -> bool:
    """Whether a result is nearer to that of float64 than the reference's, which may subtract numbers that are alike."""
    if part.shape != other.shape:
        return False
    far, near = ((each.double() - exact).norm(torch.inf) for each in (other, part))
    return bool(near <= far)


def widened(value: Any) -> Any:
    """In float64."""
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


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
    total = sum(part.double().sum() for part in smooth)
    return found, list(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))


def invalid_call(rng: random.Random, folder: Path, given: Path) -> str:
    """A call of which an argument, or a part of one, is not what it must be, on each backend that has the op.

    All of them refuse it by name, or none does; then nothing may break, and no gradient either.
    """
    op, seed, gradients = rng.choice(list(CASES)), rng.getrandbits(32), rng.random() < 0.3
    said: dict[str, str] = {}
    for backend in (*backends.implemented(op), "auto"):
        generator = random.Random(seed)  # the same call again, since an op may write into its arguments
        torch.manual_seed(seed)
        try:
            call, names = harmed_call(generator, op)
        except (ValueError, TypeError) as error:  # of a struct, which its constructor refuses
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
    if "" in said.values() and any(said.values()):
        raise Failed(f"{op}: {names} are refused by some backends: {said}; {describe(call)}")
    return REFUSED if any(said.values()) else RIGHT


def huge(call: dict[str, Any]) -> bool:
    """Whether an argument speaks of gigabytes."""
    sizes = [leaf.numel() if isinstance(leaf, Tensor) else leaf for leaf in tree_leaves(call)]
    return any(isinstance(size, int) and size > 2**24 for size in sizes)


def harmed_call(rng: random.Random, op: str) -> tuple[dict[str, Any], list[str]]:
    """The arguments of an op, and those of them that were harmed."""
    case = CASES[op]
    made, other = (case.make(Draw(rng.getrandbits(32), free=True), rows(rng)) for _ in range(2))
    parameters = inspect.signature(called(op)).parameters.values()
    call = {each.name: made.get(each.name, each.default) for each in parameters if each.name != "backend"}
    names = rng.sample([*call, "backend"], rng.choice((1, 1, 1, 2)))
    for name in names:
        if name == "backend":
            call[name] = rng.choice(("", "cuda", None, 3, "Native", [], "a" * 10_000))
        elif rng.random() < 0.15:  # of another call
            call[name] = other.get(name, call[name])
        elif call[name] is None:
            tensors = [part for part in tree_leaves(made) if isinstance(part, Tensor)]
            few = torch.tensor([rng.choice((0, 1, -1, 5, 1000, 2**31 - 1, -(2**31)))], dtype=torch.int32)
            call[name] = rng.choice((3, "x", [1.0], harmed(rng, rng.choice(tensors)), rng.choice(tensors), few))
        else:
            call[name] = harmed(rng, call[name], counted=name == "steps")
    return call, names


def check_message(op: str, call: dict[str, Any], names: list[str], error: Exception) -> None:
    """The error names the op, or one that it is composed of, and an argument, in a line of some length."""
    text = str(error)
    arguments = {*inspect.signature(called(op)).parameters, *named(call)}
    arguments |= {*inspect.signature(ops.routed_mlp).parameters} if "network" in call else set()
    arguments |= {argument.removesuffix("s") for argument in arguments}  # an entry of a list
    clear = re.match(rf"({'|'.join(backends.ops())})(: |\(\) ).*\b({'|'.join(arguments)})\b", text)
    if not clear or "\n" in text or len(text) > 500:
        raise Failed(f"{op}: the error for {names} is not clear: {type(error).__name__}: {text:.300}; {describe(call)}")


def named(value: Any) -> set[str]:
    """The names of all parts of structs."""
    found = {str(key) for key, _ in parts(value)} if not isinstance(value, (list, tuple)) else set()
    found |= set(getattr(value, "_fields", ()))
    return found.union(*(named(part) for _, part in parts(value)))


def parts(value: Any) -> list[tuple[Any, Any]]:
    """Keys and parts of a list or struct."""
    if isinstance(value, (list, tuple)):
        return list(enumerate(value))
    if isinstance(value, dict):
        return list(value.items())
    if dataclasses.is_dataclass(value):
        return [(each.name, getattr(value, each.name)) for each in dataclasses.fields(value) if each.init]
    return []


def with_part(value: Any, key: Any, part: Any) -> Any:
    """A list or struct, of which one part is another."""
    if dataclasses.is_dataclass(value):
        return dataclasses.replace(value, **{key: part})
    if isinstance(value, dict):
        return {**value, key: part}
    changed = [*value[:key], part, *value[key + 1 :]]
    if hasattr(value, "_make"):
        return type(value)(*changed)
    return type(value)(changed)


def harmed(rng: random.Random, value: Any, counted: bool = False) -> Any:
    """Something else in the place of a value, or of a part of it; what is ``counted`` is worked off, however large."""
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
    """A tensor of another kind, dtype, shape or place, or something that is none."""
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
        return rng.choice(
            (lambda: tensor.to_sparse(), lambda: tensor.to("meta"), lambda: tensor.expand(2, *tensor.shape))
        )()
    if kind == 9 and tensor.dim() and tensor.shape[0]:  # more rows than an index counts, in no memory; 2^31 - 1 of some
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
    """Shapes and dtypes of the arguments."""

    def one(value: Any) -> str:
        if isinstance(value, Tensor):
            return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape) if not value.is_nested else ''}"
        return f"[{', '.join(map(one, value))}]" if isinstance(value, list) else f"{value!r:.60}"

    return ", ".join(f"{name}={one(value)}" for name, value in call.items() if value is not None)
