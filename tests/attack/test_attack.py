"""The short form of `make attack`."""

import sys
from pathlib import Path

import pytest
from helpers import python


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and limits memory and files")
def test_a_short_attack_finds_nothing():
    table = python(Path(__file__).parent, "--short", "--jobs", 1).splitlines()[-7:]
    assert all(int(line.split()[1]) > 0 and int(line.split()[4]) == 0 for line in table), table
