"""Adam, by entries that have a gradient for the tables of hash grids."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from voronerf.ops.adam import Guard, Rule, adam
from voronerf.router.optimizers import trained_parts


class Adam(torch.optim.Adam):
    """``torch.optim.Adam``, with groups of parameters whose entries without a gradient stay as they are.

    A group says ``sparse=True``, and ``shrink=RATE`` for weight decay, see :meth:`shrink`. The state has the names of
    torch's. All parameters, which are float32 and contiguous, are updated by one operation, since torch's own step
    takes longer to prepare than to compute for networks of this size.

    Args:
        params: Parameters or groups of them, as ``torch.optim.Adam`` takes them.
        lr: The learning rate.
        betas: Decay of the averages of gradients and of their squares.
        eps: Added to the root of the second moment.
        capturable: Whether a CUDA graph can record a step.
        backend: Of the operations.
    """

    #: Whether it passes over frozen cells (`VoronoiRouter.freeze`) by itself.
    leaves_frozen = True

    # The first call of torch's own imports its compiler, to keep it off them, which takes over a second.
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)

    def __init__(
        self,
        params: Iterable[Any],
        *,
        lr: float | Tensor,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        capturable: bool = False,
        backend: str = "auto",
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps, capturable=capturable, fused=True)
        self.backend = backend

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Drops the gradients, or fills them with zeros; torch's takes as long as a layer of a small network."""
        if set_to_none:
            for group in self.param_groups:
                for parameter in group["params"]:
                    parameter.grad = None
        else:
            super().zero_grad(set_to_none=False)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Updates the parameters, as of ``torch.optim.Adam``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        # A scaler leaves these to an optimiser that can be fused, as torch's: the scale, and whether one overflowed.
        scale, overflow = getattr(self, "grad_scale", None), getattr(self, "found_inf", None)
        # Without a loss nothing is counted.
        self.update(None if overflow is None else Guard(overflow, overflow, overflow, scale))
        return loss

    @torch.no_grad()
    def shrink(self, steps: int) -> None:
        """Weight decay apart from the gradients (Loshchilov and Hutter 2019), of groups that say ``shrink=RATE``.

        Their weights are multiplied by 1 - steps * lr * RATE. Parameters without a gradient and frozen cells stay.

        Args:
            steps: For which this stands.
        """
        for group in self.param_groups:
            held = [p for p in group["params"] if p.grad is not None] if group.get("shrink") else []
            for parameter, parts in zip(held, trained_parts(held), strict=True):
                for part in parts:
                    parameter[part].mul_(1 - steps * group["lr"] * group["shrink"])

    @torch.no_grad()
    def update(self, guard: Guard | None, loss: Tensor | None = None) -> None:
        """:meth:`step` without its hooks, which take as long as a layer of a small network.

        Args:
            guard: Leaves out the step, see :func:`voronerf.ops.adam`; None for never.
            loss: [], of the step; with it the guard judges first.
        """
        rules, tensors = [], []
        held = [(p, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        for (parameter, group), parts in zip(held, trained_parts([entry[0] for entry in held]), strict=True):
            state = self._state(parameter)
            step, every = state["step"], not group.get("sparse", False)
            own = parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"]
            for number, part in enumerate(parts):
                counted = step.clone() if number else step  # once for a parameter
                rules.append(Rule(counted, group["lr"], group["betas"], group["eps"], every))
                tensors.append(own if part is ... else tuple(tensor[part] for tensor in own))
        if rules:
            adam(rules, *zip(*tensors, strict=True), guard=guard, loss=loss, backend=self.backend)

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        """The state of a parameter, on its device: a checkpoint has the steps done on the CPU."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        if state["step"].device != parameter.device:
            state["step"] = state["step"].to(parameter.device)
        return state
