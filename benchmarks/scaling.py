"""Weak scaling of joint training: the city grows with the ranks, four blocks for each, in processes of this machine.

    python benchmarks/scaling.py --out benchmarks/results/scaling.json --plot docs/images/scaling.png

With ``--device cuda`` rank n has the n-th GPU of this machine, and nccl is measured.

Each rank has one territory, with so many cells and rays whatever the number of ranks. Processor time is that of the
whole process, its messages included; a rank that waits for others takes none. With ``--territories 2 --blocks 4 4``,
``--ranks 2`` and ``--ranks 1 --threads 2`` train the same run.
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
from pathlib import Path
from typing import Any

import torch
from harness import metadata
from torch.distributed import TCPStore

#: Blocks along x and y for each number of ranks.
CITIES = {1: (2, 2), 2: (2, 4), 4: (4, 4), 8: (4, 8), 16: (8, 8), 32: (8, 16)}


def rank(number: int, size: int, port: int, folder: str, options: dict[str, Any]) -> None:
    """Trains on one rank; writes what it took."""
    os.environ |= {"RANK": str(number), "LOCAL_RANK": str(number), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "TORCHELASTIC_USE_AGENT_STORE": "True"}
    torch.set_num_threads(options["threads"])
    from voronerf.data import city_scene, load_scene
    from voronerf.distributed.group import joined
    from voronerf.training.config import TrainConfig
    from voronerf.training.joint import JointTrainer

    blocks = tuple(options["blocks"] or CITIES[size])
    if options["data"] is None:
        scene = city_scene(options["size"], blocks=blocks, train_views=20, test_views=2, images=options["images"])
    else:
        scene = load_scene(options["data"], downscale=options["downscale"], images=options["images"])
    device = torch.device(options["device"], number if options["device"] == "cuda" else None)
    steps, last = options["steps"], options["last"]
    config = TrainConfig(
        out=Path(folder) / "run",
        device=str(device),
        seed=options["seed"],
        data="builtin-city",
        steps=steps,
        territories=options["territories"] or size,
        rays=options["rays"],
        ray_growth=1.0,
        cells=(options["cells"],),
        field=options["field"],
        split_at_steps=(steps // 4,),
        reservoir_batches=steps // 4,
        evaluations=1,
        eval_views=1,
        checkpoint_every=1e9,
    )
    with joined(device) as group:
        trainer = JointTrainer(config, scene, group=group)
        found: list[dict[str, float]] = []
        for _ in range(steps):
            began, rays = time.perf_counter(), trainer.rays_done
            before = time.process_time(), sum(group.sent.values()), sum(group.messages.values())
            trainer._split()
            trainer.train_step()
            trainer.step += 1
            if trainer.step % 8 == 0:
                trainer._agree()
            after = time.process_time(), sum(group.sent.values()), sum(group.messages.values())
            found.append(
                {
                    "ms": 1e3 * (after[0] - before[0]),
                    "clock_ms": 1e3 * (time.perf_counter() - began),
                    "kb": (after[1] - before[1]) / 1e3,
                    "messages": after[2] - before[2],
                    "samples": sum(trainer.work.values()),
                    "rays": trainer.rays_done - rays,
                }
            )
            trainer.work = dict.fromkeys(trainer.work, 0)
        private = sum(
            int(line.split()[1])
            for line in Path("/proc/self/smaps_rollup").read_text().splitlines()
            if line.startswith("Private_")
        )
        measured = found[-last:]
        result: dict[str, Any] = {name: statistics.mean(step[name] for step in measured) for name in found[0]}
        result["early_ms"] = statistics.mean(step["ms"] for step in found[8:40])
        result["private_mb"] = private / 1e3
        result["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        result["neighbours"] = max(int((trainer.joint.map.links[n] >= 0).sum()) for n in trainer.trainers)
        result["loss"] = trainer.loss
        Path(folder, f"{number}.json").write_text(json.dumps(result))


def measure(size: int, options: dict[str, Any]) -> dict[str, Any]:
    """Trains with so many ranks; medians and the largest of all of them."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["voronerf.cli", "voronerf.training.joint", "voronerf.data.builtin.city"])
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        ranks = [context.Process(target=rank, args=(n, size, store.port, folder, options)) for n in range(size)]
        for process in ranks:
            process.start()
        for process in ranks:
            process.join()
        found = [json.loads(Path(folder, f"{n}.json").read_text()) for n in range(size)]
    row: dict[str, Any] = {
        "ranks": size,
        "seed": options["seed"],
        "blocks": list(options["blocks"] or CITIES[size]),
        "wall_s": time.monotonic() - began,
    }
    for name in found[0]:
        row[name] = statistics.median(each[name] for each in found)
        row[f"{name}_largest"] = max(each[name] for each in found)
    return row


def _commit() -> str:
    command = ("git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD")
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws what a rank takes over the number of ranks, each as a multiple of that of four."""
    import matplotlib.pyplot as plt

    first = next(row for row in rows if row["ranks"] == 4)
    shown = [row for row in rows if row["ranks"] >= 4 and row["seed"] == first["seed"]]
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
    parser.add_argument("--ranks", type=int, nargs="+", default=list(CITIES))
    parser.add_argument("--steps", type=int, default=320)
    parser.add_argument("--last", type=int, default=48, help="steps that count")
    parser.add_argument("--rays", type=int, default=256)
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--size", type=int, default=50)
    parser.add_argument("--field", default="hashgrid")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--images", choices=("memory", "disk"), default="disk")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--territories", type=int)
    parser.add_argument("--blocks", type=int, nargs=2)
    parser.add_argument("--data", help="another scene than the city")
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    arguments = vars(parser.parse_args())
    out, sizes, drawn = arguments.pop("out"), arguments.pop("ranks"), arguments.pop("plot")
    rows = []
    for seed, size in itertools.product(arguments["seeds"], sizes):
        rows.append(measure(size, {**arguments, "seed": seed}))
        print({key: round(value, 3) if isinstance(value, float) else value for key, value in rows[-1].items()})
        row = metadata(**arguments, load=[round(value, 1) for value in os.getloadavg()], commit=_commit())
        out.write_text(json.dumps({"metadata": row, "results": rows}, indent=1) + "\n")
    if drawn is not None:
        plot(rows, drawn)


if __name__ == "__main__":
    main()
