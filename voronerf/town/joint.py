"""Joint training: several territories, each a training of its own, whose rays cross their borders.

A territory has its own cells, table, occupancy grid, optimiser, kept samples and views; all settings are those of one
territory. In a step each draws rays from its views, and rays go on to other territories, see
:mod:`voronerf.town.ray_runs`. Ranks share out territories, and what a territory computes does not depend on which rank
has it: one process trains the same run. T territories.
"""

from __future__ import annotations

import functools
import math
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from voronerf.app.evaluate.lpips import Lpips, find_lpips
from voronerf.app.evaluate.scores import ViewScore, evaluate, mean_scores, view_numbers
from voronerf.app.files import json_text, parse_json, write_text
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import within, write_scene
from voronerf.app.train import state
from voronerf.app.train.batches import RayBatches
from voronerf.app.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointWriter,
    checkpoint_paths,
    load_checkpoint,
    network_files,
    part_path,
)
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.config_checks import ConfigError, check_joint
from voronerf.app.train.divergence import (
    PATIENCE,
    SETTLED,
    all_finite,
    check_can_go_back,
    one_colour_psnr,
    why_scores_are_poor,
)
from voronerf.app.train.networks import check_shapes, resolve_config
from voronerf.app.train.progress import Progress, Stage
from voronerf.app.train.rates import learning_rate
from voronerf.app.train.renderers import make_contraction, make_grid
from voronerf.app.train.run_directory import read_metrics
from voronerf.app.train.trainer import FIGURES, Trainer
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.cameras import Rays
from voronerf.nerf.marching import RayColours
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.ops._core import backends
from voronerf.town.distributed.group import Group
from voronerf.town.distributed.territories import cut_space
from voronerf.town.parts import Similarity
from voronerf.town.ray_runs import JointLoss, Map, Territory, see_together
from voronerf.town.run_parts import recipe_of

#: Steps after which ranks agree on loss, time, stops and checkpoints.
AGREE_EVERY = 8
#: Steps after which territories may move, and the share of the mean work from which the heaviest rank gives some away.
BALANCE_EVERY, HEAVIEST = 256, 1.15
#: What checkpoints keep of a `Map`.
KNOWN = tuple(field.name for field in fields(Map))
#: The most voxels of the grid that a finished run is drawn with.
VOXELS = 1 << 21


def joint_config(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The settings with which a joint run is drawn as a whole: strata are as long as those of its territories."""
    territories = cut_space(scene, int(config.territories or 1), _contraction(config, scene))
    own = resolve_config(config, territories.scene(scene, 0))
    whole = replace(resolve_config(config, scene), territories=None)
    if scene.box is None or whole.contraction != "none":
        return whole
    lengths = [float((box[1] - box[0]).norm()) for box in (scene.box, territories.boxes[0])]
    return replace(whole, samples=math.ceil(int(own.samples or 0) * lengths[0] / lengths[1]))


def _contraction(config: TrainConfig, scene: Scene) -> Any:
    resolved = resolve_config(config, scene)
    return None if resolved.contraction == "none" else make_contraction(scene, resolved.contraction)


class JointTrainer:
    """Trains the territories of a scene, over one or more ranks, and keeps the run directory.

    Arguments and methods are those of :class:`Trainer`, which each territory has one of.

    Attributes:
        trainers: Of the territories of this rank, by their numbers.
        owner: The rank of each territory, [T].

    Args:
        config: The settings of a territory; ``config.territories`` is T.
        scene: The scene that ``config.data`` names.
        group: The ranks that train together; None for this process alone.
        on_step: Called after every step with a :class:`Progress`.
        on_event: Called with one line of text for each split and evaluation.
        clock: Counts the seconds of training; default ``time.perf_counter``.

    Raises:
        CheckpointError: With ``config.resume``, when there is no checkpoint or it is of another configuration.
        ConfigError: For settings that joint training does not support.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        *,
        group: Group | None = None,
        on_step: Callable[[Progress], None] | None = None,
        on_event: Callable[[str], None] | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if config.out is None:
            raise ValueError("JointTrainer: config.out must name the run directory, got None")
        if config.resume:  # the space is that of the run, whatever the views
            scene = within(scene, config.out, joined=False)
        self.out, self.scene, self.config = config.out, scene, config
        self.on_step, self.on_event, self.clock = on_step, on_event, clock or time.perf_counter
        self.device = torch.device(config.device)
        self.group = group or Group(self.device)
        check_joint(config, self.group.size)
        check_joint(resolve_config(config, scene), self.group.size)  # what follows from the scene
        self.whole, count = resolve_config(config, scene), int(config.territories or 1)
        try:
            self.territories = cut_space(scene, count, _contraction(config, scene))
        except ValueError as error:
            raise ConfigError(str(error)) from None
        self.places = [self.territories.place(number) for number in range(count)]
        self.owner = [number * self.group.size // count for number in range(count)]
        self.lpips, self.lpips_source = find_lpips(config.lpips, config.data, scene.test.cameras.smallest[::-1])
        self.step, self.seconds, self._passed = 0, 0.0, 0.0
        self.rays_done, self.rays_per_step = 0, count * config.rays
        self.cells_now, self.stages = count, [Stage(count, 0.0, 0, None, None, 0)]
        self.evaluated, self.skipped, self.rate_factor = 0, 0, 1.0
        self.metrics: list[dict[str, Any]] = []
        self.stopped = self._asked_to_stop = self.described = False
        self.loss, self.one_colour = math.nan, one_colour_psnr(scene)
        self.work = dict.fromkeys(range(count), 0)
        self.writer = CheckpointWriter(self.out, config.keep_checkpoints, self.group)
        if config.resume:
            self._resume()
        else:
            self._take(dict.fromkeys(self._own()), Map.of(self.territories.boxes, self.territories.centres))
        self.saved_at = self.seconds

    # --- what others ask of a trainer ------------------------------------------------------------------------------

    @property
    def writes(self) -> bool:
        """Whether this process writes the files of the run."""
        return self.group.rank == 0

    @property
    def fraction(self) -> float:
        """How much of the run is done, 0..1."""
        if self.config.steps is not None:
            return min(1.0, self.step / self.config.steps)
        return min(1.0, self.seconds / float(self.config.budget or 1.0))

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """The grid of the first territory of this rank."""
        return next(iter(self.trainers.values())).occupancy

    def explain(self) -> str:
        """How a step is computed: some lines."""
        return next(iter(self.trainers.values())).learner.explain(len(self.owner))

    def learning_rate(self) -> float:
        """Of the next step, see :func:`voronerf.app.train.rates.learning_rate`; half of it after a divergence."""
        first = next(iter(self.trainers.values())).config
        return learning_rate(first, self.fraction, self.step) * self.rate_factor

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """A context in which the networks have their averaged weights, for pictures; not for training."""
        with ExitStack() as stack:
            for trainer in self.trainers.values():
                stack.enter_context(trainer.averaged())
            yield

    def request_stop(self) -> None:
        """Ends training some steps later, with a checkpoint, as Ctrl-C does; ranks stop together."""
        self._asked_to_stop = True

    def say(self, line: str) -> None:
        """Tells whoever listens, see ``on_event``."""
        if self.on_event is not None:
            self.on_event(line)

    # --- territories -----------------------------------------------------------------------------------------------

    def _own(self) -> list[int]:
        return [number for number, rank in enumerate(self.owner) if rank == self.group.rank]

    def _take(self, checkpoints: Mapping[int, Checkpoint | None], known: Map) -> None:
        """Makes the trainers of territories, new or from their checkpoints."""
        self.trainers = {number: self._trainer(number, found) for number, found in checkpoints.items()}
        self._join(known, checkpoints)

    def _join(self, known: Map, checkpoints: Mapping[int, Checkpoint | None]) -> None:
        """Lets the rays of the trainers cross."""
        members = {
            number: Territory(self.places[number], trainer.renderer, trainer.draws)
            for number, trainer in self.trainers.items()
        }
        before = getattr(self, "joint", None)
        self.joint: JointLoss = JointLoss(self.group, members, self.owner, known, self.whole.sightings or 0.0)
        if before is not None:
            self.joint.counts |= {n: counts for n, counts in before.counts.items() if n in members}
        for number, found in checkpoints.items():
            if found is not None:
                self.joint.counts[number] = found.tensors["joint.counts"].clone()
        first = next(iter(self.trainers.values())).renderer
        self.renderer = Renderer(first.fields, first.sampler, backend=first.backend)
        self.renderer.look = self._look

    def _trainer(self, number: int, checkpoint: Checkpoint | None) -> Trainer:
        seed = (self.config.seed + 1_000_003 * number) % 2**63
        config = replace(
            self.config, seed=seed, lpips=Path("off"), resume=False, territories=None, evaluation_share=0.0
        )
        scene = self.territories.scene(self.scene, number)
        views: Tensor | None = self.territories.views(number)
        images = self.scene
        memory = config.images == "memory" and images.train.on_disk
        if memory or (config.images != "disk" and self.device.type != "cpu"):
            images, views = replace(images, train=images.train.copy(self.territories.views(number))), None
        given: dict[str, Any] = {"sightings": bool(self.whole.sightings), "backend": config.backend}
        batches = RayBatches(images, self.device, views=views, **given)
        if checkpoint is not None:
            check_shapes(resolve_config(config, scene), checkpoint)
        trainer = Trainer(config, scene, clock=self.clock, batches=batches, checkpoint=checkpoint)
        trainer.writes = False
        if trainer.occupancy is not None and trainer.renderer.contraction is None:
            trainer.cells.leave(self.places[number].outside(trainer.occupancy))
        return trainer

    def _split(self) -> None:
        """Splits the cells of the territories that are due, and have samples."""
        for trainer in self.trainers.values():
            trainer.step, trainer.seconds, trainer.rate_factor = self.step, self.seconds, self.rate_factor
            if trainer.split_is_due():
                enough = trainer.level > 0 or len(trainer.cells.reservoir) >= trainer.cells.children
                if enough:
                    trainer.split()

    def train_step(self) -> None:
        """One step of all territories."""
        self.joint.survey(self.step)
        natively = all(trainer.thread_deterministic for trainer in self.trainers.values())
        first = next(iter(self.trainers.values()))
        with backends.torch_on_one_thread() if natively else nullcontext():
            batches = {}
            for number, trainer in self.trainers.items():
                trainer.optimizer.zero_grad(set_to_none=True)
                trainer.step, trainer.seconds, trainer.rate_factor = self.step, self.seconds, self.rate_factor
                trainer.draws.manual_seed((trainer.config.seed * 6364136223846793005 + self.step) % 2**63)
                trainer.prepare()
                batches[number] = trainer.draw(float(self.joint.map.shares[number]))
            with first.precision():
                found = self.joint.run(batches, backward=self.config.precision == "fp32")
            self._losses = 0.0
            for number, trainer in self.trainers.items():
                self.rays_done += len(batches[number].rays)
                self.work[number] += len(found[number].weights)
                loss, kept = trainer.learn(found[number])
                trainer.finish(kept)
                self._losses += float(loss)

    def _balance(self) -> None:
        """Moves territories from the rank that evaluates the most samples, while it has more than `HEAVIEST` allow."""
        own = [float(self.work[number]) if number in self.trainers else 0.0 for number in range(len(self.owner))]
        work = self.group.total(torch.tensor(own, dtype=torch.float64, device=self.group.device)).tolist()
        self.work = dict.fromkeys(self.work, 0)
        owner = balanced(self.owner, work, self.group.size)
        moved = [n for n, (old, new) in enumerate(zip(self.owner, owner, strict=True)) if old != new]
        if moved:
            self._move(moved, owner)
            self.say(f"moved territories {', '.join(map(str, moved))} at step {self.step}, so that ranks work alike")

    def _move(self, moved: Sequence[int], owner: list[int]) -> None:
        """Gives territories to other ranks."""
        came: dict[int, Checkpoint | None] = {}
        for number in moved:
            source, target = self.owner[number], owner[number]
            if source == self.group.rank:
                message = _packed(self._part(number)).to(self.device)
                self.group.swap("moves", {target: torch.tensor([len(message)], device=self.device)}, {})
                self.group.swap("moves", {target: message}, {})
                del self.trainers[number]
            elif target == self.group.rank:
                size = self.group.swap("moves", {}, {source: torch.zeros(1, dtype=torch.int64, device=self.device)})
                room = torch.empty(int(size[source]), dtype=torch.uint8, device=self.device)
                came[number] = _unpacked(self.group.swap("moves", {}, {source: room})[source].cpu())
        self.owner = owner
        self.trainers |= {number: self._trainer(number, found) for number, found in came.items()}
        self.trainers = dict(sorted(self.trainers.items()))
        self._join(self.joint.map, came)

    # --- the loop --------------------------------------------------------------------------------------------------

    def run(self) -> dict[str, Any]:
        """As :meth:`Trainer.run`."""
        self.advance()
        while not self._check_moments():
            self.advance()
        self.save()
        if self.fraction >= 1:
            self.stopped = False
            self._evaluate(self.config.final_views, self.lpips)
        return self._summarise()

    def advance(self, until: float = math.inf) -> None:
        """As :meth:`Trainer.advance`."""
        while self.fraction < 1 and self.seconds < until and not self.stopped:
            if self._due() > self.evaluated:
                self._evaluate(self.config.eval_views)
                continue
            started = self.clock()
            self._split()
            self.train_step()
            self.step += 1
            self._passed += self.clock() - started
            if self.group.size == 1 or self.step % AGREE_EVERY == 0 or self.step == self.config.steps:
                self._agree()
            if self.step % BALANCE_EVERY == 0 and self.group.size > 1:
                self._balance()
            if self.on_step is not None:
                speed = self.rays_done * len(self.owner) / len(self.trainers) / max(self.seconds, 1e-9)
                psnr = self.metrics[-1].get("psnr") if self.metrics else None
                now = self.step, self.seconds, self.fraction, self.loss, speed, self.cells_now, psnr
                self.on_step(Progress(*now))
            saving = self.seconds - self.saved_at >= self.config.checkpoint_every and not self.writer.busy
            if saving and self._check_moments():
                self.save(wait=False)
        self.writer.wait()

    def _agree(self) -> None:
        """Ranks agree on the loss, the time, whether to stop, and whether a checkpoint is there."""
        cells = sum(trainer.router.num_cells for trainer in self.trainers.values())
        in_a_row = [float(trainer.guard.in_a_row) for trainer in self.trainers.values()]
        own = [
            self._losses,
            self._passed * (self.group.rank == 0),
            self._asked_to_stop,
            self.writer.ready,
            cells,
            max(in_a_row) >= PATIENCE,
        ]
        told = self.group.total(torch.tensor(own, dtype=torch.float64, device=self.group.device)).tolist()
        loss, passed, stop, ready, cells, broken = told
        self.loss, self.seconds, self._passed = loss / len(self.owner), self.seconds + passed, 0.0
        self.stopped |= stop > 0
        if ready == self.group.size:
            self.writer.commit()
        if cells != self.cells_now:
            self.say(f"{int(cells)} cells in {len(self.owner)} territories at {self.seconds:.0f} s, step {self.step}")
            split = int(cells) - self.cells_now
            self.stages.append(Stage(int(cells), self.seconds, self.step, None, None, split))
            self.cells_now = int(cells)
        if broken:
            self._go_back(f"gradients of {PATIENCE} steps in a row not finite")

    def _check_moments(self) -> bool:
        """Goes back to the last good state if a moment of Adam of any territory is not finite."""
        finite = all(all_finite(trainer.optimizer) for trainer in self.trainers.values())
        if self.group.largest(torch.tensor(float(not finite), device=self.group.device)) > 0:
            self._go_back("parameters or moments of Adam not finite")
            return False
        return True

    def _go_back(self, reason: str) -> None:
        """Goes on from the last checkpoint with half the learning rate, once in a run.

        Raises:
            TrainingError: The second time, or without a checkpoint.
        """
        self.writer.wait()
        at = self.step
        check_can_go_back(self.out, reason, at, self.rate_factor)
        self._resume()
        self.rate_factor, self.saved_at = 0.5, self.seconds
        self.say(f"{reason} at step {at}: back to step {self.step}, with half the learning rate")

    # --- evaluation ------------------------------------------------------------------------------------------------

    def _due(self) -> int:
        return int(self.fraction * self.config.evaluations + 1e-9)

    def _look(self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None, heaviest: bool) -> RayColours:
        """For the renderer: one rank more that is not done."""
        self.group.total(torch.ones(1, device=self.group.device))
        return see_together(self.joint, rays, near, far, background)

    def _evaluate(self, views: int | None, lpips: Lpips | None = None) -> None:
        """Scores test views, each on the rank of its territory; ranks that are done help the others."""
        chosen = view_numbers(len(self.scene.test), views)
        own = [view for view in chosen if self.owner[int(self.territories.test[view])] == self.group.rank]
        with self.averaged(), torch.no_grad():
            scores = evaluate(self.renderer, self.scene, views=own, lpips=lpips, stop=lambda: self._asked_to_stop)
            none = torch.empty(0, device=self.device)
            rays = Rays(none.reshape(0, 3), none.reshape(0, 3))
            while self.group.total(torch.zeros(1, device=self.group.device)) > 0:
                see_together(self.joint, rays, none, none, None)
        table = torch.zeros(len(chosen) + 1, 3, dtype=torch.float64, device=self.group.device)
        for view, score in zip(own, scores):
            perceived = math.nan if score.lpips is None else score.lpips
            table[chosen.index(view)] = torch.tensor((score.psnr, score.ssim, perceived))
        table[-1, 0] = len(own) - len(scores)
        *rows, (left, _, _) = self.group.total(table).tolist()
        if left:  # a stop was asked for
            self.stopped = True
            return
        names = [self.scene.test.names[view] for view in chosen]
        found = [
            ViewScore(name, psnr, ssim, None if math.isnan(perceived) else perceived)
            for name, (psnr, ssim, perceived) in zip(names, rows, strict=True)
        ]
        self.evaluated = self._due()
        self._record(found)

    def _record(self, scores: list[ViewScore]) -> None:
        """Appends scores and the state of the run to ``metrics.jsonl``."""
        now = {
            "step": self.step,
            "seconds": round(self.seconds, 3),
            "cells": self.cells_now,
            "learning_rate": self.learning_rate(),
            "views": len(scores),
            **mean_scores(scores),
        }
        self.metrics = [m for m in self.metrics if m["step"] < self.step] + [now]
        if self.writes:
            write_text(self.out / "metrics.jsonl", "".join(json_text(m) + "\n" for m in self.metrics))
        self.say(
            f"{self.seconds:7.1f} s  step {self.step:6d}  {self.cells_now:4d} cells  "
            f"psnr {now['psnr']:6.2f}  ssim {now['ssim']:.4f}  ({len(scores)} views)"
        )
        settled = self.step >= SETTLED and self.fraction >= 0.5
        poor = why_scores_are_poor(self.metrics, self.config, self.one_colour, settled=settled)
        if poor is not None:
            self.say(poor)

    def _summarise(self) -> dict[str, Any]:
        """Writes ``summary.json``; returns what it holds."""
        parameters = sum(trainer.parameter_count for trainer in self.trainers.values())
        left = sum(len(trainer.plan) - trainer.level for trainer in self.trainers.values())
        skipped = sum(int(trainer.guard.skipped) for trainer in self.trainers.values())
        sums = torch.tensor((parameters, left, skipped, self.rays_done), dtype=torch.float64, device=self.group.device)
        parameters, left, skipped, rays = map(int, self.group.total(sums).tolist())
        if self.fraction >= 1 and left:
            self.say(f"Run ended before {left} planned splits of territories.")
        summary = {
            **{key: self.metrics[-1].get(key) if self.metrics else None for key in FIGURES},
            "complete": self.fraction >= 1 and not self.stopped,
            "seconds": self.seconds,
            "steps": self.step,
            "rays_per_second": rays / max(self.seconds, 1e-9),
            "parameters": parameters,
            "cells": self.cells_now,
            "splits_left": left,
            "skipped_steps": skipped,
            "width": self.config.width,
            "stages": [asdict(stage) for stage in self.stages],
            "territories": len(self.owner),
        }
        if self.writes:
            write_text(self.out / "summary.json", json_text(summary, indent=2) + "\n")
        return summary

    # --- files -----------------------------------------------------------------------------------------------------

    def save(self, *, wait: bool = True) -> None:
        """As :meth:`Trainer.save`."""
        if self.writes and not self.described:
            write_text(self.out / "config.json", self.config.to_json())
            write_scene(self.out / "scene.json", self.scene)
            self.described = True
        self.writer.wait()
        number = torch.tensor(secrets.randbelow(2**40) * (self.group.rank == 0), dtype=torch.int64)
        token = f"{self.step}-{int(self.group.total(number.to(self.group.device))):x}"
        stored = state.Stored(
            config=self.config.to_values(),
            step=self.step,
            seconds=self.seconds,
            rays=self.config.rays,
            rays_done=self.rays_done,
            stages=tuple(asdict(stage) for stage in self.stages),
            evaluated=self.evaluated,
            skipped=self.skipped,
            rate_factor=self.rate_factor,
            threads=torch.get_num_threads(),
        )
        known = self.joint.map
        tensors = {f"joint.{name}": getattr(known, name) for name in KNOWN}
        tensors["joint.owner"] = torch.tensor(self.owner)
        paths = [part_path(self.out, token, number) for number in range(len(self.owner))]
        values = {**asdict(stored), "stages": list(stored.stages)}
        index = functools.partial(self._index, Checkpoint(tensors, values), paths)
        self.writer.write_parts({paths[number]: self._part(number) for number in self.trainers}, index)
        self.saved_at = self.seconds
        if wait:
            self.writer.wait()

    def _part(self, number: int) -> Checkpoint:
        """The checkpoint of a territory of this rank."""
        found = self.trainers[number].state()
        return replace(found, tensors={**found.tensors, "joint.counts": self.joint.counts[number].clone()})

    def _index(self, known: Checkpoint, paths: Sequence[Path]) -> Checkpoint:
        """The checkpoint that names the files of all territories, which are written: their cells, and one grid."""
        root, diagrams = VoronoiDiagram(self.territories.centres), {}
        sizes, grids, recipes = [], [], []
        for number, path in enumerate(paths):
            part = load_checkpoint(path)
            diagrams[number] = VoronoiDiagram.from_state(part.group("router"), "diagram.")
            sizes.append(diagrams[number].num_cells)
            grids.append(part.group("occupancy"))
            config = TrainConfig.from_json(json_text(part.values["config"]), str(path))
            recipes.append({"file": path.name, **recipe_of(config)})
        diagram = root.refine(diagrams)[0] if len(paths) > 1 else diagrams[0]
        owner = torch.repeat_interleave(torch.arange(len(paths)), torch.tensor(sizes)).to(torch.int32)
        tensors = {**known.tensors, "part-0.owner": owner}
        tensors |= {f"part-0.diagram.{name}": value for name, value in diagram.state_dict().items()}
        seen = _contraction(self.config, self.scene)
        if self.whole.occupancy and seen is None:
            grid = _whole_grid(make_grid(joint_config(self.config, self.scene), self.scene, "cpu", 1), grids)
            tensors |= {f"occupancy.{name}": value for name, value in grid.state_dict().items()}
        sphere = None if seen is None else {"centre": seen.centre.tolist(), "radius": seen.radius}
        frame = Similarity().to_values()
        told = {"routers": recipes, "frame": frame, "region": [], "layer": 0, "contraction": sphere}
        return Checkpoint(tensors, {**known.values, "parts": [told]})

    def _resume(self) -> None:
        """Puts all territories where they were at the last checkpoint that all ranks can read.

        Raises:
            CheckpointError: When there is none, or it is of another configuration.
        """
        errors: list[CheckpointError] = []
        for path in checkpoint_paths(self.out):
            index, parts, failure = None, {}, None
            try:
                index = load_checkpoint(path, keep=lambda name: not name.startswith("part-"))
                files = network_files(index.values)
                stored, values = state.stored_values(index)
                different = state.differences(stored, self.config)
                if different:
                    raise CheckpointError(f"{path}: a checkpoint of another configuration: {'; '.join(different)}")
                if len(files) != len(self.owner):
                    raise CheckpointError(f"{path}: must name {len(self.owner)} territories, got {len(files)} files")
                owner = index.tensors["joint.owner"].tolist()
                if sorted(set(owner)) == list(range(self.group.size)):
                    self.owner = owner
                parts = {number: load_checkpoint(path.with_name(files[number])) for number in self._own()}
            except (CheckpointError, KeyError) as error:
                failure = (
                    error if isinstance(error, CheckpointError) else CheckpointError(f"{path}: {error} is missing")
                )
            failed = torch.tensor(float(failure is not None), device=self.group.device)
            if self.group.largest(failed) == 0:
                assert index is not None
                self._take(parts, Map(*(index.tensors[f"joint.{name}"].clone() for name in KNOWN)))
                self._continue(values)
                if errors:
                    self.say(f"{errors[0]}; {path.name} takes its place")
                return
            errors.append(failure or CheckpointError(f"{path}: another rank cannot read it"))
        raise errors[0] if errors else CheckpointError(f"{self.out}: there is no checkpoint")

    def _continue(self, stored: state.Stored) -> None:
        self.step, self.seconds, self.rays_done = stored.step, stored.seconds, stored.rays_done
        self.stages = [Stage(**stage) for stage in stored.stages]
        self.cells_now, self.rate_factor, self.skipped = self.stages[-1].cells, stored.rate_factor, stored.skipped
        self.evaluated = min(stored.evaluated, self._due())
        self.metrics = [m for m in read_metrics(self.out) if m["step"] <= self.step]


def balanced(owner: Sequence[int], work: Sequence[float], ranks: int) -> list[int]:
    """The rank of each territory, after the heaviest ranks have given some away.

    Args:
        owner: The rank of each territory now.
        work: Of each territory.
        ranks: How many there are.

    Examples:
        >>> from voronerf.town.joint import balanced
        >>> balanced([0, 0, 0, 1], [1.0, 2.0, 3.0, 1.0], 2)
        [0, 1, 0, 1]
    """
    owner = list(owner)
    for _ in owner:
        loads = [sum(w for w, rank in zip(work, owner, strict=True) if rank == each) for each in range(ranks)]
        heaviest, lightest = loads.index(max(loads)), loads.index(min(loads))
        some = [number for number, rank in enumerate(owner) if rank == heaviest]
        if max(loads) <= HEAVIEST * sum(loads) / ranks or len(some) < 2:
            break
        best = min(some, key=lambda n: (max(loads[heaviest] - work[n], loads[lightest] + work[n]), n))
        if loads[lightest] + work[best] >= loads[heaviest]:
            break
        owner[best] = lightest
    return owner


def _whole_grid(like: OccupancyGrid, grids: Sequence[dict[str, Tensor]]) -> OccupancyGrid:
    """One grid over the box of another; occupied where that of any territory is, too much rather than too little."""
    box = like.box
    sizes = torch.stack([(g["box"][1] - g["box"][0]) / torch.tensor(g["occupied"].shape) for g in grids]).amax(0)
    shape = ((box[1] - box[0]) / sizes).floor().clamp(1, 512)
    shape = (shape * min(1.0, (VOXELS / float(shape.prod())) ** (1 / 3))).floor().clamp(min=1).long()
    whole = OccupancyGrid(box, shape.tolist(), threshold=like.threshold, contraction=like.contraction)
    whole.occupied.zero_()
    voxel, (_, y, z) = (box[1] - box[0]) / shape, shape.tolist()
    for found in grids:
        inner = torch.tensor(found["occupied"].shape)
        rows = found["occupied"].nonzero()
        for corner in torch.cartesian_prod(*(torch.tensor((0.0, 1.0)),) * 3):
            place = found["box"][0] + (rows + 0.001 + 0.998 * corner) * (found["box"][1] - found["box"][0]) / inner
            cell = ((place - box[0]) / voxel).long().clamp(min=torch.zeros(3), max=shape - 1).long()
            whole.occupied.view(-1)[(cell[:, 0] * y + cell[:, 1]) * z + cell[:, 2]] = True
    whole.density = torch.where(whole.occupied, 2 * whole.threshold, 0.0)
    return whole


def _packed(checkpoint: Checkpoint) -> Tensor:
    """A checkpoint as bytes."""
    return torch.frombuffer(
        bytearray(save(checkpoint.tensors, {"values": json_text(checkpoint.values)})), dtype=torch.uint8
    )


def _unpacked(message: Tensor) -> Checkpoint:
    raw = message.numpy().tobytes()
    header = parse_json(raw[8 : 8 + int.from_bytes(raw[:8], "little")].decode())
    return Checkpoint(load(raw), parse_json(header["__metadata__"]["values"]), "a territory that moved here")
