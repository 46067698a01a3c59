"""Networks of cells as one plain layer after another, with torch's own gradients: the oracle of every backend."""

from __future__ import annotations

import functools
import itertools

import torch
from torch.nn.functional import linear, softplus

from voronerf.ops.grouped_mlp import reference

ACTIVATIONS = {
    "none": lambda z: z,
    "relu": torch.relu,
    "softplus": softplus,
    "sigmoid": torch.sigmoid,
    "sine": torch.sin,
}


def grouped_linear(x, offsets, weight, bias=None, *, activation="none"):
    y = x.new_zeros(x.shape[0], weight.shape[1])
    for cell, (start, stop) in enumerate(itertools.pairwise(offsets.tolist())):
        z = linear(x[start:stop], weight[cell], None if bias is None else bias[cell])
        y = torch.cat([y[:start], ACTIVATIONS[activation](z), y[stop:]])
    return y


grouped_mlp = functools.partial(reference.grouped_mlp, linear=grouped_linear)
