"""What it costs in quality to join two runs: halves of a city against one training of all of it.

    python benchmarks/editing.py --out /tmp/editing

Seconds are processor time of one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch
from harness import metadata
from turns import Training

from voronerf import town
from voronerf.app import Run, open_run
from voronerf.app.evaluate.panels import contact_sheet, picture_of_colour, save_picture
from voronerf.app.scenes import Scene, city_scene
from voronerf.app.train.config import TrainConfig
from voronerf.nerf.rays import intersect_box

RESULT = Path(__file__).parent / "results" / "editing.json"
PICTURES = Path(__file__).parent.parent / "docs" / "images"
BLOCKS, SIZE = 2, 64
OVERLAP = 0.1  # of a half, on each side of the border


def keep(name: str, values: list, **extra: object) -> None:
    """Adds a part to the JSON."""
    known = json.loads(RESULT.read_text()) if RESULT.is_file() else {"metadata": {}, "results": {}}
    command, here = "python benchmarks/editing.py --out DIR", metadata(**extra)
    parts = {**known["metadata"].get("parts", {}), name: here}  # each of a machine of its own
    known = {"metadata": {"command": command, "parts": parts}, "results": {**known["results"], name: values}}
    RESULT.write_text(json.dumps(known, indent=1) + "\n")
    print(json.dumps(values, indent=1))


def train(out: Path, scene: Scene, seconds: float, seed: int, **options: object) -> Run:
    """A run of so many seconds of processor time; what is there is opened."""
    if not (out / "summary.json").is_file():
        config = TrainConfig(out=out, budget=seconds, seed=seed, evaluations=1, eval_views=1, **options)
        Training(config, scene, clock=time.process_time, on_event=print).run()
    return open_run(out, scene=scene)


def seen(scene: Scene, views: torch.Tensor | None = None, box: torch.Tensor | None = None) -> Scene:
    """A scene with some of its training views, or with the pixels alone whose rays meet a box."""
    train = scene.train
    if views is not None:
        names = tuple(name for name, used in zip(train.names, views.tolist(), strict=True) if used)
        train = replace(train, cameras=train.cameras[views], images=train.images[views], names=names)
    if box is not None:
        masks = []
        for view in range(len(train)):
            rays = train.cameras.image_rays(view)
            hit = intersect_box(rays.origins, rays.directions, box, scene.near, scene.far)[2]
            masks.append(hit.reshape(train.images.shape[1:3]))
        train = replace(train, masks=torch.stack(masks))
    return replace(scene, train=train)


def half(scene: Scene, side: int) -> torch.Tensor:
    """The box of a half, and the overlap beyond its border."""
    box = scene.box.clone()
    middle = float(box[:, 0].mean())
    wider = OVERLAP * (middle - float(box[0, 0]))
    box[1 - side, 0] = middle + (wider if side == 0 else -wider)
    return box


def city(out: Path, seconds: float, seeds: list[int]) -> None:
    """Two halves trained apart and joined, against one training on everything for the sum of their times."""
    scene = city_scene(SIZE, blocks=BLOCKS)
    print(len(scene.train), "views", scene.box.tolist())
    middle, rows = float(scene.box[:, 0].mean()), []
    places = scene.train.cameras.origins[:, 0]
    for seed in seeds:
        runs = {"one training": train(out / f"one-{seed}", scene, 2 * seconds, seed, cells=(16,))}
        for way in ("views by position", "pixels by cell"):
            halves = []
            for side in (0, 1):
                sign = 1 if side == 0 else -1
                near = sign * (places - middle) < OVERLAP * BLOCKS / 2
                own = seen(scene, views=near) if way == "views by position" else seen(scene, box=half(scene, side))
                name = f"{way.split()[0]}-{side}-{seed}-{seconds:g}"
                run, there = train(out / name, own, seconds, seed, cells=(8,)), out / f"cut-{name}"
                if not there.exists():
                    town.cut(run.path, town.Solid.box(*half(scene, side).tolist()), there)
                halves.append(there)
            there = out / f"joined-{way.split()[0]}-{seed}-{seconds:g}"
            if not there.exists():
                town.join(halves, there)
            runs[way] = town.open_run(there, scene=scene)
        for way, run in runs.items():
            row = {"way": way, "seed": seed, "cells": run.router.num_cells}
            row["psnr"] = run.evaluate(lpips="off")["psnr"]
            rows.append(row)
            print(row)
        if seed == seeds[0]:
            pictures = {way: picture_of_colour(run.render(4).colour) for way, run in runs.items()}
            truth = picture_of_colour(scene.test.truth(4, scene.background_colour()))
            save_picture(PICTURES / "editing-join.png", contact_sheet({"truth": truth, **pictures}))
    about = {"blocks": BLOCKS, "size": SIZE, "seconds of a half": seconds, "seeds": seeds}
    keep("city", rows, **about)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    city(args.out, args.seconds, args.seeds)


if __name__ == "__main__":
    main()
