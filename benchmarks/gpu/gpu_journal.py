"""Cases that are tried one by one, and the journal of what they have found.

A CUDA error of a kernel ends all that its process could still do, and so do a kernel that does not end and a crash. The
program then ends, and its caller starts it again with the case that :func:`unfinished` tells.
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
"""Exit status of a process that has to be started again; others count the cases that failed."""


class Journal:
    """The findings so far, kept in a file after every case; a process that goes on finds them there."""

    def __init__(self, path: Path, *, begun: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.found: dict[str, Any] = json.loads(path.read_text()) if begun and path.exists() else {}

    def add(self, kind: str, row: dict[str, Any]) -> None:
        """Append a row to those of a kind."""
        self.put(kind, [*self.found.get(kind, []), row])

    def put(self, kind: str, value: Any) -> None:
        """Set an entry; the file is whole whenever the process is killed."""
        self.found[kind] = value
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps(self.found, indent=1) + "\n")
        new.replace(self.path)


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


def settling(device: str) -> Callable[[], None]:
    """A function that waits for a device, and raises where the device or torch's generator is of no use any more."""
    import torch

    def settle() -> None:
        torch.cuda.synchronize()
        torch.rand(1, device=device)  # a capture that went wrong leaves the generator unusable, and nothing else

    return settle if device == "cuda" else lambda: None


def one_by_one(
    cases: list[Case], budgets: dict[str, float], settle: Callable[[], None], journal: Journal, start: int = 0
) -> int:
    """Try every case for itself; a case that leaves the device unusable, or does not end, ends the process.

    Args:
        cases: in their order.
        budgets: seconds of each part, in the order of the parts. What one leaves is the next ones'; of a part whose
            time is over the other cases are left out.
        settle: waits for the device, and raises where it is of no use any more.
        journal: gets a row of ``cases`` for each.
        start: the case to begin with.

    Returns:
        The number of cases that failed, or ``BROKEN``.
    """
    if "ends" not in journal.found:
        end, ends = time.time(), {}
        for part, seconds in budgets.items():
            ends[part] = end = end + seconds
        journal.put("ends", ends)

    def keep(number: int, right: bool, found: dict[str, Any]) -> None:
        """Print a line and keep a row."""
        case, said = cases[number], found.get("said", "")
        print(f"{'right' if right else 'WRONG'}  {case.part}: {case.name}{f': {said}' * bool(said)}", flush=True)
        row = {"number": number, "part": case.part, "name": case.name, "right": right, "said": said}
        journal.add("cases", {**found, **row, "took": time.perf_counter() - begin})

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
            found = case.run()
            settle()
            keep(number, True, {"said": found} if isinstance(found, str) else found or {})
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
    """The case with which a program goes on that has ended before its last one; None where it has not.

    A case that ended the process, such as by a crash, is noted as wrong.
    """
    journal = Journal(path, begun=True)
    at = journal.found.get("at")
    if at is None or journal.found.get("done"):
        return None
    if all(row["number"] != at["number"] for row in journal.found.get("cases", ())):
        journal.add("cases", {**at, "right": False, "said": f"ended its process, status {status}"})
    return int(at["number"]) + 1
