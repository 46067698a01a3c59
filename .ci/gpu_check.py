"""Everything to be learnt from a machine with a GPU, in one command: ``gpu_check.py --out DIR``.

For a bare machine: torch with CUDA, nvcc and ninja, no network. Parts run one after another, each for itself: one that
fails or runs into its limit is told with its last lines, and the next one begins. All of them together keep within
eight minutes; ``--parts`` takes some of them, ``--data DIR`` adds a short training on a Blender scene.

    build      the extension for this GPU alone
    tests      the tests of the operations on CUDA, all failures
    captured   a training step of the network in a CUDA graph
    memcheck   compute-sanitizer over small tests, where it is installed
    racecheck  the same for races in shared memory
    benchmark  benchmarks/throughput.py
    training   voronerf train on --data

DIR gets summary.json and what each part said. The last lines printed are the summary; the exit status counts failures.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHON = sys.executable
TAIL = 25
"""Lines of a failure that are printed."""

SMALL = "native-cuda and (packed_rows or stable_sort or ties or output_and_gradients)"
"""What the sanitizer runs."""

CAPTURED = """
import torch, voronerf
from voronerf.layers import MLP, POSITIONS, Layer
layers = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 64, "relu"), Layer((1,), 4)), (2,), 10)
shapes = layers.weight_shapes(3)
weights = [(torch.randn(8, o, i, device="cuda") / i**0.5).requires_grad_() for o, i in shapes]
biases = [torch.zeros(8, o, device="cuda", requires_grad=True) for o, _ in shapes]
points, centres = torch.rand(4096, 3, device="cuda"), torch.rand(8, 3, device="cuda")
def step():
    cells = voronerf.nearest_centre(points, centres, backend="native")
    order, offsets = voronerf.cell_sort(cells, 8, backend="native")
    out = voronerf.grouped_mlp(points[order], offsets, weights, biases, layers=layers, backend="native")
    return torch.autograd.grad(out.square().mean(), [*weights, *biases])
side = torch.cuda.Stream()
side.wait_stream(torch.cuda.current_stream())
with torch.cuda.stream(side):
    expected = [part.clone() for part in step()]
torch.cuda.current_stream().wait_stream(side)
graph = torch.cuda.CUDAGraph()
with torch.cuda.graph(graph):
    found = step()
for _ in range(3):
    graph.replay()
torch.cuda.synchronize()
assert all(torch.equal(a, b) for a, b in zip(expected, found)), "a replay differs from the step itself"
print("a step was captured and replays with the same gradients")
"""


@dataclass(frozen=True)
class Part:
    """One part: its command, or why it is left out, and the seconds it may take."""

    command: list[str] | str
    seconds: int
    environment: tuple[tuple[str, str], ...] = ()


def main(arguments: list[str]) -> int:
    """Run the parts and return the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for summary.json and the parts' outputs")
    parser.add_argument("--parts", nargs="+", help="some of the parts, in this order")
    parser.add_argument("--data", type=Path, help="a Blender scene for the training")
    given = parser.parse_args(arguments)
    known = parts(given.out, given.data)
    chosen = given.parts or list(known)
    if unknown := [name for name in chosen if name not in known]:
        parser.error(f"--parts takes {', '.join(known)}, got {', '.join(unknown)}")
    given.out.mkdir(parents=True, exist_ok=True)
    results = {}
    for name in chosen:
        print(f"gpu-check: {name} ...", flush=True)
        results[name] = run(name, known[name], given.out)
    (given.out / "summary.json").write_text(json.dumps({"device": device(), "parts": results}, indent=1) + "\n")
    print(f"\ngpu-check on {device()}:")
    for name, result in results.items():
        print(f"  {name:10} {result['outcome']:8} {result['seconds']:6.1f} s  {result['last']}")
    return sum(result["outcome"] == "failed" for result in results.values())


def parts(out: Path, data: Path | None) -> dict[str, Part]:
    """The parts by name."""
    small = [PYTHON, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "tests/ops", "-k", SMALL]
    sanitizer = shutil.which("compute-sanitizer", path=os.environ.get("PATH", "") + ":/usr/local/cuda/bin")
    architecture = capability()
    built = (("VORONERF_CUDA", "1"), ("VORONERF_CUDA_ARCHITECTURES", architecture or ""))
    tests = [PYTHON, "-m", "pytest", "-q", "tests/ops", "-k", "cuda", "--require", "cuda"]
    sanitize = [sanitizer or "", "--error-exitcode", "9", "--target-processes", "all"]
    benchmark = ROOT / "benchmarks" / "throughput.py"
    train = [PYTHON, "-m", "voronerf.cli", "train", "--data", str(data), "--downscale", "2", "--budget", "40"]
    return {
        "build": Part([PYTHON, "setup.py", "build_ext", "--inplace"], 120, built)
        if architecture
        else Part("torch sees no GPU", 0),
        "tests": Part(tests if importlib.util.find_spec("pytest") else "pytest is not installed", 120),
        "captured": Part([PYTHON, "-c", CAPTURED], 30),
        "memcheck": Part([*sanitize, "--tool", "memcheck", *small] if sanitizer else "no compute-sanitizer", 45),
        "racecheck": Part([*sanitize, "--tool", "racecheck", *small] if sanitizer else "no compute-sanitizer", 45),
        "benchmark": Part(
            [PYTHON, str(benchmark), "--device", "cuda", "--quick", "--json", str(out / "throughput.json")]
            if benchmark.exists()
            else "there is no benchmarks/throughput.py",
            60,
        ),
        "training": Part([*train, "--out", str(out / "training")] if data is not None else "no --data", 60),
    }


def run(name: str, part: Part, out: Path) -> dict[str, object]:
    """Outcome, seconds and the last line of one part; what it said goes to a file."""
    if isinstance(part.command, str):
        return {"outcome": "left out", "seconds": 0.0, "last": part.command}
    environment = {**os.environ, **dict(part.environment), "PYTHONPATH": str(ROOT)}
    begin = time.perf_counter()
    with (out / f"{name}.txt").open("w+") as log:
        try:
            status: int | str = subprocess.run(
                part.command, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT, timeout=part.seconds
            ).returncode
        except subprocess.TimeoutExpired:
            status = f"stopped after {part.seconds} s"
        except OSError as error:
            status = str(error)
        log.seek(0)
        lines = [line for line in log.read().splitlines() if line.strip()]
    if status != 0:
        print("\n".join(f"    {line}" for line in lines[-TAIL:]))
    last = lines[-1][:160] if lines else ""
    return {
        "outcome": "passed" if status == 0 else "failed",
        "seconds": time.perf_counter() - begin,
        "last": last if isinstance(status, int) else f"{status}; {last}",
    }


def capability() -> str | None:
    """Compute capability of the GPU, such as "90"; None without one."""
    import torch

    if not torch.cuda.is_available():
        return None
    major, minor = torch.cuda.get_device_capability()
    return f"{major}{minor}"


def device() -> str:
    """The GPU and the versions that belong to it."""
    import torch

    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{name}, torch {torch.__version__}, CUDA {torch.version.cuda}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
