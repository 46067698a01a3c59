"""Prints a result of throughput.py as Markdown, to regenerate tables of the documents from the committed JSON.

python benchmarks/table.py benchmarks/results/throughput.json                    the rows that docs/performance.md shows
python benchmarks/table.py benchmarks/results/throughput.json --rows '^routed_mlp/'   other rows
python benchmarks/table.py benchmarks/results/foreign_fields.json --foreign      speed-ups over the loop over masks
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, NoReturn

from harness import Parser

Row = dict[str, Any]

SHOWN = (
    r"^nearest_centre/n=262144 k=(16|512)/float32",
    r"^locate_cell/16x16 n=262144/",
    r"^cell_sort/n=262144 k=256/",
    r"^grouped_linear/64-64 .*/float32/",
    r"^grouped_mlp/w64d4 n=262144 k=16/float32/",
    r"^grouped_mlp/nerf64 n=262144 k=16/",
    r"^grouped_mlp/mlp32 n=262144 k=256/float32",
    r"^frequency_encode/L=10 n=262144/float32/",
    r"^composite/dense n=262144/",
    r"^routed_mlp/(w64d4|mlp32) n=262144 k=(16|256)/",
)
"""Patterns of op/case/dtype/direction for the rows in docs/performance.md."""


def fail(message: str) -> NoReturn:
    sys.exit(f"table: error: {message}")


def load(path: Path) -> dict[str, Any]:
    """Reads {metadata, results} from a file."""
    try:
        outcome = json.loads(path.read_text())
        if outcome["metadata"]["benchmark"] != "throughput":
            fail(f"{path} must be a result of throughput.py, got {outcome['metadata']['benchmark']}")
        return dict(outcome)
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"{path} must be a result of throughput.py: {error!r}")


def key(row: Row) -> str:
    return "/".join(str(row[column]) for column in ("op", "case", "dtype", "direction"))


def native_rows(outcome: dict[str, Any]) -> list[Row]:
    """Returns the rows of the native backend."""
    return [row for row in outcome["results"] if row["backend"] == "native"]


def best(row: Row) -> tuple[str, float] | None:
    """Returns the name and milliseconds of the fastest alternative, or None."""
    times = [(value, name) for name, value in row["alternatives"].items() if value is not None]
    return (min(times)[1], min(times)[0]) if times else None


def milliseconds(value: float) -> str:
    places = next((places for places, most in ((3, 1), (2, 10), (1, 100)) if value < most), 0)
    return f"{value:.{places}f}"


def markdown(rows: list[Row]) -> list[str]:
    """Returns the lines of a Markdown table of native rows."""
    lines = ["| | dtype | | ms | of the limit | best alternative | ms | x |", "|---|---|---|---|---|---|---|---|"]
    for row in rows:
        other = best(row)
        percent = row["percent_of_peak"]
        cells = [
            f"`{row['op']}` {row['case']}",
            row["dtype"],
            row["direction"].replace("+", " + "),
            milliseconds(row["median_ms"]),
            "-" if percent is None else f"{percent:.0f} % {row['bound'].split(',')[0]}",
            "-" if other is None else other[0],
            "-" if other is None else milliseconds(other[1]),
            "-" if row["speedup_over_best"] is None else f"**{row['speedup_over_best']:.1f}**",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def foreign_markdown(rows: list[Row]) -> list[str]:
    """Returns the lines of the table of foreign fields: the speed-up of each way over the loop over masks."""
    order = ("grouped", "masks behind one encoding", "one module")
    ways = [way for way in order if any(row["alternatives"].get(way) is not None for row in rows)]
    head = ("", "n", "k", "", "masks, ms", "fused", *ways)
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in rows:
        times = row["alternatives"]
        masks = times["masks"]
        name, direction = row["case"].split(" n=")[0], row["direction"].replace("+", " + ")
        cells = [name, f"{row['n']:,}", str(row["k"]), direction, milliseconds(masks)]
        cells += [f"**{masks / row['median_ms']:.2f}**"]
        cells += ["-" if times.get(way) is None else f"{masks / times[way]:.2f}" for way in ways]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Prints the requested table."""
    parser = Parser("table", description=(__doc__ or "").split("\n\n")[0], allow_abbrev=False)
    parser.add_argument("file", type=Path)
    parser.add_argument(
        "--rows", action="append", metavar="REGEX", help="rows whose op/case/dtype/direction it occurs in"
    )
    parser.add_argument("--foreign", action="store_true", help="the table of fields of other codebases")
    options = parser.parse_args(arguments)
    try:
        patterns = [re.compile(text) for text in options.rows or SHOWN]
    except re.error as error:
        fail(f"--rows must be a regular expression, got {options.rows!r}: {error}")
    outcome = load(options.file)
    native = native_rows(outcome)
    if options.foreign:
        print("\n".join(foreign_markdown([row for row in native if row["op"] == "foreign"])))
        return
    rows = [row for row in native if any(pattern.search(key(row)) for pattern in patterns)]
    if not rows:
        fail(f"{options.file} has no such row of the native backend")
    described = outcome["metadata"]
    limits = ", ".join(f"{name} {value:g}" for name, value in described["peaks"].items())
    print(
        f"{described['machine']}, {described['threads']} threads, torch {described['torch']}; limits (G/s): {limits}\n"
    )
    print("\n".join(markdown(rows)))


if __name__ == "__main__":
    main()
