"""Tests of the benchmarks' shared code, and of the throughput table's contenders and checks."""

import re
import subprocess
import sys
import time
from pathlib import Path

import harness
import pytest
import table
import throughput
import torch
from helpers import read_json
from ops import (
    alternatives,
    case,
    cases_any,
    cases_foreign,
    cases_hash,
    cases_lookup,
    cases_network,
    cases_sampling,
    cases_step,
    networks,
    route,
)
from ops.case import NotApplicable

import voronerf

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
CPU = torch.device("cpu")
COLUMNS = [
    *("op", "case", "backend", "device", "dtype", "direction", "n", "k", "threads"),
    *("median_ms", "iqr_ms", "throughput", "unit", "percent_of_peak", "alternatives", "speedup_over_best", "max_error"),
]


def test_contenders_take_turns_and_slow_ones_are_capped():
    cost, turns = {"fast": 0.25, "middle": 0.5, "slow": 2.5, "slowest": 2.5}, []

    def stopwatch(run, first, count):
        assert count == 1
        run(first)
        return cost[turns[-1][0]]

    runs = {name: (lambda call, name=name: turns.append((name, call))) for name in cost}
    timings = harness.measure(runs, dict.fromkeys(cost, 1.0), stopwatch, {"slowest": 99.0})
    counts = {name: len(timing.seconds) for name, timing in timings.items()}
    assert counts == {"fast": 4, "middle": 3, "slow": 1, "slowest": 1}
    assert [name for name, timing in timings.items() if timing.capped] == ["slow", "slowest"]
    assert timings["slowest"].seconds == [99.0] and all(name != "slowest" for name, _ in turns)
    assert [name for name, _ in turns[3:7]] == ["fast", "middle", "middle", "fast"]
    numbers = [call for name, call in turns if name == "fast"]
    assert numbers == sorted(set(numbers)) and 0 not in numbers, "a timed call must not see the inputs before it"


def test_short_calls_are_timed_in_batches_behind_an_untimed_one():
    calls = []

    def stopwatch(run, first, count):
        for call in range(first, first + count):
            run(call)
        return 1e-3 * count

    timing = harness.measure({"short": calls.append}, {"short": 0.015}, stopwatch)["short"]
    assert timing.seconds == pytest.approx([1e-3] * 3) and not timing.capped
    assert len(calls) == 1 + 3 * (1 + 5)
    assert timing.median_ms == pytest.approx(1.0) and timing.iqr_ms == pytest.approx(0.0)


@pytest.mark.skipif(not Path("/proc/stat").is_file(), reason="the kernel's counters are Linux's")
def test_other_processes_are_noticed():
    others = harness.Others()
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        deadline, most = time.monotonic() + 60, 0.0
        while most <= 0.3 and time.monotonic() < deadline:
            time.sleep(0.5)
            most = max(most, others.cores() or 0.0)
        process.kill()
    assert most > 0.3


def test_every_operation_has_rows_in_both_modes():
    for arguments in ([], ["--quick"]):
        cases = throughput.chosen_cases(throughput.parse(arguments))
        assert {case.op for case in cases} == {op for op, case in cases_any.CASES.items() if case.comparable}
        keys = [case.key for case in cases]
        assert len(set(keys)) == len(keys)
    both = {(case.op, case.direction) for case in throughput.chosen_cases(throughput.parse([]))}
    differentiable = {op for op, case in cases_any.CASES.items() if case.differentiable}
    differentiable |= {"render_loss"}  # returns its gradient
    assert {op for op, direction in both if direction == "forward+backward"} == differentiable


def test_foreign_fields_have_rows_of_their_own():
    cases, quick = (throughput.chosen_cases(throughput.parse(["--foreign", *more])) for more in ([], ["--quick"]))
    assert len({case.key for case in cases}) == len(cases) and {case.op for case in cases} == {"foreign"}
    assert len(quick) == len(cases_foreign.FIELDS) == len({case.case.split(" n=")[0] for case in cases})
    assert {(case.n, case.k, case.threads) for case in quick} == {(1024, 16, 1)}


@pytest.mark.parametrize("name", ["nerf-pytorch w64", "appearance", "siren laplacian", "nerfacto table", "k-planes"])
def test_foreign_contenders_compute_what_masks_do(name):
    for direction in ("forward", "forward+backward"):
        work = cases_foreign.foreign_work(cases_foreign.FIELDS[name], 300, 5, direction, CPU)
        contender = work.ours("reference")
        first, second = (contender.adapt(contender.run(call)) for call in (0, 1))
        assert work.error(first) < work.tolerance < work.error(second), "another call sees other samples"
        assert work.error(work.alternatives["masks"]().run(0)[:1]) == 0


#: All fields but large ones, and those that differ from others by their activation.
DISTINCT = [name for name in cases_foreign.FIELDS if not re.search("2.1|ngp|w256|isdf|leaky|tanh|gelu|elu", name)]


@pytest.mark.parametrize("name", DISTINCT)
def test_fused_foreign_fields_compute_what_masks_do(name):
    """Compares values and the gradients of every parameter; some values are derivatives of the field."""
    work = cases_foreign.foreign_work(cases_foreign.FIELDS[name], 300, 4, "forward+backward", CPU)
    fused = work.ours("auto")
    assert work.error(fused.adapt(fused.run(0))) < 1e-3


def test_cost_counts_products():
    w64d4 = networks.cost(networks.NETS["w64d4"])
    hidden, head = 2 * 64 * 64 * 3, 2 * 64 * 4
    assert w64d4.forward == 2 * 63 * 64 + hidden + head
    assert w64d4.backward == w64d4.forward + hidden + head, "all weights, and the inputs of all layers but the first"
    assert w64d4.again == w64d4.forward - head
    assert 1.18e6 < networks.cost(networks.NETS["nerf256"]).forward < 1.19e6
    # The layer after the skip connection reads the encoding again, which needs no gradient.
    skip = networks.NETS["nerf64"].layers[5]
    assert skip.inputs == ("positions", 4)


@pytest.mark.parametrize("name", ["w64d4", "nerf64", "64-64"])
@pytest.mark.parametrize("direction", ["forward", "forward+backward"])
def test_alternatives_compute_the_same(name, direction):
    features, net = networks.LAYERS.get(name) or (None, networks.NETS[name])
    for dtype in (torch.float32, torch.bfloat16):
        tolerance = cases_network.TOLERANCE[dtype, direction]
        batch = networks.make_batch(net, 300, 5, dtype, direction, CPU, features=features)
        error, done = networks.network_error(batch), []
        for backend in ("reference", "native"):
            if voronerf.ops._core.backends.missing(backend, CPU) is None:
                contender = alternatives.ours(batch, backend)
                assert error(contender.adapt(contender.run(0))) < tolerance, backend
        for label, set_up in alternatives.alternatives(batch).items():
            try:
                contender = set_up()
            except NotApplicable as reason:
                assert "oneDNN" in label and dtype is torch.bfloat16 and "cpu support" in str(reason)
                done.append(label)
                continue
            assert error(contender.adapt(contender.run(0))) < tolerance, f"{label}, {dtype}"
            # A later call has other samples and a dense gradient.
            assert error(contender.adapt(contender.run(1))) > 0
            done.append(label)
        fastest = "oneDNN" if direction == "forward" else "torch loop, stacked"
        assert {"padded bmm", "F.grouped_mm", fastest} <= set(done)


@pytest.mark.parametrize("direction", ["forward", "forward+backward"])
def test_routes_compute_the_same(direction):
    for name in ("w64d4", "nerf64"):
        work = route.route_work(name, 300, 5, torch.float32, direction, 1e-4, CPU)
        contenders = {label: set_up() for label, set_up in work.alternatives.items()}
        assert any("masks" in label for label in contenders)
        contenders["ours"] = work.ours("reference")
        for label, contender in contenders.items():
            assert work.error(contender.adapt(contender.run(0))) < 1e-4, f"{name}, {label}"


def test_what_is_compared_is_right_in_every_small_case():
    lookup, sampling = cases_lookup, cases_sampling
    works = {
        "nearest_centre": lookup._nearest_work(500, 7, torch.float32, CPU),
        "by an index": lookup._nearest_work(500, 70, torch.float32, CPU, d=1, kind="heavy-tailed", way=lookup.MADE),
        "locate_cell": lookup._locate_work(500, (4, 3), CPU),
        "cell_sort": lookup._sort_work(500, 7, CPU),
        "resample": sampling._resample_work(512, CPU),
        "march_rays": sampling._march_work(1 << 13, False, CPU),
        "march_rays, jittered": sampling._march_work(1 << 13, True, CPU),
        "pixel_rays": cases_step.pixel_work(300, CPU),
        "render_loss": cases_step.loss_work(100, 800, CPU),
        "observe_occupancy": cases_step.observe_work(800, CPU),
        "adam": cases_step.adam_work(1000, 0.1, CPU),
    }
    for direction in ("forward", "forward+backward"):
        for op in ("frequency_encode", "spherical_harmonics"):
            works[f"{op}, {direction}"] = sampling._encode_work(op, 64, torch.float32, direction, False, CPU)
        works[f"hash_encode, {direction}"] = cases_hash.hash_work(512, 12, direction, False, CPU)
        works[f"hash + MLP, {direction}"] = cases_hash.network_work(512, direction, CPU)
        for packed in (False, True):
            work = sampling._composite_work(512, packed, direction, CPU)
            works[f"composite, packed {packed}, {direction}"] = work
    for label, work in works.items():
        contenders = {"reference": work.ours("reference")}
        for name, set_up in work.alternatives.items():
            try:
                contenders[name] = set_up()
            except case.NotApplicable as reason:
                assert not name.startswith("torch"), f"{label}, {name}: {reason}"
        assert len(contenders) > 1
        for name, contender in contenders.items():
            error = work.error(contender.adapt(contender.run(0)))
            assert error <= work.tolerance, f"{label}, {name}: {error}"
            contender.run(1)


def test_wrong_answers_are_found():
    lookup, infinite = cases_lookup, float("inf")
    nearest, marched = lookup._nearest_work(500, 7, torch.float32, CPU), cases_sampling._march_work(1 << 13, True, CPU)
    for work, spoilt, least in (
        (nearest, lambda right: (right + 1) % 7, 500),
        (nearest, lambda right: right + 7, infinite),
        (lookup._sort_work(500, 7, CPU), lambda right: (right[0].flip(0), right[1]), 1e-6),
        (marched, lambda right: right._replace(depths=right.depths * 1.1), 0.05),
        (marched, lambda right: marched.ours("reference").run(1), 0.1),  # results for the rays of another call
    ):
        right = work.ours("reference").run(0)
        assert work.error(right) < 1e-6 and work.error(spoilt(right)) >= least
    batch = networks.make_batch(networks.NETS["mlp32"], 200, 3, torch.float32, "forward+backward", CPU)
    error = networks.network_error(batch)
    out, gradients = alternatives.ours(batch, "reference").run(0)
    assert error((out, gradients)) < 1e-5
    assert error((out, (*gradients[:-1], gradients[-1] * 1.5))) > 0.1
    assert error((out * torch.nan, None)) == infinite


def test_rows_report_failures_losses_and_caps():
    def absent():
        raise case.NotApplicable("not installed")

    def broken():
        raise RuntimeError("first line\nsecond")

    def sleeper(seconds):
        return case.Contender(lambda call: time.sleep(seconds) or torch.ones(3))

    others = {"faster": lambda: sleeper(0.001), "slow": lambda: sleeper(0.4), "absent": absent, "broken": broken}
    others["wrong"] = lambda: case.Contender(lambda call: torch.zeros(3))
    error = lambda found: case.relative_error(found, torch.ones(3))  # noqa: E731
    work = case.Work(lambda backend: sleeper(0.006), others, error, 1e-3, 1e6, "")
    bench = throughput.Bench(CPU, quick=True, wanted=["reference"])
    given = "cell_sort", "x", torch.int32, "forward", 10, 2, lambda device: work
    (row,) = bench.run(case.Case(*given, backends=("reference", "native")))
    assert set(COLUMNS) <= set(row) and row["backend"] == "reference"
    assert row["alternatives"]["faster"] < row["median_ms"] and row["speedup_over_best"] < 1
    assert row["alternatives"]["slow"] >= 400 and row["notes"]["slow"] == "capped"
    assert row["alternatives"]["absent"] is None and row["notes"]["absent"] == "n/a: not installed"
    assert row["notes"]["broken"] == "n/a: RuntimeError: first line"
    assert row["alternatives"]["wrong"] is None and "error of 1 is above" in row["notes"]["wrong"]
    assert row["percent_of_peak"] is None and row["max_error"] == 0 and row["first_call_ms"] >= 6
    text = "\n".join(throughput.lines(row, last=True))
    assert "n/a: not installed" in text and "capped" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--filter", "("], "--filter must be a regular expression, got '('"),
        (["--filter", "no such row"], "--filter must leave a row, got 'no such row'"),
        (["--backends", "cutlass"], "--backends must be of reference, native, warp, got 'cutlass'"),
        (["--device", "tpu"], "--device must be cpu or cuda, got 'tpu'"),
        (["--json", "."], "--json must name a file, got the folder ."),
        (["--json", "Makefile/rows.json", "--filter", "resample"], "--json: "),
        (["--fast"], "unrecognized arguments: --fast"),
    ],
)
def test_bad_arguments_are_one_line(monkeypatch, arguments, message):
    monkeypatch.chdir(BENCHMARKS.parent)
    with pytest.raises(SystemExit) as error:
        throughput.main(arguments)
    text = str(error.value)
    assert text.startswith(f"throughput: error: {message}") and "\n" not in text


def test_throughput_runs_and_table_reads_its_result(tmp_path, capsys):
    path = tmp_path / "results" / "throughput.json"
    throughput.main(["--quick", "--filter", "^resample", "--json", str(path)])
    assert "[1/1," in capsys.readouterr().err
    outcome = read_json(path)
    metadata = outcome["metadata"]
    assert metadata["benchmark"] == "throughput" and metadata["quick"] is True and metadata["device"] == "cpu"
    assert isinstance(metadata["missing"], list) and len(metadata["load"]) == 3
    for row in outcome["results"]:
        assert list(row)[: len(COLUMNS)] == COLUMNS
        assert row["op"] == "resample" and row["unit"] == "GB/s" and row["median_ms"] > 0
        assert row["alternatives"]["torch cumsum + searchsorted"] > 0 and row["max_error"] < 1e-2
        if row["backend"] == "native":
            assert f"`resample` {row['case']}" in table.markdown([row])[-1]
    with pytest.raises(SystemExit, match=r"must be a result of throughput\.py"):
        table.load(BENCHMARKS / "results" / "time_to_quality_lego_400.json")


def test_the_table_shows_rows_that_the_benchmark_has():
    cases = throughput.chosen_cases(throughput.parse([]))
    for pattern in table.SHOWN:
        assert any(re.search(pattern, case.key) for case in cases), pattern


def test_a_disturbed_limit_does_not_flatter():
    peaks = harness.Peaks(CPU)
    assert peaks._keep("copy", 100.0) == ("copy", 100.0)
    assert peaks._keep("copy", 95.0) == ("copy", 95.0)
    assert peaks._keep("copy", 50.0) == ("copy", 100.0)
    assert peaks.found == {"copy": 100.0}
