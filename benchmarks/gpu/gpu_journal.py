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

CASE_SECONDS = 10.0
"""For one case, after which it is said to hang."""


class Journal:
    """What a part has found so far, kept in OUT/PART.json; a process that goes on finds it there."""

    def __init__(self, out: Path, part: str, *, begun: bool = False) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self.path = out / f"{part}.json"
        self.found: dict[str, Any] = json.loads(self.path.read_text()) if begun and self.path.exists() else {}

    def add(self, kind: str, row: dict[str, Any]) -> None:
        """One more row of a kind."""
        self.put(kind, [*self.found.get(kind, []), row])

    def put(self, kind: str, value: Any) -> None:
        """Replaces a value for a while."""
        self.found[kind] = value
        self.path.write_text(json.dumps(self.found, indent=1) + "\n")


@dataclass(frozen=True)
class Again:
    """Where a part begins, and how it starts itself anew: its arguments, its first case and the cases failed before."""

    arguments: tuple[str, ...]
    start: int = 0
    failed: int = 0
    case_seconds: float = CASE_SECONDS

    def go_on(self, number: int, failed: int, said: str = "") -> None:
        """The cases from ``number`` on, in a process that takes the place of this one."""
        if said:
            print(said, flush=True)
        state = {"start": number, "failed": failed, "case-seconds": self.case_seconds}
        options = [part for name, value in state.items() for part in (f"--{name}", str(value))]
        os.execv(sys.executable, [sys.executable, sys.argv[0], *self.arguments, *options])


Case = tuple[str, Callable[[], "str | None"]]
"""A name, and a function that raises, or returns a line to print."""


def settling(device: str) -> Callable[[], None]:
    """What waits for all that a device has been given."""
    import torch

    return torch.cuda.synchronize if device == "cuda" else lambda: None


def one_by_one(cases: list[Case], again: Again, settle: Callable[[], None], journal: Journal) -> int:
    """Every case for itself; after one that leaves the device unusable, or does not end, the rest in a new process.

    ``settle()`` waits for the device, and raises where that is of no use any more.
    """
    settle()  # makes the context, in the time of no case
    failed = again.failed

    def keep(name: str, right: bool, said: str) -> None:
        journal.add("cases", {"name": name, "right": right, "said": said, "seconds": time.perf_counter() - begin})

    def hangs(name: str, number: int) -> None:
        said = f"hangs, stopped after {again.case_seconds:g} s"
        keep(name, False, said)
        again.go_on(number + 1, failed + 1, f"WRONG  {name}: {said}")

    for number in range(again.start, len(cases)):
        name, run = cases[number]
        begin = time.perf_counter()
        watch = threading.Timer(again.case_seconds, hangs, (name, number))
        watch.daemon = True
        watch.start()
        try:
            result = run()
            settle()
            print(f"right  {name}{f': {result}' if result else ''}", flush=True)
            keep(name, True, result or "")
        except Exception as error:
            failed += 1
            reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            print(f"WRONG  {name}: {reason}", flush=True)
            keep(name, False, reason)
            traceback.print_exc(file=sys.stdout)
            sys.stdout.flush()
            try:
                settle()
            except Exception:
                watch.cancel()
                again.go_on(number + 1, failed)
        finally:
            watch.cancel()
    print(f"{len(cases) - failed} of {len(cases)} cases are right")
    return failed
