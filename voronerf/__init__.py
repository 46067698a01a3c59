"""Many small networks, one per Voronoi cell of space, as cheap to run and to train as one."""

__version__ = "0.1.0"

import gc
import os
import signal
import sys

# Whether this is the program and not a library of another.
if _command := bool(sys.argv) and sys.argv[0].endswith(("/voronerf", "\\voronerf", "\\voronerf.exe")):
    # OpenMP's threads spin for milliseconds by default while they wait for each other, on cores that others may need:
    # beside ten busy processes a step of training takes twenty times as long. Read when torch loads its runtime.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # They spin for some ten microseconds before that: to sleep and wake takes as long, many times in a step.
    if os.environ["OMP_WAIT_POLICY"] == "passive":
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # Garbage is collected again in voronerf.app.cli.main: while torch is loaded there is none, and to look for it takes
    # a tenth of the time.
    gc.disable()
    # Ctrl-C ends the program without a traceback while it is loaded; main asks for KeyboardInterrupt again.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    line = "voronerf needs PyTorch 2.9 or newer, which is not installed: pip install torch"
    if _command:
        sys.exit(f"voronerf: error: {line}")
    raise ImportError(line) from None

from voronerf.diagram import (
    Balance,
    SampleReservoir,
    Split,
    VoronoiDiagram,
    balance,
    imbalance,
    split_diagram,
    uniform_centres,
)
from voronerf.nerf import OccupancyGrid
from voronerf.nerf.fields import HashGridField, NeRF
from voronerf.ops import (
    Composite,
    cell_sort,
    composite,
    frequency_encode,
    grouped_linear,
    grouped_mlp,
    hash_encode,
    integrated_encode,
    locate_cell,
    march_rays,
    nearest_centre,
    resample,
    routed_mlp,
    spherical_harmonics,
)
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import MLP, Layer
from voronerf.router import VoronoiRouter

__all__ = [
    "MLP",
    "BackendUnavailable",
    "Balance",
    "Composite",
    "HashGrid",
    "HashGridField",
    "Layer",
    "NeRF",
    "OccupancyGrid",
    "SampleReservoir",
    "Split",
    "VoronoiDiagram",
    "VoronoiRouter",
    "balance",
    "cell_sort",
    "composite",
    "frequency_encode",
    "grouped_linear",
    "grouped_mlp",
    "hash_encode",
    "imbalance",
    "integrated_encode",
    "locate_cell",
    "march_rays",
    "nearest_centre",
    "resample",
    "routed_mlp",
    "spherical_harmonics",
    "split_diagram",
    "uniform_centres",
]
