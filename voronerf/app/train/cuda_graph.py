"""A training step that is captured in a CUDA graph and replayed.

A step of small networks launches some hundred kernels, which takes the host longer than the device. A captured step is
one launch. It reads its inputs from the memory where they were at the capture: parameters and moments that are updated
in place, a learning rate in a tensor, and random numbers from generators that are registered with the graph. A split
replaces parameters by new tensors. It ends the graph, and the steps after it are captured anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

#: Steps before the capture, in which libraries choose algorithms and allocate memory, and the optimiser its moments.
WARMUP = 3


class GraphedStep:
    """Runs a step: the first ``WARMUP`` times directly, on a separate stream, afterwards as a graph.

    Args:
        step: A whole training step that does the same work each time and never waits for the device; returns tensors.
        generators: The CUDA generators that it draws from.
    """

    def __init__(self, step: Callable[[], Any], generators: Sequence[torch.Generator]) -> None:
        self.step = step
        self.generators = generators
        self.runs = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.results: Any = None

    def __call__(self) -> Any:
        """Runs one step. Every replay returns the same tensors with new contents."""
        # Streams and captures belong to the current device, which may be another one than the trainer's.
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
    """Sets the learning rate of all groups; a tensor, which a graph reads, is changed in place."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
