"""Results of trainings in one file that can be committed: a long table is made over several sittings and machines.

    {"metadata": {...}, "results": {"SCENE-SEED-HASH": what a training's result.json holds}}

No checkpoints, samples or pictures: of a training's looks the numbers only. A training in the file counts as made
wherever the file is named (``--record``), so a later session on another machine continues where the last one ended.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from harness import processor

from paper import looks as paper_looks
from voronerf import __version__, backends
from voronerf.files import write_text
from voronerf.training.config import ConfigError, TrainConfig

Row = dict[str, Any]
BENCHMARK = "paper trainings"
#: Of a configuration, what says nothing about the training or names a place of the machine.
NOT_TOLD = {"data", "out", "resume", "lpips", "checkpoint_every", "keep_checkpoints", "panels"}


def made_on() -> dict[str, Any]:
    """The machine and the versions of this process, for a training made by it."""
    native = backends.describe()["native"]
    return {
        "machine": processor(),
        "processor": _processor_numbers(),
        "threads": torch.get_num_threads(),
        "instruction set": native.get("instruction set"),
        "torch": torch.__version__,
        "voronerf": __version__,
    }


def _processor_numbers() -> str | None:
    """Family and model of the processor, which many names leave open; None where they are unknown."""
    path = Path("/proc/cpuinfo")
    text = path.read_text() if path.is_file() else ""
    found = [re.search(rf"^{name}\s*: (\d+)$", text, re.MULTILINE) for name in ("cpu family", "model")]
    family, model = (match and match[1] for match in found)
    return f"family {family}, model {model}" if family and model else None


def comparable(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two trainings were made on equal machines; results without a machine count as equal."""
    one, other = (row.get("made_on") for row in (first, second))
    same = ("machine", "processor", "threads", "instruction set")
    return one is None or other is None or all(one.get(name) == other.get(name) for name in same)


def machine_name(made: Mapping[str, Any]) -> str:
    """A machine, in words."""
    numbers = f" ({made['processor']})" if made.get("processor") else ""
    return f"{made['threads']} threads; {made['machine']}{numbers}"


def changed_settings(config: Mapping[str, Any]) -> Row:
    """The settings of a configuration, as in its JSON, that differ from their defaults."""
    usual = json.loads(
        TrainConfig(
            field="nerf",
            occupancy=False,
            contraction="none",
            average=0.0,
            centres="balanced",
            rays=1024,
            downscale=1,
        ).to_json()
    )  # as in every training of the paper
    return {name: value for name, value in config.items() if name not in NOT_TOLD and value != usual.get(name)}


def read_result(folder: Path) -> Row:
    """What result.json of a run directory holds, with the numbers of its looks and its settings."""
    row: Row = json.loads((folder / "result.json").read_text())
    row.setdefault("looks", paper_looks.numbers(folder))
    config = folder / "config.json"
    if "config" not in row and config.is_file():
        row["config"] = changed_settings(json.loads(config.read_text()))
    return row


def read_record(record: Path) -> dict[str, Row]:
    """The results of a file by the names of their run directories; {} where there is none yet.

    Raises:
        ConfigError: When it is another file.
    """
    if not record.is_file():
        return {}
    try:
        found = json.loads(record.read_text())
        if found["metadata"]["benchmark"] != BENCHMARK:
            raise KeyError("benchmark")
        results: dict[str, Row] = found["results"]
        for row in results.values():
            row["psnr"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
        raise ConfigError(f"--record must be a file of results written by paper.py, got {record}") from None
    return results


def write_record(record: Path, results: Mapping[str, Row]) -> None:
    """Writes a file of results."""
    description = {
        "benchmark": BENCHMARK,
        "about": "result.json of trainings of benchmarks/paper.py, by the names of their run directories",
        "machines": sorted({machine_name(row["made_on"]) for row in results.values() if "made_on" in row}),
    }
    # a line a training: a file that is committed shows in its differences which are new
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(row)}" for name, row in sorted(results.items()))
    text = f'{{\n "metadata": {json.dumps(description)},\n "results": {{\n{lines}\n }}\n}}\n'
    write_text(record, text)


def keep(folders: Iterable[Path], record: Path) -> tuple[int, int]:
    """Adds the results in run directories to a file, instead of older ones; returns how many were new, and all.

    Results that do not say where they were made are taken to be of this machine, with as many threads.
    """
    results = read_record(record)
    before = dict(results)
    for folder in folders:
        if (folder / "result.json").is_file():
            results[folder.name] = {"made_on": made_on(), **read_result(folder)}
    if results != before or not record.is_file():
        write_record(record, results)
    return len(results.keys() - before.keys()), len(results)


def restore(folders: Iterable[Path], record: Path) -> int:
    """Writes result.json of the trainings that are in a file and not in the run directories; returns how many."""
    results, count = read_record(record), 0
    for folder in folders:
        if folder.name in results and not (folder / "result.json").is_file():
            write_text(folder / "result.json", json.dumps(results[folder.name], indent=1) + "\n")
            count += 1
    return count


def forget(folders: Iterable[Path], record: Path) -> None:
    """Removes the results of trainings from a file: they will be made again."""
    results = read_record(record)
    names = {folder.name for folder in folders}
    if results.keys() & names:
        write_record(record, {name: row for name, row in results.items() if name not in names})
