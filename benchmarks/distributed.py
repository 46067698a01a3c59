"""Compares trainings of several processes with one training, at equal work.

    python benchmarks/distributed.py --data LEGO --json benchmarks/results/distributed.json
    python benchmarks/distributed.py --data LEGO --kills 20 --json benchmarks/results/distributed_kills.json
    python benchmarks/distributed.py --data builtin-city:8x8 --regions 16 --json benchmarks/results/regions.json

The first command compares two processes with one process of two threads, at equal steps and rays of a step. Each side
runs in processes of its own, in turns over the seeds. ``average_us`` is the time in which a step averages gradients and
waits for the other process; ``alone_us`` is the time without the wait, after a barrier; ``equal`` says whether both
processes end with the same bits. The second command kills one of the processes of ``torchrun --max-restarts`` again and
again, at random moments. The third trains regions one after another and joins them, then trains the whole scene in 1.2
times the processor time: with as many parameters, and with the default tables.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import random
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import tyro
from harness import write_results
from torch import Tensor

from voronerf.app.evaluate import evaluate, mean_scores
from voronerf.app.files import json_text, read_json_lines
from voronerf.app.scenes import load_scene
from voronerf.app.train import TrainConfig, build, train
from voronerf.nerf import Ranks

LAUNCH = [sys.executable, *shlex.split("-m torch.distributed.run --standalone --nproc-per-node 2")]
"""The first words of a command that runs in two processes."""


@dataclass(frozen=True)
class Options:
    """The settings of the trainings."""

    data: tuple[str, ...] = ("builtin",)
    """The scenes; kills and regions use the first."""
    downscale: int | None = None
    """The factor by which the images are downscaled on load. Default: as in trainings."""
    steps: int = 1500
    """The steps of a training."""
    rays: int = 1024
    """The rays of a step, of all processes together."""
    seeds: tuple[int, ...] = (0, 1)
    """The seeds of the trainings."""
    kills: int = 0
    """The number of times that a process is killed; 0 compares two processes with one instead."""
    regions: int = 0
    """The number of regions; 0 compares processes instead."""
    seconds: float = 60
    """The budget of each region in seconds."""
    whole: float = 1340
    """The budget of each whole training in seconds; 1340 took 1.2 times the processor time of 16 regions of 60 s."""
    entries: int = 24
    """log2 of the entries of each table of the whole training; with 24, it has as many parameters as 16 regions."""
    folder: Path | None = None
    """The folder of the runs of regions, which are kept. Default: a temporary folder."""
    worker: int | None = None
    """The seed of a training in this process, which prints its result; for internal use."""
    json: Path | None = None
    """The JSON file of the results. Default: results are only printed."""


class TimedRanks(Ranks):
    """Ranks that note the seconds and the bytes of each average."""

    seconds: list[float] = []  # noqa: RUF012
    sizes: list[list[int]] = []  # noqa: RUF012

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Averages tensors, and notes the time."""
        tensors = list(tensors)
        start = time.perf_counter()
        super().average(tensors)
        self.seconds.append(time.perf_counter() - start)
        self.sizes.append([tensor.numel() for tensor in tensors])


def work(options: Options, seed: int) -> None:
    """Trains in this process, which may be one of several; the first prints the result."""
    ranks = TimedRanks.join()
    scene = load_scene(options.data[0], downscale=options.downscale)
    rays = options.rays // ranks.size
    config = TrainConfig(data=options.data[0], steps=options.steps, rays=rays, seed=seed)
    state = build(config, scene, ranks=ranks)
    train(state)
    result: dict[str, Any] = {"scene": scene.name, "processes": ranks.size, "threads": torch.get_num_threads()}
    result |= {"seed": seed, "steps": state.step, "rays": rays, "step_ms": 1e3 * state.seconds / state.step}
    if ranks.size > 1:
        sizes = ranks.sizes[-1]
        tensors, alone = [torch.zeros(size) for size in sizes], []
        for _ in range(100):
            dist.barrier()
            start = time.perf_counter()
            ranks.average(tensors)
            alone.append(time.perf_counter() - start)
        in_steps = ranks.seconds[:-100]
        result |= {"bytes": 4 * sum(sizes), "average_us": 1e6 * statistics.median(in_steps)}
        result |= {"alone_us": 1e6 * statistics.median(alone)}
        held = [*state.renderer.field.state_dict().values(), state.sampler.grid.density, state.sampler.grid.occupied]
        digest = hashlib.sha256(b"".join(tensor.detach().numpy().tobytes() for tensor in held)).digest()
        differs = torch.tensor(float(ranks.first(digest) != digest))
        ranks.maximum(differs)
        result |= {"equal": not differs, "cells": state.router.num_cells}
    if not ranks.rank:
        with state.averaged():
            result |= mean_scores(evaluate(state.renderer, scene))
        print(json_text(result), flush=True)


def in_turns(options: Options) -> list[dict[str, Any]]:
    """Trains in two processes, in one of two threads, and in one of one thread, in turns."""
    results = []
    for data, seed in itertools.product(options.data, options.seeds):
        for prefix, threads in ((LAUNCH, 1), ([sys.executable], 2), ([sys.executable], 1)):
            words = [__file__, "--worker", seed, *_scene_words(options, data)]
            words += ["--steps", options.steps, "--rays", options.rays]
            environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
            done = subprocess.run([*prefix, *map(str, words)], env=environment, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(done.stdout + done.stderr)
            results.append(json.loads(done.stdout.splitlines()[-1]))
            print(json_text(results[-1]), flush=True)
    return results


def killed(options: Options) -> dict[str, Any]:
    """Kills a process of a training again and again; returns the finished run's steps and the longest wait."""
    choose = random.Random(options.seeds[0])
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [*LAUNCH, "--max-restarts", options.kills + 1, "-m", "voronerf", "train", "--out", out]
        words += shlex.split("--resume --checkpoint-every 1 --panels 0 --eval-views 1")
        words += [*_scene_words(options, options.data[0]), "--steps", options.steps, "--rays", options.rays]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        command = [*map(str, words)]
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        waits, kills = list[float](), 0
        while kills < options.kills and process.poll() is None:
            time.sleep(choose.uniform(6, 14))
            if process.poll() is None and (children := _children(process)):
                os.kill(choose.choice(sorted(children)), signal.SIGKILL)
                kills, start = kills + 1, time.monotonic()
                while _children(process) & children and time.monotonic() - start < 90:
                    time.sleep(0.05)
                waits.append(time.monotonic() - start)
        output = process.communicate()[0]
        summary = json.loads((out / "summary.json").read_text())
        steps = [line["step"] for line in read_json_lines(out / "metrics.jsonl")]
    result = {"kills": kills, "exit_status": process.returncode, "complete": summary["complete"]}
    result |= {"steps": summary["steps"], "scored_steps": steps, "longest_wait_s": max(waits)}
    return result | {"lines_of_an_ended_process": output.count("another process of this training has ended")}


def in_regions(options: Options) -> list[dict[str, Any]]:
    """Trains a scene in regions, and as a whole with as many parameters and with the default tables; scores all."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        printed = _voronerf("regions", options.data[0], "--count", options.regions, "--out", folder)[0]
        *jobs, join = (shlex.split(line)[1:] for line in printed.splitlines() if line.startswith("voronerf"))
        used = [_trained(options, *job, budget=options.seconds) for job in jobs]
        _voronerf(*join)
        results = [_scored(options, folder / "joined", used, sorted(folder.glob("region-*")))]
        for way, added in (("whole", ["--field-options", f"log2_entries={options.entries}"]), ("default", [])):
            words = ["train", "--data", options.data[0], "--cells", 16, options.regions, *added, "--out", folder / way]
            used = [_trained(options, *words, budget=options.whole)]
            results.append(_scored(options, folder / way, used, [folder / way]))
        return results


def _trained(options: Options, *words: Any, budget: float) -> tuple[float, float]:
    shared = ["--panels", 0, "--eval-views", 1, "--seed", options.seeds[0], "--budget", budget]
    return _voronerf(*words, *_scene_words(options, options.data[0])[2:], *shared)[1:]


def _scored(options: Options, run: Path, used: list[tuple[float, float]], runs: list[Path]) -> dict[str, Any]:
    """Returns the result of trainings whose common run is ``run``, from the processor time and memory of each."""
    _voronerf("eval", run, *_scene_words(options, options.data[0]), "--lpips", "off")
    scores = json.loads((run / "eval.json").read_text())
    result: dict[str, Any] = {"way": run.name, "jobs": len(used), "seed": options.seeds[0]}
    summaries = [json.loads((each / "summary.json").read_text()) for each in runs]
    result |= {name: sum(each[name] for each in summaries) for name in ("seconds", "steps", "parameters")}
    result |= {"processor_seconds": sum(each[0] for each in used)}
    result |= {"largest_job_mib": max(each[1] for each in used), "views": len(scores["views"])}
    result |= {name: scores[name] for name in ("psnr", "ssim")}
    print(json_text(result), flush=True)
    return result


def _scene_words(options: Options, data: str) -> list[Any]:
    return ["--data", data] + ([] if options.downscale is None else ["--downscale", options.downscale])


def _voronerf(*words: Any) -> tuple[str, float, float]:
    """Runs a command; returns its output, its processor time in seconds, and its peak memory in MiB."""
    with tempfile.TemporaryFile("w+") as output:
        command = [sys.executable, "-m", "voronerf", *map(str, words)]
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(process.pid, 0)
        output.seek(0)
        text = output.read()
    if status:
        raise RuntimeError(text)
    return text, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def _children(process: subprocess.Popen[str]) -> set[int]:
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True)
    return {int(line) for line in listed.stdout.split()}


def main(options: Options) -> None:
    """Trains, prints, and writes the results."""
    if options.worker is not None:
        return work(options, options.worker)
    if options.kills:
        results = [killed(options)]
        print(json_text(results[0]))
    else:
        results = in_regions(options) if options.regions else in_turns(options)
    write_results(options.json, results, benchmark="distributed")
    return None


if __name__ == "__main__":
    main(tyro.cli(Options, description=(__doc__ or "").split("\n\n")[0], config=(tyro.conf.OmitArgPrefixes,)))
