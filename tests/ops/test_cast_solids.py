from __future__ import annotations

import pytest
import torch
from op_cases import strided

from voronerf.ops import cast_solids

pytestmark = pytest.mark.op("cast_solids")


def solids(count):
    """Kinds, frames and sizes of solids that overlap in the middle of space, every kind among them."""
    kinds = torch.arange(count, dtype=torch.int32) % 4
    turns = torch.linalg.qr(torch.randn(count, 3, 3)).Q
    centres = torch.randn(count, 1, 3) * 0.4
    sizes = 0.15 + 0.2 * torch.rand(count, 3)
    sizes[kinds == 3, 1] *= 0.4
    return [kinds, torch.cat((turns, centres), dim=1), sizes]


def rays(count):
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    return [origins, torch.nn.functional.normalize(torch.randn(count, 3) * 0.5 - origins, dim=1)]


def gap(kind, size, points):
    """Signed distance, or a bound of it, of points [n, 3] in a solid's frame."""
    x, y, z = points.double().unbind(1)
    first, second, third = size.double()
    if kind == 0:
        return points.double().norm(dim=1) - first
    if kind == 1:
        return torch.stack((x.abs() - first, y.abs() - second, z.abs() - third)).amax(0)
    if kind == 2:
        return torch.maximum(torch.hypot(x, y) - first, z.abs() - second)
    return torch.hypot(torch.hypot(x, y) - first, z) - second


@pytest.mark.parametrize("count", [1, 4, 23])
@pytest.mark.parametrize("r", [0, 1, 600])
def test_first_hits(device, backend, r, count):
    """What is found lies on its solid; solids a little smaller are hit no earlier, a little larger ones no later."""
    tables, (origins, directions) = solids(count), rays(r)
    given = [tensor.to(device) for tensor in (*tables, origins, directions)]
    depths, which = (part.cpu() for part in cast_solids(*(strided(tensor) for tensor in given), backend=backend))
    assert depths.shape == which.shape == (r,) and which.dtype == torch.int32
    assert torch.equal(depths.isfinite(), which >= 0) and not bool(depths.isnan().any())
    points = origins + depths.nan_to_num(posinf=0)[:, None] * directions
    for number in range(count):
        mine = which == number
        local = (points[mine] - tables[1][number, 3]) @ tables[1][number, :3]
        assert bool((gap(int(tables[0][number]), tables[2][number], local).abs() < 1e-3).all())
    # The brackets are taken from the reference in float64.
    wide = [tensor.double() if tensor.is_floating_point() else tensor for tensor in (*tables, origins, directions)]
    from voronerf.ops.cast_solids.reference import cast_solids as exact

    smaller, larger = (exact(wide[0], wide[1], wide[2] + shift, *wide[3:])[0] for shift in (-2e-3, 2e-3))
    assert bool((depths <= smaller + 1e-3).all()) and bool((depths >= larger - 1e-3).all())
    if r > 1 and count > 1:
        assert 0.05 < float((which >= 0).float().mean()) < 0.95
        assert len(which.unique()) > min(count, 4)


def test_by_hand(device, backend):
    kinds = torch.tensor([0, 0, 1, 2, 3], dtype=torch.int32)
    frames = torch.eye(3)[None].repeat(5, 1, 1)
    centres = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [3.0, 0, 0], [6.0, 0, 0], [9.0, 0, 0]])
    frames = torch.cat((frames, centres[:, None]), dim=1)
    sizes = torch.tensor([[0.5, 0, 0], [0.5, 0, 0], [0.3, 0.4, 0.5], [0.5, 0.25, 0], [0.6, 0.2, 0]])
    origins = torch.tensor(
        [[0.0, 0, 2], [3, 0, 2], [6, 0, 2], [9, 0, 2], [9.6, 0, 2], [0, 0, 0], [0, 0, 2], [-2, 0, 0]]
    )
    directions = torch.tensor([[0.0, 0, -1]] * 6 + [[0.0, 0, 1], [1.0, 0, 0]])
    given = (tensor.to(device) for tensor in (kinds, frames, sizes, origins, directions))
    depths, which = (part.cpu() for part in cast_solids(*given, backend=backend))
    # of the two equal spheres the first; through the hole of the torus; from inside, away and along the row
    assert which.tolist() == [0, 2, 3, -1, 4, -1, -1, 0]
    inf = float("inf")
    torch.testing.assert_close(depths, torch.tensor([1.5, 1.5, 1.75, inf, 1.8, inf, inf, 1.5]), atol=1e-3, rtol=0)
    none = [tensor[:0] for tensor in (kinds, frames, sizes)]
    depths, which = cast_solids(*(t.to(device) for t in (*none, origins, directions)), backend=backend)
    assert bool((depths == inf).all()) and bool((which == -1).all())
