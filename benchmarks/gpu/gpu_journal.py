"""Cases that are tried one by one, and the journal of what they have found.

A CUDA error of a kernel ends all that its process could still do, and so does a kernel that does not end: the program
then starts itself anew with the case after it.
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


class Journal:
    """What has been found so far, kept in a file after every case; a process that goes on finds it there."""

    def __init__(self, path: Path, *, begun: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if begun and path.exists() else {}

    def add(self, kind: str, row: dict[str, Any]) -> None:
        """One more row of a kind."""
        self.put(kind, [*self.found.get(kind, []), row])

    def put(self, kind: str, value: Any) -> None:
        """A value by itself."""
        self.found[kind] = value
        self.path.write_text(json.dumps(self.found, indent=1) + "\n")


@dataclass(frozen=True)
class Case:
    """One thing to try.

    Attributes:
        part: which of the parts it belongs to.
        name: of the case.
        run: raises, or returns what is kept of it: values by name, of which ``said`` is printed, or that alone.
        seconds: after which it is said to hang.
    """

    part: str
    name: str
    run: Callable[[], dict[str, Any] | str | None]
    seconds: float = 10.0


@dataclass(frozen=True)
class Again:
    """How a program starts itself anew: its arguments, its first case and the cases failed before."""

    arguments: tuple[str, ...]
    start: int = 0
    failed: int = 0

    def go_on(self, number: int, failed: int) -> None:
        """The cases from ``number`` on, in a process that takes the place of this one."""
        options = ["--start", str(number), "--failed", str(failed)]
        os.execv(sys.executable, [sys.executable, sys.argv[0], *self.arguments, *options])


def settling(device: str) -> Callable[[], None]:
    """What waits for all that a device has been given."""
    import torch

    return torch.cuda.synchronize if device == "cuda" else lambda: None


def one_by_one(
    cases: list[Case], budgets: dict[str, float], again: Again, settle: Callable[[], None], journal: Journal
) -> int:
    """Every case for itself; after one that leaves the device unusable, or does not end, the rest in a new process.

    Args:
        cases: in their order.
        budgets: seconds of each part, in the order of the parts. What one leaves is the next ones'; of a part whose
            time is over the other cases are left out.
        again: where to begin.
        settle: waits for the device, and raises where that is of no use any more.
        journal: gets a row of ``cases`` for each.

    Returns:
        The number of cases that failed.
    """
    settle()  # makes the context, in the time of no case
    failed = again.failed
    if "ends" not in journal.found:
        end, ends = time.time(), {}
        for part, seconds in budgets.items():
            ends[part] = end = end + seconds
        journal.put("ends", ends)

    def keep(case: Case, right: bool, found: dict[str, Any]) -> None:
        """One line and one row."""
        said = found.setdefault("said", "")
        print(f"{'right' if right else 'WRONG'}  {case.part}: {case.name}{f': {said}' * bool(said)}", flush=True)
        row = {"part": case.part, "name": case.name, "right": right, **found}
        journal.add("cases", {**row, "took": time.perf_counter() - begin})

    def hangs(case: Case, number: int) -> None:
        keep(case, False, {"said": f"hangs, stopped after {case.seconds:g} s"})
        again.go_on(number + 1, failed + 1)

    for number in range(again.start, len(cases)):
        case, begin = cases[number], time.perf_counter()
        if time.time() > journal.found["ends"][case.part]:
            journal.add("left out", {"part": case.part, "name": case.name})
            continue
        watch = threading.Timer(case.seconds, hangs, (case, number))
        watch.daemon = True
        watch.start()
        try:
            found = case.run()
            settle()
            keep(case, True, {"said": found} if isinstance(found, str) else found or {})
        except Exception as error:
            failed += 1
            keep(case, False, {"said": f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"})
            traceback.print_exc(file=sys.stdout)
            sys.stdout.flush()
            try:
                settle()
            except Exception:
                watch.cancel()
                again.go_on(number + 1, failed)
        finally:
            watch.cancel()
    left_out = len(journal.found.get("left out", ()))
    print(f"{len(cases) - failed - left_out} of {len(cases)} cases are right, {left_out} left out for want of time")
    return failed
