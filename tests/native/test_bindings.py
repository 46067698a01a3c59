"""The compiled module's description of itself, and the arguments that it refuses."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refuses

import voronerf
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import MLP, Layer
from voronerf.ops._core.program import BINARY, FUNCTIONS, HASH, Builder, Function

pytestmark = pytest.mark.native
native = pytest.importorskip("voronerf.ops._core.native")
lowering = pytest.importorskip("voronerf.ops.network.lowering")


def test_the_interface_is_the_checksum_of_what_the_build_bound() -> None:
    folder = Path(voronerf.__file__).with_name("ops") / "_core"
    assert (folder / "_C.pyi").read_text() == native.compiled.stub
    checksum = zlib.crc32(native.compiled.stub.encode())
    assert (folder / "interface.txt").read_text() == f"{checksum}\n" == f"{native.compiled.interface}\n"


def test_enumerations_have_the_names_that_users_write() -> None:
    assert sorted(native.compiled.ProgramFunction) == sorted(FUNCTIONS)
    assert sorted(native.compiled.ProgramBinary) == sorted(BINARY)
    assert sorted(native.compiled.ProgramEncoding) == sorted([*ENCODINGS, HASH])
    assert (
        set(native.SUPPORTED_ISAS) <= set(native.ISAS) == {"portable", "neon", "avx2", "avx512", "avx512_bf16", "amx"}
    )


def test_what_does_not_fit_a_signature_is_refused() -> None:
    compiled, cpu = native.compiled, native.cpu()
    points, cells = torch.rand(4, 3), torch.empty(4, dtype=torch.int32)
    compiled.nearest_centre(points, points.clone(), None, cells, 4, 4, 3, 0, cpu)
    for wrong in (points.half(), points.double(), points.tolist(), 0):
        with pytest.raises(TypeError, match="incompatible function arguments"):
            compiled.nearest_centre(points, wrong, None, cells, 4, 4, 3, 0, cpu)
    with pytest.raises(TypeError, match="incompatible function arguments"):  # a result that is not contiguous
        compiled.nearest_centre(points, points, None, torch.empty(8, dtype=torch.int32)[::2], 4, 4, 3, 0, cpu)
    sizes = {"encoding": "frequency", "n": 4, "d": 3, "size": 1, "include_input": True, "width": 9}
    with pytest.raises(TypeError, match=r"^Encoding: x is not of type const float32\*$"):
        compiled.encode(compiled.Encoding(x=points.double(), variances=None, **sizes), torch.empty(4, 9), cpu)
    refuses("unexpected keyword argument 'y'", compiled.Encoding, y=points, variances=None, **sizes, error=TypeError)
    whole = compiled.Encoding(x=points, variances=None, **sizes)
    compiled.encode(whole, torch.empty(4, 9), cpu)
    for count in range(len(whole)):  # the compiled module knows the class from the call above
        with pytest.raises(TypeError, match="incompatible function arguments"):
            compiled.encode(tuple.__new__(compiled.Encoding, whole[:count]), torch.empty(4, 9), cpu)


def test_a_function_of_one_side_alone_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions are bound by name, not by number: a function that only Python knows is not mistaken for another."""
    monkeypatch.setitem(FUNCTIONS, "cube", Function(lambda x, a, b: x**3))
    b = Builder()
    program = b.program([b.apply("cube", b.input(3))])
    with pytest.raises(TypeError, match="ProgramStep: function is not of type ProgramFunction"):
        lowering.lower(program.text)


def test_a_product_takes_as_many_sources_as_the_compiled_module_has_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    programs, most = list[Any](), native.compiled.most_sources
    monkeypatch.setattr(native.compiled, "make_program", programs.append)
    table = MLP((Layer(("positions",) * (2 * most + 3), 5),), (0,))
    lowering.lower.__wrapped__(table.program(3, 0, (5,), (True,), False).text)
    assert [step.sources for step in programs[0].steps if step.op == "linear"] == [most, most, 3]


def test_layers_hand_words_and_sums_to_the_next_on_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """A result stays in registers if only the next product reads it; if other steps read it, it also has a slot."""
    programs, most = list[Any](), native.compiled.most_held
    monkeypatch.setattr(native.compiled, "make_program", programs.append)

    def linear(*layers: Layer, layout: str = "tiles") -> list[tuple[str, bool, bool]]:
        table = MLP(layers, (len(layers) - 1,))
        text = table.program(3, 0, tuple(layer.width for layer in layers), (True,) * len(layers), False).text
        lowering.lower.__wrapped__(text, layout, True)
        steps = [s for s in programs[-1].steps if s.op == "linear"]
        return [(s.to_registers, s.from_registers, s.pairs >= 0 or s.floats) for s in steps]

    first, positions = Layer(("positions",), most, "relu"), Layer(("positions",), 5)
    assert linear(first, Layer((0,), most, "relu"), Layer((1,), 4)) == [
        ("words", False, False),
        ("words", True, False),
        ("nothing", True, True),
    ]
    # The partial sum of two products stays in registers. So does the output of the first layer, as words (packed pairs
    # of 16-bit numbers).
    assert linear(first, Layer(("positions", 0), 5)) == [
        ("words", False, False),
        ("sums", False, False),
        ("nothing", True, True),
    ]
    assert linear(first, Layer((0,), 7, "relu"), Layer((1, 0), 5))[0] == ("words", False, True)
    wide = Layer((0,), most + 1, "relu")
    assert [to_registers for to_registers, _, _ in linear(first, wide, Layer((1,), 4))] == ["nothing"] * 3
    assert [to_registers for to_registers, _, _ in linear(first, Layer((0,), 4), layout="floats")] == ["nothing"] * 2
    assert linear(positions) == [("nothing", False, True)]
