"""Gradients of tables as ranks tell them: with and without the compiled module."""

import pytest
import torch
from helpers import seeded

from voronerf.ops import add_entries, pack_entries


@pytest.mark.parametrize("n", [1, 31, 32, 33, 100, 5000])
def test_what_ranks_tell_adds_up(n):
    """The message is the same bit for bit by both ways, and short where few entries are touched."""
    generator, found = seeded(), []
    gradients = torch.randn(3, n, generator=generator) * (torch.rand(3, n, generator=generator) < 0.3)
    gradients[2] = 1
    for backend in ("auto", "reference"):
        messages = [pack_entries(gradient, backend=backend) for gradient in gradients]
        found.append([*messages, add_entries(messages, n, backend=backend)])
    assert all(a.view(torch.int32).equal(b.view(torch.int32)) for a, b in zip(*found, strict=True))
    assert found[0][-1].equal(gradients[0] + gradients[1] + gradients[2])
    assert len(found[0][2]) == n and (n < 100 or len(found[0][0]) < n / 2)


def test_a_message_of_another_table():
    pytest.importorskip("voronerf.native", reason="the extension is not built")
    message = pack_entries(torch.cat((torch.ones(700), torch.zeros(4300))))
    with pytest.raises(ValueError, match="must be as long as its bits tell, got 858 numbers for 5000"):
        add_entries([torch.cat((message, torch.zeros(1)))], 5000)
