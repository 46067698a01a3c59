"""Adam, by entries that have a gradient for the tables of hash grids."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from voronerf import backends
from voronerf.ops.sparse_adam import Rule, adam, sparse_adam
from voronerf.router.optimizers import trained_parts


class Adam(torch.optim.Adam):
    """``torch.optim.Adam``, with groups of parameters whose entries without a gradient stay as they are.

    A group says ``sparse=True``; see :func:`voronerf.ops.sparse_adam`. Its state has the same names as that of the
    other groups, which are torch's. On the CPU all float32 parameters are updated by one operation, since torch's own
    step takes longer to prepare than to compute for networks of this size.

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
        """Updates the parameters."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if self._is_on_device():
            self._step_on_device()
            return loss
        entries = [(p, p.grad, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        together = self.leaves_frozen()
        own = [entry for entry in entries if together or entry[2].get("sparse", False)]
        # A scaler leaves these to an optimiser that can be fused, as torch's: the scale, and whether one overflowed.
        scale, overflow = getattr(self, "grad_scale", None), getattr(self, "found_inf", None)
        if own and (overflow is None or not overflow.item()):
            if scale is not None:
                own = [(parameter, gradient / scale, group) for parameter, gradient, group in own]
            if together:
                self._step_together(own)
            else:
                for parameter, gradient, group in own:
                    self._step_table(parameter, gradient, group)
        if not together:
            for parameter, _, _ in own:
                parameter.grad = None  # torch's step passes them over
            super().step()
            for parameter, gradient, _ in own:
                parameter.grad = gradient
        return loss

    def leaves_frozen(self) -> bool:
        """Whether one operation takes all parameters, and passes over frozen cells (`VoronoiRouter.freeze`)."""
        held = (p for group in self.param_groups for p in group["params"] if p.grad is not None)
        return self._in_one() and all(_is_plain(parameter) for parameter in held)

    def _in_one(self) -> bool:
        """Whether one operation takes all parameters on the CPU; torch's own step is faster than the reference."""
        chosen = backends.chosen("adam", torch.device("cpu"), torch.float32, backend=self.backend)
        return chosen == "native" or self.backend == "reference"

    def _step_together(self, entries: list[tuple[Tensor, Tensor, dict[str, Any]]]) -> None:
        rules, tensors = [], []
        for (parameter, gradient, group), parts in zip(entries, trained_parts([entry[0] for entry in entries])):
            state, step = self._next(parameter)
            rule = Rule(step, float(group["lr"]), group["betas"], group["eps"], not group.get("sparse", False))
            own = parameter, gradient, state["exp_avg"], state["exp_avg_sq"]
            rules += [rule] * len(parts)
            tensors += [[tensor[part] for tensor in own] for part in parts]
        adam(rules, *(list(column) for column in zip(*tensors)), backend=self.backend)

    def _step_table(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state, step = self._next(parameter)
        sparse_adam(
            parameter,
            gradient,
            state["exp_avg"],
            state["exp_avg_sq"],
            step=step,
            learning_rate=group["lr"],
            betas=group["betas"],
            epsilon=group["eps"],
            backend=self.backend,
        )

    def _next(self, parameter: Tensor) -> tuple[dict[str, Tensor], int]:
        """The state of a parameter, and the number of the step that comes, which is counted."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        step = state["step"] = state["step"].cpu()  # a fused optimiser loads it to the parameter's device
        step += 1
        return state, int(step)

    def _is_on_device(self) -> bool:
        """Whether the compiled module's CUDA step takes all parameters, for which the host does not wait."""
        parameters = [p for group in self.param_groups for p in group["params"] if p.grad is not None]
        if not parameters or backends.why_not("sparse_adam", "native", parameters[0].device) is not None:
            return False
        from voronerf import native

        return all(native.on_cuda(p) and p.dtype == torch.float32 and p.is_contiguous() for p in parameters)

    def _step_on_device(self) -> None:
        from voronerf.ops.sparse_adam.native import Judged, Rule, adam_on_device

        rates: dict[float, Tensor] = {}
        rules, tensors = [], []
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                rate, device, state = group["lr"], parameter.device, self.state[parameter]
                if not isinstance(rate, Tensor):
                    if rate not in rates:
                        rates[rate] = torch.full((), rate, device=device)
                    rate = rates[rate]
                if not state:
                    state["step"] = torch.zeros((), device=device)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                state["step"] = state["step"].to(device)  # a checkpoint of a CPU has it there
                first, second = group["betas"]
                every = not group.get("sparse", False)
                rules.append(Rule(rate.to(device), state["step"], first, second, group["eps"], every))
                tensors.append((parameter.grad, parameter, state["exp_avg"], state["exp_avg_sq"]))
        found = getattr(self, "found_inf", None)
        judged = None if found is None else Judged(found)
        gradients, parameters, means, squares = zip(*tensors, strict=True)
        adam_on_device(
            rules, gradients, parameters, means, squares, judged=judged, scale=getattr(self, "grad_scale", None)
        )


def _is_plain(parameter: Tensor) -> bool:
    return parameter.is_cpu and parameter.dtype == torch.float32 and parameter.is_contiguous()
