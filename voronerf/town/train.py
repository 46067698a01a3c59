"""Training in territories: regions of space with networks, grid, optimiser and views of their own. Rays cross borders.

The territories are distributed over the ranks. The results of a territory do not depend on its rank, so that one
process trains the same run as several, bit for bit. T territories.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.files import json_text, write_text
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import write_scene
from voronerf.app.train import Callback, Checkpoint, CheckpointError, ConfigError, State, TrainConfig, build, load
from voronerf.app.train.build import make_batches, make_grid
from voronerf.app.train.callbacks import KEPT, PATIENCE, Divergence, all_finite, diverged
from voronerf.app.train.checkpoint import (
    checkpoint_path,
    checkpoint_paths,
    keep_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from voronerf.app.train.defaults import resolve, unseen_move
from voronerf.app.train.loop import count, prepare
from voronerf.app.train.loop import train as train_alone
from voronerf.app.train.resume import snapshot
from voronerf.app.train.start import judge_start, judged_at
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf import Occupancy, OccupancyGrid, Perspective
from voronerf.nerf.radiance import Radiance, radiance_of
from voronerf.nerf.schedule import GROUP
from voronerf.ops._core import backends
from voronerf.town.geometry import Similarity
from voronerf.town.group import Group, RankLost
from voronerf.town.rays import Territory, step_together
from voronerf.town.run import TOWN, index_of
from voronerf.town.territories import Territories, cut_space

#: Number of steps between exchanges of the bounds of occupied space; the first exchanges are more frequent.
EXCHANGE_EVERY = 64
#: Number of steps between agreements of the ranks on the elapsed time and on a stop.
AGREE_EVERY = 8
#: Greatest number of voxels of the occupancy grid of a finished run.
VOXELS = 1 << 21


@dataclass
class Town:
    """The state of a training in territories on one rank; :func:`build_town` makes it.

    Attributes:
        config: The settings of a territory.
        render_config: The settings for rendering the whole run; a ray has enough samples to be sampled as densely as in
            the first territory.
        scene: The whole scene.
        group: The ranks.
        territories: All territories.
        owner: The rank of each territory, [T].
        states: The training states of this rank's territories, by number.
        members: The territories of this rank by number, for the exchange of rays.
        bounds: [T, 2, 3], a box around the occupied space of each territory.
        stopping: Whether this rank was asked to end the training.
    """

    config: TrainConfig
    render_config: TrainConfig
    scene: Scene
    group: Group
    territories: Territories
    owner: list[int]
    states: dict[int, State]
    members: dict[int, Territory]
    bounds: Tensor
    stopping: bool = False

    @property
    def out(self) -> Path:
        """The run directory."""
        assert self.config.out is not None
        return self.config.out

    @property
    def first(self) -> State:
        """The state of this rank's first territory; time and steps are the same in all states."""
        return next(iter(self.states.values()))

    def stop(self) -> None:
        """Ends the training on all ranks within `AGREE_EVERY` steps, with a checkpoint."""
        self.stopping = True
        if len(self.owner) == 1:
            self.first.stop()

    def exchange_bounds(self) -> None:
        """Exchanges the bounds of occupied space between ranks."""
        bounds = torch.zeros_like(self.bounds)
        for number, state in self.states.items():
            bounds[number] = self.members[number].place.bounds(grid_of(state))
        self.bounds = self.group.total(bounds)


def grid_of(state: State) -> OccupancyGrid:
    """Returns the occupancy grid of a territory, which always has one, see `check_territories`."""
    assert state.sampler.grid is not None
    return state.sampler.grid


def check_territories(config: TrainConfig, count: int, ranks: int) -> None:
    """Rejects settings that a training in territories does not support."""
    rules: dict[str, tuple[bool, str]] = {
        "out": (config.out is not None, "be given: all ranks write there"),
        "sampling": (config.sampling == "stratified", "be stratified: a ray is split between territories"),
        "field": (not config.field_type.cones, "take points: cones cross borders"),
        "contraction": (config.contraction != "ndc", "be none or sphere: parts have no normalised device coordinates"),
        "occupancy": (config.occupancy, "be on"),
        "precision": (config.precision == "fp32", "be fp32"),
        "sparse_depth": (count == 1 or not config.sparse_depth, "be 0: a ray is split between territories"),
    }
    for name, (fits, text) in rules.items():
        if not fits:
            (rule, colon, reason), setting = text.partition(":"), getattr(config, name)
            option = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{option} must {rule} with --territories{colon}{reason}, got {setting!r}")
    if count < ranks:
        raise ConfigError(f"--territories must be at least the {ranks} ranks, got {count}")


def build_town(
    config: TrainConfig, scene: Scene, count: int, group: Group, *, on_event: Callable[[str], None] | None = None
) -> Town:
    """Builds a training in territories on this rank, before its first step.

    Args:
        config: The settings of a territory.
        scene: The scene that ``config.data`` names.
        count: The number of territories, T.
        group: The ranks.
        on_event: Called with a line of text for each event.
    """
    config = config if count == 1 else replace(config, sparse_depth=0.0)
    check_territories(config, count, group.size)
    resolved = resolve(config, scene)
    check_territories(resolved, count, group.size)
    space = scene.space(resolved.contraction)
    contraction, unseen = space.contraction, unseen_move(scene, space) if count == 1 else 0.0
    try:
        territories = cut_space(scene, count, contraction)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    owner = [number * group.size // count for number in range(count)]
    states: dict[int, State] = {}
    members: dict[int, Territory] = {}
    for number in (n for n in range(count) if owner[n] == group.rank):
        seed = (config.seed + 1_000_003 * number) % 2**63
        territory_config = replace(config, seed=seed, sparse_depth=resolved.sparse_depth)
        batches = make_batches(territory_config, scene, territories.views(number), unseen=unseen)
        place = territories.place(number)
        state = states[number] = build(
            territory_config, territories.scene(scene, number), batches=batches, on_event=on_event
        )
        obstacle, radiance = state.ray_loss.why_not_fused(), radiance_of(state.renderer.field)
        if isinstance(radiance, Radiance) and radiance.networks.density_scale is None:
            obstacle = obstacle or "its activations are not a sigmoid and a scaled softplus"
        if obstacle is not None:
            raise ConfigError(f"--field {config.field} cannot be trained in territories: {obstacle}")
        if contraction is None:
            sampler, grid = state.sampler, grid_of(state)
            state.renderer.sampler = Occupancy(
                grid,
                sampler.samples,
                space=sampler.space,
                empty=place.outside(grid),
                backend=sampler.backend,
            )
        members[number] = Territory(place, state.training_step)
    render_config = resolved
    if contraction is None and scene.box is not None:
        lengths = [float((box[1] - box[0]).norm()) for box in (scene.box, territories.boxes[0])]
        samples = resolve(config, territories.scene(scene, 0)).samples or (64,)
        render_config = replace(resolved, samples=(math.ceil(samples[0] * lengths[0] / lengths[1]),))
    return Town(config, render_config, scene, group, territories, owner, states, members, territories.boxes.clone())


class _Saver(Callback):
    """A callback that writes the checkpoints of a training whose only territory is the whole scene."""

    group = GROUP

    def __init__(self, town: Town, interval: float) -> None:
        self.town, self.interval, self.saved_at = town, interval, town.first.seconds

    def after_step(self, state: State) -> None:
        if state.seconds - self.saved_at >= self.interval:
            save(self.town)
            self.saved_at = state.seconds


def train(
    town: Town,
    callbacks: Sequence[Callback] = (),
    *,
    checkpoint_every: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> None:
    """Trains to the end, or until :meth:`Town.stop`; all ranks call it together.

    Args:
        town: The training from :func:`build_town`.
        callbacks: Called with the state of this rank's first territory.
        checkpoint_every: Seconds of training between checkpoints; another one is written at the end.
        clock: Function that returns the time in seconds; all ranks use the time of rank 0.

    Raises:
        TrainingError: Gradients or parameters are no longer finite; the last checkpoint stays.
        OSError: A checkpoint cannot be written.
        RankLost: Another rank has ended.
    """
    group, first, passed, saved_at = town.group, town.first, 0.0, town.first.seconds
    if len(town.owner) == 1:  # no ray crosses a border
        train_alone(first, [*callbacks, Divergence(town.out), _Saver(town, checkpoint_every)], clock=clock)
        return save(town)
    one_thread = all(state.thread_deterministic for state in town.states.values())
    while first.fraction < 1 and not first.stopped:
        started = clock()
        with backends.torch_on_one_thread() if one_thread else nullcontext():
            if first.step % EXCHANGE_EVERY == 0 or (first.step < EXCHANGE_EVERY and first.step & (first.step - 1) == 0):
                town.exchange_bounds()
            for state in town.states.values():
                prepare(state, patient=True)
            rays = {number: state.rays for number, state in town.states.items()}
            steps_done = {number: state.step - state.began for number, state in town.states.items()}
            results = step_together(group, town.members, town.owner, town.bounds, rays, steps_done)
            for number, state in town.states.items():
                count(state, 1, results[number])
                if state.step == judged_at(state):
                    judge_start(state, results[number].whole())
        passed += clock() - started
        if group.size == 1 or first.step % AGREE_EVERY == 0 or first.step == town.config.steps:
            agreed = torch.tensor([passed * (group.rank == 0), float(town.stopping)], dtype=torch.float64)
            seconds, stop = group.total(agreed).tolist()
            passed = 0.0
            for state in town.states.values():
                state.add_seconds(seconds)
                if stop > 0:
                    state.stop()
                if state.skipped_in_a_row >= PATIENCE:
                    raise diverged(
                        town.out,
                        f"the gradients of {state.skipped_in_a_row} consecutive steps are not finite",
                        state,
                    )
        for callback in callbacks:
            callback.after_step(first)
        if first.seconds - saved_at >= checkpoint_every:
            save(town)
            saved_at = first.seconds
    if first.fraction >= 1:
        for state in town.states.values():
            with state.averaged():
                state.sampler.finish(state.renderer.field, state.config.seed)
    save(town)


# Files ----------------------------------------------------------------------------------------------------------------


def save(town: Town) -> None:
    """Writes the checkpoints of all territories, then the index of their names; until then, the old index is valid."""
    group, count, folder = town.group, len(town.owner), checkpoint_path(town.out).parent
    token = f"{town.first.step}-{group.gather(secrets.token_hex(4))[0]}"
    names = [f"networks-{token}-{number}.safetensors" for number in range(count)]
    failure: OSError | None = None
    try:
        for number, state in town.states.items():
            if not all_finite(state.optimizer):
                raise diverged(town.out, "parameters or moments of Adam are not finite", state)
            save_checkpoint(folder / names[number], snapshot(state))
    except OSError as error:
        failure = error
    if group.any(failure is not None):
        raise failure or RankLost("another rank could not write the checkpoint")
    own_grids = {
        number: [{k: v.cpu() for k, v in each.state_dict().items()} for each in (state.router.diagram, grid_of(state))]
        for number, state in town.states.items()
    }
    grids = {number: tensors for each in group.gather(own_grids) for number, tensors in each.items()}
    if group.rank == 0:
        if not (town.out / TOWN).is_file():
            write_text(town.out / TOWN, json_text({"territories": count}) + "\n")
            write_text(town.out / "config.json", town.config.to_json())
            write_scene(town.out / "scene.json", town.scene)
        keep_checkpoint(town.out, _index(town, names, [grids[number] for number in range(count)]), KEPT)
        named = {name for path in checkpoint_paths(town.out) for name in _names(path)}
        for path in folder.glob("networks-*.safetensors"):
            if path.name not in named:
                path.unlink(missing_ok=True)


def _names(path: Path) -> list[str]:
    """Returns the names of the files that a checkpoint uses; all names for an unreadable checkpoint."""
    try:
        return list(load_checkpoint(path).values["parts"][0]["networks"])
    except CheckpointError:
        return [file.name for file in path.parent.glob("networks-*.safetensors")]


def _index(town: Town, names: list[str], stored: Sequence[Sequence[dict[str, Tensor]]]) -> Checkpoint:
    """Makes the index, a checkpoint that names the files of all territories and describes a run of one part.

    Args:
        town: The training.
        names: The files of the territories.
        stored: The state of the diagram and of the grid of each territory.
    """
    diagrams = [VoronoiDiagram.from_state(diagram) for diagram, _ in stored]
    grids = [OccupancyGrid.from_state(grid) for _, grid in stored]
    sizes = torch.tensor([diagram.num_cells for diagram in diagrams])
    diagram = diagrams[0]
    if len(stored) > 1:
        diagram, _ = VoronoiDiagram(town.territories.centres).refine(dict(enumerate(diagrams)))
    owner = torch.repeat_interleave(torch.arange(len(stored)), sizes)
    sphere, grid = town.scene.space(town.render_config.contraction).contraction, None
    assert not isinstance(sphere, Perspective)
    if sphere is None:
        grid = _whole_grid(make_grid(town.render_config, town.scene, "cpu", 1), grids)
    place = {
        "networks": names,
        "frame": Similarity().to_values(),
        "region": [],
        "layer": 0,
        "contraction": None if sphere is None else {"centre": sphere.centre.tolist(), "radius": sphere.radius},
    }
    index = index_of(town.render_config, [(diagram, owner.int())], [place], grid)
    return replace(index, tensors={**index.tensors, "bounds": town.bounds.clone()})


def resume(town: Town) -> None:
    """Restores all territories from the last checkpoint that all ranks can read."""
    errors: list[CheckpointError] = []
    for path in checkpoint_paths(town.out):
        index, parts, failure = Checkpoint({}, {}), dict[int, Checkpoint](), None
        try:
            index = load_checkpoint(path)
            names = index.values["parts"][0]["networks"]
            if len(names) != len(town.owner) or "bounds" not in index.tensors:
                raise CheckpointError(f"{path}: must name {len(town.owner)} territories, got {len(names)} files")
            parts = {number: load_checkpoint(path.with_name(names[number])) for number in town.states}
        except CheckpointError as error:
            failure = error
        except (KeyError, IndexError, TypeError) as error:
            failure = CheckpointError(f"{path}: not a checkpoint of territories: {error}")
        if not town.group.any(failure is not None):
            for number, state in town.states.items():
                load(state, parts[number])
            town.bounds = index.tensors["bounds"].clone()
            if errors:
                town.first.report(f"{errors[0]}; using {path.name} instead")
            return
        errors.append(failure or CheckpointError(f"{path}: another rank cannot read it"))
    raise errors[0] if errors else CheckpointError(f"{town.out}: there is no checkpoint")


def _whole_grid(like: OccupancyGrid, grids: Sequence[OccupancyGrid]) -> OccupancyGrid:
    """Merges the grids of territories into one over the box of ``like``.

    A voxel is occupied if an occupied voxel of any territory reaches into it.
    """
    box = like.box
    sizes = torch.stack([(g.box[1] - g.box[0]) / torch.tensor(g.occupied.shape) for g in grids]).amax(0)
    shape = ((box[1] - box[0]) / sizes).floor().clamp(1, 512)
    shape = (shape * min(1.0, (VOXELS / float(shape.prod())) ** (1 / 3))).floor().clamp(min=1).long()
    merged = OccupancyGrid(box, shape.tolist(), threshold=like.threshold)
    merged.occupied.zero_()
    corners = torch.cartesian_prod(*(torch.tensor((0.001, 0.999)),) * 3)
    for grid in grids:
        occupied = grid.occupied.view(-1).nonzero()[:, 0]
        for corner in corners:
            points = grid.points(occupied, corner.expand(len(occupied), 3))
            merged.occupied.view(-1)[merged.voxels(points).long()] = True
    merged.density = torch.where(merged.occupied, 2 * merged.threshold, 0.0)
    return merged


def summary_of(town: Town) -> dict[str, Any]:
    """Returns the contents of ``summary.json`` without scores, the same on all ranks; all ranks call it together."""
    sums = torch.zeros(5, dtype=torch.float64)
    for state in town.states.values():
        counts = state.parameter_count, state.strategy.remaining, state.skipped, state.rays_done, state.router.num_cells
        sums += torch.tensor(counts, dtype=torch.float64)
    totals = town.group.total(sums)
    parameters, splits_left, skipped, rays, cells = map(int, totals.tolist())
    return {
        "complete": town.first.fraction >= 1,
        "seconds": town.first.seconds,
        "steps": town.first.step,
        "rays_per_second": rays / max(town.first.seconds, 1e-9),
        "parameters": parameters,
        "cells": cells,
        "splits_left": splits_left,
        "skipped_steps": skipped,
        "width": town.render_config.width,
        "territories": len(town.owner),
    }
