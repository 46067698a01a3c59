"""Runs modules of other codebases in VoronoiRouter; reports how each runs and its errors against a loop over masks.

Modules of public repositories (``ops/foreign_public.py``) are imported from checkouts in one folder, each named
``owner+name``. Without that folder, small modules in the style of public code (``ops/foreign_kinds.py``) are run.

    python benchmarks/foreign_modules.py [--checkouts FOLDER] [--filter kilonerf] [--speed] [--json FILE]
"""

from __future__ import annotations

import json
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness import Parser, write_results
from ops.foreign_imports import repository
from ops.foreign_kinds import KINDS
from ops.foreign_public import PUBLIC
from ops.foreign_rows import ROUNDED, SEED, SIZES, K, N, Row, compare, speed

COMPARED = """with a loop over masks of distinct modules: values by the largest entry, gradients of parameters and float
    arguments and those of (|d y/d x| - 1)^2 by the norm of each tensor, or 1e-6 of the largest norm"""
STAND_INS = (
    "CUDA encoders, tiny-cuda-nn and what is not installed are small PyTorch stand-ins; width 64 in most modules"
)


def run(row: Row, timed: bool, *imported: Any) -> dict[str, Any]:
    """Returns the result of a module."""
    result = compare(row, *imported)
    return result | ({"speed": speed(row, *imported)} if timed and way(result) != "refused" else {})


def way(result: dict[str, Any]) -> str:
    """Returns how a module runs, in short."""
    short: str = (result.get("otherwise") or result["how"]).partition(":")[0]
    return short


def public(checkouts: Path, pattern: str, timed: bool = False) -> Iterator[dict[str, Any]]:
    """Yields the result of each module of the repositories."""
    for key, rows in PUBLIC.items():
        path, _, file = key.partition(":")
        owner, name, *inner = path.split("/")
        chosen = [row for row in rows if re.search(pattern, f"{key} {row.module}")]
        folder = checkouts / f"{owner}+{name}"
        if not chosen:
            continue
        head = subprocess.run(["git", "-C", folder, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        origin = {"module": "", "repository": f"https://github.com/{owner}/{name}", "commit": head.stdout[:12]}
        for row in chosen:
            with repository(folder.joinpath(*inner)) as load:
                result = run(row, timed, load(file))
            yield origin | result


def small(pattern: str, timed: bool = False) -> Iterator[dict[str, Any]]:
    """Yields the result of each small module."""
    for kind, rows in KINDS.items():
        for row in rows:
            if re.search(pattern, f"{kind} {row.module}"):
                yield {"kind": kind, **run(row, timed)}


def counts(results: list[dict[str, Any]]) -> dict[str, int]:
    """Counts modules by how they run, and those with wrong values or errors at some batch size."""
    ways = Counter(map(way, results))
    repositories = {row.get("repository") for row in results}
    classes = {(row.get("repository"), row["class"]) for row in results}
    kinds = {"modules": len(results), "repositories": len(repositories), "classes": len(classes)}
    named = {name: ways[name] for name in ("fused", "fused in runs", "grouped", "cell by cell", "refused")}
    return {**kinds, **named, "wrong": sum(map(wrong, results)), "errors": sum("error_sizes" in row for row in results)}


def wrong(row: dict[str, Any]) -> bool:
    """Returns whether values or gradients of a module are wrong, at its own batch size or at another one."""
    errors = {name: row.get(f"{name}_float64", row[name]) for name in row if name.endswith("error")}
    return "wrong_sizes" in row or not all(error <= ROUNDED for error in errors.values())


def main(arguments: list[str] | None = None) -> None:
    parser = Parser(prog="foreign_modules", description=__doc__)
    parser.add_argument("--checkouts", type=Path, help="a folder with the repositories, each as owner+name")
    parser.add_argument("--filter", default="", help="a regular expression of repositories, files and modules")
    parser.add_argument("--speed", action="store_true", help="also time each way beside the loop over masks")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    results = []
    chosen = options.filter, options.speed
    for row in public(options.checkouts, *chosen) if options.checkouts else small(*chosen):
        results.append(row)
        print(json.dumps(row), flush=True)
    print(counts(results))
    write_results(
        options.json,
        results,
        benchmark="modules of public repositories in VoronoiRouter(fuse=True)",
        samples=N,
        sizes=[SIZES.start, SIZES.stop - 1],
        cells=K,
        seed=SEED,
        compared=" ".join(COMPARED.split()),
        **{"stand-ins": STAND_INS},
        **counts(results),
    )


if __name__ == "__main__":
    main()
