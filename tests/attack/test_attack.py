"""A short run of `make attack`."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest
from attempts import FAILED, REFUSED, RIGHT, Failed, Part, run_part
from faults import FAULTS
from helpers import python

ROOT = Path(__file__).resolve().parents[2]
linux = pytest.mark.skipif(sys.platform != "linux", reason="forks, and limits memory and files")


def harmed(rng, folder, inputs):
    """Crashes, hangs, fails or succeeds, depending on the seed of the attempt."""
    seed = int(folder.name)
    if seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 2:
        time.sleep(60)
    if seed == 3:
        raise Failed("wrong")
    return REFUSED if seed == 4 else RIGHT


@linux
def test_a_crash_is_a_failure_like_another(tmp_path):
    tally = run_part(Part("part", harmed, 2, batch=4), range(6), tmp_path, jobs=2)
    assert tally.counts == {RIGHT: 2, REFUSED: 1, FAILED: 3}
    assert sorted(tally.failures) == [(1, "ended by SIGKILL"), (2, "took 2 s"), (3, "Failed: wrong")]


def test_every_fault_can_be_planted():
    """Checks that the fault's line occurs once in its file; ``python tests/attack --mutate`` plants the fault."""
    assert len({fault.what for fault in FAULTS}) == len(FAULTS) > 100
    for fault in FAULTS:
        assert (ROOT / fault.file).read_text().count(fault.line) == 1 and fault.line != fault.wrong, fault
        tests = fault.tests[: fault.tests.index("-k")] if "-k" in fault.tests else fault.tests
        assert tests and all((ROOT / test).exists() for test in tests), fault


@pytest.mark.slow
@linux
def test_a_short_attack_finds_nothing():
    said = python(Path(__file__).parent, "--short", "--jobs", 1)
    table = said[said.index("part  ") :].splitlines()[1:]
    assert len(table) > 8
    assert all(int(line.split()[1]) > 0 and int(line.split()[4]) == 0 for line in table), table
