"""Attacks the library with random calls, killed processes, damaged and hostile files: ``python tests/attack --help``.

Each attempt has its own seed. The last line of a failure is the command that repeats it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import input_files
import interrupts
import mutate
import op_attacks
import process_attacks
import router_sequences
import run_attacks
import step_sequences
import store_attacks
import torch
import training_attacks
import viewer_attacks
from attempts import FAILED, MEMORY, REFUSED, RIGHT, Part, Tally, prepare, run_part

#: The parts by name, with the numbers of attempts in a long and in a short run.
PARTS = {
    part.name: (part, long, short)
    for part, long, short in (
        (Part("valid-calls", op_attacks.valid_call, 60, 200, peak=3 * MEMORY), 140_000, 150),
        (Part("invalid-calls", op_attacks.invalid_call, 20, 200, MEMORY // 2), 60_000, 150),
        (Part("steps", step_sequences.changed_steps, 120, 20, peak=2 * MEMORY), 500, 5),
        (Part("interrupts", interrupts.interrupted_step, 60, 20, peak=2 * MEMORY), 1000, 12),
        (Part("routers", router_sequences.random_sequence, 60, 10), 500, 6),
        (Part("kills", training_attacks.killed_training, 300, 1, prepare=input_files.prepare_scenes), 20, 1),
        (Part("bits", run_attacks.flipped_bit, 60, 20, prepare=input_files.prepare_runs), 500, 15),
        (Part("scenes", process_attacks.stranger_files, 60, 1, prepare=input_files.prepare_photographs), 300, 6),
        (Part("runs", run_attacks.stranger_run, 60, 1, prepare=input_files.prepare_runs), 150, 4),
        (Part("stores", store_attacks.harmed_store, 60, 1, prepare=input_files.prepare_scenes), 150, 4),
        (Part("clients", viewer_attacks.hostile_client, 60, 1, prepare=input_files.prepare_runs), 150, 2),
        (Part("stress", training_attacks.stressed_command, 60, 1, prepare=input_files.prepare_scenes), 150, 4),
    )
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python tests/attack", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; default all")
    parser.add_argument("--short", action="store_true", help="the few attempts that the test suite makes")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first attempt of each part (default: 0)")
    parser.add_argument("--count", type=int, help="attempts of each part; a chain of kills is one")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (default: one a core)")
    parser.add_argument(
        "--mutate", nargs="*", metavar="WORD", help="plant faults, all or those named by words, instead"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="with --mutate: a JSON file for the outcome of each fault"
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="minutes after which no attempt begins")
    options = parser.parse_args()
    if options.mutate is not None:
        return mutate.plant(options.mutate, options.json)
    unknown = [name for name in options.parts if name not in PARTS]
    if unknown:
        parser.error(f"PART must be one of {', '.join(PARTS)}, got {unknown[0]}")

    torch.set_num_threads(1)
    os.environ["RUST_BACKTRACE"] = "0"  # safetensors would hang when memory is exhausted
    until = time.monotonic() + 60 * options.minutes
    tallies: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory(prefix="attack-") as scratch:
        for name in options.parts or PARTS:
            part, long, short = PARTS[name]
            count = options.count or (short if options.short else long)
            folder = Path(scratch) / getattr(part.prepare, "__name__", "nothing")  # parts may share the folder
            if not folder.exists():
                prepare(part, folder)
            seeds = range(options.seed, options.seed + count)
            tallies[name] = run_part(part, seeds, folder, jobs=options.jobs, until=until)
            for seed, failure in tallies[name].failures:
                again = f"{sys.executable} tests/attack {name} --seed {seed} --count 1"
                print(f"{name}: {failure}\n    {again}", flush=True)

    print(f"{'part':14} {'tried':>8} {'refused clearly':>16} {'accepted and right':>19} {'failed':>8} {'seconds':>8}")
    for name, tally in tallies.items():
        counts = tally.counts
        print(
            f"{name:14} {tally.tried:8} {counts[REFUSED]:16} {counts[RIGHT]:19} {counts[FAILED]:8} {tally.seconds:8.0f}"
        )
    return int(any(tally.counts[FAILED] for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
