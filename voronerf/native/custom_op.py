"""One declaration of an op of the compiled module: its custom op and the op's fake, from one function."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.library import CustomOpDef

from voronerf import native

# Results of at least this many bytes are put on huge pages; for smaller ones the allocator usually has warm memory.
_LARGE = 1 << 22


def custom_op(
    name: str, *, devices: tuple[str, ...] = ("cpu", "cuda"), fake: Callable[..., Any] | None = None
) -> Callable[[Callable[..., Iterator[Any]]], CustomOpDef]:
    """Makes a function that allocates, yields its results, and then fills them the custom op ``voronerf::name``.

    ::

        @custom_op("nearest_centre")
        def _nearest_centre(points: Tensor, centres: Tensor, weights: Tensor | None) -> Iterator[Tensor]:
            cells = points.new_empty(points.shape[0], dtype=torch.int32)
            yield cells
            native.compiled.nearest_centre(points, centres, weights, cells, ...)

    The op's fake, with which torch traces, ends at the ``yield``: up to there shapes alone are known. The op is
    functional; what it may get and what it returns is said by the annotations. The compiled functions check dtypes and
    make their inputs contiguous (csrc/bindings/load.h).

    Args:
        name: of the op.
        devices: device types that it runs on.
        fake: of an op whose sizes depend on values, and which yields when it knows them.
    """

    def declare(steps: Callable[..., Iterator[Any]]) -> CustomOpDef:
        def run(*arguments: Any) -> Any:
            going = steps(*arguments)
            results = next(going)
            for _ in going:
                raise AssertionError(f"{name} yields twice")
            return results

        signature = inspect.signature(steps, eval_str=True)
        (results,) = typing.get_args(signature.return_annotation)
        run.__signature__ = signature.replace(return_annotation=results)  # type: ignore[attr-defined]
        schema = torch.library.infer_schema(run, mutates_args=())
        op = torch.library.custom_op(f"voronerf::{name}", run, mutates_args=(), device_types=devices, schema=schema)
        op.register_fake(fake or (lambda *arguments: next(steps(*arguments))))
        return op

    return declare


def on_huge_pages(result: Tensor) -> None:
    """Asks for huge pages for a result that has just been allocated, where it is large and the system gives them."""
    if result.nbytes >= _LARGE and result.device.type == "cpu":
        native.compiled.advise_huge_pages(result, result.nbytes)
