"""A whole network for each cell. n samples, r rays, k cells, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf import backends
from voronerf.checks import FLOATS, INDEX, check_count, check_dtype, check_same_device, check_same_dtype, check_shape
from voronerf.layers import DIRECTIONS, MLP, POSITIONS

_OP = "grouped_mlp"


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Every sample through the network of its cell, encodings included.

    The same as ``frequency_encode`` where ``layers`` gives octaves, then one ``grouped_linear`` for each layer, with
    the sources that the table names concatenated. Gradients of every order to positions, directions, weights and
    biases. Encodings are computed in float32 at least, and rounded to the dtype of the weights; under
    ``torch.autocast`` layers run in its dtype.

    Args:
        positions: [n, p] floating point, sorted by cell, n < 2**31; raw where the table gives octaves, else encoded;
            p >= 1 where a layer reads them, as q >= 1 for directions.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows of no cell (before
            ``offsets[0]``, from ``offsets[k]`` on) give 0. Cells may be empty.
        weights: one [k, o, i] for each layer, all of one dtype; i as ``layers.input_width`` says.
        biases: one [k, o] or None for each layer.
        layers: the layer table.
        directions: [n, q], or [r, q] with ``direction_index``; None where no layer reads directions.
        direction_index: int32 [n], values 0 to r - 1: the row of ``directions`` of each sample. A direction is then
            encoded once a ray rather than once a sample.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, layers.out_features] in the dtype of the weights (of autocast, where it is on).

    Raises:
        ValueError: shapes, devices, directions that are missing, an unknown backend; on the CPU also offsets that fall
            or exceed n.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.
    """
    sizes: dict[str, int] = {}
    check_shape(_OP, "positions", positions, ("n", "p"), sizes)
    check_dtype(_OP, "positions", positions)
    check_shape(_OP, "offsets", offsets, ("k+1",), sizes)
    check_dtype(_OP, "offsets", offsets, INDEX)
    _check_directions(directions, direction_index, layers, sizes)
    _check_parameters(weights, biases, layers, sizes)
    check_same_device(
        _OP,
        positions=positions,
        offsets=offsets,
        directions=directions,
        direction_index=direction_index,
        **{f"weights[{index}]": weight for index, weight in enumerate(weights)},
        **{f"biases[{index}]": bias for index, bias in enumerate(biases)},
    )
    check_count(_OP, "positions", sizes["n"])
    run = backends.resolve(_OP, backend=backend, device=positions.device, dtype=weights[0].dtype)
    out: Tensor = run(
        positions, offsets, weights, biases, layers=layers, directions=directions, direction_index=direction_index
    )
    return out


def _check_directions(
    directions: Tensor | None, direction_index: Tensor | None, layers: MLP, sizes: dict[str, int]
) -> None:
    if directions is None:
        if layers.uses_directions:
            raise ValueError(f"{_OP}: directions must be given for layers that read them, got None")
        if direction_index is not None:
            raise ValueError(f"{_OP}: direction_index must come with directions, got no directions")
        sizes["q"] = 0
        return
    check_shape(_OP, "directions", directions, ("n", "q") if direction_index is None else ("r", "q"), sizes)
    check_dtype(_OP, "directions", directions)
    if direction_index is not None:
        check_shape(_OP, "direction_index", direction_index, ("n",), sizes)
        check_dtype(_OP, "direction_index", direction_index, INDEX)


def _check_parameters(
    weights: Sequence[Tensor], biases: Sequence[Tensor | None], layers: MLP, sizes: dict[str, int]
) -> None:
    count = len(layers.layers)
    for name, parameters in (("weights", weights), ("biases", biases)):
        if len(parameters) != count:
            raise ValueError(f"{_OP}: {name} must have one entry for each of {count} layers, got {len(parameters)}")
    if sizes["k"] < 1:
        raise ValueError(f"{_OP}: offsets must have at least two entries, got [{sizes['k'] + 1}]")
    for source, features in ((POSITIONS, sizes["p"]), (DIRECTIONS, sizes["q"])):
        if features < 1 and any(source in layer.inputs for layer in layers.layers):
            raise ValueError(f"{_OP}: {source} must have at least one feature where a layer reads them, got {features}")
    for index, (o, i) in enumerate(layers.weight_shapes(sizes["p"], sizes["q"])):
        check_shape(_OP, f"weights[{index}]", weights[index], ("k", o, i), sizes)
        check_dtype(_OP, f"weights[{index}]", weights[index], FLOATS if index == 0 else (weights[0].dtype,))
        bias = biases[index]
        if bias is not None:
            check_shape(_OP, f"biases[{index}]", bias, ("k", o), sizes)
            check_same_dtype(_OP, **{"weights[0]": weights[0], f"biases[{index}]": bias})
