"""The custom op of an implementation: one declaration gives its schema, its fake implementation and its gradients.
Calls bypass torch's dispatcher if nothing observes them."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from voronerf.ops._core.active import active

# torch has no public names for these functions. If one is missing, the custom op is always called.
LISTENERS = [
    getattr(torch._C, "_len_torch_function_stack", lambda: True),
    getattr(torch._C, "_len_torch_dispatch_stack", lambda: True),
    getattr(torch._C, "_are_functorch_transforms_active", lambda: True),
    getattr(torch.autograd, "_profiler_enabled", lambda: True),
    getattr(torch._C, "_is_tracing", lambda: True),
]
_PLAIN = (Tensor, torch.nn.Parameter)
_is_wrapped = torch._C._functorch.is_functorch_wrapped_tensor


def has_listeners() -> bool:
    """Returns whether modes, transforms, tracers or profilers of torch observe calls."""
    for listens in LISTENERS:  # noqa: SIM110  # any() with a generator takes twice the time
        if listens():
            return True
    return False


def custom_op(name: str, memory: Callable[[Any], Any], **options: Any) -> Callable[[Callable[..., Any]], Op]:
    """Makes the custom op ``voronerf::name`` from a function that fills allocated memory, with the options of `Op`.

    ::

        class Arguments(NamedTuple):
            points: Tensor
            centres: Tensor

        def memory(arguments: Arguments) -> Tensor:
            return arguments.points.new_empty(arguments.points.shape[0], dtype=torch.int32)

        @custom_op("nearest_centre", memory)
        def nearest_centre(arguments: Arguments, cells: Tensor) -> None:
            native.compiled.nearest_centre(*arguments, cells, ...)

        cells = nearest_centre(points, centres)
    """
    return lambda fill: Op(name, memory, fill, **options)


class _Fields:
    """The conversion between an op's arguments, some of them named tuples, and the flat arguments of its custom op.

    Attributes:
        hints: the types of the custom op's arguments, by name.
        nested: whether any argument of the op is a named tuple.
    """

    def __init__(self, kind: Any) -> None:
        self.hints: dict[str, Any] = {}
        self._kinds: list[Any] = []  # the named-tuple class of each argument, or None
        self._optional: list[bool] = []
        for name, hint in typing.get_type_hints(kind).items():
            tuples = [member for member in (hint, *typing.get_args(hint)) if hasattr(member, "_fields")]
            fields = typing.get_type_hints(tuples[0]) if tuples else {name: hint}
            optional = bool(tuples) and hint is not tuples[0]
            self.hints |= {key: member | None for key, member in fields.items()} if optional else fields
            self._kinds.append(tuples[0] if tuples else None)
            self._optional.append(optional)
        self.nested = any(kind is not None for kind in self._kinds)

    def packed(self, flat: Sequence[Any]) -> Sequence[Any]:
        """Returns the op's arguments, made from the flat arguments of the custom op."""
        if not self.nested:
            return flat
        arguments, start = [], 0
        for kind, optional in zip(self._kinds, self._optional):
            end = start + (1 if kind is None else len(kind._fields))
            missing = kind is None or (optional and flat[start] is None)
            arguments.append(flat[start] if missing else kind._make(flat[start:end]))
            start = end
        return arguments

    def flat(self, packed: Sequence[Any]) -> Sequence[Any]:
        """Returns the flat arguments of the custom op, made from the op's arguments."""
        if not self.nested:
            return packed
        flat: list[Any] = []
        for kind, value in zip(self._kinds, packed):
            if kind is None:
                flat.append(value)
            else:
                flat.extend((None,) * len(kind._fields) if value is None else value)  # torch 2.11 cannot trace +=
        return flat


class Op:
    """A custom op whose calls bypass PyTorch's dispatcher if nothing observes them.

    The dispatcher and the autograd of ``torch.library`` take some 130 us for a forward and a backward pass, and more
    for lists of tensors. A layer of width 64 takes as long for a thousand samples. Modes, transforms, tracers and
    profilers see the custom op. The compiled functions check dtypes and make their inputs contiguous
    (csrc/bindings/load.h).

    Args:
        name: the name of the op.
        memory: the function that allocates the results from shapes alone; it is also the op's fake, with which torch
            traces. The annotation of its parameter is the named tuple of the arguments. Members may be named tuples,
            which the custom op flattens. The first field of an optional named tuple is never None.
        fill: the function that writes the results into the allocated memory.
        devices: the device types that the op runs on.
        mutates: the arguments that the op writes into.
        counted: whether only the kernels know the number of rows: ``fill`` then takes the arguments alone and returns
            the results, and ``memory`` is only the fake.

    Attributes:
        tensors: the indices of the custom op's arguments that are tensors or None.
        plan: the description with which the compiled module makes the call (`Declaration.compiled_op`), or None.
    """

    plan: Any = None
    way: Callable[[tuple[Any, ...]], int] = staticmethod(lambda flat: 2)
    """The compiled module's classification of a call, once the module is loaded (csrc/bindings/signature.cpp).

    0: plain CPU tensors without gradients. 1: plain CPU tensors with gradients. 2: undecided; Python checks further.
    """

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
            packed_arguments = new(kind, arguments)
            if counted:
                return fill(packed_arguments)
            results = memory(packed_arguments)
            fill(packed_arguments, results)
            return results

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
        """Calls the op and returns its results."""
        flat = self._flat(arguments) if self._nested else arguments
        if torch.compiler.is_dynamo_compiling():
            return self._op(*flat)
        way = self.way(tuple(flat))
        if way == 0:
            return self._run(arguments)
        if way == 1 and self._backward is not None:
            return self._with_node(flat, arguments)
        if forward_ad._current_level >= 0:
            self._refuse_tangents(flat)
        if active.recording is None and has_listeners():
            return self._transformed(flat) if torch._C._are_functorch_transforms_active() else self._op(*flat)
        tensors = [flat[place] for place in self.tensors if flat[place] is not None]
        for place in self._lists:
            tensors += flat[place]
        needs_gradients = False
        for tensor in tensors:
            supported = tensor.is_cpu or (tensor.is_cuda and self._on_cuda)
            if not supported or type(tensor) not in _PLAIN:  # such as fake tensors of other tracers
                return self._op(*flat)
            needs_gradients = needs_gradients or tensor.requires_grad
        if not (needs_gradients and torch.is_grad_enabled()):
            return self._run(arguments)
        if self._backward is None or active.recording is not None:
            return self._op(*flat)
        if any(map(_is_wrapped, tensors)):  # wrapped by a transform that has ended, such as the saved arguments of vjp
            return self._transformed(flat)
        return self._with_node(flat, arguments)

    def _with_node(self, flat: Sequence[Any], arguments: Sequence[Any]) -> Any:
        """Calls the op with its autograd node."""
        entries = self._tensors_of(flat) if self._lists else flat
        return self._as_declared(_apply_node(*entries, self, arguments))

    def _tensors_of(self, flat: Sequence[Any]) -> list[Any]:
        """Returns the tensors among the custom op's arguments: the entries of lists, then single tensors or None."""
        entries: list[Any] = []
        for place in self._lists:
            entries += flat[place]
        entries += [flat[place] for place in self.tensors]
        return entries

    def _transformed(self, flat: Sequence[Any]) -> Any:
        """Calls the op under ``torch.func``, which does not differentiate custom ops."""
        if self._backward is None:
            return self._op(*flat)
        entries, lengths = _flattened(flat)
        return self._as_declared(_Transformed.apply(*entries, lengths, self))

    def _as_declared(self, results: Any) -> Any:
        return list(results) if self._listed else results  # autograd.Function cannot return lists

    @property
    def no_batches(self) -> NotImplementedError:
        """The error for batched gradients."""
        return NotImplementedError(
            f"{self._name.removesuffix('_native')}: torch.func.vmap, jacrev, hessian, is_grads_batched=True and "
            "vectorize=True are not supported; call torch.autograd.grad once for each gradient"
        )

    def _refuse_tangents(self, flat: Sequence[Any]) -> None:
        """Raises NotImplementedError for tensors with a forward-mode tangent, which would be lost."""
        for tensor in _flattened(flat)[0]:
            if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
                raise NotImplementedError(
                    f"{self._name.removesuffix('_native')}: has no forward-mode derivative (jvp, jacfwd, dual "
                    "numbers); use torch.func.vjp or torch.autograd.grad"
                )

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
        """Registers the backward pass, as ``torch.library`` does, but with the op's arguments instead of flat ones.

        Args:
            backward: (ctx, *gradients of the results) -> the gradient of each op argument; it is a named tuple
                if the argument is one.
            setup_context: (ctx, the op's arguments, the results) -> None; saves what ``backward`` needs.
        """
        packed, self._backward, self.set_up = self._fields.packed, backward, setup_context
        self._op.register_autograd(
            self.gradients, setup_context=lambda ctx, inputs, output: setup_context(ctx, packed(inputs), output)
        )

    def gradients(self, ctx: Any, *of_results: Any) -> tuple[Any, ...]:
        """Returns the gradients of the custom op's arguments; raises NotImplementedError for batched gradients."""
        assert self._backward is not None
        for gradient in of_results[0] if self._listed else of_results:
            if gradient is not None and torch._C._functorch.is_legacy_batchedtensor(gradient):
                raise self.no_batches
        gradients = self._backward(ctx, *of_results)
        return tuple(self._fields.flat(gradients if isinstance(gradients, tuple) else (gradients,)))

    def flat_gradients(self, ctx: Any, of_results: Sequence[Any]) -> tuple[Any, ...]:
        """Calls `gradients` with the gradients of the results, which are passed as one sequence."""
        return self.gradients(ctx, of_results) if self._listed else self.gradients(ctx, *of_results)

    def results(self, arguments: Sequence[Any]) -> Any:
        """Returns the results in the form of ``torch.autograd.Function``: a tensor or a tuple."""
        results = self._run(arguments)
        return tuple(results) if self._listed else results

    def arguments(self, entries: Sequence[Any], lengths: Sequence[int]) -> Sequence[Any]:
        """Returns the op's arguments, from the results of `_flattened`."""
        return self._fields.packed(_nested(entries, lengths))


class _Node(torch.autograd.Function):
    """The autograd node of an op.

    ``forward`` takes the op's tensors (`Op._tensors_of`), which only tell autograd what the op takes, then the op and
    its arguments.
    """

    @staticmethod
    def forward(ctx: Any, *flat: Any) -> Any:
        op, arguments = flat[-2:]
        ctx.op, results = op, op.results(arguments)
        op.set_up(ctx, arguments, results)
        return results

    @staticmethod
    def backward(ctx: Any, *of_results: Any) -> tuple[Any, ...]:
        gradients = ctx.op.flat_gradients(ctx, of_results)
        return *(ctx.op._tensors_of(gradients) if ctx.op._lists else gradients), None, None


#: ``apply`` without the checks of ``torch.func`` and of ``forward``'s signature, which take 20 us.
_apply_node = super(torch.autograd.Function, _Node).apply


class _Transformed(torch.autograd.Function):
    """An op with gradients for ``torch.func``, which replaces the tensors among the arguments of ``forward``.

    ``forward`` takes the custom op's arguments with flattened lists, the lengths of the lists, and the op.
    """

    @staticmethod
    def forward(*flat: Any) -> Any:
        *entries, lengths, op = flat
        return op.results(op.arguments(entries, lengths))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        *entries, ctx.lengths, ctx.op = inputs
        ctx.op.set_up(ctx, ctx.op.arguments(entries, ctx.lengths), output)

    @staticmethod
    def backward(ctx: Any, *of_results: Any) -> tuple[Any, ...]:
        lists = zip(ctx.op.flat_gradients(ctx, of_results), ctx.lengths, strict=True)
        flat_gradients = _flattened([[None] * n if part is None and n >= 0 else part for part, n in lists])[0]
        return *flat_gradients, None, None

    @staticmethod
    def vmap(info: Any, in_dims: Any, *flat: Any) -> Any:
        raise flat[-1].no_batches


def _flattened(arguments: Sequence[Any]) -> tuple[list[Any], list[int]]:
    """Returns the arguments with flattened lists, and the list length of each argument (-1: not a list)."""
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
    """Inverts `_flattened`: returns the arguments with their lists."""
    entries = iter(flat)
    return tuple(next(entries) if n < 0 else [next(entries) for _ in range(n)] for n in lengths)


def in_float32(op: Op) -> Callable[..., Any]:
    """Wraps a float32 op for other dtypes: casts its floating-point tensors to float32, and its results back.

    All floating-point arguments have the dtype of the first one. The result is a tensor or a tuple of tensors.
    """

    def run(*arguments: Any) -> Any:
        dtype = arguments[0].dtype
        if dtype is torch.float32:
            return op(*arguments)
        floats = [part.float() if isinstance(part, Tensor) and part.is_floating_point() else part for part in arguments]
        results = op(*floats)
        return results.to(dtype) if isinstance(results, Tensor) else tuple(part.to(dtype) for part in results)

    run.op = op  # type: ignore[attr-defined]
    return run
