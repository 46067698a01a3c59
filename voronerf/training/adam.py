"""Adam, by entries that have a gradient for the tables of hash grids."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import backends
from voronerf.ops.sparse_adam import Guard, Rule, adam, sparse_adam
from voronerf.ops.sparse_adam.reference import judge


class Adam(torch.optim.Adam):
    """``torch.optim.Adam``, with groups of parameters whose entries without a gradient stay as they are.

    A group says ``sparse=True``; see :func:`voronerf.ops.sparse_adam`. Its state has the same names as that of the
    other groups, which are torch's. All float32 parameters are updated by one operation, since torch's own step takes
    longer to prepare than to compute for networks of this size.

    Args:
        params: Parameters or groups of them, as ``torch.optim.Adam`` takes them.
        lr: The learning rate.
        betas: Decay of the averages of gradients and of their squares.
        eps: Added to the root of the second moment.
        capturable: Whether a CUDA graph can record a step.
        backend: Of the operations.
    """

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
    def update(self, guard: Guard | None = None, loss: Tensor | None = None) -> None:
        """Updates the parameters, without the hooks of ``step``, which take as long as a layer of a small network.

        Args:
            guard: Leaves out the step, see :func:`voronerf.ops.adam`.
            loss: [], of the step; with it the guard judges first.
        """
        rules, tensors = [], []
        for group in self.param_groups:
            rule = group["lr"], group["betas"], group["eps"], not group.get("sparse", False)
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.zeros((), device=parameter.device)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                if state["step"].device != parameter.device:  # a checkpoint has it on the CPU
                    state["step"] = state["step"].to(parameter.device)
                rules.append(Rule(state["step"], *rule))
                tensors.append((parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"]))
        if not rules:
            return
        if self._in_one([entry[0] for entry in tensors]):
            adam(rules, *zip(*tensors, strict=True), guard=guard, loss=loss, backend=self.backend)
        else:
            self._one_by_one(rules, tensors, guard, loss)

    def _in_one(self, parameters: Sequence[Tensor]) -> bool:
        """Whether one operation takes all parameters; torch's own step is faster than the reference."""
        if not all(parameter.dtype is torch.float32 and parameter.is_contiguous() for parameter in parameters):
            return False
        chosen = backends.chosen("adam", parameters[0].device, torch.float32, backend=self.backend)
        return chosen == "native" or self.backend == "reference"

    def _one_by_one(
        self, rules: list[Rule], tensors: Sequence[tuple[Tensor, ...]], guard: Guard | None, loss: Tensor | None
    ) -> None:
        """Tables by their operation, the rest by torch's step."""
        scale = None
        if guard is not None:
            judge(guard, loss, [entry[1] for rule, entry in zip(rules, tensors) if rule.every])
            scale = guard.scale
        tables = [(rule, entry) for rule, entry in zip(rules, tensors) if not rule.every]
        for rule, (parameter, gradient, mean, square) in tables:
            if guard is None or not guard.found.item():
                rule.step.add_(1)
                given = gradient if scale is None else gradient / scale
                numbers: dict[str, Any] = {"step": int(rule.step), "learning_rate": float(rule.learning_rate)}
                options: dict[str, Any] = {"betas": rule.betas, "epsilon": rule.epsilon, "backend": self.backend}
                sparse_adam(parameter, given, mean, square, **numbers, **options)
            parameter.grad = None  # torch's step passes them over
        scaled = hasattr(self, "found_inf")  # by torch's scaler
        if guard is not None:
            self.found_inf = guard.found
        super().step()
        if guard is not None and not scaled:
            del self.found_inf
        for _, (parameter, gradient, *_) in tables:
            parameter.grad = gradient
