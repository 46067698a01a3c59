"""Layers and networks as plain loops over cells, differentiated by torch: the oracle for every backend."""

from __future__ import annotations

import itertools

import torch
from torch.nn.functional import linear, softplus

from voronerf.ops._core.encodings import ENCODINGS, wide
from voronerf.ops._core.layers import DIRECTIONS, POSITIONS

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


def encoded(x, layers, source):
    encoding = layers.encoding(source)
    return x if encoding is None else ENCODINGS[encoding[0]].formula(wide(x), encoding[1])


def grouped_mlp(positions, offsets, weights, biases, *, layers, directions=None, direction_index=None):
    sources = {POSITIONS: encoded(positions, layers, POSITIONS).to(weights[0].dtype)}
    if layers.uses_directions:
        seen = encoded(directions, layers, DIRECTIONS).to(weights[0].dtype)
        sources[DIRECTIONS] = seen if direction_index is None else seen[direction_index]
    for index, (layer, weight, bias) in enumerate(zip(layers.layers, weights, biases)):
        x = torch.cat([sources[source] for source in layer.inputs], dim=1)
        sources[index] = grouped_linear(x, offsets, weight, bias, activation=layer.activation)
    return torch.cat([sources[index] for index in layers.outputs], dim=1)
