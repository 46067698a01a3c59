"""Adam, by entries that have a gradient for the tables of hash grids."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from voronerf.ops.sparse_adam import sparse_adam


class Adam(torch.optim.Adam):
    """``torch.optim.Adam``, with groups of parameters whose entries without a gradient stay as they are.

    A group says ``sparse=True``; see :func:`voronerf.ops.sparse_adam`. Its state has the same names as that of the
    other groups, which are torch's.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Updates the parameters."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        groups = [group for group in self.param_groups if group.get("sparse", False)]
        tables = [(p, p.grad, group) for group in groups for p in group["params"] if p.grad is not None]
        # A scaler leaves these to an optimiser that can be fused, as torch's: the scale, and whether one overflowed.
        scale, overflow = getattr(self, "grad_scale", None), getattr(self, "found_inf", None)
        if tables and (overflow is None or not overflow.item()):
            for parameter, gradient, group in tables:
                self._step_table(parameter, gradient if scale is None else gradient / scale, group)
        for parameter, _, _ in tables:
            parameter.grad = None  # torch's step passes them over
        super().step()
        for parameter, gradient, _ in tables:
            parameter.grad = gradient
        return loss

    def _step_table(self, parameter: torch.Tensor, gradient: torch.Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        state["step"] = state["step"].cpu() + 1  # a fused optimiser loads it to the parameter's device
        sparse_adam(
            parameter,
            gradient,
            state["exp_avg"],
            state["exp_avg_sq"],
            step=int(state["step"]),
            learning_rate=group["lr"],
            betas=group["betas"],
            epsilon=group["eps"],
        )
