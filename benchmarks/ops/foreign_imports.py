"""Imports files of other repositories, with PyTorch stand-ins for CUDA modules and mocks for missing packages.

The stand-ins have the signatures that the repositories call. d inputs, F features of an entry.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import math
import os
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

ENTRIES = 1 << 10  # maximum number of entries of a level


class GridEncoder(nn.Module):
    """A hash grid like torch-ngp's or tiny-cuda-nn's, whose small levels are dense with (resolution + 1)^d entries."""

    def __init__(
        self,
        input_dim: int = 3,
        num_levels: int = 16,
        level_dim: int = 2,
        per_level_scale: float = 2.0,
        base_resolution: int = 16,
        log2_hashmap_size: int = 19,
        desired_resolution: float | None = None,
        **_: Any,
    ) -> None:
        super().__init__()
        if desired_resolution is not None:
            per_level_scale = (desired_resolution / base_resolution) ** (1 / max(num_levels - 1, 1))
        self.input_dim, self.num_levels, self.init_std = input_dim, num_levels, 1e-4
        self.output_dim = self.n_output_dims = num_levels * level_dim
        self.sizes = [math.ceil(base_resolution * per_level_scale**level) + 1 for level in range(num_levels)]
        self.entries = min(ENTRIES, 1 << log2_hashmap_size)
        self.register_buffer("grid_sizes", torch.tensor(self.sizes))
        self.embeddings = nn.Parameter(torch.rand(num_levels, self.entries, level_dim) * 0.2 - 0.1)

    def forward(self, inputs: Tensor, bound: float | None = 1.0, **_: Any) -> Tensor:
        inputs = inputs if bound is None else (inputs + bound) / (2 * bound)
        x, levels = inputs.reshape(-1, self.input_dim), []
        corners = torch.tensor(list(itertools.product((0, 1), repeat=self.input_dim)), device=x.device)
        for table, size in zip(self.embeddings, self.sizes):
            low = torch.floor(x * (size - 1))
            share = (x * (size - 1) - low)[:, None]
            place, number = low.long()[:, None] + corners, torch.zeros_like(corners[:, 0])
            for axis, prime in zip(range(self.input_dim), (1, 2654435761, 805459861, 3674653429)):
                dense = size**self.input_dim <= self.entries
                number = number + place[..., axis] * size**axis if dense else number ^ place[..., axis] * prime
            weights = torch.where(corners.bool(), share, 1 - share).prod(-1)
            levels.append((table[number % self.entries] * weights[..., None]).sum(1))
        return torch.cat(levels, -1).reshape(*inputs.shape[:-1], self.output_dim)


class FreqEncoder(nn.Module):
    """A frequency encoding: sines and cosines of the octaves."""

    def __init__(self, input_dim: int = 3, degree: int = 4) -> None:
        super().__init__()
        self.degree, self.output_dim = degree, input_dim * (1 + 2 * degree)

    def forward(self, inputs: Tensor, **_: Any) -> Tensor:
        waves = [wave(inputs * 2.0**octave) for octave in range(self.degree) for wave in (torch.sin, torch.cos)]
        return torch.cat([inputs, *waves], -1)


class SHEncoder(nn.Module):
    """A stand-in for spherical harmonics: the same number of products of coordinates."""

    def __init__(self, input_dim: int = 3, degree: int = 4) -> None:
        super().__init__()
        powers = [p for p in itertools.product(range(degree), repeat=3) if sum(p) < degree]
        self.powers, self.output_dim = powers[: degree**2], degree**2
        self.n_output_dims = self.output_dim

    def forward(self, inputs: Tensor, **_: Any) -> Tensor:
        x, y, z = inputs.unbind(-1)
        return torch.stack([x**i * y**j * z**k for i, j, k in self.powers], -1)


class Network(nn.Sequential):
    """A network like tiny-cuda-nn's: layers without biases."""

    def __init__(self, n_input_dims: int, n_output_dims: int, network_config: dict[str, Any], **_: Any) -> None:
        kinds = {"ReLU": nn.ReLU, "Sigmoid": nn.Sigmoid, "None": nn.Identity}
        widths = [n_input_dims, *[network_config["n_neurons"]] * network_config["n_hidden_layers"], n_output_dims]
        layers: list[nn.Module] = []
        for i, o in itertools.pairwise(widths):
            layers += [nn.Linear(i, o, bias=False), kinds[network_config["activation"]]()]
        super().__init__(*layers[:-1], kinds[network_config["output_activation"]]())


class UnitGrid(GridEncoder):
    """A grid like tiny-cuda-nn's: positions lie in [0, 1]."""

    def forward(self, inputs: Tensor) -> Tensor:
        return super().forward(inputs, bound=None)


def encoding(n_input_dims: int, encoding_config: dict[str, Any], **_: Any) -> nn.Module:
    """Returns the stand-in for an encoding of tiny-cuda-nn."""
    config = encoding_config.get("nested", [encoding_config])[0]
    if "n_levels" not in config:
        return SHEncoder(degree=config["degree"])
    return UnitGrid(
        n_input_dims,
        config["n_levels"],
        config["n_features_per_level"],
        config["per_level_scale"],
        config["base_resolution"],
        config["log2_hashmap_size"],
    )


def encoded_network(
    n_input_dims: int, n_output_dims: int, encoding_config: dict[str, Any], network_config: dict[str, Any], **_: Any
) -> nn.Module:
    """Returns the stand-in for a network with an encoding of tiny-cuda-nn."""
    first = encoding(n_input_dims, encoding_config)
    return nn.Sequential(first, Network(int(first.n_output_dims), n_output_dims, network_config))


def repeated(x: Tensor, pattern: str, sample: int) -> Tensor:
    """Replaces ``einops.repeat`` for the only pattern in use."""
    assert pattern == "batch feature -> batch sample feature"
    return x[:, None].expand(-1, sample, -1)


STAND_INS: dict[str, dict[str, Any]] = {
    "tinycudann": {"Encoding": encoding, "Network": Network, "NetworkWithInputEncoding": encoded_network},
    "gridencoder": {"GridEncoder": GridEncoder},
    "hashencoder": {"HashEncoder": GridEncoder},
    "hashencoder.hashgrid": {"HashEncoder": GridEncoder, "_hash_encode": None},
    "freqencoder": {"FreqEncoder": FreqEncoder},
    "shencoder": {"SHEncoder": SHEncoder},
    "einops": {"repeat": repeated, "rearrange": None, "reduce": None},
}
ABSENT = (
    "raymarching",
    "psencoder",
    "torchsearchsorted",
    "hash_encoding",
    "internal.datasets",
    "external.pohsun_ssim",
    "deepctr_torch.models",
    "deepctr_torch.utils",
)
"""Modules that compile, use CUDA or call servers at import, need an older numpy, or belong to other repositories."""


@contextlib.contextmanager
def repository(folder: Path) -> Iterator[Callable[[str], Any]]:
    """Imports files of a folder; removes their modules from ``sys.modules`` at the end."""
    modules, path = dict(sys.modules), list(sys.path)
    for name, members in STAND_INS.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(members)
    for name in ABSENT:
        sys.modules[name] = _absent(name)
    sys.modules["gin"] = mock.MagicMock(configurable=_unchanged)
    sys.path.insert(0, str(folder))
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(mock.patch("torch.utils.cpp_extension.load"))
            stack.enter_context(mock.patch.object(sys, "argv", sys.argv[:1]))  # scripts parse it at import
            stack.enter_context(mock.patch.dict(os.environ, DDE_BACKEND="pytorch"))  # DeepXDE would write a file
            stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            yield _imported
    finally:
        sys.path[:] = path
        for name in [name for name, module in sys.modules.items() if _foreign(name, module, folder)]:
            del sys.modules[name]
        sys.modules.update(modules)


def _imported(name: str) -> Any:
    """Imports a file; mocks replace its missing imports."""
    while True:
        try:
            imported = importlib.import_module(name)
            torch.autograd.set_detect_anomaly(False)  # KiloNeRF sets it, which makes every step five times as slow
            return imported
        except ModuleNotFoundError as error:
            if error.name is None or name.startswith(error.name):
                raise
            sys.modules[error.name] = _absent(error.name)


def _unchanged(made: Any = None) -> Any:
    """Replaces a decorator, with or without parentheses, by one that does nothing."""
    return made or _unchanged


def _absent(name: str) -> Any:
    return mock.MagicMock(__spec__=importlib.machinery.ModuleSpec(name, None), __path__=[], __name__=name)


def _foreign(name: str, module: Any, folder: Path) -> bool:
    if name in STAND_INS or isinstance(module, mock.MagicMock):
        return True
    spec = getattr(module, "__spec__", None)
    places = (
        [spec.origin, *(spec.submodule_search_locations or ())] if spec else []
    )  # a folder without __init__.py has no origin
    return any(str(place).startswith(str(folder)) for place in places)
