"""Runs cases one by one, and records their findings in a journal.

After a CUDA error in a kernel, a hanging kernel or a crash, a process can run no further case. It then ends, and its
caller restarts it with the case that :func:`unfinished` returns.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BROKEN = 101
"""Exit status of a process that must be restarted; any other status is the number of failed cases."""


class Journal:
    """The findings so far, written to a file after every case and read again by a restarted process."""

    def __init__(self, path: Path, *, begun: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if begun and path.exists() else {}

    def add(self, kind: str, row: dict[str, Any]) -> None:
        """Appends a row to the rows of a kind."""
        self.put(kind, [*self.found.get(kind, []), row])

    def put(self, kind: str, value: Any) -> None:
        """Sets an entry; the file is replaced atomically, so that a kill cannot damage it."""
        self.found[kind] = value
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps(self.found, indent=1) + "\n")
        new.replace(self.path)


@dataclass(frozen=True)
class Case:
    """A case to run.

    Attributes:
        part: The name of its part.
        name: The name of the case.
        run: A function that raises on errors. It returns a dict for the journal, whose entry ``said`` is printed, or
            only the printed text.
        seconds: Seconds after which the case counts as hanging.
    """

    part: str
    name: str
    run: Callable[[], dict[str, Any] | str | None]
    seconds: float = 10.0


def settling(device: str) -> Callable[[], None]:
    """Returns a function that waits for a device, and raises if the device or torch's generator is unusable."""
    import torch

    def settle() -> None:
        torch.cuda.synchronize()
        torch.rand(1, device=device)  # a failed capture leaves only the generator unusable

    return settle if device == "cuda" else lambda: None


def one_by_one(
    cases: list[Case], budgets: dict[str, float], settle: Callable[[], None], journal: Journal, start: int = 0
) -> int:
    """Runs every case separately; a case that hangs or leaves the device unusable ends the process.

    Args:
        cases: The cases, in their order.
        budgets: Seconds of each part, in the order of the parts. Later parts inherit unused time; when the time of a
            part is over, its remaining cases are skipped.
        settle: A function that waits for the device, and raises if the device is unusable.
        journal: The journal, which gets a row of ``cases`` for each case.
        start: The index of the first case.

    Returns:
        The number of cases that failed, or ``BROKEN``.
    """
    if "ends" not in journal.found:
        end, ends = time.time(), {}
        for part, seconds in budgets.items():
            ends[part] = end = end + seconds
        journal.put("ends", ends)

    def keep(number: int, right: bool, values: dict[str, Any]) -> None:
        """Prints a line and records a row."""
        case, said = cases[number], values.get("said", "")
        print(f"{'right' if right else 'WRONG'}  {case.part}: {case.name}{f': {said}' * bool(said)}", flush=True)
        row = {"number": number, "part": case.part, "name": case.name, "right": right, "said": said}
        journal.add("cases", {**values, **row, "took": time.perf_counter() - begin})

    def hangs(number: int) -> None:
        keep(number, False, {"said": f"hangs, stopped after {cases[number].seconds:g} s"})
        os._exit(BROKEN)

    for number in range(start, len(cases)):
        case, begin = cases[number], time.perf_counter()
        if time.time() > journal.found["ends"][case.part]:
            journal.add("left out", {"part": case.part, "name": case.name})
            continue
        journal.put("at", {"number": number, "part": case.part, "name": case.name})
        watch = threading.Timer(case.seconds, hangs, (number,))
        watch.daemon = True
        watch.start()
        try:
            values = case.run()
            settle()
            keep(number, True, {"said": values} if isinstance(values, str) else values or {})
        except Exception as error:
            keep(number, False, {"said": f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"})
            traceback.print_exc(file=sys.stdout)
            sys.stdout.flush()
            try:
                settle()
            except Exception:
                watch.cancel()
                return BROKEN
        finally:
            watch.cancel()
    journal.put("done", True)
    failed = sum(not row["right"] for row in journal.found.get("cases", ()))
    left_out = len(journal.found.get("left out", ()))
    print(f"{len(cases) - failed - left_out} of {len(cases)} cases are right, {left_out} left out for want of time")
    return min(failed, BROKEN - 1)


def unfinished(path: Path, status: int | str) -> int | None:
    """Returns the index of the case with which an interrupted program continues; None if it ran all cases.

    A case that ended the process, for example by a crash, is recorded as wrong.
    """
    journal = Journal(path, begun=True)
    at = journal.found.get("at")
    if at is None or journal.found.get("done"):
        return None
    if all(row["number"] != at["number"] for row in journal.found.get("cases", ())):
        journal.add("cases", {**at, "right": False, "said": f"ended its process, status {status}"})
    return int(at["number"]) + 1
