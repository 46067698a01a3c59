"""Scripts and packages of benchmarks/ are imported by their own names, as they import one another."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
