"""Makes the stand-ins of benchmarks/ops importable, which these tests share with the benchmarks."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)
