"""Adam, by entries that have a gradient for the tables of hash grids; weight decay of tables, and averaged weights."""

from __future__ import annotations

import fnmatch
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.nerf import schedule
from voronerf.nerf.segment import replayed
from voronerf.ops._core.rows import varying
from voronerf.ops.adam import Guard, Rule, adam, average
from voronerf.router import VoronoiRouter
from voronerf.router.optimizers import trained_parts

#: The window of an average is at most this part of the steps done, since weights move far in the first steps.
WINDOW = 1 / 30
#: Weight decay of tables: of what nothing asks for again, such as noise that early steps have left in empty space. With
#: more views than these it is less by as much: a place is asked for again only after many more steps.
TABLE_DECAY, DECAY_VIEWS = 0.1, 300
#: Key of the averaged weights in an optimiser's state, beside Adam's moments.
_AVERAGE = "average"


@replayed
class Adam(torch.optim.Adam):
    """``torch.optim.Adam``, with groups of parameters whose entries without a gradient stay as they are.

    A group says ``sparse=True``, and ``shrink=RATE`` for weight decay. The state has the names of torch's. All
    parameters, which are float32 and contiguous, are updated by one operation, since torch's own step takes longer to
    prepare than to compute for networks of this size.

    Averages of the weights over the last steps, for pictures and scores, lie in the state too (``average``): each cell
    meets few of a batch's samples, so its weights jitter around what they would be with more of them.

    Args:
        params: Parameters or groups of them, as ``torch.optim.Adam`` takes them.
        lr: The learning rate.
        betas: Decay of the averages of gradients and of their squares. After a split each cell sees fewer samples and
            other gradients than its parent; with torch's 0.999 the moments of the parent would set its step sizes for a
            thousand steps. The change is worth 0.7 dB after 800 steps of Lego at 100 x 100.
        eps: Added to the root of the second moment.
        average: Decay per step of the averaged weights, smaller in the first steps; 0 for none.
        backend: Of the operations.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Adam
        >>> weight = torch.nn.Parameter(torch.ones(3))
        >>> optimizer = Adam([weight], lr=0.001, average=0.9)
        >>> for step in range(400):
        ...     weight.grad = torch.ones(3)
        ...     optimizer.update()
        ...     optimizer.after_step(step + 1)
        >>> with optimizer.averaged():
        ...     shown = weight.detach().clone()
        >>> bool((shown > weight).all())
        True
    """

    #: Whether it passes over frozen cells (`VoronoiRouter.freeze`) by itself.
    leaves_frozen = True

    # The first call of torch's own imports its compiler, to keep it off them, which takes over a second.
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)

    def __init__(
        self,
        params: Iterable[Any],
        *,
        lr: float,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-15,
        average: float = 0.0,
        backend: str = "auto",
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps, fused=True)
        self.average, self.backend, self.steps_done = average, backend, 0

    @classmethod
    def of(
        cls,
        routers: Mapping[str, VoronoiRouter],
        *,
        lr: float,
        views: int = 1,
        sparse: Sequence[str] = (),
        average: float = 0.98,
        backend: str = "auto",
    ) -> Adam:
        """An optimiser of all networks of a radiance field.

        Args:
            routers: The networks by name.
            lr: The learning rate.
            views: Of the training; the more of them, the less a table decays.
            sparse: Names of tables, as patterns, of which a step reads few entries; see ``FieldType``.
            average: Decay per step of the averaged weights.
            backend: Of the operations.
        """
        dense, tables = parameter_groups(routers, sparse)
        groups: list[dict[str, Any]] = [{"params": dense, "sparse": False}]
        if tables:
            groups.append({"params": tables, "sparse": True, "shrink": TABLE_DECAY / max(1.0, views / DECAY_VIEWS)})
        return cls(groups, lr=lr, average=average, backend=backend)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """See ``torch.optim.Adam``; leaves no mark for profilers, which takes as long as a small layer."""
        if not set_to_none:
            inspect.unwrap(torch.optim.Adam.zero_grad)(self, False)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Adds a group of parameters, as ``torch.optim.Adam``.

        Raises:
            ValueError: The group sets an option of ``torch.optim.Adam`` that is not supported.
        """
        _check_group(param_group)
        inspect.unwrap(torch.optim.Adam.add_param_group)(self, param_group)

    def set_learning_rate(self, rate: float) -> None:
        """Sets the learning rate of all groups."""
        for group in self.param_groups:
            group["lr"] = rate

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

    def after_step(self, step: int) -> None:
        """Weight decay of the groups that have it, and the averages of the weights, after each `GROUP` of steps.

        In between weights are much the same, and a large table takes time to read.

        Decay is apart from the gradients (Loshchilov and Hutter 2019): weights are multiplied by 1 - lr * RATE for each
        step. Parameters without a gradient and frozen cells stay. An average's decay per step is 1 - 1 / w with the
        window w = `WINDOW` * step, until it reaches ``average``.

        Args:
            step: Steps done.
        """
        self.steps_done = step
        if step % schedule.GROUP == 0:
            self._shrink()
            self._average()

    @torch.no_grad()
    def _shrink(self) -> None:
        for group in self.param_groups:
            held = [p for p in group["params"] if p.grad is not None] if group.get("shrink") else []
            shrunk = [p[part] for p, parts in zip(held, trained_parts(held), strict=True) for part in parts]
            if shrunk:
                average(shrunk, None, varying(functools.partial(_shrinks, group)), backend=self.backend)

    def _moved(self) -> float:
        """By what share averages now move to the weights."""
        return 1 - min(self.average, 1 - 1 / max(1, WINDOW * self.steps_done)) ** schedule.GROUP

    @torch.no_grad()
    def _average(self) -> None:
        if not self.average:
            return
        # Those that have state: a look at it would make state for all of them.
        parameters = [p for group in self.param_groups for p in group["params"] if self.state.get(p)]
        averages, weights = list[Tensor](), list[Tensor]()
        for parameter, parts in zip(parameters, trained_parts(parameters), strict=True):
            state = self.state[parameter]
            if _AVERAGE not in state:
                state[_AVERAGE] = parameter.detach().clone()
            averages += [state[_AVERAGE][part] for part in parts]
            weights += [parameter[part] for part in parts]
        if weights:
            average(averages, weights, varying(self._moved), backend=self.backend)

    def drop_averages(self) -> None:
        """Begins all averages anew at the next update."""
        for state in self.state.values():
            state.pop(_AVERAGE, None)

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Puts the averages where the weights are, as long as the context lasts; weights without an average stay."""
        held = [p for group in self.param_groups for p in group["params"] if _AVERAGE in self.state.get(p, {})]
        weights = [parameter.data for parameter in held]
        for parameter in held:
            parameter.data = self.state[parameter][_AVERAGE]
        try:
            yield
        finally:
            for parameter, average in zip(held, weights, strict=True):
                parameter.data = average

    @torch.no_grad()
    def update(self, guard: Guard | None = None, loss: Tensor | None = None) -> None:
        """:meth:`step` without its hooks, which take as long as a layer of a small network.

        Args:
            guard: Leaves out the step, see :func:`voronerf.ops.adam`; None for never.
            loss: [], of the step; with it the guard judges first.

        Raises:
            ValueError: A group sets an option of ``torch.optim.Adam`` that is not supported.
        """
        held, rules, tensors = [], [], []
        for group in self.param_groups:
            _check_group(group)
            rate = varying(functools.partial(group.__getitem__, "lr"))
            rule = rate, group["betas"], group["eps"], not group.get("sparse", False)
            held += [(p, gradient, rule) for p in group["params"] if (gradient := p.grad) is not None]
        for (parameter, gradient, rule), parts in zip(held, trained_parts([entry[0] for entry in held]), strict=True):
            state = self._state(parameter)
            step, whole = state["step"], (parameter, gradient, state["exp_avg"], state["exp_avg_sq"])
            for number, part in enumerate(parts):
                rules.append(Rule(step.clone() if number else step, *rule))  # counted once for a parameter
                tensors.append(whole if part is ... else tuple(tensor[part] for tensor in whole))
        if rules:
            adam(rules, *zip(*tensors, strict=True), guard=guard, loss=loss, backend=self.backend)

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        """The state of a parameter, on its device: a checkpoint has the steps done on the CPU."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        if state["step"].get_device() != parameter.get_device():
            state["step"] = state["step"].to(parameter.device)
        return state


_REFUSED = ("weight_decay", "amsgrad", "maximize", "differentiable")


def _check_group(group: Mapping[str, Any]) -> None:
    if not any(map(group.get, _REFUSED)):
        return
    for option in _REFUSED:
        if group.get(option):
            remedy = "; use shrink=RATE for decoupled weight decay" if option == "weight_decay" else ""
            raise ValueError(f"Adam: {option} of a group must be 0 or False, got {group[option]}{remedy}")


def _shrinks(group: Mapping[str, Any]) -> float:
    """By what share the weights of a group get smaller at once."""
    return schedule.GROUP * float(group["lr"]) * float(group["shrink"])


def parameter_groups(
    routers: Mapping[str, VoronoiRouter], sparse: Sequence[str] = ()
) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The parameters in the order that an optimiser numbers them: those of the networks, then the tables."""
    dense, tables = list[nn.Parameter](), list[nn.Parameter]()
    for router in routers.values():
        for name, parameter in router.module.named_parameters():
            (tables if any(fnmatch.fnmatchcase(name, each) for each in sparse) else dense).append(parameter)
    return dense, tables
