"""Runs programs by the reference and differentiates them to any order by their gradient programs."""

from __future__ import annotations

import torch

from voronerf.ops._core.program import Program, gradient
from voronerf.ops.network import reference


class ByPrograms(torch.autograd.Function):
    """The op as an autograd function: ``apply(text, offsets, order, ray_index, *inputs, *parameters)``."""

    @staticmethod
    def forward(ctx, text, offsets, order, ray_index, *tensors):
        """Runs the program."""
        ctx.text = text
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(offsets, order, ray_index, *tensors)
        program = Program.parse(text)
        count = len(program.inputs)
        arguments = [tensor.detach() for tensor in tensors]
        return tuple(reference.evaluate(arguments[:count], arguments[count:], offsets, order, ray_index, program))

    @staticmethod
    def backward(ctx, *arriving):
        """Runs the gradient program through this class, so that the gradients are differentiable too."""
        offsets, order, ray_index, *tensors = ctx.saved_tensors
        program, k = Program.parse(ctx.text), len(offsets) - 1
        count, split, wanted = len(program.inputs), len(program.outputs), ctx.needs_input_grad[4:]
        there = [g is not None for g in arriving]
        own = gradient(
            program, tuple(wanted[:count]), tuple(wanted[count:]), tuple(there[:split]), tuple(there[split:])
        )
        parts = (tensors[:count], arriving[:split], tensors[count:], arriving[split:])
        arguments = [tensor for part in parts for tensor in part if tensor is not None]
        results = iter(ByPrograms.apply(own.text, offsets, order, ray_index, *arguments))
        gradients = [next(results) if want else None for want in wanted]
        for i, tensor in enumerate(tensors[count:], start=count):
            if gradients[i] is not None and len(tensor) == 1 < k:
                gradients[i] = gradients[i].sum(0, keepdim=True)
        return None, None, None, None, *gradients


def derivatives(run, tensors, orders=3):
    """Returns the results of a function, and their derivatives up to an order.

    Each order has the gradients of a randomly weighted sum of the previous order's tensors.

    Args:
        run: a function of tensors that returns a list of tensors.
        tensors: the arguments of ``run``.
        orders: the number of derivatives.

    Returns:
        The results, followed by the gradients with respect to all arguments for each order.
    """
    generator = torch.Generator().manual_seed(5)
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    results = [list(run(*leaves))]
    for order in range(1, orders + 1):
        total = 0 * leaves[0].sum()
        for tensor in results[-1]:
            factors = torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
            total = total + (tensor * factors.to(tensor)).sum()
        options = {"create_graph": order < orders, "allow_unused": True, "materialize_grads": True}
        results.append(list(torch.autograd.grad(total, leaves, **options)))
    return [tensor.detach() for part in results for tensor in part]
