"""Shows what cells give, and after what time: test PSNR of one network and of cells, for trainings of several lengths.

    python benchmarks/cells_over_time.py --data LEGO builtin-city:4x4 --minutes 1 5 20 --json FILE --plot PICTURE

All sides are trained by the same kernels on one thread, in turns, for equal processor time. Cells are trained as in the
paper: one network for a fifth of the time, then its copies. Every point is a training of its own, since the learning
rate falls over the whole training. Trainings that the JSON file has are not repeated.
"""

from __future__ import annotations

import itertools
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import metadata
from turns import CLOCKS, Training, take_turns

from voronerf.app.evaluate.scores import evaluate, mean_scores
from voronerf.app.files import json_text, write_text
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import load_scene
from voronerf.app.train.config import TrainConfig

#: The settings of each side, and the least minutes of its trainings. 16 networks of width 12 have the parameters of one
#: of width 64, 12 % more. A network of width 256 makes 250 steps in a minute, which teach it nothing.
SIDES: dict[str, tuple[dict[str, Any], float]] = {
    "one network of width 64": ({"cells": (), "width": 64}, 0),
    "one network of width 256": ({"cells": (), "width": 256}, 5),
    "16 cells of width 64": ({"cells": (16,), "width": 64}, 0),
    "64 cells of width 64": ({"cells": (64,), "width": 64}, 0),
    "one network of width 12": ({"cells": (), "width": 12}, 0),
    "16 cells of width 12": ({"cells": (16,), "width": 12}, 0),
}


@dataclass(frozen=True)
class Options:
    """The scenes and the lengths of the trainings."""

    json: Path
    """The JSON file of the results, which is continued."""
    data: tuple[str, ...] = ("builtin-city:4x4",)
    """The scene folders or built-in scenes."""
    minutes: tuple[float, ...] = (1, 5, 20, 60)
    """The lengths of the trainings."""
    seeds: tuple[int, ...] = (0,)
    """The seeds."""
    sides: tuple[str, ...] = tuple(SIDES)
    """The compared sides."""
    views: int = 4
    """The number of test views."""
    plot: Path | None = None
    """The file of the plot."""


def train(data: str, minutes: float, seed: int, sides: Sequence[str], views: int) -> list[dict[str, Any]]:
    """Trains the sides in turns; returns a row of scores for each."""
    scene, rows = load_scene(data), []
    with tempfile.TemporaryDirectory() as folder:
        common: dict[str, Any] = {"field": "nerf", "data": data, "seed": seed, "evaluations": 1, "eval_views": 1}
        trainings = {
            side: Training(
                TrainConfig(**common, **SIDES[side][0], budget=60 * minutes, out=Path(folder, str(i))),
                scene,
                clock=CLOCKS["cpu"],
            )
            for i, side in enumerate(sides)
        }
        take_turns(trainings.values(), budget=60 * minutes, turn=5)
        for side, training in trainings.items():
            state = training.state
            with state.averaged():
                scores = evaluate(state.renderer, scene, views=views)
                began = time.process_time()
                render_camera(state.renderer, scene, scene.test.cameras, 0)
                seconds = time.process_time() - began
            rows.append(
                {
                    "scene": Path(data).name,
                    "minutes": minutes,
                    "seed": seed,
                    "side": side,
                    **mean_scores(scores),
                    "steps": state.step,
                    "picture_ms": round(1e3 * seconds),
                }
            )
    return rows


def plot(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """Draws the PSNR of all sides by the length of the training, one pane for each scene; a band spans the seeds.

    The legend has the time of a picture after the longest training.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(row["scene"] for row in results))
    figure, panes = pyplot.subplots(1, len(scenes), figsize=(5 * len(scenes), 4.6), layout="constrained", squeeze=False)
    for scene, pane in zip(scenes, panes[0]):
        for color, side in enumerate(SIDES):
            rows = [row for row in results if (row["scene"], row["side"]) == (scene, side)]
            if not rows:
                continue
            times = sorted({row["minutes"] for row in rows})
            scores = [[row["psnr"] for row in rows if row["minutes"] == minutes] for minutes in times]
            picture = statistics.median(row["picture_ms"] for row in rows if row["minutes"] == times[-1])
            style: dict[str, Any] = {"color": f"C{color}", "label": f"{side}, {picture:.0f} ms a picture"}
            pane.plot(times, list(map(statistics.mean, scores)), "o-", markersize=3, **style)
            pane.fill_between(times, list(map(min, scores)), list(map(max, scores)), color=f"C{color}", alpha=0.2)
        pane.set(title=scene, xscale="log", xlabel="minutes of one thread", ylabel="test PSNR [dB]")
        pane.set_xticks(times := sorted({row["minutes"] for row in results}), [f"{minutes:g}" for minutes in times])
        pane.minorticks_off()
        pane.grid(alpha=0.3)
        pane.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False)
    figure.savefig(path, dpi=110)


def by_side(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns for each side, scene and length the means over the seeds of PSNR, steps and milliseconds of a picture."""
    found: list[dict[str, Any]] = []
    for side in SIDES:
        result: dict[str, Any] = {"side": side}
        for scene, minutes in dict.fromkeys((row["scene"], row["minutes"]) for row in rows):
            group = [row for row in rows if (row["scene"], row["minutes"], row["side"]) == (scene, minutes, side)]
            if group:
                means = {name: sum(row[name] for row in group) / len(group) for name in ("psnr", "steps", "picture_ms")}
                result.setdefault(scene, {})[f"{minutes:g} min"] = {**means, "seeds": len(group)}
        found.append(result)
    return found


def main(options: Options) -> None:
    """Trains what is missing, writes the results after every length, and draws them."""
    torch.set_num_threads(1)
    if options.json.exists():
        stored = json.loads(options.json.read_text())
    else:
        stored = metadata(benchmark="cells_over_time", views=options.views, field="nerf", results={"trainings": []})
    rows: list[dict[str, Any]] = stored["results"]["trainings"]
    for minutes, data, seed in itertools.product(options.minutes, options.data, options.seeds):
        this = Path(data).name, minutes, seed
        there = {row["side"] for row in rows if (row["scene"], row["minutes"], row["seed"]) == this}
        missing = [side for side in options.sides if side not in there and SIDES[side][1] <= minutes]
        if missing:
            rows += train(data, minutes, seed, missing, options.views)
            stored["results"]["sides"] = by_side(rows)
            write_text(options.json, json_text(stored))
            print(f"{minutes:g} minutes of {data}, seed {seed}", flush=True)
    if options.plot is not None:
        plot(options.plot, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
