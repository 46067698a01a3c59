"""``adam`` and ``average`` of the compiled module. They are not custom ops, which cannot take lists of rules."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.adam import reference
from voronerf.ops.adam.reference import Guard, UpdateRule


def adam(
    rules: Sequence[UpdateRule],
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    guard: Guard | None,
    loss: Tensor | None,
) -> None:
    """Makes a step for several parameters; see ``voronerf.ops.adam``.

    On CUDA, a step takes two kernel launches for each group of up to 36 parameters.
    """
    compiled, machine = native.compiled, native.machine(parameters[0])
    records = []
    for step, rate, (first, second), epsilon, dense in rules:
        number, at = (0.0, rate) if isinstance(rate, Tensor) else (rate, None)
        records.append(compiled.AdamRule(number, at, step, first, second, epsilon, dense))
    skip, skipped, in_a_row, scale, limit = guard or (None, None, None, None, 0.0)
    if scale is not None and isinstance(machine, compiled.Cpu):
        gradients, scale = [gradient / scale for gradient in gradients], None
    judged = compiled.AdamGuard(loss, limit, skip, skipped, in_a_row, scale)
    arguments = records, parameters, gradients, means, squares, judged, [parameter.numel() for parameter in parameters]
    if isinstance(machine, compiled.Cuda):
        compiled.adam(*arguments, parameters[0].new_empty(compiled.adam_workspace(len(rules), machine)), machine)
    else:
        compiled.adam(*arguments, machine)


def average(averages: Sequence[Tensor], parameters: Sequence[Tensor] | None, share: float | Tensor) -> None:
    """Moves averages towards the parameters; see ``voronerf.ops.average``."""
    if native.on_cuda(averages[0]):
        reference.average(averages, parameters, share)  # one launch for many tensors
        return
    share, sizes = torch.as_tensor(share, dtype=torch.float32, device="cpu"), [tensor.numel() for tensor in averages]
    native.compiled.average(averages, parameters, share, sizes, native.cpu())
