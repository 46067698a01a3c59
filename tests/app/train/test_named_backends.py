"""A backend that is given by name computes all of a step."""

import pytest
from tiny_runs import small

from voronerf.app.train.trainer import Trainer
from voronerf.ops._core import native


@pytest.mark.native
@pytest.mark.parametrize("occupancy", [False, True])
def test_the_reference_calls_nothing_compiled(tmp_path, scene, monkeypatch, occupancy):
    """Two steps and a split, counted at the compiled module; the native backend does call it."""
    calls = []
    real = native.compiled

    class Counted:
        def __getattr__(self, name):
            calls.append(name)
            return getattr(real, name)

    for backend in ("reference", "native"):
        config = small(tmp_path / backend, backend=backend, occupancy=occupancy, cells=(2,), field="hashgrid", depth=1)
        trainer = Trainer(config, scene)
        with monkeypatch.context() as patch:
            patch.setattr(native, "compiled", Counted())
            calls.clear()
            for _ in range(2):
                trainer.train_step()
            trainer.split()
            trainer.train_step()
        assert bool(calls) == (backend == "native"), sorted(set(calls))


def test_a_step_says_how_it_is_computed(tmp_path, scene):
    found = {}
    for name, settings in {"grid": {"occupancy": True, "occupancy_resolution": 8}, "plain": {}}.items():
        found[name] = Trainer(small(tmp_path / name, **settings), scene).learner.explain().splitlines()
    assert found["grid"][0] == "samples: Occupancy, 12 a ray, of which 100% of the grid are left"
    assert found["grid"][1].startswith("loss: networks, colours, loss and gradients in one operation, on the ")
    assert found["plain"][1:] == [
        "loss: networks, colours and loss are separate operations",
        "not faster: empty space is not skipped",
    ]
