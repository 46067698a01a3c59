"""Times one network per label on one thread, computed by a router, by ``vmap``, by ``baddbmm``, and by a loop.

Beside them stands one network that gets all rows, in a router of one cell.

Also compares optimisers for many labels of which a batch holds few.

    python benchmarks/groups.py --json benchmarks/results/groups.json

The networks are SIRENs with three layers of width 32. Rows are sorted by label, with the same number per label, so that
the alternatives need neither a sort nor padding. The benchmark first checks that all methods compute the same values. A
call runs forward and backward. The last row is a step with Adam on 1,000 images; then the router trains for ``--steps``
steps, and its PSNR is stored. Times are median processor times in milliseconds; the methods take turns.

The optimisers update `KEYS` networks with the layers 8, 16, 1; a batch has `BATCH` rows with random labels. Each
optimiser also trains a tenth of that number of networks to ``tanh(a[label] @ x)``, for each seed and each learning rate
of `RATES`. Every tenth network is silent: it gets samples in the first `HEARD` steps only, and none in the next
`SILENT` steps. For the rate with the smallest error, two figures are stored, both means over the seeds: the mean
squared error of the other networks on new samples, and the relative change of the silent networks in the `SILENT`
steps, ``|after - before| / |before|`` in percent.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import Stopwatch, measure, threads, write_results
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from voronerf import VoronoiRouter
from voronerf.nerf import Adam

SIZES = ((64, 8), (64, 1024), (1024, 64), (1024, 256), (4096, 16))
IMAGES, PIXELS, SIDE = 1000, 256, 32
KEYS, BATCH, HEARD, SILENT, SEEDS = 20_000, 256, 100, 1000, 3
RATES = (0.003, 0.01, 0.03, 0.1)
Run = Callable[[Tensor], Tensor]
Parameters = list[nn.Parameter]
OPTIMIZERS: dict[str, Callable[[Parameters, float], torch.optim.Optimizer]] = {
    "torch.optim.Adam": lambda parameters, rate: torch.optim.Adam(parameters, lr=rate),
    "torch.optim.Adam, fused=True": lambda parameters, rate: torch.optim.Adam(parameters, lr=rate, fused=True),
    "torch.optim.AdamW": lambda parameters, rate: torch.optim.AdamW(parameters, lr=rate),
    "voronerf.nerf.Adam, sparse=True": lambda parameters, rate: Adam([{"params": parameters, "sparse": True}], lr=rate),
}


@dataclass(frozen=True)
class Options:
    """The settings of the benchmark."""

    seconds: float = 4.0
    """Seconds of measurement for each method of a row."""
    steps: int = 500
    """Steps of the training on images."""
    json: Path | None = None
    """The JSON file of the results. Default: results are only printed."""


class Siren(nn.Module):
    """A SIREN from two coordinates in -1..1 to a colour."""

    def __init__(self, width: int = 32, frequency: float = 10.0) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(i, width) for i in (2, width, width)])
        self.last, self.frequency = nn.Linear(width, 3), frequency

    def forward(self, x: Tensor) -> Tensor:
        """Returns colours [..., 3] of coordinates [..., 2]."""
        x = x * self.frequency
        for layer in self.layers:
            x = torch.sin(layer(x))
        return self.last(x)


def ways(k: int) -> dict[str, tuple[Parameters, Run]]:
    """Returns {method: (parameters, function [k, rows, 2] -> [k, rows, 3])}.

    All methods have the same k networks, except "one", which has the first of them.
    """
    modules = [Siren() for _ in range(k)]
    router = VoronoiRouter.from_modules(modules, fuse=True)
    labels = torch.arange(k)[:, None]
    one = VoronoiRouter(modules[0], torch.zeros(1, 2), coords="first2", fuse=True)

    stacked = {name: nn.Parameter(value.detach()) for name, value in stack_module_state(modules)[0].items()}
    mapped = vmap(lambda parameters, x: functional_call(modules[0], parameters, (x,)))

    every = [[*module.layers, module.last] for module in modules]
    weights = [nn.Parameter(torch.stack([layer.weight.detach().t() for layer in place])) for place in zip(*every)]
    biases = [nn.Parameter(torch.stack([layer.bias.detach()[None] for layer in place])) for place in zip(*every)]

    def by_hand(x: Tensor) -> Tensor:
        x = x * modules[0].frequency
        for weight, bias in zip(weights[:-1], biases[:-1]):
            x = torch.sin(torch.baddbmm(bias, x, weight))
        return torch.baddbmm(biases[-1], x, weights[-1])

    def loop(x: Tensor) -> Tensor:
        return torch.stack([module(rows) for module, rows in zip(modules, x)])

    return {
        "router": (list(router.parameters()), lambda x: router(x, cells=labels.expand(k, x.shape[1]))),
        "one": (list(one.parameters()), one),
        "vmap": (list(stacked.values()), lambda x: mapped(stacked, x)),
        "baddbmm": ([*weights, *biases], by_hand),
        "loop": ([p for module in modules for p in module.parameters()], loop),
    }


def pictures() -> Tensor:
    """Draws images [IMAGES, SIDE * SIDE, 3]: a smooth background with a disc in front."""
    smooth = nn.functional.interpolate(torch.rand(IMAGES, 3, 6, 6), SIDE, mode="bicubic", align_corners=True)
    centre, size = torch.rand(IMAGES, 1, 2) * 1.2 - 0.6, 0.2 + 0.3 * torch.rand(IMAGES, 1)
    inside = (grid() - centre).norm(dim=-1) < size
    return torch.where(inside[..., None], torch.rand(IMAGES, 1, 3), smooth.flatten(2).mT.clamp(0, 1))


def grid() -> Tensor:
    """Returns the coordinates [SIDE * SIDE, 2] of all pixels."""
    line = torch.linspace(-1, 1, SIDE)
    return torch.cartesian_prod(line, line)


def step(run: Run, parameters: Parameters, images: Tensor) -> Callable[[int], None]:
    """Returns a function that runs a step of Adam on random pixels of each image; its argument is the step's number."""
    optimizer, places = torch.optim.Adam(parameters, lr=1e-2, fused=True), grid()

    def once(number: int) -> None:
        chosen = torch.randint(SIDE * SIDE, (IMAGES, PIXELS), generator=torch.Generator().manual_seed(number))
        colours, target = run(places[chosen]), images.gather(1, chosen[..., None].expand(-1, -1, 3))
        optimizer.zero_grad()
        (colours - target).square().mean((1, 2)).sum().backward()
        optimizer.step()

    return once


def call(run: Run, parameters: Parameters, x: Tensor) -> Callable[[int], None]:
    """Returns a function that runs forward and backward."""

    def once(_: int) -> None:
        run(x).square().sum().backward()
        for parameter in parameters:
            parameter.grad = None

    return once


def row(options: Options, k: int, rows: int, images: Tensor | None = None) -> dict[str, Any]:
    """Measures k networks with ``rows`` rows each: calls, or steps with Adam if ``images`` are given."""
    contenders, x = ways(k), torch.rand(k, rows, 2) * 2 - 1
    expected = contenders["loop"][1](x)
    for name, (_, run) in contenders.items():
        if name != "one":
            torch.testing.assert_close(run(x), expected, atol=1e-4, rtol=1e-4)
    runs = {
        name: call(run, parameters, x) if images is None else step(run, parameters, images)
        for name, (parameters, run) in contenders.items()
    }
    for once in runs.values():
        once(0)
    timings = measure(runs, dict.fromkeys(runs, options.seconds), Stopwatch(torch.device("cpu"), time.process_time))
    result: dict[str, Any] = {f"{name}_ms": round(timing.median_ms, 2) for name, timing in timings.items()}
    best = min(timing.median_ms for name, timing in timings.items() if name not in ("router", "one"))
    result |= {"times_as_fast": round(best / timings["router"].median_ms, 2)}
    if images is not None:
        parameters, run = ways(k)["router"]  # the timed router has made steps already
        once = step(run, parameters, images)
        for number in range(options.steps):
            once(number)
        with torch.no_grad():
            error = (run(grid().expand(k, -1, -1)) - images).square().mean((1, 2))
        result |= {"steps": options.steps, "psnr": round(float((-10 * error.log10()).mean()), 2)}
    return {"networks": k, "rows": rows, "step": images is not None, **result}


def network() -> nn.Module:
    """Returns the module of one label for the comparison of optimisers."""
    return nn.Sequential(nn.Linear(8, 16), nn.Tanh(), nn.Linear(16, 1))


def step_times(options: Options) -> dict[str, float]:
    """Measures forward and backward of `KEYS` networks with a batch, and the step of each optimiser."""
    router = VoronoiRouter(network(), KEYS, fuse=True)
    batches = [(torch.randn(BATCH, 8), torch.randint(KEYS, (BATCH,))) for _ in range(4)]

    def differentiate(number: int) -> None:
        x, labels = batches[number % len(batches)]
        router.zero_grad()
        router(x, cells=labels).square().mean().backward()

    gradients = []
    for number in range(len(batches)):
        differentiate(number)
        gradients.append([parameter.grad for parameter in router.parameters()])

    def stepper(name: str) -> Callable[[int], None]:
        parameters = [nn.Parameter(parameter.detach().clone()) for parameter in router.parameters()]
        optimizer = OPTIMIZERS[name](parameters, 0.001)

        def step(number: int) -> None:
            for parameter, gradient in zip(parameters, gradients[number % len(gradients)]):
                parameter.grad = gradient
            optimizer.step()

        return step

    runs = {"forward and backward": differentiate, **{name: stepper(name) for name in OPTIMIZERS}}
    for run in runs.values():
        run(0)
    timings = measure(runs, dict.fromkeys(runs, options.seconds), Stopwatch(torch.device("cpu"), time.process_time))
    return {name: round(timing.median_ms, 2) for name, timing in timings.items()}


def learn(name: str, rate: float, seed: int) -> tuple[float, float]:
    """Trains networks; returns the error of the others and the relative change of the silent ones in percent."""
    torch.manual_seed(seed)
    labels = torch.arange(KEYS // 10)
    silent, others = labels[labels % 10 == 0], labels[labels % 10 > 0]
    directions = torch.randn(len(labels), 8)
    router = VoronoiRouter(network(), len(labels), fuse=True)
    optimizer = OPTIMIZERS[name](list(router.parameters()), rate)

    def error(allowed: Tensor, rows: int = BATCH) -> Tensor:
        cells, x = allowed[torch.randint(len(allowed), (rows,))], torch.randn(rows, 8)
        target = (directions[cells] * x).sum(-1, keepdim=True).tanh()
        return (router(x, cells=cells) - target).square().mean()

    def train(allowed: Tensor, steps: int) -> Tensor:
        for _ in range(steps):
            optimizer.zero_grad()
            error(allowed).backward()
            optimizer.step()
        return torch.cat([parameter.detach()[silent].flatten(1) for parameter in router.parameters()], 1)

    before, after = train(labels, HEARD), train(others, SILENT)
    change = (after - before).norm(dim=1) / before.norm(dim=1)
    with torch.no_grad():
        return float(error(others, 20_000)), 100 * float(change.mean())


def optimizers(options: Options) -> list[dict[str, Any]]:
    """Measures the steps of all optimisers, and trains networks by each of them."""
    common, times = {"keys": KEYS, "batch": BATCH}, step_times(options)
    results: list[dict[str, Any]] = [{"optimizer": name, **common, "ms": ms} for name, ms in times.items()]
    for result in results[1:]:
        outcomes = {rate: [learn(result["optimizer"], rate, seed) for seed in range(SEEDS)] for rate in RATES}
        means = {rate: [round(sum(column) / SEEDS, 4) for column in zip(*pairs)] for rate, pairs in outcomes.items()}
        rate = min(means, key=lambda rate: means[rate][0])
        result |= {"rate": rate, "error": means[rate][0], "silent_change_percent": means[rate][1], "seeds": SEEDS}
        result |= {"errors_by_rate": {str(rate): mean[0] for rate, mean in means.items()}}
    return results


def main(options: Options) -> None:
    """Prints a line for each row and writes the results."""
    torch.manual_seed(0)
    results = []
    with threads(1):
        for k, rows in SIZES:
            results.append(row(options, k, rows))
            print(results[-1], flush=True)
        results.append(row(options, IMAGES, PIXELS, pictures()))
        print(results[-1], flush=True)
        for result in optimizers(options):
            results.append(result)
            print(result, flush=True)
        write_results(options.json, results, benchmark="groups")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
