"""Tests of kernels under stress: several Python threads, forked children, thread counts, NaN and infinity."""

import sys
import threading

import pytest
import torch
from helpers import python, same, seeded

import voronerf as v
from voronerf.ops._core.layers import MLP, Layer

pytestmark = pytest.mark.native

LAYERS = MLP((Layer(("positions",), 7, "sine"),), (0,))


def halves(points):
    return torch.tensor([0, len(points) // 2, len(points)], dtype=torch.int32)


def network(points, weight):
    return v.grouped_linear(points, halves(points), weight)


def calls(seed):
    generator = seeded(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    points, centres, weight = rand(5000, 3), rand(400, 3), rand(2, 7, 3)
    ray, rgb, edges = [rand(100, 50) for _ in range(3)], rand(100, 50, 3), rand(100, 51).sort(dim=1).values
    cells = v.nearest_centre(points, centres)

    def gradient():
        leaf = weight.clone().requires_grad_()
        return torch.autograd.grad(network(points, leaf).square().sum(), leaf)

    return [
        lambda: (v.nearest_centre(points, centres),),
        lambda: v.cell_sort(cells, 400),
        lambda: (network(points, weight),),
        lambda: (v.grouped_mlp(points, halves(points), [weight], [None], layers=LAYERS),),
        gradient,
        lambda: (v.frequency_encode(points, 6),),
        lambda: tuple(v.composite(ray[0], rgb, ray[1], ray[2])),
        lambda: (v.resample(ray[0], edges, 30),),
    ]


def test_calls_from_several_python_threads_at_once():
    everything = [calls(seed) for seed in range(4)]
    expected = [[call() for call in own] for own in everything]
    wrong = []

    def work(index):
        try:
            torch.set_num_threads(1 + index % 2)
            for _ in range(5):
                for i, call in enumerate(everything[index]):
                    if not same(call(), expected[index][i]):
                        wrong.append((index, i))
        except Exception as error:  # a thread's exception is lost otherwise
            wrong.append(error)

    before = torch.get_num_threads()
    threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    torch.set_num_threads(before)
    assert not wrong


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and counts threads in /proc")
def test_threads_of_a_process_and_of_its_forked_child():
    """Kernels start exactly the threads of `set_num_threads`.

    A forked child works on one thread after its parent used several; with more it would wait for parent threads.
    """
    code = """
import os, torch, voronerf
torch.set_num_threads(1)
points, centres = torch.rand(50000, 3), torch.rand(16, 3)
before = len(os.listdir("/proc/self/task"))
expected = voronerf.nearest_centre(points, centres)
voronerf.cell_sort(expected, 16)
assert len(os.listdir("/proc/self/task")) == before
torch.set_num_threads(3)
voronerf.nearest_centre(points, centres)
assert len(os.listdir("/proc/self/task")) == before + 2
child = os.fork()
if child == 0:
    torch.set_num_threads(1)
    cells = voronerf.nearest_centre(points, centres)
    order, offsets = voronerf.cell_sort(cells, 16)
    out = voronerf.grouped_linear(points[order.long()], offsets, torch.rand(16, 8, 3))
    os._exit(0 if torch.equal(cells, expected) and out.isfinite().all() else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    python("-c", code)
