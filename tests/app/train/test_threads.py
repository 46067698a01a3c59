"""Steps of training are the same bit for bit on any number of threads, or a line says that they are not."""

from dataclasses import replace

import pytest
import torch
from helpers import on_any_number_of_threads
from tiny_runs import small, tensors

from voronerf.app.train.trainer import Trainer
from voronerf.ops._core import backends

PROPOSAL = {"sampling": "proposal"}
VARIANTS = {
    "nerf": {},
    "hierarchical": {"sampling": "hierarchical"},
    "proposal": PROPOSAL,
    "cones": {"field": "mipnerf", "contraction": "sphere", **PROPOSAL},
    "half": {"precision": "bf16", "assignment": "stochastic"},
    "hash grid": {"field": "hashgrid", "width": 16, "average": 0.9},
    "hash grid in a sphere": {"field": "hashgrid", "width": 16, "contraction": "sphere"},
    "hash grid with occupancy": {"field": "hashgrid", "width": 16, "occupancy": True},
}


def trained(out, scene, **settings):
    """A training of four steps, split after the second."""
    # Torch shares work on 32,768 elements and more among threads, here in parts of odd sizes.
    few = {"steps": 4, "rays": 521, "samples": 67, "evaluations": 1, "depth": 1, "split_at_steps": (2,)}
    trainer = Trainer(small(out, **{**few, **settings}), scene)
    trainer.advance()
    trainer.save()
    return trainer


@pytest.mark.parametrize("variant", VARIANTS)
def test_steps_do_not_depend_on_threads(tmp_path, scene, variant):
    runs = iter(range(2))

    def run():
        out = tmp_path / str(next(runs))
        trained(out, scene, **VARIANTS[variant])
        return [tensor for _, tensor in sorted(tensors(out).items())]

    on_any_number_of_threads(run, (1, 3))


def test_a_change_of_threads_is_said_where_torch_computes(tmp_path, scene):
    before = torch.get_num_threads()
    for backend, expected in (("auto", []), ("reference", [f"on {before} threads, now there are {before + 1}"])):
        said: list[str] = []
        config = trained(tmp_path / backend, scene, backend=backend, rays=16, samples=8).config
        torch.set_num_threads(before + 1)
        try:
            Trainer(replace(config, resume=True), scene, on_event=said.append)
        finally:
            torch.set_num_threads(before)
        assert len(said) == len(expected) and all(part in line for part, line in zip(expected, said))


def test_torch_on_one_thread():
    """Also one in another; ops keep their threads."""
    before = torch.get_num_threads()
    with backends.torch_on_one_thread():
        with backends.torch_on_one_thread():
            assert (torch.get_num_threads(), backends.threads()) == (1, before)
        assert (torch.get_num_threads(), backends.threads()) == (1, before)
    assert (torch.get_num_threads(), backends.threads()) == (before, before)
