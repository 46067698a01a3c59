"""The search for the defaults of `voronerf train`: one setting changed at a time, on several scenes.

    python benchmarks/defaults.py --scenes ../shared/data/lego ../shared/data/fox builtin --downscale 4 8 1 \\
        --json results/defaults.json

On each scene, the defaults and each change of them train for the same time, in turns, as in `time_to_quality.py`. What
counts is the mean gain in PSNR over the defaults, over all scenes, at half of the time and at the end. The file of
`--json` is written after each scene; the next call with the same settings makes only the scenes that it lacks.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import time_to_quality
import tyro
from harness import metadata

from voronerf.cli.main import EXPECTED
from voronerf.files import write_text
from voronerf.training.config import ConfigError

#: What is compared, as the sides of `time_to_quality.py`; the first are the defaults.
SIDES = (
    "default:",
    "256 rays: --rays 256",
    "1,024 rays: --rays 1024",
    "96 samples: --samples 96",
    "8 cells: --cells 8",
    "64 cells: --cells 64",
    "split at 0.1: --split-at 0.1",
    "width 64: --width 64",
    "2^14 entries: --field-options log2_entries=14",
    "2^16 entries: --field-options log2_entries=16",
    "rate 0.01: --lr 0.01",
    "rate 0.03: --lr 0.03",
    "balanced: --centres balanced",
)


@dataclass(frozen=True)
class Options:
    """Where to search, and for how long."""

    scenes: tuple[str, ...] = ("builtin", "builtin-rich")
    """Scene folders or built-in scenes."""
    downscale: tuple[int, ...] = ()
    """Factor by which the images of each scene are made smaller; default: 1 for all."""
    sides: tuple[str, ...] = SIDES
    """What is compared, each as "NAME: OPTIONS" with options of `voronerf train`; gains are over the first."""
    variants: tuple[str, ...] = ()
    """Options for all sides, each as "NAME: OPTIONS"; with each of them every scene has a column of its own."""
    budget: float = 30.0
    """Training seconds of each side."""
    clock: Literal["wall", "cpu"] = "cpu"
    """What counts as a second: wall time, or process CPU time / threads."""
    seeds: int = 1
    """Runs of each side and scene."""
    eval_views: int = 10
    """Test views of an evaluation."""
    json: Path | None = None
    """Where the rows go, and which of them are there already; default: printed only."""


def measure(options: Options) -> dict[str, Any]:
    """Trains what the file of results lacks; returns {metadata, results}.

    Raises:
        ConfigError: for settings that do not fit, or a file of other settings.
    """
    factors = options.downscale or (1,) * len(options.scenes)
    if len(factors) != len(options.scenes):
        raise ConfigError(f"--downscale must have a factor for each of {len(options.scenes)} scenes, got {factors}")
    names = ("budget", "clock", "seeds", "eval_views")
    settings = {name: getattr(options, name) for name in names} | {"sides": list(options.sides)}
    results: list[dict[str, Any]] = []
    if options.json is not None and options.json.is_file():
        stored = json.loads(options.json.read_text())
        if {name: stored["metadata"].get(name) for name in settings} != settings:
            raise ConfigError(f"--json must name a file of the same settings, got {options.json}")
        results = stored["results"]
    outcome = {"metadata": metadata(benchmark="defaults", **settings), "results": results}
    scenes = zip(options.scenes, factors, strict=True)
    for (scene, downscale), variant in itertools.product(scenes, options.variants or ("",)):
        key = {"scene": Path(scene).name, "downscale": downscale} | ({"variant": variant} if variant else {})
        common = variant.partition(":")[2]
        if any(column(key) == column(row) for row in results):
            continue
        given = {name: value for name, value in dataclasses.asdict(options).items() if name in (*names, "sides")}
        comparison = time_to_quality.Options(data=scene, downscale=downscale, common=common, evaluations=2, **given)
        with tempfile.TemporaryDirectory() as folder:
            found = time_to_quality.compare(comparison, Path(folder))
        for row in found["results"]:
            psnr = [point["psnr"] for point in row["curve"]]
            results.append(key | {name: row[name] for name in ("side", "seed", "steps")} | {"psnr": psnr})
        if options.json is not None:
            write_text(options.json, json.dumps(outcome, indent=1) + "\n")
    return outcome


def column(row: dict[str, Any]) -> str:
    """What a row's column of the table is called."""
    scene = row["scene"] if row["downscale"] == 1 else f"{row['scene']} / {row['downscale']}"
    return f"{scene}, {row['variant'].partition(':')[0]}" if "variant" in row else str(scene)


def table(outcome: dict[str, Any]) -> str:
    """Mean gain over the first side on each scene, at half of the time and at the end, as Markdown.

    Of several seeds also the least and the largest gain at the end.
    """
    runs: dict[str, dict[str, list[list[float]]]] = {}
    for row in outcome["results"]:
        runs.setdefault(column(row), {}).setdefault(row["side"], []).append(row["psnr"])
    sides = [side.partition(":")[0].strip() for side in outcome["metadata"]["sides"]]
    lines = [f"| {' | '.join(['', *runs, 'mean'])} |", "|---" * (len(runs) + 2) + "|"]
    for side in sides:
        cells, gains = [], []
        for found in runs.values():
            first = found[sides[0]]
            gain = [[a - b for a, b in zip(*pair)] for pair in zip(found[side], first)]
            gains.append([statistics.mean(at) for at in zip(*gain)])
            if side == sides[0]:
                cells.append(", ".join(f"{statistics.mean(at):.2f}" for at in zip(*first)))
                continue
            text = ", ".join(f"{x:+.2f}" for x in gains[-1])
            ends = [of_seed[-1] for of_seed in gain]
            cells.append(f"{text} ({min(ends):+.2f} to {max(ends):+.2f})" if len(ends) > 1 else text)
        mean = ", ".join(f"{statistics.mean(at):+.2f}" for at in zip(*gains))
        lines.append(f"| {' | '.join([side, *cells, '' if side == sides[0] else mean])} |")
    return "\n".join(lines)


def main() -> int:
    """Measures, prints and stores."""
    print(table(measure(tyro.cli(Options, description=__doc__))))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except EXPECTED as error:
        sys.exit(f"defaults: error: {error}")
