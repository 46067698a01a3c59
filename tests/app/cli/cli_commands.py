"""Splits commands into lists of words, and defines the options of a run of a few steps."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "scenes"))  # for scene_files

TINY = (
    "--downscale 6 --steps 16 --cells 3 --split-at 0.5 --width 8 --depth 2 --rays 64 --samples 8 --evaluations 2 "
    "--eval-views 2 --panels 1"
)


def words(*parts):
    """Returns a command as a list of words: strings are split at their spaces, other objects become one word each."""
    return [word for part in parts for word in (part.split() if isinstance(part, str) else [str(part)])]
