"""Adam with sparse updates and weight decay for the tables of hash grids, and with averaged weights."""

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
from voronerf.nerf.replay import replayed
from voronerf.ops._core.rows import varying
from voronerf.ops.adam import Guard, UpdateRule, adam, average
from voronerf.router import VoronoiRouter
from voronerf.router.optimizers import trained_parts

#: The largest averaging window as a fraction of the steps done: short windows at first, when weights change fast.
WINDOW = 1 / 30
#: The weight decay of tables. Entries that no sample reads any more, such as noise of the first steps in empty space,
#: shrink towards 0. With more than `DECAY_VIEWS` views, the decay is divided by views / `DECAY_VIEWS`, since a point is
#: then sampled less often.
TABLE_DECAY, DECAY_VIEWS = 0.1, 300
#: The key of the averaged weights in an optimiser's state, beside Adam's moments.
_AVERAGE = "average"


@replayed
class Adam(torch.optim.Adam):
    """An Adam optimiser like ``torch.optim.Adam``, with sparse updates, decoupled weight decay and averaged weights.

    A group with ``sparse=True`` updates only entries that have a gradient; ``shrink=RATE`` sets its weight decay. The
    state has the same keys as in torch. One op updates all parameters, which must be float32 and contiguous: for
    networks of this size, torch's own step takes longer to prepare than to compute.

    The state also holds exponential moving averages of the weights (``average``), for pictures and scores. Averages
    reduce noise: each cell gets few samples of a batch, so its weights fluctuate.

    Args:
        params: Parameters or groups of them, as ``torch.optim.Adam`` takes them.
        lr: The learning rate.
        betas: Decay rates of the first and second moments. After a split, each cell gets fewer samples and other
            gradients than its parent. With torch's 0.999, the moments of the parent would determine the step sizes of
            the cell for a thousand steps. In 800 steps of Lego at 100 x 100, 0.99 gains 0.7 dB over 0.999.
        eps: The constant that is added to the root of the second moment.
        average: Decay factor per step of the weights' moving averages, smaller in the first steps; 0 for no averages.
        backend: The backend of the ops.

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

    #: True: this optimiser itself skips frozen cells (`VoronoiRouter.freeze`).
    leaves_frozen = True

    # Unwrapped: torch's wrappers import its compiler in the first call, which takes over a second.
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
        self.average, self.backend, self.steps_done, self.decay = average, backend, 0, 1.0

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of torch's optimiser for a copy, and the attributes of this class."""
        own = {name: vars(self)[name] for name in ("average", "backend", "steps_done", "decay")}
        return {**super().__getstate__(), **own}

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
        """Returns an optimiser of all networks of a radiance field.

        Args:
            routers: The routers by name.
            lr: The learning rate.
            views: The number of training views; tables decay less with more views.
            sparse: Name patterns of sparse tables: a step reads few of their entries. See ``FieldType``.
            average: Decay factor per step of the weights' moving averages; 0 for no averages.
            backend: The backend of the ops.
        """
        dense, tables = parameter_groups(routers, sparse)
        groups: list[dict[str, Any]] = [{"params": dense, "sparse": False}]
        if tables:
            groups.append({"params": tables, "sparse": True, "shrink": TABLE_DECAY / max(1.0, views / DECAY_VIEWS)})
        return cls(groups, lr=lr, average=average, backend=backend)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clears the gradients like ``torch.optim.Adam``.

        Unlike torch's method, it makes no profiler record, since a record takes as long as evaluating a small layer.
        """
        if not set_to_none:
            inspect.unwrap(torch.optim.Adam.zero_grad)(self, False)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Adds a group of parameters, like ``torch.optim.Adam``.

        Raises:
            ValueError: The group sets an option of ``torch.optim.Adam`` that is not supported.
        """
        _check_group(param_group)
        inspect.unwrap(torch.optim.Adam.add_param_group)(self, param_group)

    def note_dependencies(self, noted: Any) -> list[Any]:
        """Notes attributes whose change makes a step be recorded again; learning rates are not among them."""
        noted.contents(vars(self), ["steps_done", "decay"])
        noted.contents(self.param_groups)
        for group in self.param_groups:
            noted.contents(group, ["lr"])
        return [self.state, *(group[name] for group in self.param_groups for name in ("params", "betas"))]

    def set_learning_rate(self, rate: float, *, decay: float = 1.0) -> None:
        """Sets the learning rate of all groups, and the factor by which all weight decays are multiplied."""
        self.decay = decay
        for group in self.param_groups:
            group["lr"] = rate

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Updates the parameters, like ``torch.optim.Adam``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        # A GradScaler sets these attributes on a fused optimiser: the scale, and whether a gradient overflowed.
        scale, overflow = getattr(self, "grad_scale", None), getattr(self, "found_inf", None)
        # Without a loss, `update` does not write to the guard, so `overflow` can stand in for the guard's two counters.
        self.update(None if overflow is None else Guard(overflow, overflow, overflow, scale))
        return loss

    def after_step(self, step: int) -> None:
        """Applies weight decay and updates the averages of the weights after each `GROUP` of steps.

        Once per group suffices, since weights change little within a group; reading a large table in each step would
        take time.

        Weight decay is decoupled from the gradients (Loshchilov and Hutter 2019): weights are multiplied by
        1 - lr * shrink * decay * `GROUP`, with the rate ``shrink`` of the parameter group and the factor ``decay`` of
        `set_learning_rate`. Parameters without a gradient and frozen cells do not decay. The moving averages have a
        decay factor of 1 - 1 / w per step, with the window w = `WINDOW` * step, until the factor reaches ``average``.

        Args:
            step: The number of steps done.
        """
        self.steps_done = step
        if step % schedule.GROUP == 0:
            self._shrink()
            self._average()

    @torch.no_grad()
    def _shrink(self) -> None:
        for group in self.param_groups:
            decaying = [p for p in group["params"] if p.grad is not None] if group.get("shrink") else []
            shrunk = [p[part] for p, parts in zip(decaying, trained_parts(decaying), strict=True) for part in parts]
            if shrunk:
                average(shrunk, None, varying(functools.partial(self._shrink_rate, group)), backend=self.backend)

    def _shrink_rate(self, group: Mapping[str, Any]) -> float:
        """Returns the fraction by which the weights of a parameter group shrink in `GROUP` steps."""
        return schedule.GROUP * float(group["lr"]) * float(group["shrink"]) * self.decay

    def _average_rate(self) -> float:
        """Returns the fraction by which averages move towards the weights in this group of steps."""
        return 1 - min(self.average, 1 - 1 / max(1, WINDOW * self.steps_done)) ** schedule.GROUP

    @torch.no_grad()
    def _average(self) -> None:
        if not self.average:
            return
        # Skips parameters without state, since indexing `self.state` would create a state.
        parameters = [p for group in self.param_groups for p in group["params"] if self.state.get(p)]
        averages, weights = list[Tensor](), list[Tensor]()
        for parameter, parts in zip(parameters, trained_parts(parameters), strict=True):
            state = self.state[parameter]
            if _AVERAGE not in state:
                state[_AVERAGE] = parameter.detach().clone()
            averages += [state[_AVERAGE][part] for part in parts]
            weights += [parameter[part] for part in parts]
        if weights:
            average(averages, weights, varying(self._average_rate), backend=self.backend)

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Replaces the weights by their averages within the context; weights without an average do not change."""
        parameters = [p for group in self.param_groups for p in group["params"] if _AVERAGE in self.state.get(p, {})]
        weights = [parameter.data for parameter in parameters]
        for parameter in parameters:
            parameter.data = self.state[parameter][_AVERAGE]
        try:
            yield
        finally:
            for parameter, average in zip(parameters, weights, strict=True):
                parameter.data = average

    @torch.no_grad()
    def update(self, guard: Guard | None = None, loss: Tensor | None = None) -> None:
        """Updates the parameters like :meth:`step`, but without torch's hooks, which take as long as a small layer.

        Args:
            guard: NaN guard, which may skip the step, see :func:`voronerf.ops.adam`; None for no guard.
            loss: [], the loss of the step, which the guard checks first; None for no check.

        Raises:
            ValueError: A group sets an option of ``torch.optim.Adam`` that is not supported.
        """
        entries, rules, tensors = [], [], []
        for group in self.param_groups:
            _check_group(group)
            rate = varying(functools.partial(group.__getitem__, "lr"))
            rule = rate, group["betas"], group["eps"], not group.get("sparse", False)
            entries += [(p, gradient, rule) for p in group["params"] if (gradient := p.grad) is not None]
        for (parameter, gradient, rule), parts in zip(
            entries, trained_parts([entry[0] for entry in entries]), strict=True
        ):
            state = self._state(parameter)
            step, members = state["step"], (parameter, gradient, state["exp_avg"], state["exp_avg_sq"])
            for number, part in enumerate(parts):
                rules.append(UpdateRule(step.clone() if number else step, *rule))  # a step counts once per parameter
                tensors.append(members if part is ... else tuple(tensor[part] for tensor in members))
        if rules:
            adam(rules, *zip(*tensors, strict=True), guard=guard, loss=loss, backend=self.backend)

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        """Returns the state of a parameter on its device; a checkpoint holds the step count on the CPU."""
        state = self.state[parameter]
        if not state:  # the entries are added at once, so an interrupt leaves none of them
            moments = {"exp_avg": torch.zeros_like(parameter), "exp_avg_sq": torch.zeros_like(parameter)}
            state.update(step=torch.zeros((), dtype=torch.float32, device=parameter.device), **moments)
        if state["step"].get_device() != parameter.get_device():
            state["step"] = state["step"].to(parameter.device)
        return state


_UNSUPPORTED = ("weight_decay", "amsgrad", "maximize", "differentiable")


def _check_group(group: Mapping[str, Any]) -> None:
    if not any(map(group.get, _UNSUPPORTED)):
        return
    for option in _UNSUPPORTED:
        if group.get(option):
            remedy = "; use shrink=RATE for decoupled weight decay" if option == "weight_decay" else ""
            raise ValueError(f"Adam: {option} of a group must be 0 or False, got {group[option]}{remedy}")


def parameter_groups(
    routers: Mapping[str, VoronoiRouter], sparse: Sequence[str] = ()
) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Returns the parameters in the optimiser's order: the dense parameters, then the tables."""
    dense, tables = list[nn.Parameter](), list[nn.Parameter]()
    for router in routers.values():
        for name, parameter in router.module.named_parameters():
            (tables if any(fnmatch.fnmatchcase(name, each) for each in sparse) else dense).append(parameter)
    return dense, tables
