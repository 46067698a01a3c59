"""Tests of data-parallel training: two or three processes of this machine."""

import os
import socket
import sys

import pytest
import torch
from helpers import python

needs_gloo = pytest.mark.skipif(
    not (torch.distributed.is_available() and torch.distributed.is_gloo_available()), reason="needs gloo"
)

#: The collectives, with tensors that differ in each process, checked against the tensors of all processes. The first
#: process loads torch once for all.
COLLECTIVES = """
import gc, os, sys
import torch
from voronerf import OccupancyGrid
from voronerf.nerf import Ranks

gc.freeze()  # otherwise each process collects the garbage of torch at its end
rank = next((rank for rank in (1, 2) if not os.fork()), 0)
os.environ["RANK"] = str(rank)
ranks = Ranks.join()
assert (ranks.rank, ranks.size) == (rank, 3)
drawn = [
    [torch.randn(shape, generator=torch.Generator().manual_seed(rank)) for shape in ((), (3, 4), (40_000, 2))]
    for rank in range(ranks.size)
]
tensors = [tensor.clone() for tensor in drawn[ranks.rank]] + [drawn[ranks.rank][1].clone().T]
ranks.average(tensors)
for place, tensor in enumerate(tensors[:3]):
    torch.testing.assert_close(tensor, sum(each[place] for each in drawn) / ranks.size)
torch.testing.assert_close(tensors[3], tensors[1].T)
rows = ranks.gather(drawn[ranks.rank][1][: ranks.rank + 1])
assert torch.equal(rows, torch.cat([each[1][: rank + 1] for rank, each in enumerate(drawn)]))
most = drawn[ranks.rank][1].clone()
ranks.maximum(most)
assert torch.equal(most, torch.stack([each[1] for each in drawn]).amax(0))
assert ranks.first(ranks.rank) == 0
seed = torch.tensor([2**31 - 1], dtype=torch.int32)
assert [int(ranks.seed(seed) == seed)] == [ranks.rank == 0]
grid = OccupancyGrid(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), (3, 1, 1), threshold=0.4)
grid.merge(ranks)
kept = grid.density[0].item()
grid.density[1] = 0.125 * (ranks.rank + 1)  # all see less than before
if ranks.rank == 1:
    grid.density[2] = 0.25  # one sees less
grid.merge(ranks)
assert grid.density.flatten().tolist() == [kept, 0.375, 0.25], grid.density
assert grid.occupied.flatten().tolist() == [True, False, False]
sys.setswitchinterval(1000)  # Python ends before another thread can free the last tensors
for _ in range(20):
    ranks.maximum(torch.ones(2))
assert rank or [os.wait()[1] for _ in (1, 2)] == [0, 0]
"""

#: A training with a split, updates of the grid and a learning start, which prints a checksum of its networks.
TRAINING = """
import hashlib
import sys

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import TrainConfig, build, train
from voronerf.nerf import Ranks

ranks = Ranks.join()
scene = builtin_scene(24, train_views=6, test_views=2)
state = build(TrainConfig(steps=500, cells=(4,), split_at=(130,), rays=256), scene, ranks=ranks)
train(state)
tensors = [*state.renderer.field.state_dict().values(), state.sampler.grid.density, state.sampler.grid.occupied]
text = b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)
digest, ray = hashlib.sha256(text).hexdigest(), float(state.batches.draw(1, state.draws).rays.directions.sum())
held = f"{state.router.num_cells} {state.rays_done} {digest}"
sys.stdout.write(f"rank {ranks.rank} {held}\\nrays {ranks.rank} {ray}\\n")
explained = state.training_step.explain()
assert "replayed" in explained and "in Python: average" in explained, explained
"""


@needs_gloo
@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_collectives_give_the_numbers_of_all_processes():
    with socket.create_server(("localhost", 0)) as free:
        port = str(free.getsockname()[1])
    python("-c", COLLECTIVES, env={**os.environ, "WORLD_SIZE": "3", "MASTER_ADDR": "localhost", "MASTER_PORT": port})


@pytest.mark.slow
@needs_gloo
@pytest.mark.skipif(sys.platform == "win32", reason="torchrun needs libuv on Windows")
def test_processes_hold_equal_networks_and_draw_other_rays(tmp_path):
    (script := tmp_path / "script.py").write_text(TRAINING)
    said = python("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", script)
    lines = [line.split() for line in said.splitlines()]
    results = {tuple(words[2:]) for words in lines if words[0] == "rank"}
    assert len(results) == 1 and next(iter(results))[0] == "4", lines
    assert len({words[2] for words in lines if words[0] == "rays"}) == 2, lines
