"""Tests of ``import voronerf``: its cost and its output."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from voronerf import app, ops
from voronerf.app.cli.info import EXTRAS
from voronerf.ops._core import backends

START = """
import sys, torch, voronerf
heavy = {"torch._dynamo", "torch._inductor", "sympy", "warp", "matplotlib", "rich", "tyro"}
assert not heavy & sys.modules.keys()
torch.set_num_threads(1)
for fuse in (False, True):
    field = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.ReLU(), torch.nn.Linear(16, 4))
    router = voronerf.VoronoiRouter(field, torch.rand(8, 3), coords="first3", fuse=fuse)
    router(torch.rand(1024, 3)).sum().backward()
assert not heavy & sys.modules.keys()
for backend in ("native", "reference"):
    assert voronerf.nearest_centre(torch.rand(5, 3), torch.rand(4, 3), backend=backend).shape == (5,)
    router = voronerf.VoronoiRouter(voronerf.NeRF(8, 1), torch.rand(4, 3), backend=backend)
    router(torch.rand(5, 3), torch.rand(5, 3))[1].sum().backward()
"""

LIBRARY = """
import importlib, pkgutil, torch, voronerf
for part in voronerf._PARTS:
    package = importlib.import_module(f"voronerf.{part}")
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
router = voronerf.VoronoiRouter(torch.nn.Linear(3, 4), torch.rand(8, 3), coords="first3")
optimizer = torch.optim.Adam(router.parameters())
router(torch.rand(64, 3)).square().mean().backward()
optimizer.step()
"""

TRAINING = """
import sys, tempfile, pathlib, torch
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Checkpoints, Scores, TrainConfig, build, last_checkpoint, load, run
torch.set_num_threads(1)
scene = builtin_scene(16, train_views=4, test_views=2)
with tempfile.TemporaryDirectory() as folder:
    for steps in (4, 8):
        out = pathlib.Path(folder)
        state = build(TrainConfig(steps=steps, cells=(4,), width=8, depth=1, rays=64), scene)
        if steps > 4:
            load(state, last_checkpoint(out))
        run(state, [Checkpoints(out), Scores(out)])
assert not {"torch._dynamo", "sympy"} & sys.modules.keys()
"""


@pytest.mark.native
def test_functions_of_ops_hide_no_modules() -> None:
    """``import a.b as c`` works for the modules of ops, although a function hides the package of the same name."""
    paths = sorted(Path(ops.__path__[0]).glob("[a-z]*/*.py"))
    lines = ["import sys", *(f"from voronerf.ops import {op}; assert callable({op})" for op in ops.__all__)]
    for name in (f"voronerf.ops.{path.parent.name}.{path.stem}" for path in paths if path.stem != "__init__"):
        lines.append(f"import {name} as module; assert module is sys.modules['{name}']")
    assert len(lines) > len(backends.ops())
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)


@pytest.mark.slow
@pytest.mark.native
@pytest.mark.parametrize("code", [START, TRAINING], ids=["calls", "training"])
def test_neither_first_calls_nor_a_training_print_or_import_compilers(code: str) -> None:
    """First calls and trainings print nothing and import no compiler, which would take as long as torch."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def without(*packages: str, code: str) -> subprocess.CompletedProcess[str]:
    """Runs code in a process that cannot import the packages."""
    absent = f"import sys; sys.modules.update(dict.fromkeys({packages}))\n"
    return subprocess.run([sys.executable, "-c", absent + code], capture_output=True, text=True)


def test_a_missing_torch_is_one_line() -> None:
    line = "voronerf needs PyTorch 2.9 or newer, which is not installed: pip install torch\n"
    program = "from voronerf.app.cli import main; sys.exit(main())"
    for code, text in (("from voronerf import NeRF", f"ImportError: {line}"), (program, f"voronerf: error: {line}")):
        run = without("torch", code=code)
        assert run.returncode == 1 and run.stderr.endswith(text) and run.stderr.count("Traceback") == ("I" in text[:1])
        assert "During handling" not in run.stderr


@pytest.mark.native
def test_the_library_needs_no_extra() -> None:
    run = without(*(name for extra in EXTRAS.values() for name in extra.modules), code=LIBRARY)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_a_missing_extra_of_the_application_is_one_line() -> None:
    program = "import runpy; runpy.run_module('voronerf', run_name='__main__')"
    for packages, code, kind in (
        (app.PACKAGES, program, "voronerf: error"),
        (("rich",), program, "voronerf: error"),
        (app.PACKAGES, "from voronerf.app import open_run", "ImportError"),
        (("safetensors",), "import voronerf.editing", "ImportError"),
    ):
        line = f"the command line and voronerf.app need {', '.join(packages)}: pip install 'voronerf[app]'"
        run = without(*packages, code=code)
        assert run.returncode == 1 and run.stderr.endswith(f"{kind}: {line}\n"), run.stderr
        assert run.stderr.count("\n") == 1 or kind == "ImportError"


def test_threads_of_the_command_sleep_while_they_wait() -> None:
    """The command, not the library, sets the OpenMP wait policy; the user's variables take precedence."""
    code = "import os, sys; sys.modules['torch'] = None; {}"
    code += "; print(*map(os.environ.get, ('OMP_WAIT_POLICY', 'GOMP_SPINCOUNT')))"
    command = "from voronerf.app.cli import main; main()"
    for program, variables, expected in (
        (command, {}, "passive 1000"),
        (command, {"OMP_WAIT_POLICY": "active"}, "active None"),
        (command, {"GOMP_SPINCOUNT": "7"}, "passive 7"),
        ("import voronerf.app.cli", {}, "None None"),
    ):
        env = {name: value for name, value in os.environ.items() if "OMP_" not in name} | variables
        run = subprocess.run([sys.executable, "-c", code.format(program)], env=env, capture_output=True, text=True)
        assert run.stdout.strip() == expected, run.stderr


@pytest.mark.slow
@pytest.mark.warp
def test_other_errors_still_reach_stderr_while_warp_starts() -> None:
    code = "import os, warp; warp.init = lambda: os.write(2, b'trouble\\n'); import voronerf.kernels"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "trouble\n" in run.stderr and "CUDA driver" not in run.stderr
