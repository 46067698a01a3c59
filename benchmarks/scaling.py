"""Weak scaling of joint training: the city grows with the ranks, four blocks for each, in processes of this machine.

    python benchmarks/scaling.py --out benchmarks/results/scaling.json --plot docs/images/scaling.png

A row in the file takes the place of one with the same options; others stay, so rows can be measured one by one. With
``--device cuda`` rank n has the n-th GPU of this machine, and nccl is measured.

Each rank has one territory, with so many cells and rays whatever the number of ranks. Processor time is that of the
whole process, its messages included; a rank that waits for others takes none. "inner" are the territories that touch no
side of the city: none of 4, 4 of 16, 12 of 32. ``--ranks 4 --groups 8`` says what a rank
takes only because 32 processes share this machine: the groups do not know of each other. With ``--territories 2``,
``--ranks 2`` and ``--ranks 1 --threads 2 --blocks 2 4`` train the same run.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import resource
import statistics
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from harness import metadata
from torch.distributed import TCPStore

from voronerf.app.train.config_checks import ConfigError, check_device

#: Blocks along x and y for each number of ranks.
CITIES = {1: (2, 2), 2: (2, 4), 4: (4, 4), 8: (4, 8), 16: (8, 8), 32: (8, 16)}


def rank(number: int, size: int, port: int, folder: Path, options: dict[str, Any]) -> None:
    """Trains on one rank; writes what it took."""
    os.environ |= {"RANK": str(number), "LOCAL_RANK": str(number), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "TORCHELASTIC_USE_AGENT_STORE": "True"}
    torch.set_num_threads(options["threads"])
    from voronerf.app.scenes import city_scene, load_scene
    from voronerf.app.train.config import TrainConfig
    from voronerf.app.train.progress import Progress
    from voronerf.app.train.trainer import Trainer
    from voronerf.town.distributed.group import joined
    from voronerf.town.joint import JointTrainer

    blocks = tuple(options["blocks"] or CITIES[size])
    if options["data"] is None:
        scene = city_scene(options["size"], blocks=blocks, train_views=20, test_views=2, images=options["images"])
    else:
        scene = load_scene(options["data"], downscale=options["downscale"], images=options["images"])
    device = torch.device(options["device"], number if options["device"] == "cuda" else None)
    steps, budget = options["steps"], options["budget"]
    given: dict[str, Any] = {"steps": steps, "split_at_steps": (steps // 4,), "reservoir_batches": steps // 4}
    scored = {"budget": budget, "evaluations": 6, "eval_views": 64, "final_views": 256, "evaluation_share": 0.0}
    config = TrainConfig(
        out=folder / "run",
        device=str(device),
        seed=options["seed"],
        data="builtin-city",
        territories=options["territories"] or size,
        rays=options["rays"],
        ray_growth=1.0,
        cells=(options["cells"],),
        field=options["field"],
        checkpoint_every=1e9,
        **(scored if budget else {**given, "evaluations": 1}),
    )
    with joined(device) as group:
        trainer: Any = JointTrainer(config, scene, group=group)
        if config.territories == 1:  # what a user without ranks has: rays need not be put together
            trainer = Trainer(replace(config, territories=None), scene)
        told: list[list[float]] = []

        def note(progress: Progress) -> None:
            sent, work = [sum(group.sent.values()) / 1e3, sum(group.messages.values())], 0.0
            if isinstance(trainer, JointTrainer):
                work = sum(trainer.work.values())
            clocks = time.process_time(), time.thread_time(), time.perf_counter()
            told.append([*(1e3 * clock for clock in clocks), *sent, work, trainer.rays_done])

        trainer.on_step = note
        began = time.process_time()
        summary = trainer.run() if budget else trainer.advance()
        steps = torch.tensor(told, dtype=torch.float64).diff(dim=0)
        means = steps[-options["last"] :].mean(0).tolist()
        names = ("ms", "thread_ms", "clock_ms", "kb", "messages", "samples", "drawn")
        result: dict[str, Any] = dict(zip(names, means, strict=True))
        private = sum(
            int(line.split()[1])
            for line in Path("/proc/self/smaps_rollup").read_text().splitlines()
            if line.startswith("Private_")
        )
        result["early_ms"] = float(steps[8:40, 0].mean())
        result["private_mb"] = private / 1e3
        result["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        result["neighbours"] = result["to_light"] = 0
        result["inner"] = False
        if isinstance(trainer, JointTrainer):
            own, known = list(trainer.trainers), trainer.joint.map
            sides = (trainer.territories.boxes[own] - scene.box).abs()[..., :2]  # of the box of the city
            result["inner"] = bool((sides > 1e-3).all())
            result["neighbours"] = max(len(known.goes_to(each, True)) for each in own)
            result["to_light"] = max(len(known.goes_to(each, False)) for each in own)
        result["loss"] = trainer.loss
        if summary is not None:
            result["cpu_s"] = time.process_time() - began
            result |= {"psnr": summary["psnr"], "done": summary["steps"]}
            result["scores"] = [{name: each[name] for name in ("seconds", "step", "psnr")} for each in trainer.metrics]
        folder.mkdir(exist_ok=True)
        (folder / f"{number}.json").write_text(json.dumps(result))


def measure(size: int, options: dict[str, Any]) -> dict[str, Any]:
    """Trains with so many ranks; medians and the largest of all of them."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["voronerf.app.cli", "voronerf.town.joint", "voronerf.app.scenes.builtin.city"])
    stores = [TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False) for _ in range(options["groups"])]
    began, found = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        given = [(Path(folder, str(store.port)), store.port, number) for store in stores for number in range(size)]
        ranks = [context.Process(target=rank, args=(n, size, port, where, options)) for where, port, n in given]
        for process in ranks:
            process.start()
        for process in ranks:
            process.join()
        found = [json.loads((where / f"{number}.json").read_text()) for where, _, number in given]
    territories, blocks = options["territories"] or size, list(options["blocks"] or CITIES[size])
    row: dict[str, Any] = {"ranks": size, **options, "territories": territories, "blocks": blocks}
    row["wall_s"] = time.monotonic() - began
    row |= {name: found[0].pop(name) for name in ("psnr", "done", "scores") if name in found[0]}
    inner = [each for each in found if each.pop("inner")]
    row["inner"] = len(inner)
    for name in found[0]:
        row[name] = statistics.median(each[name] for each in found)
        row[f"{name}_largest"] = max(each[name] for each in found)
        if inner:
            row[f"{name}_inner"] = statistics.median(each[name] for each in inner)
    return row


def _commit() -> str:
    command = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude", "*")
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws what a rank takes over the number of ranks, each as a multiple of that of four."""
    import matplotlib.pyplot as plt

    first = next(row for row in rows if row["ranks"] == 4)
    shown = [row for row in rows if row["ranks"] >= 4 and row["blocks"] == list(CITIES[row["ranks"]])]
    shown = [
        row for row in shown if all(row[name] == first[name] for name in ("seed", "field", "threads", "rays", "groups"))
    ]
    figure, axes = plt.subplots(figsize=(6, 3.4))
    names = {
        "ms": "processor time, median",
        "ms_largest": "processor time, largest",
        "private_mb": "memory",
        "kb": "bytes sent",
        "messages": "messages",
    }
    for name, label in names.items():
        axes.plot([row["ranks"] for row in shown], [row[name] / first[name] for row in shown], "o-", label=label)
    axes.axhspan(0.85, 1.15, color="0.9")
    axes.set(
        xscale="log",
        xlabel="ranks, each with four blocks of the city",
        ylabel="over that of 4 ranks",
    )
    axes.set_xticks([row["ranks"] for row in shown], [str(row["ranks"]) for row in shown], minor=False)
    axes.minorticks_off()
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measures, and writes a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ranks", type=int, nargs="*", default=list(CITIES))
    parser.add_argument("--steps", type=int, default=320)
    parser.add_argument("--budget", type=float, help="seconds of training, which is scored, in place of steps")
    parser.add_argument("--last", type=int, default=64, help="steps that count")
    parser.add_argument("--rays", type=int, default=256)
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--size", type=int, default=50)
    parser.add_argument("--field", default="hashgrid")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--images", choices=("memory", "disk"), default="disk")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--territories", type=int)
    parser.add_argument("--groups", type=int, default=1, help="of so many ranks each, which train beside each other")
    parser.add_argument("--blocks", type=int, nargs=2)
    parser.add_argument("--data", help="another scene than the city")
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    arguments = vars(parser.parse_args())
    if arguments["device"] == "cuda":
        try:
            for number in range(max(arguments["ranks"], default=0)):
                check_device(f"cuda:{number}")
        except ConfigError as error:
            parser.error(str(error))
    out, sizes, drawn = arguments.pop("out"), arguments.pop("ranks"), arguments.pop("plot")
    for seed, size in itertools.product(arguments.pop("seeds"), sizes):
        options = {**arguments, "seed": seed}
        row = {"commit": _commit(), "load": [round(value, 1) for value in os.getloadavg()], **measure(size, options)}
        print({key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}, flush=True)
        rows = json.loads(out.read_text())["results"] if out.exists() else []
        rows = [other for other in rows if any(other.get(name) != row[name] for name in ("ranks", *options))] + [row]
        rows.sort(key=lambda each: (each["seed"], each["field"], each["threads"], each["territories"], each["groups"]))
        out.write_text(json.dumps({"metadata": metadata(), "results": rows}, indent=1) + "\n")
    if drawn is not None:
        plot(json.loads(out.read_text())["results"], drawn)


if __name__ == "__main__":
    main()
