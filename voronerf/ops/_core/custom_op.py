"""One declaration of an op of the compiled module or of Warp: its custom op, its fake and its direct call, from one
function."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.library import CustomOpDef

from voronerf.ops._core.active import active

# torch has no public names for these questions; without an answer the custom op is called.
_LISTENERS = [
    getattr(torch._C, "_len_torch_function_stack", lambda: True),
    getattr(torch._C, "_len_torch_dispatch_stack", lambda: True),
    getattr(torch._C, "_are_functorch_transforms_active", lambda: True),
    getattr(torch.autograd, "_profiler_enabled", lambda: True),
]
_PLAIN = (Tensor, torch.nn.Parameter)


def is_watched() -> bool:
    """Whether modes, transforms, tracers or profilers of torch are to see what is called."""
    return any(listens() for listens in _LISTENERS)


def custom_op(name: str, *, devices: tuple[str, ...] = ("cpu", "cuda")) -> Callable[[Callable[..., Iterator[Any]]], Op]:
    """Makes a function that allocates, yields its results, and then fills them the custom op ``voronerf::name``.

    ::

        @custom_op("nearest_centre")
        def _nearest_centre(points: Tensor, centres: Tensor, weights: Tensor | None) -> Iterator[Tensor]:
            cells = points.new_empty(points.shape[0], dtype=torch.int32)
            yield cells
            native.compiled.nearest_centre(points, centres, weights, cells, ...)

    The op's fake, with which torch traces, ends at the ``yield``: up to there shapes alone are known. The op is
    functional; what it may get and what it returns is said by the annotations. An argument may be a named tuple, whose
    fields are arguments of the custom op one by one. The compiled functions check dtypes and
    make their inputs contiguous (csrc/bindings/load.h).

    Args:
        name: of the op.
        devices: device types that it runs on.
    """

    def declare(steps: Callable[..., Iterator[Any]]) -> Op:
        def run(*arguments: Any) -> Any:
            going = steps(*arguments)
            results = next(going)
            for _ in going:
                raise AssertionError(f"{name} yields twice")
            return results

        signature = inspect.signature(steps, eval_str=True)
        (results,) = typing.get_args(signature.return_annotation)
        structs = Structs(signature.replace(return_annotation=results))
        return make_op(name, run, lambda *flat: next(steps(*structs.packed(flat))), structs, steps, devices=devices)

    return declare


def make_op(
    name: str,
    run: Callable[..., Any],
    fake: Callable[..., Any],
    structs: Structs,
    described: Callable[..., Any],
    *,
    devices: tuple[str, ...] = ("cpu", "cuda"),
) -> Op:
    """The custom op ``voronerf::name``.

    Args:
        name: of the op.
        run: gives its results, from its arguments with named tuples.
        fake: gives memory for them, from its arguments one by one.
        structs: its arguments and results.
        described: the function whose module, name and docstring it gets.
        devices: device types that it runs on.
    """

    def flat(*arguments: Any) -> Any:
        return run(*structs.packed(arguments))

    flat.__signature__ = signature = structs.flat_signature()  # type: ignore[attr-defined]
    schema = torch.library.infer_schema(flat, mutates_args=())
    op = torch.library.custom_op(f"voronerf::{name}", flat, mutates_args=(), device_types=devices, schema=schema)
    op.register_fake(fake)
    made = Op(op, run, devices, structs, listed=typing.get_origin(signature.return_annotation) is list)
    made.__module__, made.__name__, made.__doc__ = described.__module__, described.__name__, described.__doc__
    return made


class Structs:
    """The arguments of a function of which some are named tuples, and those of its custom op, which knows none.

    Attributes:
        kinds: the named tuple of each argument, None for others.
        tensors: places of the arguments of the custom op that are tensors, or None.
        lists: of those that are lists of them.
    """

    def __init__(self, signature: inspect.Signature) -> None:
        self._parameters, self._results = list(signature.parameters.values()), signature.return_annotation
        self.kinds = [kind if hasattr(kind := given.annotation, "_fields") else None for given in self._parameters]
        self._widths = [1 if kind is None else len(kind._fields) for kind in self.kinds]
        self._any = any(kind is not None for kind in self.kinds)
        self._alone = self._any and len(self.kinds) == 1
        hints = [given.annotation for given in self.flat_signature().parameters.values()]
        kinds = (Tensor, Tensor | None)
        self.tensors = [place for place, hint in enumerate(hints) if hint in kinds]
        self.lists = [place for place, hint in enumerate(hints) if any(of in kinds for of in typing.get_args(hint))]
        self.lists = [place for place in self.lists if place not in self.tensors]

    def flat_signature(self) -> inspect.Signature:
        """The signature with the fields of named tuples in their place."""
        found = []
        for given, kind in zip(self._parameters, self.kinds):
            hints = {given.name: given.annotation} if kind is None else typing.get_type_hints(kind)
            found += [inspect.Parameter(name, given.kind, annotation=hint) for name, hint in hints.items()]
        return inspect.Signature(found, return_annotation=self._results)

    def packed(self, flat: Sequence[Any]) -> Sequence[Any]:
        """The arguments of the function."""
        if not self._any:
            return flat
        if self._alone:
            return (self.kinds[0]._make(flat),)  # type: ignore[union-attr]
        found, at = [], 0
        for kind, width in zip(self.kinds, self._widths):
            found.append(flat[at] if kind is None else kind._make(flat[at : at + width]))
            at += width
        return found

    def flat(self, packed: Sequence[Any]) -> Sequence[Any]:
        """The arguments of the custom op."""
        if not self._any or self._alone:
            return packed[0] if self._alone else packed
        found: list[Any] = []
        for given, kind in zip(packed, self.kinds):
            if kind is None:
                found.append(given)
            else:
                found += given
        return found


class Op:
    """A custom op, which is called past PyTorch's dispatcher where nothing there would see the call.

    The dispatcher and the autograd of ``torch.library`` take some 130 us for a forward and a backward pass, as long as
    a layer of width 64 takes for a thousand samples, and more for lists of tensors. Modes, transforms, tracers and
    profilers are given the custom op.
    """

    def __init__(
        self, op: CustomOpDef, run: Callable[..., Any], devices: tuple[str, ...], structs: Structs, listed: bool
    ) -> None:
        self._op, self._run, self._on_cuda, self.structs, self._listed = op, run, "cuda" in devices, structs, listed
        self._function: Any = None
        self._setup: Any = None
        self.__name__ = ""

    def __call__(self, *arguments: Any) -> Any:
        """What the op gives."""
        flat = self.structs.flat(arguments)
        if torch.compiler.is_dynamo_compiling():
            return self._op(*flat)
        if forward_ad._current_level >= 0:
            self._refuse_tangents(flat)
        if active.recording is None and is_watched():
            return self._listened(flat)
        tensors = [flat[place] for place in self.structs.tensors]
        for place in self.structs.lists:
            tensors += flat[place]
        learns = False
        for tensor in tensors:
            if tensor is not None:
                here = tensor.is_cpu or (tensor.is_cuda and self._on_cuda)
                if not here or type(tensor) not in _PLAIN:  # fake tensors of other tracers among them
                    return self._op(*flat)
                learns = learns or tensor.requires_grad
        if not (learns and torch.is_grad_enabled()):
            return self._run(*arguments)
        if self._function is None or active.recording is not None:
            return self._op(*flat)
        entries, lengths = _flattened(flat) if self.structs.lists else (flat, None)
        results = self._function.apply(*entries, lengths)
        return list(results) if self._listed else results

    def _listened(self, flat: Sequence[Any]) -> Any:
        """The custom op; for torch.func, which does not differentiate those, a function that it does."""
        if self._setup is None or not torch._C._are_functorch_transforms_active():
            return self._op(*flat)
        entries, lengths = _flattened(flat)
        results = self._transformed.apply(*entries, lengths)
        return list(results) if self._listed else results

    @functools.cached_property
    def _transformed(self) -> Any:
        """The op with its gradients, as ``torch.func`` takes it."""

        def forward(*flat: Any) -> Any:
            *given, lengths = flat
            result = self._run(*self.structs.packed(_nested(given, lengths)))
            return tuple(result) if self._listed else result

        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            *given, ctx.lengths = inputs
            self._setup(ctx, self.structs.packed(_nested(given, ctx.lengths)), output)

        def vmap(*_: Any) -> Any:
            raise NotImplementedError(self._no_batches)

        parts = {"forward": forward, "setup_context": setup_context, "vmap": vmap}
        parts = {name: staticmethod(part) for name, part in parts.items()}
        return type("Transformed", (torch.autograd.Function,), {**parts, "backward": self._function.backward})

    @property
    def _no_batches(self) -> str:
        return (
            f"{self._op._name.removesuffix('_native')}: torch.func.vmap, jacrev, hessian, is_grads_batched=True and "
            "vectorize=True are not supported; ask torch.autograd.grad for one gradient at a time"
        )

    def _refuse_tangents(self, flat: Sequence[Any]) -> None:
        """Raises NotImplementedError for tensors with a tangent, which would be lost."""
        for tensor in _flattened(flat)[0]:
            if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
                raise NotImplementedError(
                    f"{self._op._name.removesuffix('_native')}: has no forward-mode derivative (jvp, jacfwd, dual "
                    "numbers); take torch.func.vjp or torch.autograd.grad"
                )

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
        """The op's backward, as of ``torch.library.custom_op``; inputs and gradients are packed like the arguments."""
        structs = self.structs

        def setup(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            setup_context(ctx, structs.packed(inputs), output)

        def unpacked(ctx: Any, *of_results: Any) -> tuple[Any, ...]:
            found = backward(ctx, *of_results)
            return tuple(structs.flat(found if isinstance(found, tuple) else (found,)))

        self._op.register_autograd(unpacked, setup_context=setup)
        self._setup = setup_context

        def forward(ctx: Any, *flat: Any) -> Any:  # with a setup_context of its own it takes 20 us longer
            *given, lengths = flat
            arguments, ctx.lengths = structs.packed(_nested(given, lengths) if lengths else given), lengths
            result = self._run(*arguments)
            setup_context(ctx, arguments, result)
            return tuple(result) if self._listed else result  # autograd.Function knows no lists

        def gradients(ctx: Any, *of_results: Any) -> tuple[Any, ...]:
            if any(own is not None and torch._C._functorch.is_legacy_batchedtensor(own) for own in of_results):
                raise NotImplementedError(self._no_batches)
            found = unpacked(ctx, of_results) if self._listed else unpacked(ctx, *of_results)
            if ctx.lengths is None:
                return (*found, None)
            lists = zip(found, ctx.lengths, strict=True)
            return (*_flattened([[None] * n if part is None and n >= 0 else part for part, n in lists])[0], None)

        parts = {"forward": staticmethod(forward), "backward": staticmethod(gradients)}
        self._function = type("Direct", (torch.autograd.Function,), parts)


def _flattened(arguments: Sequence[Any]) -> tuple[list[Any], list[int]]:
    """Arguments with the entries of lists in their place, and the length of each list, -1 for what is none."""
    flat: list[Any] = []
    lengths = []
    for argument in arguments:
        if isinstance(argument, (list, tuple)):
            flat.extend(argument)
            lengths.append(len(argument))
        else:
            flat.append(argument)
            lengths.append(-1)
    return flat, lengths


def _nested(flat: list[Any], lengths: list[int]) -> tuple[Any, ...]:
    """The arguments that `_flattened` took."""
    entries = iter(flat)
    return tuple(next(entries) if n < 0 else [next(entries) for _ in range(n)] for n in lengths)


def in_float32(op: Op) -> Callable[..., Any]:
    """The function that has an op, which computes in float32, compute for other dtypes of its floating-point tensors.

    All of them have the dtype of the first argument; the results are a tensor or a tuple of them.
    """

    def run(*given: Any) -> Any:
        narrow = given[0].dtype
        if narrow is torch.float32:
            return op(*given)
        wide = [part.float() if isinstance(part, Tensor) and part.is_floating_point() else part for part in given]
        found = op(*wide)
        return found.to(narrow) if isinstance(found, Tensor) else tuple(part.to(narrow) for part in found)

    return run
