"""What VoronoiRouter refuses: modules that mix samples, and calls that leave open where samples are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from convention_listed import RAYS, mip_field, nerfacc, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter


@pytest.fixture
def centres() -> Tensor:
    return torch.rand(4, 3) * 2 - 1


class Mixes(nn.Module):
    """A linear layer, a step that brings samples together, and another layer."""

    def __init__(self, step: Callable[[Any, Tensor], Any], **parts: nn.Module) -> None:
        super().__init__()
        self.fc, self.out, self.step = nn.Linear(3, 4), nn.Linear(4, 4), [step]
        for name, part in parts.items():
            self.add_module(name, part)

    def forward(self, x: Tensor) -> Any:
        result = self.step[0](self, self.fc(x))
        return result if isinstance(result, tuple) else self.out(result)


def attention() -> nn.Module:
    return nn.MultiheadAttention(4, 1, batch_first=True)


MIXING: list[tuple[Callable[[], nn.Module], tuple[int, ...], str]] = [
    (lambda: nn.Sequential(nn.Linear(3, 8), nn.BatchNorm1d(8), nn.Linear(8, 2)), (40,), "BatchNorm1d"),
    (lambda: nn.Sequential(nn.Linear(3, 8), nn.SyncBatchNorm(8), nn.Linear(8, 2)), (40,), "SyncBatchNorm"),
    *(
        (step, lead, "sample")
        for lead, steps in (
            (
                (40,),
                (
                    lambda: Mixes(
                        lambda net, h: net.layer(h[None])[0],
                        layer=nn.TransformerEncoderLayer(4, 2, 16, batch_first=True),
                    ),
                    lambda: Mixes(lambda net, h: net.layer(h[None], h[None], h[None])[0][0], layer=attention()),
                    lambda: Mixes(lambda net, h: torch.softmax(h @ net.out(h).t(), -1) @ h),
                    lambda: Mixes(lambda net, h: h - h.mean(0)),
                    lambda: Mixes(lambda net, h: h + h.roll(1, 0)),
                    lambda: Mixes(lambda net, h: h + h[:1]),
                    lambda: Mixes(lambda net, h: h.cumsum(0)),
                    lambda: Mixes(lambda net, h: h.flip(0)),
                    lambda: Mixes(lambda net, h: torch.cat([h[1:], h[:1]])),
                    lambda: Mixes(lambda net, h: h / h.norm()),
                    lambda: Mixes(lambda net, h: h[torch.argsort(h[:, 0])]),
                    lambda: Mixes(lambda net, h: h / h.abs().max().item()),
                    lambda: Mixes(lambda net, h: h * (1.0 if h.max() > 0.3 else -1.0) * float(h.sum())),
                    lambda: Mixes(
                        lambda net, h: torch.autograd.grad(h.square().sum() / h.shape[0], h, create_graph=True)[0]
                    ),
                    lambda: Mixes(lambda net, h: (h, h.square().mean())),  # a number for the whole batch
                ),
            ),
            (
                RAYS,  # each sample sees those before it on its ray, or all of it
                (
                    lambda: Mixes(
                        lambda net, h: net.layer(h.transpose(1, 2)).transpose(1, 2), layer=nn.Conv1d(4, 4, 3, padding=1)
                    ),
                    lambda: Mixes(lambda net, h: h + net.layer(h, h, h)[0], layer=attention()),
                    lambda: Mixes(lambda net, h: torch.cumsum(h, 1)),
                ),
            ),
        )
        for step in steps
    ),
]


@pytest.mark.filterwarnings("ignore:.*cell by cell")
@pytest.mark.parametrize(("make", "lead", "reason"), MIXING, ids=lambda value: getattr(value, "__name__", None))
def test_modules_that_mix_samples_are_refused(
    make: Callable[[], nn.Module], lead: tuple[int, ...], reason: str, centres: Tensor
) -> None:
    with pytest.raises((ValueError, TypeError), match=reason) as error:
        VoronoiRouter(make(), centres, coords="first3")(uniform(lead))
    assert "VoronoiRouter" in str(error.value)


class Field(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(7, 4)

    def forward(self, x: Tensor, z: Tensor | None = None) -> Tensor:
        return self.fc(x if z is None else torch.cat([x, z.expand(*x.shape[:-1], -1)], -1))

    @property
    def width(self) -> int:
        return 7


X = torch.zeros(6, 7)

WRONG: dict[str, tuple[Callable[[Tensor], Any], type[Exception], str]] = {
    "no coords": (lambda c: VoronoiRouter(Field(), c)(X), ValueError, "coords"),
    "no coords, integrated encoding": (
        lambda c: VoronoiRouter(mip_field(), c, per_ray=["view_direction"])(uniform(RAYS, 12), uniform((9,), 9)),
        ValueError,
        "coords=",
    ),
    "unknown name": (lambda c: VoronoiRouter(Field(), c, coords="first4"), ValueError, "first4"),
    "coords of another type": (lambda c: VoronoiRouter(Field(), c, coords=3.5), (TypeError, ValueError), "coords"),
    "two features": (lambda c: VoronoiRouter(Field(), c, coords="first3")(X[:, :2]), ValueError, r"\[6, 2\]"),
    "slice of four": (lambda c: VoronoiRouter(Field(), c, coords=slice(0, 4))(X), ValueError, "3"),
    "slice past the end": (lambda c: VoronoiRouter(Field(), c, coords=slice(6, 9))(X), ValueError, "3"),
    "callable that gives no positions": (
        lambda c: VoronoiRouter(Field(), c, coords=lambda x: x[:, 0])(X),
        ValueError,
        "coords",
    ),
    "callable that gives None": (
        lambda c: VoronoiRouter(Field(), c, coords=lambda x: None)(X),
        (TypeError, ValueError),
        "coords",
    ),
    "fewer positions than samples": (
        lambda c: VoronoiRouter(Field(), c)(X, coords=torch.zeros(5, 3)),
        ValueError,
        "[56]",
    ),
    "positions of integers": (
        lambda c: VoronoiRouter(Field(), c)(X, coords=torch.zeros(6, 3, dtype=torch.int64)),
        (TypeError, ValueError),
        "int64",
    ),
    "no module": (lambda c: VoronoiRouter(lambda x: x, c, coords="first3"), TypeError, "module"),
    "centres of two coordinates": (
        lambda c: VoronoiRouter(Field(), c[:, :2], coords="first3"),
        ValueError,
        r"\[4, 2\]",
    ),
    "method that is not there": (
        lambda c: VoronoiRouter(Field(), c, coords="first3", methods=["density"]),
        (ValueError, AttributeError),
        "density",
    ),
    "method that is no method": (
        lambda c: VoronoiRouter(Field(), c, coords="first3", methods=["width"]),
        (ValueError, TypeError),
        "width",
    ),
    "per_ray that is no argument": (
        lambda c: VoronoiRouter(Field(), c, coords="first3", per_ray=["directions"])(X),
        ValueError,
        "directions",
    ),
    "unknown backend": (lambda c: VoronoiRouter(Field(), c, coords="first3", backend="fast")(X), ValueError, "fast"),
    "modules and centres differ in number": (
        lambda c: VoronoiRouter.from_modules([Field(), Field()], c, coords="first3"),
        ValueError,
        "2",
    ),
    "no modules": (lambda c: VoronoiRouter.from_modules([], c, coords="first3"), ValueError, "module"),
    "modules of different sizes": (
        lambda c: VoronoiRouter.from_modules([nn.Linear(7, 2), nn.Linear(7, 3)], c[:2], coords="first3"),
        ValueError,
        "weight",
    ),
    "modules of different classes": (
        lambda c: VoronoiRouter.from_modules([nn.Linear(7, 2), Field()], c[:2], coords="first3"),
        (ValueError, TypeError),
        "parameters",
    ),
    "module without parameters": (
        lambda c: VoronoiRouter.from_modules([nn.Linear(7, 2), nn.Identity()], c[:2], coords="first3"),
        (ValueError, TypeError),
        "parameters",
    ),
    "loading another module into a cell": (
        lambda c: VoronoiRouter(Field(), c, coords="first3").load_cell(0, nn.Linear(3, 2)),
        (ValueError, TypeError),
        "parameters",
    ),
    "loading into a cell that is not there": (
        lambda c: VoronoiRouter(Field(), c, coords="first3").load_cell(4, Field()),
        IndexError,
        "4",
    ),
    "subdividing without samples": (
        lambda c: VoronoiRouter(Field(), c, coords="first3").subdivide(4),
        (ValueError, TypeError),
        "points",
    ),
    "subdividing with an optimiser of other parameters": (
        lambda c: VoronoiRouter(Field(), c[:1], coords="first3").subdivide(
            2, points=torch.rand(9, 3), weights=torch.rand(9), optimizer=torch.optim.Adam(Field().parameters())
        ),
        ValueError,
        "optimizer",
    ),
}


@pytest.mark.parametrize(("call", "kind", "says"), WRONG.values(), ids=WRONG)
def test_wrong_use_says_what_is_wrong(call: Callable[[Tensor], Any], kind: Any, says: str, centres: Tensor) -> None:
    with pytest.raises(kind, match=says) as error:
        call(centres)
    text = str(error.value)
    assert "VoronoiRouter" in text or "VoronoiDiagram" in text or "backend" in text, text


def test_as_many_rays_as_samples_must_be_said(centres: Tensor) -> None:
    """[5, 5, 3] with [5, 3]: a row for each ray, or positions that broadcast over rays? Only the caller knows."""
    field = nerfacc.VanillaNeRFRadianceField(2, 8)
    x, condition = uniform((5, 5)), uniform((5,))
    told = VoronoiRouter(field, centres, coords="first3", per_ray=["condition"])
    torch.testing.assert_close(told(x, condition), field(x, condition))
    with pytest.raises(ValueError, match="per_ray"):
        VoronoiRouter(field, centres, coords="first3")(x, condition)


def test_rays_are_found_where_shapes_say_so(centres: Tensor) -> None:
    field = nerfacc.VanillaNeRFRadianceField(2, 8)
    x, condition = uniform(RAYS), uniform(RAYS[:1])
    router = VoronoiRouter(field, centres, coords="first3")
    torch.testing.assert_close(router(x, condition), field(x, condition))
    torch.testing.assert_close(router(x, condition=condition), field(x, condition))


def test_an_error_of_the_field_itself_is_shown(centres: Tensor) -> None:
    class Picky(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.fc = nn.Linear(3, 2)

        def forward(self, x: Tensor) -> Tensor:
            if x.shape[-1] != 3:
                raise KeyError(f"wants three features, not {x.shape[-1]}")
            return F.relu(self.fc(x))

    router = VoronoiRouter(Picky(), centres, coords="first3")
    with pytest.raises(KeyError, match="wants three features, not 7"):
        router(X)


def test_cell_by_cell_is_said_once(centres: Tensor) -> None:
    class Mixed(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.mix, self.out = nn.Bilinear(3, 3, 4), nn.Linear(4, 2)

        def forward(self, x: Tensor) -> Tensor:
            return self.out(self.mix(x, x))

    router = VoronoiRouter(Mixed(), centres, coords="first3")
    with pytest.warns(UserWarning, match=r"(?s)VoronoiRouter.*(Bilinear|bilinear)") as said:
        for _ in range(3):
            router(uniform((50,)))
    assert len([warning for warning in said if "VoronoiRouter" in str(warning.message)]) == 1
