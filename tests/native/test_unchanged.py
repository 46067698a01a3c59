"""The change guard of routers, fields and steps detects every change of a watched object, and nothing else."""

from __future__ import annotations

import contextlib
import functools
import gc
import weakref

import pytest
import torch
from test_calls import without_the_exchange

from voronerf.ops._core import backends
from voronerf.ops._core.unchanged import Stale, Values, unchanged

pytestmark = pytest.mark.native


class Thing:
    def __init__(self):
        self.rate, self.name, self.held, self.made = 0.5, "thing", [1, object()], torch.zeros(3, 2)


def notes(guard, thing, tensors, table):
    guard.contents(vars(thing), ["made"])
    guard.contents(thing.held)
    guard.contents(table)
    guard.entries(vars(thing), ["rate", "absent"])
    guard.attributes(thing, ["name", "missing"])
    guard.answer(torch.is_grad_enabled)
    guard.layout(tensors["here"])
    guard.place(tensors["place"])
    guard.kind(tensors, "kind")
    guard.attributes(tensors["read"], ["_version"])


SAME = {
    "nothing": lambda thing, tensors, table: None,
    "a free entry": lambda thing, tensors, table: setattr(thing, "made", None),
    "equal numbers and texts": lambda thing, tensors, table: vars(thing).update(
        rate=1 / 2, name="".join(["th", "ing"])
    ),
    "values of a tensor": lambda thing, tensors, table: tensors["here"].zero_(),
    "another tensor of the kind": lambda thing, tensors, table: tensors.update(kind=torch.ones(4, 2)),
    "other memory of the kind": lambda thing, tensors, table: setattr(tensors["kind"], "data", torch.ones(4, 2)),
    "another shape in its place": lambda thing, tensors, table: tensors["place"].t_(),
}
CHANGED = {
    "a number": lambda thing, tensors, table: setattr(thing, "rate", 0.25),
    "a number of another type": lambda thing, tensors, table: thing.held.__setitem__(0, True),
    "a text": lambda thing, tensors, table: setattr(thing, "name", "other"),
    "an entry that is new": lambda thing, tensors, table: setattr(thing, "absent", 1),
    "an attribute that is new": lambda thing, tensors, table: setattr(type(thing), "missing", 1),
    "a longer list": lambda thing, tensors, table: thing.held.append(1),
    "a shorter list": lambda thing, tensors, table: thing.held.pop(),
    "an object of a list": lambda thing, tensors, table: thing.held.__setitem__(1, object()),
    "a key": lambda thing, tensors, table: table.update(second=table.pop("first")),
    "an equal list": lambda thing, tensors, table: table.update(first=[]),
    "an answer": lambda thing, tensors, table: torch.set_grad_enabled(False),
    "a place": lambda thing, tensors, table: setattr(tensors["place"], "data", torch.ones(2, 3)),
    "memory of a layout": lambda thing, tensors, table: setattr(tensors["here"], "data", torch.ones(2, 3)),
    "strides of a layout": lambda thing, tensors, table: tensors["here"].as_strided_((2, 3), (1, 2)),
    "a shape of a kind": lambda thing, tensors, table: setattr(tensors["kind"], "data", torch.ones(2, 4)),
    "a dtype of a kind": lambda thing, tensors, table: tensors.update(kind=torch.ones(4, 2).double()),
    "no tensor of a kind": lambda thing, tensors, table: tensors.pop("kind"),
    "values that are read": lambda thing, tensors, table: tensors["read"].add_(1),
}


def exchange(there):
    """Makes the guard use torch's tensor exchange API, or only Python's methods."""
    return contextlib.nullcontext() if there else without_the_exchange()


@pytest.mark.parametrize("there", [True, False], ids=["exchange", "methods"])
@pytest.mark.parametrize("name", [*SAME, *CHANGED])
def test_what_is_noted_is_followed(name, there):
    kind = type("Own", (Thing,), {})
    thing, table = kind(), {"first": []}
    tensors = {"here": torch.zeros(2, 3), "place": torch.zeros(2, 3), "kind": torch.zeros(4, 2), "read": torch.zeros(2)}
    with exchange(there), torch.set_grad_enabled(True):
        guard = unchanged()
        notes(guard, thing, tensors, table)
        assert guard.holds()
        (SAME | CHANGED)[name](thing, tensors, table)
        assert guard.holds() == (name in SAME)


def test_memory_that_a_tensor_has_left_is_not_given_to_another():
    guard, tensor = unchanged(), torch.zeros(1 << 20)
    guard.place(tensor)
    tensor.data = torch.zeros(1)
    assert torch.zeros(1 << 20).data_ptr() != 0 and not guard.holds()
    tensor.data = torch.zeros(1 << 20)
    assert not guard.holds()


def test_without_the_compiled_module_nothing_is_known():
    guard = Stale()
    notes(guard, Thing(), dict.fromkeys(("here", "place", "kind", "read"), torch.zeros(2)), {})
    assert not guard.holds()


def test_who_asks_is_freed_with_what_is_noted():
    """Python frees the reference cycle of a guard and an object that hold each other."""
    thing = Thing()
    thing.guard = unchanged()
    notes(thing.guard, thing, dict.fromkeys(("here", "place", "kind", "read"), thing.made), {})
    thing.guard.answer(functools.partial(getattr, thing, "name"))
    gone = weakref.ref(thing)
    del thing
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("note", ["place", "layout", "values"])
def test_who_asks_is_freed_with_the_tensors_that_are_noted(note):
    """Python frees the reference cycle of a guard and a tensor with an attribute that holds the guard."""
    tensor = torch.zeros(3)
    tensor.guard = unchanged()
    getattr(tensor.guard, note)(tensor, *[tensor.clone()] * (note == "values"))
    gone = weakref.ref(tensor)
    del tensor
    gc.collect()
    assert gone() is None


def of_inference(tensor):
    with torch.inference_mode():
        return tensor.clone()


#: Tensors whose values a guard notes.
NOTED = {
    "a vector": lambda: torch.arange(8.0),
    "a number": lambda: torch.tensor(2.0),
    "no entries": lambda: torch.zeros(0, 3),
    "a transposed matrix": lambda: torch.arange(6.0).reshape(2, 3).T,
    "one number many times": lambda: torch.tensor(2.0).expand(4, 3),
    "every second entry": lambda: torch.arange(8)[::2],
    "flags": lambda: torch.tensor([True, False]),
    "complex numbers": lambda: torch.tensor([1j, 2.0]),
    "NaN": lambda: torch.tensor([torch.nan, 0.0, -0.0]),
    "bfloat16": lambda: torch.ones(3, dtype=torch.bfloat16),
    "inference mode": lambda: of_inference(torch.ones(3)),
    "a parameter": lambda: torch.nn.Parameter(torch.ones(3)),
}


@pytest.mark.parametrize("way", ["exchange", "methods", "no module"])
@pytest.mark.parametrize("name", NOTED)
def test_values_are_compared(name, way, monkeypatch):
    """Writes that no version counter counts are found; a value that comes back counts as unchanged."""
    tensor = NOTED[name]()
    if way == "no module":
        monkeypatch.setattr(backends, "compiled", lambda: None)
    with exchange(way != "methods"):
        values, guard = Values(tensor), unchanged()
        values.note(guard)
        exact = way == "exchange" or (way == "methods" and name != "NaN")  # else it may report a change that was none
        assert not values.changed() and guard.holds() == exact
        last = (-1,) * tensor.dim()
        was = tensor.data[last].clone() if tensor.numel() else None
        for value in () if was is None else (was == 0, was):
            with torch.inference_mode(tensor.is_inference()):
                tensor.data[last].copy_(value)
            is_changed = value is not was
            assert values.changed() == is_changed and guard.holds() == (exact and not is_changed)
        tensor.data = torch.ones(9, 9, dtype=tensor.dtype)
        assert values.changed() and not guard.holds()


def test_values_of_large_tensors_are_told_by_their_version_and_place():
    tensor = torch.zeros((1 << 18) + 1)
    for write in (lambda: tensor.zero_(), lambda: setattr(tensor, "data", tensor.clone())):
        values, guard = Values(tensor), unchanged()
        values.note(guard)
        assert values.copy is None and not values.changed() and guard.holds()
        write()
        assert values.changed() and not guard.holds()
