"""The programs of ``make gpu-check`` on the CPU, so that their first run on a GPU does not end in a slip of theirs."""

import functools
import importlib.util
import itertools
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from emulated import emulated
from graphs import graphs
from helpers import read_json

from voronerf.app import train as app_train
from voronerf.app.scenes import builtin_scene

ROOT = Path(__file__).resolve().parent.parent.parent


def program(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / "gpu" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = sys.modules[name] = importlib.util.module_from_spec(spec)  # its dataclasses look for it there
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture
def parts(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    return program("gpu_parts")


@pytest.fixture
def timings(parts):
    return sys.modules["gpu_timings"]


@pytest.fixture
def check():
    return program("gpu_check")


@pytest.mark.slow
def test_every_small_case_is_right_on_the_emulated_device(parts):
    with emulated():
        for name, run in parts.small_cases("cpu"):
            try:
                run()
            except Exception as error:
                raise AssertionError(name) from error


def test_steps_to_capture_are_right_on_the_emulated_device(parts):
    with emulated():
        for name, step in parts.captured_steps("cpu", 40):
            allowed = 8e-2 if "bfloat16" in name else 1e-5  # rounding moves samples across kinks
            for found, exact in zip(step(), step("reference", torch.float64)):
                difference = (found.double() - exact).norm()
                assert difference <= allowed * exact.norm() + 1e-7, (name, list(found.shape))
    assert len(parts.captured_steps("cpu", 1)) == 6


@pytest.mark.native
def test_trainings_to_capture_are_right_on_the_emulated_device(parts, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "is_cpu", False)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    small = {"width": 16, "samples": (8,), "rays": 16, "cells": (), "split_at": ()}
    with emulated(), graphs() as seen:
        for name, run in parts.captured_trainings("cpu", 3, **small):
            assert run().endswith("as a graph, the same bits"), name
    assert seen.calls == 3 * ["register", "capture", *["replay"] * 4]


AFTER_FAULTS = """
import sys, threading, types
sys.path.insert(0, {ci!r})
import gpu_parts

broken = False

def synchronize():
    if broken:
        raise RuntimeError("an illegal memory access was encountered")

def breaks():
    global broken
    broken = True
    synchronize()

cuda = types.SimpleNamespace(synchronize=synchronize)
sys.modules["torch"] = types.SimpleNamespace(cuda=cuda, manual_seed=lambda seed: None)
cases = [("first", lambda: None), ("breaks", breaks), ("between", lambda: None)]
cases += [("hangs", lambda: threading.Event().wait(60)), ("last", lambda: None)]
gpu_parts.small_cases = lambda device: cases
sys.exit(gpu_parts.main(sys.argv[1:]))
"""


def test_a_fault_and_a_kernel_that_hangs_end_their_own_case_alone(tmp_path):
    """In processes that truly start themselves anew, with a device that stays broken."""
    (tmp_path / "faults.py").write_text(AFTER_FAULTS.format(ci=str(ROOT / "benchmarks" / "gpu")))
    command = [sys.executable, "faults.py", "small", "out", "--case-seconds", "0.5"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=50)
    told = [line for line in result.stdout.splitlines() if line.startswith(("right", "WRONG"))]
    assert told == [
        "right  first",
        "WRONG  breaks: RuntimeError: an illegal memory access was encountered",
        "right  between",
        "WRONG  hangs: hangs, stopped after 0.5 s",
        "right  last",
    ]
    assert result.stdout.endswith("3 of 5 cases are right\n") and result.returncode == 2
    kept = read_json(tmp_path / "out" / "small.json")["cases"]
    names = [line.split()[1].removesuffix(":") for line in told]
    assert [(row["name"], row["right"]) for row in kept] == list(zip(names, (True, False) * 2 + (True,), strict=False))


@pytest.mark.native
def test_roofs(parts, monkeypatch, tmp_path):
    """Every row is measured, on the CPU's kernels, and what a first process measured stays."""
    import harness  # of benchmarks/, to which gpu_parts.py has led

    monkeypatch.setattr(harness, "_cuda_peak", lambda kind, device: 1e12)
    again = parts.Again(("roofs",), case_seconds=60.0)
    assert parts.roofs(tmp_path, again, "cpu", 256) == 0
    rows = read_json(tmp_path / "roofs.json")["rows"]
    assert len(rows) == 31 and all(row["seconds"] > 0 and row["share"] > 0 for row in rows)
    assert all(row["floor"] == row["work"] / 1e12 for row in rows)
    again = parts.Again(("roofs",), start=30, failed=1, case_seconds=60.0)
    assert parts.roofs(tmp_path, again, "cpu", 256) == 1
    after = read_json(tmp_path / "roofs.json")["rows"]
    assert after[:31] == rows and [row["name"] for row in after[31:]] == [rows[30]["name"]]


@pytest.mark.native
def test_what_surrounds_the_networks_is_timed_beside_plain_torch(parts, monkeypatch, tmp_path):
    import harness

    monkeypatch.setattr(harness, "_cuda_peak", lambda kind, device: 1e12)
    assert parts.step(tmp_path, parts.Again(("step",), case_seconds=60.0), "cpu", 256) == 0
    rows = read_json(tmp_path / "step.json")["rows"]
    own = [row["name"] for row in rows if " by " not in row["name"]]
    assert len(own) == 13 and all(row["limit"] == "copy" and row["work"] > 0 for row in rows)
    assert all(any(row["name"].startswith(f"{name} by ") for row in rows) for name in own)


def test_training(parts, tmp_path, capsys, monkeypatch):
    # A step takes twenty milliseconds however busy the machine is.
    ticks = itertools.count()
    ticking = functools.partial(app_train.run, clock=lambda: 0.0201 * next(ticks))
    monkeypatch.setattr("voronerf.app.train.run", ticking)
    monkeypatch.setattr("voronerf.app.scenes.load_scene", lambda *_, **__: builtin_scene(16))
    small = {name: {**options, "width": 16, "samples": (16,), "rays": 256} for name, options in parts.TRAININGS.items()}
    monkeypatch.setattr(parts, "TRAININGS", small)
    assert parts.training(tmp_path, "builtin", parts.Again(("training",), case_seconds=60.0), "cpu", 0.5) == 0
    assert capsys.readouterr().out.count("PSNR") == len(small)
    kept = read_json(tmp_path / "training.json")["trainings"]
    assert [row["name"] for row in kept] == list(small)
    assert all(row["psnr"] > 0 and row["milliseconds"] > 0 for row in kept)


def test_a_file_of_tests_that_hangs_fails_alone(parts, tmp_path, capsys):
    (tmp_path / "conftest.py").write_text("def pytest_addoption(parser):\n    parser.addoption('--require')\n")
    bodies = {
        "hangs": "import time\ndef test_cuda():\n    time.sleep(600)\n",
        "passes": "def test_cuda(pytestconfig):\n    assert pytestconfig.getoption('require') == 'native,cuda'\n",
        "wrong": "def test_cuda():\n    assert 1 + 1 == 3\n",
        "other": "def test_elsewhere():\n    assert False\n",
    }
    files = []
    for name, body in bodies.items():
        files.append(tmp_path / f"test_planted_{name}.py")
        files[-1].write_text(body)
    assert parts.tests(tmp_path / "out", files, 5.0) == 2
    said = capsys.readouterr().out.splitlines()
    outcomes = {line.split()[1].removeprefix("test_planted_"): line for line in said if "  test_planted_" in line}
    assert outcomes["hangs.py:"].startswith("FAILED  test_planted_hangs.py: stopped after 5 s")
    assert list(outcomes)[-1] == "hangs.py:", "the others are told before it"
    assert outcomes["passes.py:"].startswith("passed") and "1 passed" in outcomes["passes.py:"]
    assert outcomes["wrong.py:"].startswith("FAILED") and outcomes["other.py:"].startswith("passed")
    assert said[-1] == "2 of 4 files passed"
    kept = {row["name"]: row for row in read_json(tmp_path / "out" / "tests.json")["files"]}
    assert kept["test_planted_passes.py"]["right"] and not kept["test_planted_hangs.py"]["right"]
    assert any(line.endswith("assert (1 + 1) == 3") for line in kept["test_planted_wrong.py"]["wrong"])


def test_a_part_that_hangs_is_ended_with_all_that_it_started(check, monkeypatch, tmp_path):
    monkeypatch.setattr(check, "SHORTEST", 0.0)
    child = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    script = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    result = check.run("hangs", check.Part([sys.executable, "-c", script], 2), tmp_path, 100.0)
    assert result["outcome"] == "failed" and result["last"].startswith("stopped after 2 s")
    child_pid = int((tmp_path / "pid").read_text())
    for _ in range(100):
        state = Path(f"/proc/{child_pid}/stat")
        # One that has ended may still wait for whoever adopts it.
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError("the child of the part still runs")


def test_the_summary_has_all_that_a_part_has_found(check, monkeypatch, tmp_path):
    """And nothing of an earlier run, nor less than it can where a part was ended in the middle of a line."""
    (tmp_path / "old.json").write_text('{"cases": ["of an earlier run"]}')
    write = "import sys; open(sys.argv[1], 'w').write(sys.argv[2]); print('done')"

    def part(name, *program):
        path = tmp_path / f"{name}.json"
        return check.Part([sys.executable, "-c", program[0], str(path), *program[1:]], 20, (), path)

    known = {"good": part("good", write, '{"a": [1]}'), "torn": part("torn", write, '{"a"'), "old": part("old", "pass")}
    known["absent"] = check.Part("not here", 0)
    monkeypatch.setattr(check, "parts", lambda out, data: known)
    monkeypatch.setitem(check.CALLS, "2", tuple(known))
    assert check.main(["2", "--out", str(tmp_path / "out"), "--seconds", "400"]) == 0
    kept = read_json(tmp_path / "out" / "summary-2.json")["parts"]
    assert kept["good"]["found"] == {"a": [1]} and kept["torn"]["found"].startswith("torn.json: ")
    assert kept["old"]["found"] is None and kept["absent"]["outcome"] == "left out"


def test_calls_fit_their_time_and_leave_two_files(check, monkeypatch, tmp_path):
    """Without a GPU every part says why it is left out, but for the one that says what is missing."""
    monkeypatch.setattr(check, "capability", lambda: "90")
    monkeypatch.setattr(check.shutil, "which", lambda name, **_: name)
    known = check.parts(tmp_path, None)
    assert {name for call in check.CALLS.values() for name in call} == set(known)
    for call in check.CALLS.values():
        assert sum(known[name].seconds for name in call) <= check.SECONDS
    monkeypatch.undo()
    for call in check.CALLS:
        # "machine" fails for want of a GPU; it is not begun in so little time.
        assert check.main([call, "--out", str(tmp_path), "--seconds", "1"]) == 0
        outcomes = read_json(tmp_path / f"summary-{call}.json")["parts"]
        assert list(outcomes) == list(check.CALLS[call])
        assert all(row["outcome"] == "left out" and row["last"] for row in outcomes.values())
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f"{kind}-{call}.{end}" for kind, end in (("summary", "json"), ("parts", "tar.gz")) for call in check.CALLS
    )


@pytest.mark.native
def test_large_cases(parts, monkeypatch):
    """Small, on the emulated device; and gradients that are wrong are found."""
    large = sys.modules["gpu_large"]
    monkeypatch.setattr(large, "SUBSET", 16)
    with emulated():
        run = dict(large.large_cases("cpu", 300))["w64d4 bfloat16"]
        assert run().count("e-") == 2
        whole = large.evaluate
        twice = itertools.count()

        def spoilt(given):
            parts_of = whole(given)
            if next(twice) == 1:
                parts_of[1] = parts_of[1] * 1.5
            return parts_of

        monkeypatch.setattr(large, "evaluate", spoilt)
        with pytest.raises(AssertionError, match="part 1 is"):
            run()


@pytest.mark.native
def test_sizes_and_a_profiled_step(parts, timings, monkeypatch, tmp_path):
    import harness

    monkeypatch.setattr(harness, "_cuda_peak", lambda kind, device: 1e12)
    assert timings.sizes(tmp_path, parts.Again(("sizes",), case_seconds=60.0), "cpu", (1 << 10,), (1, 16)) == 0
    rows = read_json(tmp_path / "sizes.json")["rows"]
    assert len(rows) == 14 and all(row["seconds"] > 0 for row in rows)
    monkeypatch.setattr("voronerf.app.scenes.load_scene", lambda *_, **__: builtin_scene(12))
    assert timings.profile(tmp_path, parts.Again(("profile",), case_seconds=60.0), "cpu", 2) == 0
    (row,) = read_json(tmp_path / "profile.json")["steps"]
    assert row["seconds"] > 0 and row["launches"] == row["waits"] == 0


@pytest.mark.warp
@pytest.mark.native
def test_operations_of_warp_beside_native_ones(parts, timings, monkeypatch, tmp_path):
    import harness

    monkeypatch.setattr(harness, "_cuda_peak", lambda kind, device: 1e12)
    assert timings.warp(tmp_path, parts.Again(("warp",), case_seconds=60.0), "cpu", 300) == 0
    names = {row["name"] for row in read_json(tmp_path / "warp.json")["rows"]}
    assert {"grouped_mlp n=300", "grouped_mlp n=300 by Warp", "render_loss_gradient n=300 by Warp"} <= names


def test_the_summary_says_what_was_reached_and_what_is_wrong(check):
    row = {"limit": "copy", "seconds": 2e-5, "share": 0.5, "aim": None}
    timed = [{**row, "name": f"cell_sort k=16 by {way}"} for way in ("counting", "torch.sort")]
    timed += [{**row, "name": "cell_sort k=16 by radix", "seconds": 4e-5}]
    timed += [{**row, "name": "near", "aim": 0.6}, {**row, "name": "far", "aim": 0.4}]
    timed += [{**row, "name": "far by torch.bmm", "seconds": 8e-5}]
    found = {
        "roofs": {"rows": timed, "cases": [{"name": "slow", "right": False, "said": "hangs"}]},
        "training": {
            "trainings": [{"name": "plain", "psnr": 21.5, "steps": 90, "milliseconds": 8.25}],
            "cases": [{"name": "plain", "right": True, "said": ""}, {"name": "bf16", "right": False, "said": "no"}],
        },
        "small": {"cases": [{"name": "fine", "right": True, "said": ""}]},
        "captured": "captured.json: torn",
        "tests": {"files": [{"name": "test_a.py", "right": False, "said": "1 failed"}]},
        "memcheck": None,
        "rivals": {"skipped": [{"name": "far by Triton", "reason": "no package triton"}]},
        "step": {"rows": [{**row, "name": name} for name in ("loss", "loss by torch, sums by rays")]},
    }
    said = check.highlights(found)
    assert len(said) == 17
    assert said[3].endswith("0.020 ms  50.0 % of copy, MISSED 60 %") and said[4].endswith("copy, reached 40 %")
    assert said[8:] == [
        "cell_sort k=16 by counting: 0.50 x the time of radix",
        "far: 0.25 x the time of torch.bmm",
        "loss: 1.00 x the time of torch, sums by rays",
        "RULE sort: counting up to 1,022 cells stays",
        "left out: far by Triton: no package triton",
        "training plain: 8.25 ms a step, PSNR 21.50 after 90 steps",
        "WRONG in roofs: slow: hangs",
        "WRONG in training: bf16: no",
        "WRONG in tests: test_a.py: 1 failed",
    ]
    assert check.highlights({}) == []


def test_programs_of_a_bare_machine_import_what_it_has():
    """torch, and what comes with Python: pytest, tyro, rich and warp may be absent until the tests themselves run."""
    absent = ("pytest", "_pytest", "tyro", "rich", "warp", "scipy", "imageio_ffmpeg")
    code = f"""
import sys
for name in {absent!r}:
    sys.modules[name] = None
sys.path[:0] = [{str(ROOT / "benchmarks" / "gpu")!r}]
import gpu_parts, gpu_check
gpu_parts.small_cases("cpu"), gpu_parts.captured_steps("cpu", 4)
import harness, throughput, ops.networks, ops.case
import voronerf.app.train
print("imported")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert result.stdout.endswith("imported\n"), result.stderr
