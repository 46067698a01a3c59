"""What it costs to join and cut runs, and to stream them: the figures of docs/editing.md.

    python benchmarks/editing.py city --out /tmp/editing     two halves against one training, and Mega-NeRF
    python benchmarks/editing.py stream --out /tmp/editing        a joined run larger than a bound on memory

Seconds are processor time of one thread. Each adds its part to the JSON.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import math
import mmap
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from harness import metadata

from voronerf import Run, open_run
from voronerf.app.evaluate.panels import contact_sheet, picture_of_colour, save_picture
from voronerf.app.scenes import Scene, city_scene
from voronerf.app.scenes.record import read_scene
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.trainer import Trainer
from voronerf.nerf import orbit_cameras
from voronerf.nerf.rays import intersect_box
from voronerf.town.parts import Similarity, Solid

RESULT = Path(__file__).parent / "results" / "editing.json"
PICTURES = Path(__file__).parent.parent / "docs" / "images"
BLOCKS, SIZE = 2, 64
OVERLAP = 0.1  # of a half, on each side of the border
TOGETHER = 0.2  # share of the time in which joined halves are trained together


def keep(name: str, values: list, **extra: object) -> None:
    """Adds a part to the JSON."""
    known = json.loads(RESULT.read_text()) if RESULT.is_file() else {"metadata": {}, "results": {}}
    command, here = "python benchmarks/editing.py city | stream --out DIR", metadata(**extra)
    parts = {**known["metadata"].get("parts", {}), name: here}  # each of a machine of its own
    known = {"metadata": {"command": command, "parts": parts}, "results": {**known["results"], name: values}}
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
        for way, together in itertools.product(("views by position", "pixels by cell"), (0.0, TOGETHER)):
            halves, own_seconds = [], (1 - together) * seconds
            for side in (0, 1):
                sign = 1 if side == 0 else -1
                near = sign * (places - middle) < OVERLAP * BLOCKS / 2
                own = seen(scene, views=near) if way == "views by position" else seen(scene, box=half(scene, side))
                name = f"{way.split()[0]}-{side}-{seed}-{own_seconds:g}"
                run = train(out / name, own, own_seconds, seed, cells=(8,))
                box = half(scene, side).tolist()
                there = out / f"cut-{name}"
                halves.append(open_run(there, scene=scene) if there.exists() else run.cut(Solid.box(*box), there))
            there = out / f"joined-{way.split()[0]}-{seed}-{own_seconds:g}"
            joined = open_run(there, scene=scene) if there.exists() else Run.join(halves, there)
            if together:
                way += ", then together"
                if not (there / "summary.json").is_file():
                    config = replace(joined.config, resume=True, out=there, budget=2 * together * seconds, steps=None)
                    Trainer(config, scene, clock=time.process_time, on_event=print).run()
                joined = open_run(there, scene=scene)
            runs[way] = replace(joined, scene=scene)
        for way, run in runs.items():
            row = {"way": way, "seed": seed, "cells": run.router.num_cells}
            row["psnr"] = run.evaluate(lpips="off")["psnr"]
            rows.append(row)
            print(row)
        if seed == seeds[0]:
            pictures = {way: picture_of_colour(run.render(4).colour) for way, run in runs.items()}
            truth = picture_of_colour(scene.test.truth(4, scene.background_colour()))
            save_picture(PICTURES / "editing-join.png", contact_sheet({"truth": truth, **pictures}))
    keep(
        "city",
        rows,
        **{
            "blocks": BLOCKS,
            "size": SIZE,
            "seconds of a half": seconds,
            "seeds": seeds,
            "together": TOGETHER,
        },
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
    rows = []
    for memory, detail in (("512M", 1.0), ("512M", 0.0), ("none", 1.0), ("none", 0.0)):
        os.sync()
        for path in (joined / "checkpoints").iterdir():  # as after a start of the machine
            with open(path, "rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        command = [sys.executable, __file__, "picture", "--out", str(out), "--memory", memory, "--detail", str(detail)]
        most, printed = watched(command, joined / "checkpoints")
        rows.append({**json.loads(printed.splitlines()[-1]), **most})
        print(rows[-1])
    pictures = {(r["memory"], r["detail"]): torch.load(out / f"picture-{r['memory']}-{r['detail']}.pt") for r in rows}
    for detail in (0.0, 1.0):
        bounded, free = pictures["512M", detail], pictures["none", detail]
        assert all(torch.equal(a, b) for a, b in zip(bounded, free, strict=True)), "the bound must not change a bit"
    for row in rows:
        errors = zip(pictures[row["memory"], row["detail"]], pictures["none", 0.0], strict=True)
        if row["detail"]:
            row["against all fine dB"] = [round(-10 * math.log10(float((a - b).square().mean())), 2) for a, b in errors]
    keep("stream", rows, blocks=side * side, GiB=round(size(joined) / 1024, 2))


def watched(command: list[str], folder: Path) -> tuple[dict[str, int], str]:
    """Runs a program: the most memory that it and the files of a folder take, seen from outside, and what it prints."""
    libc, maps, most = ctypes.CDLL(None), [], [0, 0, 0]
    for path in folder.iterdir():
        with open(path, "rb") as file:
            pages = mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE)
        start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
        maps.append((pages, ctypes.c_void_p(start), (ctypes.c_ubyte * -(-len(pages) // mmap.PAGESIZE))()))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            status = Path(f"/proc/{process.pid}/status").read_text()
            anonymous = re.search(r"RssAnon:\s*(\d+)", status)
            found = [0 if anonymous is None else int(anonymous[1]) * 1024, 0]
            for pages, start, states in maps:
                libc.mincore(start, ctypes.c_size_t(len(pages)), states)
                found[1] += bytes(states).count(1) * mmap.PAGESIZE
            most = [max(old, new) for old, new in zip(most, (*found, sum(found)), strict=True)]
            time.sleep(0.05)
        assert process.returncode == 0
        names = ("anonymous MiB", "files MiB", "together MiB")
        assert process.stdout is not None
        return dict(zip(names, (round(x / 2**20) for x in most), strict=True)), process.stdout.read()


def picture(out: Path, memory: str, detail: float) -> None:
    """Renders views of the town in this process."""
    began = float(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19]) / os.sysconf("SC_CLK_TCK")
    started, spent = time.clock_gettime(time.CLOCK_BOOTTIME), [time.process_time()]
    scene = read_scene(out / "town" / "scene.json")
    run = open_run(out / "town", scene=scene, memory=None if memory == "none" else memory, detail=detail)
    opened = time.clock_gettime(time.CLOCK_BOOTTIME)
    spent.append(time.process_time())
    assert scene.box is not None
    middle, wide = scene.box.mean(0), float((scene.box[1] - scene.box[0]).norm())
    above = orbit_cameras(1, radius=0.8 * wide, elevation=0.6, width=64, height=48, focal=64.0)
    above = replace(above, poses=above.poses.clone())
    above.poses[:, :3, 3] += middle
    street = scene.train.cameras[[0]]
    pictures, ends = [], [opened]
    for camera, times in ((above, 1), (above, 4), (street, 1), (street, 4)):
        camera = replace(
            camera, intrinsics=camera.intrinsics * times, width=camera.width * times, height=camera.height * times
        )
        pictures.append(run.render(camera, 0, heaviest=False).colour)
        ends.append(time.clock_gettime(time.CLOCK_BOOTTIME))
        spent.append(time.process_time())
    torch.save(pictures, out / f"picture-{memory}-{detail}.pt")
    row = {
        "memory": memory,
        "detail": detail,
        "opened s": round(opened - started, 2),
        "first picture s": round(ends[1] - started, 2),
        "since the start of the process s": round(ends[1] - began, 2),
        "pictures s": [round(b - a, 2) for a, b in itertools.pairwise(ends)],
        "cpu s of start, opening, pictures": [round(b - a, 2) for a, b in itertools.pairwise([0.0, *spent])],
    }
    print(json.dumps(row))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["city", "stream", "picture"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--memory", default="512M")
    parser.add_argument("--detail", type=float, default=1.0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what == "city":
        city(args.out, args.seconds, args.seeds)
    elif args.what == "stream":
        stream(args.out, args.seconds)
    else:
        picture(args.out, args.memory, args.detail)


if __name__ == "__main__":
    main()
