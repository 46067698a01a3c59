"""Compares Adam steps of several parameters with the formula, on any backend."""

import torch

from voronerf.ops import Guard, UpdateRule, adam


def assert_adam(count, *, backend, device="cpu", scale=None, spoilt=None, limit=1e18, rate=0.01):
    """Compares three Adam steps with the formula.

    Every second parameter is sparse: its entries without a gradient do not change. ``spoilt`` makes the second step
    invalid: "loss" for a NaN loss, or the index of a dense parameter whose gradient exceeds ``limit``.
    """
    sizes = [(7 * number) % 1030 + 1 for number in range(count)]
    betas, epsilon = (0.9, 0.99), 1e-6
    dense_flags = [number % 2 == 0 for number in range(count)]
    parameters, means, squares = ([fill(n) for n in sizes] for fill in (torch.randn, torch.zeros, torch.zeros))
    tensors = [[tensor.to(device) for tensor in kind] for kind in (parameters, means, squares)]
    expected = [[tensor.double() for tensor in kind] for kind in (parameters, means, squares)]
    steps = [torch.zeros((), device=device) for _ in sizes]
    scale = None if scale is None else scale.to(device)
    guard = Guard.on(device)._replace(scale=scale, limit=limit)
    rate = rate.to(device) if isinstance(rate, torch.Tensor) else rate
    done = 0
    for step in range(3):
        gradients = [torch.randn(n) * (torch.rand(n) < 0.5) for n in sizes]
        loss = torch.tensor(torch.nan if spoilt == "loss" and step == 1 else 0.5, device=device)
        if isinstance(spoilt, int) and step == 1:
            gradients[spoilt][-1] = 2 * limit
        scaled = [gradient.to(device) * (1 if scale is None else scale) for gradient in gradients]
        rules = [UpdateRule(at, rate, betas, epsilon, dense) for at, dense in zip(steps, dense_flags)]
        adam(rules, tensors[0], scaled, *tensors[1:], guard=guard, loss=loss, backend=backend)
        left_out = step == 1 and spoilt is not None
        assert bool(guard.skip) == left_out and float(guard.in_a_row) == left_out
        if left_out:
            continue
        done += 1
        moved_by = 0.01 * (1 - betas[1] ** done) ** 0.5 / (1 - betas[0] ** done)
        for dense, gradient, parameter, mean, square in zip(dense_flags, gradients, *expected):
            present = (gradient != 0) | dense
            mean[present] = (betas[0] * mean + (1 - betas[0]) * gradient)[present]
            square[present] = (betas[1] * square + (1 - betas[1]) * gradient.double().square())[present]
            moved = moved_by * mean / (square.sqrt() + epsilon * (1 - betas[1] ** done) ** 0.5)
            parameter[present] -= moved[present]
    assert all(float(step) == done for step in steps) and float(guard.skipped) == 3 - done
    for kind, wanted in zip(tensors, expected):
        torch.testing.assert_close([t.cpu() for t in kind], [t.float() for t in wanted], rtol=1e-5, atol=1e-6)
