"""What it costs to join and cut runs, and to stream them: the figures of docs/editing.md.

    python benchmarks/editing.py city --out /tmp/editing     two halves against one training, and Mega-NeRF
    python benchmarks/editing.py stream --out /tmp/editing        a joined run larger than a bound on memory

Seconds are processor time of one thread. Each adds its part to the JSON.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import torch
from harness import metadata

from voronerf import Run, open_run
from voronerf.data import Scene, city_scene
from voronerf.data.record import read_scene
from voronerf.evaluation import seam
from voronerf.evaluation.panels import contact_sheet, picture_of_colour, save_picture
from voronerf.rendering import orbit_cameras
from voronerf.rendering.rays import intersect_box
from voronerf.router import Similarity, Solid
from voronerf.training.config import TrainConfig
from voronerf.training.streaming import _File, anonymous_bytes
from voronerf.training.trainer import Trainer

RESULT = Path(__file__).parent / "results" / "editing.json"
PICTURES = Path(__file__).parent.parent / "docs" / "images"
BLOCKS, SIZE, BLEND = 2, 64, 0.03
OVERLAP = 0.1  # of a half, on each side of the border


def keep(name: str, values: list, **extra: object) -> None:
    """Adds a part to the JSON."""
    known = json.loads(RESULT.read_text()) if RESULT.is_file() else {"results": {}}
    command = "python benchmarks/editing.py city | stream --out DIR"
    known = {"metadata": metadata(command=command, **extra), "results": {**known["results"], name: values}}
    RESULT.write_text(json.dumps(known, indent=1) + "\n")
    print(json.dumps(values, indent=1))


def train(out: Path, scene: Scene, seconds: float, seed: int, **options: object) -> Run:
    """A run of so many seconds of processor time; what is there is opened."""
    if not (out / "summary.json").is_file():
        config = TrainConfig(
            out=out, budget=seconds, seed=seed, evaluations=1, eval_views=1, final_views=1, panels=0, lpips=Path("off"),
            **options,
        )  # fmt: skip
        Trainer(config, scene, clock=time.process_time, on_event=print).run()
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
                name = f"{way.split()[0]}-{side}-{seed}"
                run = train(out / name, own, seconds, seed, cells=(8,))
                box = half(scene, side).tolist()
                there = out / f"cut-{name}"
                halves.append(open_run(there, scene=scene) if there.exists() else run.cut(Solid.box(*box), there))
            there = out / f"joined-{way.split()[0]}-{seed}"
            joined = open_run(there, scene=scene) if there.exists() else Run.join(halves, there)
            runs[way] = replace(joined, scene=scene)
        for way, run in runs.items():
            row = {"way": way, "seed": seed, "cells": run.router.num_cells}
            row["psnr"] = run.evaluate(views=8, lpips="off")["psnr"]

            def picture(view: int, run: Run = run):
                return run.render(view)

            row["seam"] = seam(run.router, scene, picture, views=2, margin=BLEND)
            if hasattr(run.router, "parts"):
                run.router.blend = BLEND
                row["psnr blended"] = run.evaluate(views=8, lpips="off")["psnr"]
                if seed == seeds[0] and way == "views by position":
                    blended = picture_of_colour(run.render(4).colour)
                run.router.blend = 0.0
            rows.append(row)
            print(row)
        if seed == seeds[0]:
            pictures = {way: picture_of_colour(run.render(4).colour) for way, run in runs.items()}
            truth = picture_of_colour(scene.test.truth(4, scene.background_colour()))
            save_picture(PICTURES / "editing-join.png", contact_sheet({"truth": truth, **pictures, "blended": blended}))
    keep(
        "city", rows, **{"blocks": BLOCKS, "size": SIZE, "seconds of a half": seconds, "margin": BLEND, "seeds": seeds}
    )
    cuts, whole = [], out / f"one-{seeds[0]}"
    run = open_run(whole, scene=scene)
    low, high = scene.box
    for share in (0.5, 0.25):
        there = out / f"share-{share}"
        box = scene.box.clone()
        box[1, 0] = low[0] + (high[0] - low[0]) * min(1.0, 2 * share)
        box[1, 1] = low[1] + (high[1] - low[1]) * (1.0 if share >= 0.5 else 2 * share if share == 0.25 else 0.25)
        made = open_run(there, scene=scene) if there.exists() else run.cut(Solid.box(*box.tolist()), there)
        cuts.append({"share of the ground": share, "cells": made.router.num_cells, "MiB": size(there)})
    keep("cut", [{"training MiB": size(whole), **{f"MiB of {c['share of the ground']}": c["MiB"] for c in cuts}}])


def size(run: Path) -> float:
    """MiB of a run's last checkpoint and its networks."""
    files = [run / "checkpoints" / "last.safetensors", *(run / "checkpoints").glob("networks-*")]
    return round(sum(file.stat().st_size for file in files) / 2**20, 2)


def stream(out: Path, seconds: float) -> None:
    """A city of one block with a large table, joined 64 times, in processes of their own."""
    scene = city_scene(SIZE, blocks=1)
    options = ("log2_entries=20", "level_features=4", "levels=9")
    joined, side = out / "town", 8
    if not joined.exists():
        train(out / "block", scene, seconds, 0, cells=(16,), field_options=options)
    width = float((scene.box[1] - scene.box[0])[:2].max())
    if not joined.exists():
        blocks = []
        for number in range(side * side):
            block = open_run(out / "block", scene=scene)
            with torch.no_grad():  # else they were one file
                block.router.module.density.bias += 1e-6 * number
            blocks.append(block)
        frames = [Similarity.of((width * (i % side), width * (i // side), 0)) for i in range(side * side)]
        Run.join(blocks, joined, frames=frames)
        del blocks, block
    values = {"blocks": side * side, "GiB": round(size(joined) / 1024, 2), "rows": []}
    for memory in ("512M", "none"):
        command = [sys.executable, __file__, "picture", "--out", str(out), "--memory", memory]
        started = time.perf_counter()
        values["rows"].append(
            json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
        )
        print(memory, time.perf_counter() - started, values["rows"][-1])
    first, second = (torch.load(out / f"picture-{memory}.pt") for memory in ("512M", "none"))
    values["same bits"] = all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    keep("stream", values["rows"])


def picture(out: Path, memory: str) -> None:
    """Renders views of the town in this process, and watches what it and the files take."""
    started, cpu = time.perf_counter(), time.process_time()
    run_scene = read_scene(out / "town" / "scene.json")
    run = open_run(out / "town", scene=run_scene, memory=None if memory == "none" else memory)
    opened = time.perf_counter() - started
    files = [_File(path) for path in sorted((out / "town" / "checkpoints").glob("networks-*"))]
    libc, most, ended = ctypes.CDLL(None), [0, 0, 0], threading.Event()

    def watch() -> None:
        while not ended.wait(0.5):
            anonymous, cached = anonymous_bytes(), sum(file.resident(libc) for file in files)
            most[:] = [max(old, new) for old, new in zip(most, (anonymous, cached, anonymous + cached), strict=True)]

    thread = threading.Thread(target=watch)
    thread.start()
    box, cameras = run_scene.box, run_scene.train.cameras
    middle, wide = box.mean(0), float((box[1] - box[0]).norm())
    above = orbit_cameras(1, radius=0.8 * wide, elevation=0.6, width=64, height=48, focal=64.0)
    above = replace(above, poses=above.poses.clone())
    above.poses[:, :3, 3] += middle
    street = cameras[[0]]
    pictures, times = [], []
    for camera in (above, replace(above, intrinsics=above.intrinsics * 2, width=128, height=96), street):
        begun = time.perf_counter()
        pictures.append(run.render(camera, 0, heaviest=False).colour)
        times.append(round(time.perf_counter() - begun, 2))
    first = round(opened + times[0], 2)
    ended.set()
    thread.join()
    torch.save(pictures, out / f"picture-{memory}.pt")
    named = dict(zip(("anonymous MiB", "files MiB", "together MiB"), (round(x / 2**20) for x in most), strict=True))
    row = {"memory": memory, "opened s": round(opened, 2), "first picture s": first, "pictures s": times}
    print(json.dumps({**row, **named, "cpu s": round(time.process_time() - cpu, 1)}))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["city", "stream", "picture"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--memory", default="512M")
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what == "city":
        city(args.out, args.seconds, args.seeds)
    elif args.what == "stream":
        stream(args.out, args.seconds)
    else:
        picture(args.out, args.memory)


if __name__ == "__main__":
    main()
