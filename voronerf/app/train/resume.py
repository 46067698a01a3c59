"""Conversion of a training state to a checkpoint and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.app.train.build import make_routers, parameter_shapes
from voronerf.app.train.checkpoint import Checkpoint, CheckpointError, load_optimizer_tensors, optimizer_tensors
from voronerf.app.train.config import TrainConfig, differences
from voronerf.app.train.schema import check_types
from voronerf.app.train.state import State, TrainingStage
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.adam import parameter_groups
from voronerf.nerf.samplers import SAMPLERS
from voronerf.nerf.schedule import MOST_LENGTH
from voronerf.router import VoronoiRouter

#: The names of the counters, in a state and in a checkpoint.
COUNTERS = ("step", "seconds", "evaluation_seconds", "reserved_seconds", "rays", "rays_done", "skipped")


@dataclass(frozen=True)
class Stored:
    """The values of a checkpoint except its tensors, named like the attributes of `State`."""

    config: dict[str, Any]
    step: int
    seconds: float
    evaluation_seconds: float
    reserved_seconds: float
    rays: int
    rays_done: int
    stages: tuple[dict[str, Any], ...]
    skipped: int
    threads: int


def snapshot(state: State) -> Checkpoint:
    """Returns a checkpoint for a bit-exact resume: parameters, moments, samples, random generators and counters."""
    values = {name: getattr(state, name) for name in COUNTERS}
    values |= {"config": state.config.to_values(), "threads": _threads(state)}
    values |= {"stages": [asdict(stage) for stage in state.stages]}
    groups: dict[str, Mapping[str, Any]] = {group(name): r.state_dict() for name, r in state.routers.items()}
    groups |= {"optimizer": optimizer_tensors(state.optimizer), "strategy": state.strategy.state_dict()}
    groups |= {"generator": {"state": state.generator.get_state(), "draws": state.draws.get_state()}}
    if (grid := state.sampler.grid) is not None:
        groups["occupancy"] = grid.state_dict()
    if state.scaler.is_enabled():
        groups["scaler"] = state.scaler.state_dict()
    tensors = {
        f"{prefix}.{name}": _tensor(value).detach().to("cpu", copy=True).contiguous()  # copied
        for prefix, entries in groups.items()
        for name, value in entries.items()
    }
    return Checkpoint(tensors, values)


def _tensor(value: Tensor | float) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, device="cpu")


def load(state: State, checkpoint: Checkpoint) -> None:
    """Restores a training from a checkpoint into a new state.

    Args:
        state: The new state, from :func:`voronerf.app.train.build`.
        checkpoint: A checkpoint of a training with the same settings, except for `RESUMABLE` settings, which may
            differ.

    Raises:
        CheckpointError: If the checkpoint has another configuration, or its contents are incomplete or do not fit.

    Examples:
        >>> from voronerf.app.scenes import builtin_scene
        >>> from voronerf.app.train import TrainConfig, build, load, snapshot, train
        >>> scene = builtin_scene(16, train_views=4, test_views=2)
        >>> config = TrainConfig(steps=20, cells=(4,), width=8, rays=64)
        >>> first, second = build(config, scene), build(config, scene)  # each a State
        >>> train(first)
        >>> load(second, snapshot(first))
        >>> second.step, second.router.num_cells
        (20, 4)
    """
    config, stored = stored_values(checkpoint)
    different = differences(config, state.config)
    if different:
        raise CheckpointError(f"{checkpoint.source}: a checkpoint of another configuration: {'; '.join(different)}")
    check_shapes(config, checkpoint)
    restore_routers(state.routers, checkpoint)
    try:
        if stored.step and not checkpoint.group("optimizer"):
            raise ValueError(f"no moments of the optimiser after {stored.step} steps")
        load_optimizer_tensors(state.optimizer, checkpoint.group("optimizer"))
        state.scaler.load_state_dict({name: value.item() for name, value in checkpoint.group("scaler").items()})
        if (grid := state.sampler.grid) is not None:
            grid.load_state_dict(checkpoint.group("occupancy"))
        state.strategy.load_state_dict(checkpoint.group("strategy"))
        generators = checkpoint.group("generator")
        state.generator.set_state(generators["state"])
        draws = generators["draws"]
        if state.draws is not state.generator and draws.shape == state.draws.get_state().shape:
            state.draws.set_state(draws)  # otherwise the training began on another type of device, such as a GPU
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{checkpoint.source}: not a checkpoint of a training: {error}") from None
    counts = stored.threads, _threads(state)
    earlier, current = (f"torch on {n} thread{'s' * (n > 1)}" if n else "native operations" for n in counts)
    if earlier != current and state.device.type == "cpu":
        state.report(
            f"the resume is not bit-exact: {checkpoint.source} was computed by {earlier}, later steps by {current}"
        )
    state.restore(**{name: getattr(stored, name) for name in (*COUNTERS, "stages")})


def _threads(state: State) -> int:
    """Returns torch's number of threads, which affects the rounding of its sums; 0 if all networks run natively."""
    return 0 if state.thread_deterministic else torch.get_num_threads()


def stored_values(checkpoint: Checkpoint) -> tuple[TrainConfig, Stored]:
    """Returns the settings and the values of a checkpoint, after checking them."""
    source, values = checkpoint.source, dict(checkpoint.values)
    if "step" not in values:
        raise CheckpointError(f"{source}: must be the checkpoint of one training, as voronerf train writes it")
    try:
        if isinstance(values.get("stages"), list):
            values["stages"] = tuple(values["stages"])
        check_types(source, Stored, values)
        for number, stage in enumerate(values["stages"]):
            check_types(f"{source}: stage {number}", TrainingStage, stage)
        stored = Stored(**values)
        times = [stored.seconds, stored.evaluation_seconds, stored.reserved_seconds]
        if not (stored.step >= 0 and all(0 <= each < math.inf for each in times) and stored.stages):
            actual = f"got {stored.step}, {times} and {len(stored.stages)}"
            raise ValueError(f"{source}: step, times and stages must be counts, {actual}")
    except ValueError as error:
        raise CheckpointError(str(error)) from None
    config = TrainConfig.from_values(stored.config, source)
    least = int(config.rays or 0)
    most = int(least * config.field_type.ray_growth * MOST_LENGTH**2)
    if not least <= stored.rays <= most:
        raise CheckpointError(f"{source}: rays must lie in {least} to {most} by its settings, got {stored.rays}")
    return config, stored


def check_shapes(config: TrainConfig, checkpoint: Checkpoint) -> None:
    """Checks that a checkpoint's parameters are float32 and have the networks' shapes, before memory is allocated."""
    for name in SAMPLERS[config.sampling].networks(config.field_type.cones):
        tensors = checkpoint.group(group(name))
        try:
            diagram, shapes = VoronoiDiagram.from_state(tensors, "diagram."), parameter_shapes(config)
        except (ValueError, TypeError) as error:
            raise CheckpointError(f"{checkpoint.source}: {error}") from None
        for key, (shape, shared) in shapes.items():
            wanted = [*([] if shared else [diagram.num_cells]), *shape]
            tensor = tensors.get(f"module.{key}")
            if tensor is None or list(tensor.shape) != wanted or tensor.dtype != torch.float32:
                actual = (
                    "nothing" if tensor is None else f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
                )
                raise CheckpointError(
                    f"{checkpoint.source}: the checkpoint is of another architecture: {group(name)}.module.{key} "
                    f"must be float32 {wanted}, got {actual}"
                )


def restore_routers(routers: Mapping[str, VoronoiRouter], checkpoint: Checkpoint, *, assign: bool = False) -> None:
    """Loads a checkpoint's cells, whose number may differ; ``assign`` uses the checkpoint's tensors without copies."""
    for name, router in routers.items():
        try:
            router.load_state_dict(checkpoint.group(group(name)), assign=assign)
        except RuntimeError as error:
            line = str(error).splitlines()[-1]
            raise CheckpointError(f"{checkpoint.source}: the checkpoint is of another architecture: {line}") from None


def open_routers(
    config: TrainConfig, checkpoint: Checkpoint, device: torch.device | str, backend: str
) -> dict[str, VoronoiRouter]:
    """Returns a checkpoint's routers with averaged weights, in eval mode; on the CPU they share the tensors."""
    check_shapes(config, checkpoint)
    routers = make_routers(config, device)
    restore_routers(routers, checkpoint, assign=torch.device(device).type == "cpu")
    dense, tables = parameter_groups(routers, config.field_type.sparse_parameters)
    for index, parameter in enumerate((*dense, *tables)):
        name = f"optimizer.{index}.average"
        average = checkpoint.tensors.get(name)
        if average is None:
            continue
        if average.shape != parameter.shape:
            wanted, actual = list(parameter.shape), list(average.shape)
            raise CheckpointError(f"{checkpoint.source}: {name} must have shape {wanted}, got {actual}")
        parameter.data = average.to(parameter)
    for router in routers.values():
        router.backend = backend
        router.eval()
    return routers


def group(name: str) -> str:
    """Returns the prefix of the names of a network's tensors in a checkpoint."""
    return "router" if name == "field" else f"router-{name}"
