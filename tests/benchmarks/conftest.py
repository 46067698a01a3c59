"""Makes scripts and packages of benchmarks/ importable by their names, as they import one another."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
