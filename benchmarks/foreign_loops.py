"""Trains fields of other codebases in their own training loops: unchanged, narrower, fused, in cells, or by masks.

Clones of EmilienDupont/coin and yenchenlin/nerf-pytorch must be in one folder, and the scenes in VORONERF_DATA. A loop
ends --seconds of processor time after its first step. Mocks replace packages that the clones import (`ABSENT`).

    python benchmarks/foreign_loops.py coin routed CLONES --json FILE [--seconds 60] [--seed 0]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from harness import metadata
from PIL import Image
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_post_hook

from voronerf import VoronoiDiagram, VoronoiRouter
from voronerf.app.scenes import load_scene

CELLS, DATA = 16, Path(os.environ.get("VORONERF_DATA", "data"))
ABSENT = "cv2 imageio configargparse"
NERF = """run_nerf --expname x --dataset_type blender --datadir x --use_viewdirs --white_bkgd --no_batching
    --N_samples 64 --N_rand 256 --lrate_decay 500 --precrop_iters 100 --i_weights 10000000 --basedir"""


class Done(Exception):
    """Raised when the time is over."""


class Masks(nn.Module):
    """One module per cell, called with the samples in the boolean mask of its cell."""

    def __init__(self, cells: list[nn.Module], diagram: VoronoiDiagram) -> None:
        super().__init__()
        self.cells, self.diagram = nn.ModuleList(cells), diagram

    def forward(self, x: Tensor) -> Tensor:
        located, out = self.diagram.locate(x[..., : self.diagram.centres.shape[1]]), x.new_zeros(0)
        for index, cell in enumerate(self.cells):
            mask = located == index
            if bool(mask.any()):
                result = cell(x[mask])
                out = out if len(out) else x.new_zeros(*x.shape[:-1], result.shape[-1])
                out[mask] = result
        return out


class Run:
    """One training, which replaces the field of the codebase and ends the training loop when the time is over."""

    def __init__(self, way: str, seconds: float, clones: Path) -> None:
        self.way, self.seconds, self.clones, self.steps, self.began = way, seconds, clones, -1, 0.0

    def field(
        self, make: Callable[[bool], nn.Module], points: Tensor, weights: Callable[[Tensor], Tensor] | None = None
    ) -> nn.Module:
        """Returns the field to train, and counts its calls as steps.

        The way "plain" trains the original field ``make(True)``. All other ways train narrower fields ``make(False)``:
        "narrow" one in PyTorch, "fused" one in a router of one cell, "split" (as published) this router, which is
        subdivided after a fifth of the time, "routed" a router with all cells from the start, "small" one whose cells
        together have at most the parameters of one network, and "masks" the cells of "routed" in a loop over masks. The
        cells' centres are computed from the samples ``points`` [..., d] or, for "split", from the samples of the last
        step and from ``weights`` of their results.
        """
        net, dim = make(self.way == "plain"), points.shape[-1]
        if self.way in ("fused", "split"):
            net = VoronoiRouter(net, torch.zeros(1, dim), coords=f"first{dim}", fuse=True)
        if self.way in ("masks", "routed", "small"):
            diagram = VoronoiDiagram.from_points(points, CELLS, generator=torch.Generator().manual_seed(0))
            net = VoronoiRouter(net, diagram, coords=f"first{dim}", fuse=True)
            net = Masks([net.cell(i) for i in range(CELLS)], diagram) if self.way == "masks" else net
        waiting = self.way == "split"

        def split(optimizer: torch.optim.Optimizer, *_: Any) -> None:
            nonlocal waiting
            if waiting and time.process_time() - self.began > self.seconds / 5:
                waiting, (x, results) = False, last
                chosen = None if weights is None else weights(results).flatten()
                torch.manual_seed(0)
                net.subdivide(CELLS, optimizer=optimizer, points=x[..., :dim].reshape(-1, dim), weights=chosen)

        def keep(module: nn.Module, arguments: tuple[Tensor, ...], results: Tensor) -> None:
            nonlocal last
            if torch.is_grad_enabled():
                last = arguments[0].detach(), results.detach()

        last: Any = None
        if waiting:
            net.register_forward_hook(keep)
            register_optimizer_step_post_hook(split)
        self.parameters = net.parameters
        net.register_forward_pre_hook(lambda *_: self.step() if torch.is_grad_enabled() else None)
        return net

    def step(self) -> None:
        self.steps += 1
        if self.steps == 0:  # the first optimiser of a process imports torch's compiler, which takes seconds
            self.began = time.process_time()
        if time.process_time() - self.began > self.seconds:
            raise Done


def coin(run: Run) -> dict[str, float]:
    """Trains COIN on Kodak image 15: all pixels in each step, ten layers of width 28 or 6, learning rate 2e-4."""
    import siren
    import training
    import util

    pixels = torch.from_numpy(np.array(Image.open(run.clones / "coin/kodak-dataset/kodim15.png"))) / 255.0
    coordinates, features = util.to_coordinates_and_features(pixels.permute(2, 0, 1))
    width = 6 if run.way == "small" else 28
    trainer = training.Trainer(run.field(lambda own: siren.Siren(2, width, 3, 10), coordinates), lr=2e-4)
    with contextlib.suppress(Done):
        trainer.train(coordinates, features, 10**6)
    return {"loss": min(trainer.logs["loss"]), "psnr": float(max(trainer.logs["psnr"]))}


def nerf(run: Run) -> dict[str, float]:
    """Runs nerf-pytorch's train() on Lego at 100 x 100: width 256 or 64, 256 rays of 64 samples a step."""

    class Parser(argparse.ArgumentParser):
        def add_argument(self, *names: Any, is_config_file: bool = False, **options: Any) -> Any:
            return super().add_argument(*names, **options)

    sys.modules["configargparse"].ArgumentParser = Parser
    import run_nerf

    scene = load_scene(DATA / "lego", downscale=4)
    images = np.concatenate([scene.train.images, scene.test.images[:4]]) / np.float32(255)
    poses = np.concatenate([scene.train.cameras.poses, scene.test.cameras.poses[:4]])
    size, focal, test = images.shape[1], float(scene.train.cameras.intrinsics[0, 0]), np.arange(100, 104)
    camera = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    rays = [run_nerf.get_rays(size, size, camera, torch.from_numpy(pose[:3, :4])) for pose in poses[:100:10]]
    z = torch.linspace(2, 6, 64)[:, None]
    points = torch.stack([o[::10, ::10, None] + d[::10, ::10, None] * z for o, d in rays])
    create, own, created = run_nerf.create_nerf, run_nerf.NeRF, list[Any]()
    loaded = images, poses, torch.zeros(1, 4, 4), [size, size, focal], (np.arange(100), test, test)
    run_nerf.load_blender_data = lambda *_: loaded
    density = lambda raw: torch.nn.functional.softplus(raw[..., 3])  # noqa: E731  positive where all is empty, too
    run_nerf.NeRF = lambda **keywords: run.field(
        lambda wide: own(**{**keywords, "W": 256 if wide else 64}), points, density
    )
    run_nerf.create_nerf = lambda args: created.append(create(args)) or created[0]
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(Done):
        sys.argv = [*NERF.split(), folder]
        run_nerf.train()
    truth, c2w = images[test, ..., :3] * images[test, ..., 3:] + 1 - images[test, ..., 3:], torch.from_numpy(poses)
    with torch.no_grad():
        shown = [run_nerf.render(size, size, camera, c2w=c2w[i, :3, :4], **created[0][1])[0].clamp(0, 1) for i in test]
    errors = np.square(torch.stack(shown).numpy() - truth).mean((1, 2, 3))
    return {"loss": float(np.mean(errors)), "psnr": float(np.mean(-10 * np.log10(errors)))}


def main() -> None:
    parser = argparse.ArgumentParser()
    loops = {"coin": (coin, "coin"), "nerf": (nerf, "nerf-pytorch")}
    parser.add_argument("loop", choices=loops)
    parser.add_argument("way", choices=("plain", "narrow", "fused", "split", "routed", "small", "masks"))
    parser.add_argument("clones", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True, help="a file of rows, to which this one is added")
    options = parser.parse_args()
    for name in ABSENT.split():
        sys.modules[name] = mock.MagicMock(__spec__=ModuleSpec(name, None))
    function, folder = loops[options.loop]
    sys.path.insert(0, str(options.clones / folder))
    torch.manual_seed(options.seed)
    np.random.seed(options.seed)  # noqa: NPY002  the loops draw from it
    scores = function(run := Run(options.way, options.seconds, options.clones))
    row = {
        "loop": options.loop,
        "way": options.way,
        "seconds": options.seconds,
        "seed": options.seed,
        "steps": run.steps,
        "bytes": 2 * sum(parameter.numel() for parameter in run.parameters()),  # COIN stores 16 bits
    } | scores
    print(row)
    stored = json.loads(options.json.read_text()) if options.json.exists() else {"metadata": metadata(), "results": {}}
    rows = [*stored["results"].get("trainings", ()), row]
    stored["results"] = {"trainings": rows, "over seeds": over_seeds(rows)}
    options.json.write_text(json.dumps(stored, indent=1))


def over_seeds(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns for each loop and length the mean steps and the mean, least and greatest score of each way."""
    tables: dict[tuple[str, float], dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        tables.setdefault((row["loop"], row["seconds"]), {}).setdefault(row["way"], []).append(row)
    results = []
    for (loop, seconds), ways in tables.items():
        result: dict[str, Any] = {"loop": loop, "seconds": seconds}
        for way, group in ways.items():
            scores = [row["psnr"] for row in group]
            result[way] = {
                "steps": round(sum(row["steps"] for row in group) / len(group)),
                "bytes": group[0]["bytes"],
                "mean": sum(scores) / len(scores),
                "least": min(scores),
                "most": max(scores),
            }
        results.append(result)
    return results


if __name__ == "__main__":
    main()
