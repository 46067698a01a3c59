"""Every table and figure of "Adaptive Voronoi NeRFs" (Elsner et al. 2023) by name, at a size that fits the machine.

    python benchmarks/paper.py table sampling --scene lego --downscale 4 --budget 480 --seeds 2
    python benchmarks/paper.py figure split-kinds --scene builtin --budget 60
    python benchmarks/paper.py all --budget 20 --downscale 8        # all of them, and docs/paper.md: `make paper`
    python benchmarks/paper.py report                               # docs/paper.md again, from what is in --out

All variants of an experiment train for the same time. Each experiment writes NAME.json ({metadata, results, claims}),
NAME.md and pictures into --out. A training that was made before with the same settings is not made again, and
an interrupted one is continued. Trainings that are started together take turns of a few seconds in one process.

A long table is made in parts, over several sittings, with a file that can be committed:

    python benchmarks/paper.py table sampling --record RECORD.json --variants '^NeRF, strat' --only-seeds 0
    python benchmarks/paper.py table sampling --record RECORD.json               # what is missing still
    python benchmarks/paper.py table sampling --record RECORD.json --no-train    # the table as far as it goes
    python benchmarks/paper.py export RECORD.json --out runs/paper               # all trainings of a folder

Tables and pages show the results so far and name what is missing. Gains compare trainings of one machine only.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import tyro
from harness import metadata

from paper import balance as paper_balance
from paper import nested as paper_nested
from paper.claims import Rows
from paper.experiments import EXPERIMENTS
from paper.records import keep, machine_name
from paper.report import ORDER, claims_text, write_experiment, write_report
from paper.runs import Run, default_scenes, failures, results, still_missing, train_missing
from paper.settings import Settings
from voronerf.files import write_text

Table = Literal["sampling", "architecture", "kilonerf"]
Figure = Literal[
    "convergence",
    "initialisation",
    "split-kinds",
    "early-late",
    "cell-count",
    "ghosting",
    "density",
    "balance",
    "title",
    "nested-2d",
    "seams",
    "limits",
]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper.md"


def say(line: str) -> None:
    """Progress, with the time."""
    print(f"{time.strftime('%H:%M:%S')}  {line}", flush=True)


def trainings(name: str, settings: Settings) -> list[Run]:
    """The trainings that an experiment needs."""
    if name == "balance":
        return paper_balance.runs(settings)
    return EXPERIMENTS[name].runs(settings) if name in EXPERIMENTS else []


def experiment(name: str, settings: Settings) -> dict[str, Any]:
    """Runs the missing trainings of an experiment and writes its files; returns {metadata, results, claims}."""
    if name == "nested-2d":
        paper_nested.refuse_trainings(settings)
    runs = trainings(name, settings)
    if runs:
        train_missing(runs, settings, say)
    return finish(name, runs, settings)


def finish(name: str, runs: Sequence[Run], settings: Settings) -> dict[str, Any]:
    """Makes an experiment's JSON, table and pictures from its trainings."""
    if name == "nested-2d":
        outcome = fitted(settings)
    elif name == "balance":
        outcome = paper_balance.measure(settings, say)
    else:
        rows = results(runs)
        asked = list(dict.fromkeys(Path(run.scene).name for run in runs))
        claims = EXPERIMENTS[name].claims(Rows(rows, asked), settings)
        description = metadata(
            benchmark="paper",
            experiment=name,
            kind=EXPERIMENTS[name].kind,
            scenes=asked,
            size=rows[0]["size"] if rows else None,
            budget_seconds=settings.budget,
            seeds=len({row["seed"] for row in rows}) or settings.seeds,
            rays=settings.rays,
            samples=settings.samples,
            rates=list(settings.rates),
            turn=settings.turn,
            eval_views=settings.eval_views,
            final_views=settings.final_views,
            backend=settings.backend,
            options=list(settings.options),
            failed=failures(runs),
            missing=still_missing(runs),
            machines=list(dict.fromkeys(machine_name(row["made_on"]) for row in rows if "made_on" in row)),
        )
        outcome = {"metadata": description, "results": rows, "claims": [claim.to_dict() for claim in claims]}
        write_text(settings.out / f"{name}.json", json.dumps(outcome, indent=1) + "\n")
    write_experiment(name, outcome, settings.out)
    return outcome


def fitted(settings: Settings) -> dict[str, Any]:
    """The nested fit of a picture: the one in the output folder if it was made with these settings, or a new one."""
    path = settings.out / "nested-2d.json"
    if path.is_file() and not settings.again:
        outcome: dict[str, Any] = json.loads(path.read_text())
        if paper_nested.described(settings).items() <= outcome["metadata"].items():
            return outcome
    return paper_nested.nested(settings, say) if settings.train else paper_nested.outcome_of([], settings)


def table(name: tyro.conf.Positional[Table], settings: Settings) -> None:
    """Repeat one of the paper's tables."""
    show(name, experiment(name, settings), settings)


def figure(name: tyro.conf.Positional[Figure], settings: Settings) -> None:
    """Repeat one of the paper's figures."""
    show(name, experiment(name, settings), settings)


def show(name: str, outcome: dict[str, Any], settings: Settings) -> None:
    """Prints the results."""
    print((settings.out / f"{name}.md").read_text())
    print(f"wrote {settings.out}: {name}.json, {name}.md, {name}*.png")


def everything(settings: Settings, page: Path = PAGE, only: tuple[str, ...] = ORDER) -> None:
    """Repeat all tables and figures, and write the page about them.

    Args:
        settings: For all of them. The experiment on limits has its own two scenes; without --scene the table by
            sampling has one, since that by architecture has more. The nested fit of a picture is no training of a
            scene: --options, --rates, --variants, --only-seeds and --record are for the others.
        page: The page.
        only: Experiments to run, in this order; the page shows whatever is in --out.
    """
    unknown = [name for name in only if name not in ORDER]
    if unknown:
        raise ValueError(f"--only must name experiments, of {', '.join(ORDER)}, got {', '.join(unknown)}")
    started = time.perf_counter()
    own = dict.fromkeys(only, settings) | {"limits": replace(settings, scene=())}
    own["sampling"] = replace(settings, scene=settings.scene or default_scenes())
    runs = {name: trainings(name, own[name]) for name in only}
    # Together, so that all trainings of a scene and a seed take turns with each other.
    train_missing([run for group in runs.values() for run in group], settings, say)
    for name in only:
        # Its trainings are there now, even where --again was asked for.
        outcome = finish(name, runs[name], own[name])
        say(f"{name}: done\n{claims_text(outcome.get('claims', []))}")
    write_report(settings.out, page)
    say(f"wrote {page} after {(time.perf_counter() - started) / 60:.1f} minutes")


def report(out: Path = Settings.out, page: Path = PAGE) -> None:
    """Write the page again from what is in the output folder.

    Args:
        out: The output folder of the experiments.
        page: The page.
    """
    write_report(out, page)
    say(f"wrote {page}")


def export(record: tyro.conf.Positional[Path], out: Path = Settings.out) -> None:
    """Add the results of all trainings in the output folder to a file that can be committed.

    Args:
        record: The file; results that it holds already stay, those of the same training are replaced.
        out: The output folder of the experiments.
    """
    folders = sorted(path.parent for path in (out / "runs").glob("*/result.json"))
    if not folders:
        raise ValueError(f"--out must hold finished trainings in runs/, got {out}")
    new, count = keep(folders, record)
    say(f"wrote {record}: {count} trainings, {new} of them new")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs one command."""
    commands: dict[str, Callable[..., Any]] = {"table": table, "figure": figure, "all": everything, "report": report}
    commands["export"] = export
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="paper.py",
        description=(__doc__ or "").split("\n\n")[0],
        args=None if arguments is None else list(arguments),
        config=(tyro.conf.OmitArgPrefixes,),
    )
