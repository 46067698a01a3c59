"""The PyTorch functions that a routed pass knows by name: what each does to the rows of its arguments."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F

_UNARY = """
    abs absolute acos arccos acosh arccosh angle asin arcsin asinh arcsinh atan arctan atanh arctanh bitwise_not ceil
    clone conj contiguous cos cosh deg2rad detach digamma erf erfc erfinv exp exp2 expm1 fix floor frac isfinite isinf
    isnan isneginf isposinf isreal lgamma log log10 log1p log2 logical_not logit nan_to_num neg negative positive
    rad2deg reciprocal round rsqrt sigmoid sign sgn signbit sin sinc sinh sqrt square tan tanh trunc relu
    float double half bfloat16 int long short bool to type type_as cpu cuda requires_grad_ fill zero clamp clamp_min
    clamp_max clip
"""
_BINARY = """
    add sub subtract rsub mul multiply div divide true_divide floor_divide remainder fmod pow float_power maximum
    minimum fmax fmin atan2 arctan2 hypot xlogy logaddexp logaddexp2 copysign ldexp nextafter gt ge lt le eq ne greater
    greater_equal less less_equal not_equal logical_and logical_or logical_xor bitwise_and bitwise_or bitwise_xor
    lerp where addcmul addcdiv masked_fill heaviside isclose
"""
_OPERATORS = """
    __add__ __radd__ __iadd__ __sub__ __rsub__ __isub__ __mul__ __rmul__ __imul__ __truediv__ __rtruediv__ __itruediv__
    __div__ __rdiv__ __idiv__ __floordiv__ __rfloordiv__ __mod__ __rmod__ __pow__ __rpow__ __ipow__ __neg__ __pos__
    __abs__ __invert__ __and__ __rand__ __or__ __ror__ __xor__ __rxor__ __lt__ __le__ __gt__ __ge__ __eq__ __ne__
"""
_ACTIVATIONS = """
    relu relu6 elu selu celu gelu silu mish leaky_relu softplus softsign tanhshrink hardtanh hardswish hardsigmoid
    logsigmoid threshold dropout alpha_dropout sigmoid tanh hardshrink softshrink rrelu
"""
_RANDOM = """
    rand_like randn_like randint_like bernoulli normal_ uniform_ bernoulli_ exponential_ random_ cauchy_ log_normal_
    geometric_
"""
_MOVES = """
    cat concat concatenate hstack dstack stack split chunk tensor_split unbind __getitem__ narrow select index_select
    permute transpose swapaxes swapdims movedim moveaxis reshape view view_as reshape_as flatten unflatten unsqueeze
    squeeze expand expand_as broadcast_to contiguous clone repeat tile flip roll dropout
"""
_LIKE = "zeros_like ones_like full_like empty_like"
_CREATE = "zeros ones full empty rand randn randint new_zeros new_ones new_full new_empty"
_READ_NOTHING = """
    size dim ndimension numel nelement stride is_contiguous is_floating_point is_complex element_size get_device
    storage_offset is_signed is_same_size is_inference data_ptr __len__ __hash__ __repr__ __dir__ __reduce_ex__
    is_tensor is_storage register_hook retain_grad requires_grad is_pinned
"""
_VIEWS = """
    reshape view view_as reshape_as flatten unflatten unsqueeze squeeze expand expand_as broadcast_to contiguous
"""


def _find(names: str, *places: Any, inplace: bool = False) -> frozenset[Any]:
    found = set()
    for name in names.split():
        for spelling in (name, name + "_") if inplace else (name,):
            found |= {function for place in places if (function := getattr(place, spelling, None)) is not None}
    return frozenset(found)


RANDOM = _find(
    _RANDOM + " dropout alpha_dropout rrelu rand randn randint randperm normal multinomial", torch, F
) | _find(_RANDOM, torch.Tensor)
"""What draws random numbers."""

ELEMENTWISE = (
    _find(_UNARY + _BINARY + _RANDOM + _LIKE, torch, torch.Tensor, inplace=True)
    | _find(_OPERATORS, torch.Tensor)
    | _find(_ACTIVATIONS, F, torch, inplace=True)
    | {torch.Tensor.data.__get__}  # type: ignore[attr-defined]
)
"""Row r of the result depends on row r of the arguments alone, wherever dimension 0 of all of them is the rows."""

CREATE = _find(_CREATE, torch, torch.Tensor)
"""New tensors with sizes that are given; with n of them in front they are rows."""

VIEWS = _find(_VIEWS, torch, torch.Tensor)
"""The same entries in the same order under other sizes (or repeated, where sizes grow)."""

MOVES = _find(_MOVES, torch, torch.Tensor, F)
"""What may move entries about without changing them."""

_TENSOR_PROPERTIES = {"T", "H", "mT", "mH", "data", "grad", "real", "imag", "_base"}
METADATA = frozenset(
    getattr(torch.Tensor, name).__get__
    for name in dir(torch.Tensor)
    if type(getattr(torch.Tensor, name)).__name__ in ("getset_descriptor", "property")
    and name not in _TENSOR_PROPERTIES
) | _find(_READ_NOTHING, torch, torch.Tensor)
"""What reads no value: shapes, dtypes, devices."""

MATRIX_PRODUCTS = _find("matmul mm __matmul__", torch, torch.Tensor)
TO = _find("to type_as", torch.Tensor)
EXPAND = _find("expand broadcast_to repeat", torch, torch.Tensor)


def name_of(function: Any) -> str:
    """A function's name for messages."""
    resolved = torch.overrides.resolve_name(function)
    return resolved or getattr(function, "__qualname__", repr(function))
