"""``voronerf demo``: the whole method on the built-in scene beside one network, at equal training time."""

from __future__ import annotations

from pathlib import Path

from voronerf.cli.commands import console, run_training
from voronerf.cli.compare import compare
from voronerf.data import BUILTIN_SIZE, load_scene
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.run_directory import held


def demo(
    out: Path = Path("runs/demo"),
    budget: float = 75.0,
    cells: int = 16,
    size: int = 100,
    seed: int = 0,
    backend: str = "auto",
) -> int:
    """Train the built-in scene twice for the same time, one coarse network and Voronoi cells, and compare.

    Args:
        out: Folder for the two runs; `single` and `voronoi` inside it are replaced.
        budget: Training seconds of each run.
        cells: Voronoi cells.
        size: Pixels along the side of the images, 100 over a whole number.
        seed: Seed of both runs.
        backend: Backend of the operations.
    """
    downscale = BUILTIN_SIZE // size if 1 <= size <= BUILTIN_SIZE else 0
    if not downscale or BUILTIN_SIZE // downscale != size:
        raise ConfigError(f"--size must be {BUILTIN_SIZE} over a whole number, 50, 33, 25, 20, 16, ..., got {size}")
    configs = {
        name: TrainConfig(
            downscale=downscale,
            out=out / name,
            budget=budget,
            cells=levels,
            seed=seed,
            backend=backend,
            evaluations=6,
            eval_views=5,
        )
        for name, levels in (("single", ()), ("voronoi", (cells,)))
    }
    scene = load_scene("builtin", downscale=downscale)
    for name, config in configs.items():
        with held(out / name):
            _remove_run(out / name)
        networks = f"{cells} Voronoi cells" if config.cells else "one coarse network"
        console.print(f"\n[bold]{name}[/bold]: {networks}, {budget:.0f} s", highlight=False)
        if not run_training(config, scene)["complete"]:
            return 130
    console.print()
    return compare(tuple(out / name for name in configs), out=out / "compare.html")


def _remove_run(run: Path) -> None:
    """Removes the files of an earlier demo, and no file that a run does not write."""
    for pattern in ("config.json", "metrics.jsonl", "summary.json", "eval.json"):
        (run / pattern).unlink(missing_ok=True)
    for folder in ("checkpoints", "images", "plots", "samples"):
        for file in (run / folder).glob("*"):
            file.unlink()
