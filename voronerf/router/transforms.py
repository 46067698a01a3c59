"""PyTorch's transforms, tracers and saved-tensor hooks that are active around a routed call."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor
from torch.autograd import forward_ad

from voronerf.router.double import Double
from voronerf.router.grouping import owned_parameters
from voronerf.router.layout import Call, map_tensors

_OP = "VoronoiRouter"
_transforms = torch._C._are_functorch_transforms_active
_hooks = torch._C._autograd._top_saved_tensors_default_hooks
_ALONE = "router.cell(i) is a plain module of one cell"


def transformed() -> bool:
    """Returns whether the call is within a function that ``torch.func`` transforms."""
    return _transforms()


def refuse_transforms() -> None:
    """Raises NotImplementedError within transforms that a routed call does not support."""
    if torch.jit.is_tracing():
        raise NotImplementedError(
            f"{_OP}: torch.jit.trace and torch.onnx.export(dynamo=False) would keep the cells of one batch; "
            f"{_ALONE}, which can be traced"
        )
    active = set[str]()
    if transformed():
        active = {interpreter.key().name for interpreter in torch._C._functorch.get_interpreter_stack() or ()}
    if "Vmap" in active:
        raise NotImplementedError(
            f"{_OP}: torch.func.vmap, jacrev and hessian split the batch of samples, which must be sorted by cell; "
            "call the router on the whole batch, where torch.autograd.grad(y[:, i].sum(), x, create_graph=True) gives "
            "the derivative of each sample, and a second call the second derivative"
        )
    if "Jvp" in active or forward_ad._current_level >= 0:
        raise NotImplementedError(
            f"{_OP}: forward-mode derivatives (jvp, jacfwd, dual numbers) are not supported; use torch.func.vjp or "
            "torch.autograd.grad, twice for a product with the Jacobian"
        )


@contextlib.contextmanager
def outside() -> Iterator[None]:
    """Suspends the transforms of ``torch.func`` in the context."""
    if not transformed():
        yield
        return
    from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack

    grad = torch.is_grad_enabled()
    with temporarily_clear_interpreter_stack(), torch.set_grad_enabled(grad):
        yield


def unwrapped(tensor: Tensor) -> Tensor:
    """Returns the tensor inside a ``torch.func`` wrapper, as a leaf tensor with the wrapper's ``requires_grad``."""
    inner = tensor
    while torch._C._functorch.is_functorch_wrapped_tensor(inner):
        inner = torch._C._functorch.get_unwrapped(inner)
    return inner if inner is tensor else inner.detach().requires_grad_(tensor.requires_grad)


@contextlib.contextmanager
def untransformed(call: Call) -> Iterator[Call]:
    """Yields a copy of a call for a probe, hidden from transforms and saved-tensor hooks.

    ``torch.utils.checkpoint`` counts the tensors that a call saves, and compares the number with the recomputation.
    """
    if not transformed():
        with torch.autograd.graph.saved_tensors_hooks(_identity, _identity) if hooked() else contextlib.nullcontext():
            yield call
        return
    with outside():
        double = Double(call.module)
        double.fill({id(p): unwrapped(p) for _, _, p in owned_parameters(call.module)})
        args, kwargs = map_tensors((call.args, call.kwargs), unwrapped)
        yield replace(call, module=double.module, args=args, kwargs=kwargs)


def hooked() -> bool:
    """Returns whether saved-tensor hooks are active. The call may then run again, and must run in the same way."""
    return _hooks(False) is not None


def is_intercepted() -> bool:
    """Returns whether transforms, tracers or saved-tensor hooks see a call."""
    return _transforms() or _hooks(False) is not None or forward_ad._current_level >= 0 or torch._C._is_tracing()


def _identity(tensor: Tensor) -> Tensor:
    return tensor
