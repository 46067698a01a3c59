"""The custom op of an implementation: its schema, its fake and its gradients from one declaration, and its direct call
where nothing listens."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from voronerf.ops._core.active import active

# torch has no public names for these questions; without an answer the custom op is called.
LISTENERS = [
    getattr(torch._C, "_len_torch_function_stack", lambda: True),
    getattr(torch._C, "_len_torch_dispatch_stack", lambda: True),
    getattr(torch._C, "_are_functorch_transforms_active", lambda: True),
    getattr(torch.autograd, "_profiler_enabled", lambda: True),
    getattr(torch._C, "_is_tracing", lambda: True),
]
_PLAIN = (Tensor, torch.nn.Parameter)
_is_wrapped = torch._C._functorch.is_functorch_wrapped_tensor


def is_watched() -> bool:
    """Whether modes, transforms, tracers or profilers of torch are to see what is called."""
    for listens in LISTENERS:  # noqa: SIM110  # a generator takes twice the time
        if listens():
            return True
    return False


def custom_op(name: str, memory: Callable[[Any], Any], **options: Any) -> Callable[[Callable[..., Any]], Op]:
    """Makes a function that fills memory with its results the custom op ``voronerf::name``, with the options of `Op`.

    ::

        class Given(NamedTuple):
            points: Tensor
            centres: Tensor

        def memory(given: Given) -> Tensor:
            return given.points.new_empty(given.points.shape[0], dtype=torch.int32)

        @custom_op("nearest_centre", memory)
        def nearest_centre(given: Given, found: Tensor) -> None:
            native.compiled.nearest_centre(*given, found, ...)

        cells = nearest_centre(points, centres)
    """
    return lambda fill: Op(name, memory, fill, **options)


class _Fields:
    """The arguments of an op, of which some are named tuples, and those of its custom op, which knows none.

    Attributes:
        hints: the types of those of the custom op, by name.
        nested: whether any is a named tuple.
    """

    def __init__(self, kind: Any) -> None:
        self.hints: dict[str, Any] = {}
        self._kinds: list[Any] = []  # of each argument the named tuple, or None
        self._optional: list[bool] = []
        for name, hint in typing.get_type_hints(kind).items():
            tuples = [each for each in (hint, *typing.get_args(hint)) if hasattr(each, "_fields")]
            own = typing.get_type_hints(tuples[0]) if tuples else {name: hint}
            optional = bool(tuples) and hint is not tuples[0]
            self.hints |= {key: each | None for key, each in own.items()} if optional else own
            self._kinds.append(tuples[0] if tuples else None)
            self._optional.append(optional)
        self.nested = any(kind is not None for kind in self._kinds)

    def packed(self, flat: Sequence[Any]) -> Sequence[Any]:
        """The arguments of the op."""
        if not self.nested:
            return flat
        found, at = [], 0
        for kind, optional in zip(self._kinds, self._optional):
            end = at + (1 if kind is None else len(kind._fields))
            missing = kind is None or (optional and flat[at] is None)
            found.append(flat[at] if missing else kind._make(flat[at:end]))
            at = end
        return found

    def flat(self, packed: Sequence[Any]) -> Sequence[Any]:
        """Those of the custom op."""
        if not self.nested:
            return packed
        found: list[Any] = []
        for kind, given in zip(self._kinds, packed):
            if kind is None:
                found.append(given)
            else:
                found.extend((None,) * len(kind._fields) if given is None else given)  # torch 2.11 traces no +=
        return found


class Op:
    """A custom op, which is called past PyTorch's dispatcher where nothing there would see the call.

    The dispatcher and the autograd of ``torch.library`` take some 130 us for a forward and a backward pass, as long as
    a layer of width 64 takes for a thousand samples, and more for lists of tensors. Modes, transforms, tracers and
    profilers are given the custom op. The compiled functions check dtypes and make their inputs contiguous
    (csrc/bindings/load.h).

    Args:
        name: of the op.
        memory: gives memory for the results, of shapes alone, which is also the op's fake, with which torch traces. By
            its annotations the arguments are a named tuple, some of whose members may be named tuples, which the custom
            op takes apart. An optional one begins with what is never None.
        fill: fills it.
        devices: device types that it runs on.
        mutates: the arguments that it writes into.
        counted: whether only the kernels know how many rows there are: ``fill`` then gets the arguments alone, and
            makes its results, and ``memory`` is nothing but the fake.

    Attributes:
        tensors: places of the arguments of the custom op that are tensors, or None.
        plan: how the compiled module calls it by itself (`Declaration.compiled_op`); None where it does not.
        at_once: gives the results where no gradients are recorded, or None where this class has to look at the call.
        learning: gives them, with a node of autograd of its own, for plain tensors of the CPU with gradients; None
            where this class makes the node.
    """

    plan: Any = None
    at_once: Callable[..., Any] | None = None
    learning: Callable[..., Any] | None = None
    way: Callable[[tuple[Any, ...]], int] = staticmethod(lambda flat: 2)
    """The compiled module's answer, once that is there (csrc/bindings/signature.cpp): 0 for plain tensors of the CPU
    past the dispatcher, 1 for those with gradients, 2 where only what follows in Python knows."""

    def __init__(
        self,
        name: str,
        memory: Callable[[Any], Any],
        fill: Callable[..., Any],
        *,
        devices: tuple[str, ...] = ("cpu", "cuda"),
        mutates: Sequence[str] = (),
        counted: bool = False,
    ) -> None:
        hints = typing.get_type_hints(memory)
        result, (kind,) = hints.pop("return"), hints.values()
        self._name, self._fields, self._on_cuda = name, _Fields(kind), "cuda" in devices
        self._listed = typing.get_origin(result) is list
        kinds, new = (Tensor, Tensor | None), tuple.__new__
        fields = list(self._fields.hints.values())
        self.tensors = [place for place, hint in enumerate(fields) if hint in kinds]
        lists = [place for place, hint in enumerate(fields) if any(of in kinds for of in typing.get_args(hint))]
        self._lists = [place for place in lists if place not in self.tensors]
        self._backward: Callable[..., Any] | None = None
        self.set_up: Any = None

        def run(arguments: Sequence[Any]) -> Any:
            given = new(kind, arguments)
            if counted:
                return fill(given)
            found = memory(given)
            fill(given, found)
            return found

        self._run, self._nested, self._flat, packed = run, self._fields.nested, self._fields.flat, self._fields.packed

        def flat(*arguments: Any) -> Any:
            return run(packed(arguments))

        either = inspect.Parameter.POSITIONAL_OR_KEYWORD
        parameters = [inspect.Parameter(name, either, annotation=hint) for name, hint in self._fields.hints.items()]
        returned = None if result is type(None) else result
        flat.__signature__ = inspect.Signature(parameters, return_annotation=returned)  # type: ignore[attr-defined]
        self._op = torch.library.custom_op(f"voronerf::{name}", flat, mutates_args=mutates, device_types=devices)
        self._op.register_fake(lambda *flat: memory(new(kind, packed(flat))))
        self.__module__, self.__name__, self.__doc__ = fill.__module__, fill.__name__, fill.__doc__

    def __call__(self, *arguments: Any) -> Any:
        """What the op gives."""
        traced = torch.compiler.is_dynamo_compiling()
        if self.at_once is not None and not traced and not torch.is_grad_enabled():
            found = self.at_once(*arguments)
            if found is not None:
                return found
        flat = self._flat(arguments) if self._nested else arguments
        if traced:
            return self._op(*flat)
        way = self.way(tuple(flat))
        if way == 0:
            return self._run(arguments)
        if way == 1 and self._backward is not None:
            return self._learning(flat, arguments) if self.learning is None else self.learning(*arguments)
        if forward_ad._current_level >= 0:
            self._refuse_tangents(flat)
        if active.recording is None and is_watched():
            return self._transformed(flat) if torch._C._are_functorch_transforms_active() else self._op(*flat)
        tensors = [flat[place] for place in self.tensors if flat[place] is not None]
        for place in self._lists:
            tensors += flat[place]
        learns = False
        for tensor in tensors:
            here = tensor.is_cpu or (tensor.is_cuda and self._on_cuda)
            if not here or type(tensor) not in _PLAIN:  # fake tensors of other tracers among them
                return self._op(*flat)
            learns = learns or tensor.requires_grad
        if not (learns and torch.is_grad_enabled()):
            return self._run(arguments)
        if self._backward is None or active.recording is not None:
            return self._op(*flat)
        if any(map(_is_wrapped, tensors)):  # by a transform that has ended, such as the arguments that vjp keeps
            return self._transformed(flat)
        return self._learning(flat, arguments)

    def _learning(self, flat: Sequence[Any], arguments: Sequence[Any]) -> Any:
        """The op with its node of autograd."""
        entries = self._tensors_of(flat) if self._lists else flat
        return self._given(_apply_directly(*entries, None, self, arguments))

    def _tensors_of(self, flat: Sequence[Any]) -> list[Any]:
        """The entries of lists among the arguments of the custom op, and its tensors, or what is in their places."""
        found: list[Any] = []
        for place in self._lists:
            found += flat[place]
        found += [flat[place] for place in self.tensors]
        return found

    def _transformed(self, flat: Sequence[Any]) -> Any:
        """The op for ``torch.func``, which does not differentiate custom ops."""
        if self._backward is None:
            return self._op(*flat)
        entries, lengths = _flattened(flat)
        return self._given(_Differentiable.apply(*entries, lengths, self, None))

    def _given(self, results: Any) -> Any:
        return list(results) if self._listed else results  # autograd.Function knows no lists

    def refuse_batches(self, of_results: Sequence[Any]) -> None:
        """Raises NotImplementedError for gradients of several results at once."""
        for gradient in of_results:
            if gradient is not None and torch._C._functorch.is_legacy_batchedtensor(gradient):
                raise self.no_batches

    @property
    def no_batches(self) -> NotImplementedError:
        """The error of batches of gradients."""
        return NotImplementedError(
            f"{self._name.removesuffix('_native')}: torch.func.vmap, jacrev, hessian, is_grads_batched=True and "
            "vectorize=True are not supported; ask torch.autograd.grad for one gradient at a time"
        )

    def _refuse_tangents(self, flat: Sequence[Any]) -> None:
        """Raises NotImplementedError for tensors with a tangent, which would be lost."""
        for tensor in _flattened(flat)[0]:
            if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
                raise NotImplementedError(
                    f"{self._name.removesuffix('_native')}: has no forward-mode derivative (jvp, jacfwd, dual "
                    "numbers); take torch.func.vjp or torch.autograd.grad"
                )

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
        """The op's backward, as of ``torch.library.custom_op``; inputs and gradients are packed like the arguments."""
        packed, self._backward, self.set_up = self._fields.packed, backward, setup_context
        self._op.register_autograd(
            self.gradients, setup_context=lambda ctx, inputs, output: setup_context(ctx, packed(inputs), output)
        )

    def gradients(self, ctx: Any, *of_results: Any) -> tuple[Any, ...]:
        """The gradients to the arguments of the custom op."""
        assert self._backward is not None
        found = self._backward(ctx, *of_results)
        return tuple(self._fields.flat(found if isinstance(found, tuple) else (found,)))

    def results(self, arguments: Sequence[Any]) -> Any:
        """What is computed, as ``torch.autograd.Function`` knows it."""
        found = self._run(arguments)
        return tuple(found) if self._listed else found

    def arguments(self, entries: Sequence[Any], lengths: Sequence[int]) -> Sequence[Any]:
        """The arguments of the op, from those of the custom op with lists taken apart."""
        return self._fields.packed(_nested(entries, lengths))


class _Differentiable(torch.autograd.Function):
    """An op with gradients, as PyTorch's autograd and ``torch.func`` take it.

    Its arguments are those of the custom op, lists of tensors taken apart; the lengths of these lists; the op; and its
    arguments once more, where ``torch.func`` does not replace their tensors by its own. Then there are no lengths, and
    of an op with lists it gets the tensors alone, as `Op._tensors_of` has them.
    """

    @staticmethod
    def forward(*flat: Any) -> Any:
        *entries, lengths, op, arguments = flat
        return op.results(arguments or op.arguments(entries, lengths))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        *entries, ctx.lengths, ctx.op, arguments = inputs
        ctx.op.set_up(ctx, arguments or ctx.op.arguments(entries, ctx.lengths), output)

    @staticmethod
    def backward(ctx: Any, *of_results: Any) -> tuple[Any, ...]:
        op: Op = ctx.op
        op.refuse_batches(of_results)
        found = op.gradients(ctx, of_results) if op._listed else op.gradients(ctx, *of_results)
        if ctx.lengths is None:
            return *(op._tensors_of(found) if op._lists else found), None, None, None
        lists = zip(found, ctx.lengths, strict=True)
        every = _flattened([[None] * n if part is None and n >= 0 else part for part, n in lists])[0]
        return *every, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: Any, *flat: Any) -> Any:
        raise flat[-2].no_batches


#: `_Differentiable.apply` without its look at ``torch.func`` and at the signature of ``forward``, which takes 20 us.
_apply_directly = super(torch.autograd.Function, _Differentiable).apply


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


def _nested(flat: Sequence[Any], lengths: Sequence[int]) -> tuple[Any, ...]:
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

    run.op = op  # type: ignore[attr-defined]
    return run
