"""A training step that is captured in a CUDA graph and replayed.

A step of small networks is some hundred launches, which take the host longer than the device. A captured step is one.
It reads its inputs where they were when it was captured: parameters and moments that are updated in place, a learning
rate in a tensor, and random numbers that are drawn on the device by generators the graph knows of. What changes tensors
for others, as a split does, ends a graph; the next one is captured from the steps after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

#: Steps before the capture: libraries choose algorithms and allocate what they keep, the optimiser makes its moments.
WARMUP = 3


class GraphedStep:
    """Runs a step: as it is for the first ``WARMUP`` times, on a stream of its own, then as a graph.

    Args:
        step: A whole training step, the same work each time, that reads nothing on the host; returns tensors.
        generators: CUDA generators that it draws from.
    """

    def __init__(self, step: Callable[[], Any], generators: Sequence[torch.Generator]) -> None:
        self.step = step
        self.generators = generators
        self.runs = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.results: Any = None

    def __call__(self) -> Any:
        """One step. A replay's results are the same tensors each time, with new contents."""
        # Streams and captures are those of the current device, which need not be the trainer's.
        with torch.cuda.device(self.generators[0].device):
            return self._run()

    def _run(self) -> Any:
        if self.runs < WARMUP:
            self.runs += 1
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                results = self.step()
            torch.cuda.current_stream().wait_stream(side)
            return results
        if self.graph is None:
            self.graph = torch.cuda.CUDAGraph()
            for generator in self.generators:
                self.graph.register_generator_state(generator)
            with torch.cuda.graph(self.graph):
                self.results = self.step()
        self.graph.replay()
        return self.results


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """The learning rate of all groups, in place where it is a tensor that a graph reads."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
