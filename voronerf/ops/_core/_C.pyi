# The compiled module, written by its build from what csrc/bindings binds; the checksum is its interface.
# A comment has the exact types of the C++ function, whose parameters these are. A tensor is contiguous, or becomes
# so where it is const; None is a null pointer.
from collections.abc import Sequence
from typing import NamedTuple, overload

import torch
from torch import Tensor

interface: int
stub: str
compiler: str
openmp: bool
cuda: bool
cuda_outcome: str
cuda_architectures: str
cuda_major: int

def name_dtypes(names: dict[str, torch.dtype]) -> None: ...

Activation: tuple[str, ...]  # none relu softplus sigmoid sine

class AdamGuard(NamedTuple):
    loss: Tensor | None  # const float32*
    limit: float  # float32
    found: Tensor | None  # float32*
    skipped: Tensor | None  # float32*
    in_a_row: Tensor | None  # float32*
    scale: Tensor | None  # const float32*

class AdamRule(NamedTuple):
    rate: float  # float64
    rate_at: Tensor | None  # const float32*
    step: Tensor | None  # float32*
    decay: float  # float64
    decay_sq: float  # float64
    epsilon: float  # float64
    every: bool

class BalanceInputs(NamedTuple):
    samples: Tensor | None  # const float32*
    masses: Tensor | None  # const float64*
    m: int  # int64
    k: int  # int64
    steps: int  # int64
    alpha: float  # float64
    neighbours: int  # int64

CellSortWay: tuple[str, ...]  # automatic counting radix

class CompositeGradients(NamedTuple):
    colour: Tensor | None  # const float32*
    opacity: Tensor | None  # const float32*
    depth: Tensor | None  # const float32*
    weights: Tensor | None  # const float32*
    sigma: Tensor | None  # float32*
    rgb: Tensor | None  # float32*
    depths: Tensor | None  # float32*
    deltas: Tensor | None  # float32*
    background: Tensor | None  # float32*
    left: Tensor | None  # float32*

class CompositeInputs(NamedTuple):
    sigma: Tensor | None  # const float32*
    rgb: Tensor | None  # const float32*
    depths: Tensor | None  # const float32*
    deltas: Tensor | None  # const float32*
    offsets: Tensor | None  # const int32*
    background: Tensor | None  # const float32*
    background_per_ray: bool
    r: int  # int64
    s: int  # int64
    m: int  # int64
    c: int  # int64

class CompositeOutputs(NamedTuple):
    colour: Tensor | None  # float32*
    opacity: Tensor | None  # float32*
    depth: Tensor | None  # float32*
    weights: Tensor | None  # float32*

class Cpu(NamedTuple):
    isa: str  # Isa
    threads: int  # int32

class Cuda(NamedTuple):
    device: int  # int32
    stream: int  # uint64

class DrawPixelsInputs(NamedTuple):
    seed: Tensor | None  # const int32*
    ends: Tensor | None  # const int64*
    shift: Tensor | None  # const int64*
    first: Tensor | None  # const int32*
    bits: int  # int64
    below: int  # int64
    b: int  # int64

class Encoding(NamedTuple):
    x: Tensor | None  # const float32*
    variances: Tensor | None  # const float32*
    n: int  # int64
    d: int  # int64
    octaves: int  # int64
    include_input: bool
    width: int  # int64

class GridLevel(NamedTuple):
    scale: float  # float32
    shift: float  # float32
    side: int  # int32
    entries: int  # int64
    offset: int  # int64
    hashed: bool

class HashGrid(NamedTuple):
    levels: Sequence[GridLevel]  # GridLevel[]
    low: Sequence[float]  # float32[]
    high: Sequence[float]  # float32[]
    features: int  # int64
    smooth: bool

class HashInputs(NamedTuple):
    positions: Tensor | None  # const float32*
    direction: Tensor | None  # const float32*
    table: Tensor | None  # const any*
    type: str  # TableType
    cells: Tensor | None  # const int32*
    n: int  # int64
    tables: int  # int64
    entries: int  # int64

Isa: tuple[str, ...]  # portable neon avx2 avx512 avx512_bf16

class KnownSamples(NamedTuple):
    positions: Tensor | None  # const float32*
    ray_index: Tensor | None  # const int32*
    depths: Tensor | None  # const float32*
    deltas: Tensor | None  # const float32*
    cells: Tensor | None  # const int32*
    own: Tensor | None  # const int32*
    n: int  # int64
    bent: bool

class LinearGradients(NamedTuple):
    out: Tensor | None  # const any*
    x: Tensor | None  # any*
    weight: Tensor | None  # any*
    bias: Tensor | None  # any*

class LinearInputs(NamedTuple):
    x: Tensor | None  # const any*
    offsets: Tensor | None  # const int32*
    weight: Tensor | None  # const any*
    bias: Tensor | None  # const any*
    n: int  # int64
    k: int  # int64
    i: int  # int64
    o: int  # int64
    activation: str  # Activation
    bfloat16: bool

class MarchInputs(NamedTuple):
    origins: Tensor | None  # const float32*
    directions: Tensor | None  # const float32*
    near: Tensor | None  # const float32*
    far: Tensor | None  # const float32*
    occupied: Tensor | None  # const uint8*
    box: Tensor | None  # const float32*
    uniforms: Tensor | None  # const float32*
    seed: Tensor | None  # const int32*
    start: Tensor | None  # const int32*
    r: int  # int64
    s: int  # int64
    x: int  # int64
    y: int  # int64
    z: int  # int64
    disparity: bool
    most: int  # int64
    space: MarchSpace

class MarchSpace(NamedTuple):
    sphere: Tensor | None  # const float32*
    perspective: Tensor | None  # const float32*

MlpCaller: tuple[str, ...]  # grouped_mlp grouped_linear routed_mlp

class MlpCudaCall: ...

MlpCudaWay: tuple[str, ...]  # auto chain tiles layers

class MlpEncoding(NamedTuple):
    kind: str  # MlpEncodingKind
    size: int  # int32

MlpEncodingKind: tuple[str, ...]  # none frequency integrated hash spherical

class MlpGradients(NamedTuple):
    output: Tensor | None  # const float32*
    weights: Sequence[Tensor | None] | None  # float32**
    biases: Sequence[Tensor | None] | None  # float32**
    positions: Tensor | None  # float32*
    directions: Tensor | None  # float32*
    features: Tensor | None  # float32*

class MlpInputs(NamedTuple):
    positions: Tensor | None  # const float32*
    directions: Tensor | None  # const float32*
    direction_index: Tensor | None  # const int32*
    offsets: Tensor | None  # const int32*
    weights: Sequence[Tensor | None] | None  # const float32**
    biases: Sequence[Tensor | None] | None  # const float32**
    n: int  # int64
    r: int  # int64
    k: int  # int64
    order: Tensor | None  # const int32*
    features: Tensor | None  # const any*
    features_type: str  # TableType
    tables: int  # int64
    encoded: Tensor | None  # float32*

class MlpLayer(NamedTuple):
    width: int  # int64
    activation: str  # Activation
    inputs: Sequence[int]  # int32[]

MlpPrecision: tuple[str, ...]  # float32 bfloat16 float16 tf32

class MlpTable(NamedTuple):
    layers: Sequence[MlpLayer]  # MlpLayer[]
    outputs: Sequence[int]  # int32[]
    positions: int  # int64
    directions: int  # int64
    position: MlpEncoding
    direction: MlpEncoding
    grid: HashGrid
    half: bool
    caller: str  # MlpCaller

class ObservedSamples(NamedTuple):
    positions: Tensor | None  # const float32*
    sigma: Tensor | None  # const float32*
    deltas: Tensor | None  # const float32*
    weights: Tensor | None  # const float32*
    box: Tensor | None  # const float32*
    x: int  # int64
    y: int  # int64
    z: int  # int64
    m: int  # int64
    decay: float  # float32
    threshold: float  # float32
    hidden: float  # float32

class OwnSamples(NamedTuple):
    positions: Tensor | None  # float32*
    ray_index: Tensor | None  # int32*
    depths: Tensor | None  # float32*
    deltas: Tensor | None  # float32*
    cells: Tensor | None  # int32*
    offsets: Tensor | None  # int32*

Peak: tuple[str, ...]  # float32 bfloat16 copy

class PixelRaysInputs(NamedTuple):
    poses: Tensor | None  # const float32*
    intrinsics: Tensor | None  # const float32*
    lens: Tensor | None  # const int32*
    tables: Tensor | None  # const float32*
    images: Tensor | None  # const uint8*
    pixels: Tensor | None  # const int64*
    box: Tensor | None  # const float32*
    background: Tensor | None  # const float32*
    background_per_ray: bool
    c: int  # int64
    h: int  # int64
    w: int  # int64
    channels: int  # int64
    b: int  # int64
    l: int  # int64
    near: float  # float32
    far: float  # float32

class PixelRaysOutputs(NamedTuple):
    origins: Tensor | None  # float32*
    directions: Tensor | None  # float32*
    near: Tensor | None  # float32*
    far: Tensor | None  # float32*
    colour: Tensor | None  # float32*

class ProgramInputs(NamedTuple):
    code: Tensor | None  # const int32*
    constants: Tensor | None  # const float32*
    inputs: Sequence[Tensor | None] | None  # const float32**
    turned: Tensor | None  # const int32*
    parameters: Sequence[Tensor | None] | None  # const float32**
    strides: Tensor | None  # const int64*
    widths: Tensor | None  # const int64*
    outputs: int  # int64
    offsets: Tensor | None  # const int32*
    order: Tensor | None  # const int32*
    n: int  # int64
    k: int  # int64

class ProgramSizes(NamedTuple):
    columns: int  # int64
    partial: int  # int64
    inputs: int  # int64
    parameters: int  # int64
    outputs: int  # int64
    sums: int  # int64

class RenderLossInputs(NamedTuple):
    raw: Tensor | None  # const float32*
    deltas: Tensor | None  # const float32*
    offsets: Tensor | None  # const int32*
    target: Tensor | None  # const float32*
    background: Tensor | None  # const float32*
    background_per_ray: bool
    density_scale: float  # float32
    hidden: float  # float32
    r: int  # int64
    m: int  # int64

class RenderLossOutputs(NamedTuple):
    loss: Tensor | None  # float32*
    colour: Tensor | None  # float32*
    weights: Tensor | None  # float32*
    density: Tensor | None  # float32*
    error: Tensor | None  # float32*
    gradient: Tensor | None  # float32*

class RunsOfRays(NamedTuple):
    sums: Tensor | None  # const float32*
    target: Tensor | None  # const float32*
    background: Tensor | None  # const float32*
    background_per_ray: bool
    q: int  # int64
    first: int  # int64
    r: int  # int64
    rays: int  # int64

class SeeCells(NamedTuple):
    centres: Tensor | None  # const float32*
    child_offsets: Tensor | None  # const int32*
    child: Tensor | None  # const int32*
    m: int  # int64
    depth: int  # int32

class SeeOutputs(NamedTuple):
    colour: Tensor | None  # float32*
    opacity: Tensor | None  # float32*
    depth: Tensor | None  # float32*
    light: Tensor | None  # float32*
    heaviest: Tensor | None  # float32*

class SeeRule(NamedTuple):
    density_scale: float  # float32
    opaque: float  # float32
    wave: int  # int64

class SparseDepth(NamedTuple):
    density: Tensor | None  # const float32*
    depths: Tensor | None  # const float32*
    deltas: Tensor | None  # const float32*
    weights: Tensor | None  # const float32*
    offsets: Tensor | None  # const int32*
    distances: Tensor | None  # const float32*
    nearby: float  # float32
    s: int  # int64
    m: int  # int64

TableType: tuple[str, ...]  # float32 bfloat16 float16

# AdamRule[], AdamGuard, const float32**, float32**, float32**, float32**, int64[], Cpu
@overload
def adam(_0: Sequence[AdamRule], _1: AdamGuard, _2: Sequence[Tensor | None] | None, _3: Sequence[Tensor | None] | None, _4: Sequence[Tensor | None] | None, _5: Sequence[Tensor | None] | None, _6: Sequence[int], _7: Cpu) -> None: ...
# AdamRule[], AdamGuard, const float32**, float32**, float32**, float32**, int64[], float32*, Cuda
@overload
def adam(_0: Sequence[AdamRule], _1: AdamGuard, _2: Sequence[Tensor | None] | None, _3: Sequence[Tensor | None] | None, _4: Sequence[Tensor | None] | None, _5: Sequence[Tensor | None] | None, _6: Sequence[int], _7: Tensor | None, _8: Cuda) -> None: ...

# any*, int64
def advise_huge_pages(_0: Tensor | None, _1: int) -> None: ...

# BalanceInputs, float32*, float64*, int32*, float64*, Cpu
def balance_centres(_0: BalanceInputs, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...

# int64
def balance_centres_workspace(_0: int) -> int: ...

# 
def bfloat16_gain() -> float: ...

# const int32*, int32*, int32*, int32*, int64, int64, Cpu
@overload
def cell_sort(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: int, _5: int, _6: Cpu) -> bool: ...
# const int32*, int32*, int32*, uint8*, int64, int64, CellSortWay, Cuda
@overload
def cell_sort(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: int, _5: int, _6: str, _7: Cuda) -> None: ...

# int64, int64
@overload
def cell_sort_workspace(_0: int, _1: int) -> int: ...
# int64, int64, CellSortWay, Cuda
@overload
def cell_sort_workspace(_0: int, _1: int, _2: str, _3: Cuda) -> int: ...

# RunsOfRays, float32*, Cpu
def compose_runs(_0: RunsOfRays, _1: Tensor | None, _2: Cpu) -> float: ...

# CompositeInputs, CompositeOutputs, Cpu
@overload
def composite(_0: CompositeInputs, _1: CompositeOutputs, _2: Cpu) -> None: ...
# CompositeInputs, CompositeOutputs, Cuda
@overload
def composite(_0: CompositeInputs, _1: CompositeOutputs, _2: Cuda) -> None: ...

# CompositeInputs, CompositeGradients, Cpu
@overload
def composite_backward(_0: CompositeInputs, _1: CompositeGradients, _2: Cpu) -> None: ...
# CompositeInputs, CompositeGradients, Cuda
@overload
def composite_backward(_0: CompositeInputs, _1: CompositeGradients, _2: Cuda) -> None: ...

# DrawPixelsInputs, int64*, float32*, Cpu
@overload
def draw_pixels(_0: DrawPixelsInputs, _1: Tensor | None, _2: Tensor | None, _3: Cpu) -> None: ...
# DrawPixelsInputs, int64*, float32*, Cuda
@overload
def draw_pixels(_0: DrawPixelsInputs, _1: Tensor | None, _2: Tensor | None, _3: Cuda) -> None: ...

# Encoding, float32*, float32*, Cpu
@overload
def encode(_0: Encoding, _1: Tensor | None, _2: Tensor | None, _3: Cpu) -> None: ...
# Encoding, float32*, Cuda
@overload
def encode(_0: Encoding, _1: Tensor | None, _2: Cuda) -> None: ...

# Encoding, const float32*, float32*, float32*, float32*, Cpu
@overload
def encode_backward(_0: Encoding, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...
# Encoding, const float32*, float32*, float32*, Cuda
@overload
def encode_backward(_0: Encoding, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Cuda) -> None: ...

# int64, int64, Cpu
def encode_workspace(_0: int, _1: int, _2: Cpu) -> int: ...

# LinearInputs, any*, Cpu
def grouped_linear(_0: LinearInputs, _1: Tensor | None, _2: Cpu) -> None: ...

# LinearInputs, LinearGradients, Cpu
def grouped_linear_backward(_0: LinearInputs, _1: LinearGradients, _2: Cpu) -> None: ...

# MlpTable, MlpInputs, float32*, Cpu
@overload
def grouped_mlp(_0: MlpTable, _1: MlpInputs, _2: Tensor | None, _3: Cpu) -> None: ...
# MlpCudaCall, MlpInputs, float32*, uint8*, Cuda
@overload
def grouped_mlp(_0: MlpCudaCall, _1: MlpInputs, _2: Tensor | None, _3: Tensor | None, _4: Cuda) -> None: ...

# MlpTable, MlpInputs, MlpGradients, Cpu
@overload
def grouped_mlp_backward(_0: MlpTable, _1: MlpInputs, _2: MlpGradients, _3: Cpu) -> None: ...
# MlpCudaCall, MlpInputs, MlpGradients, uint8*, Cuda
@overload
def grouped_mlp_backward(_0: MlpCudaCall, _1: MlpInputs, _2: MlpGradients, _3: Tensor | None, _4: Cuda) -> None: ...

# MlpTable, int64, int64, bool, bool, MlpPrecision, MlpCudaWay, Cuda
def grouped_mlp_call(_0: MlpTable, _1: int, _2: int, _3: bool, _4: bool, _5: str, _6: str, _7: Cuda) -> MlpCudaCall: ...

# MlpTable, MlpPrecision, MlpCudaWay, Cuda
def grouped_mlp_hashes(_0: MlpTable, _1: str, _2: str, _3: Cuda) -> bool: ...

# MlpCudaCall
def grouped_mlp_workspace(_0: MlpCudaCall) -> int: ...

# ProgramInputs, float32**, float32**, Cpu
@overload
def grouped_program(_0: ProgramInputs, _1: Sequence[Tensor | None] | None, _2: Sequence[Tensor | None] | None, _3: Cpu) -> None: ...
# ProgramInputs, ProgramSizes, float32**, float32**, uint8*, Cuda
@overload
def grouped_program(_0: ProgramInputs, _1: ProgramSizes, _2: Sequence[Tensor | None] | None, _3: Sequence[Tensor | None] | None, _4: Tensor | None, _5: Cuda) -> None: ...

# ProgramSizes, int64, int64, Cuda
def grouped_program_workspace(_0: ProgramSizes, _1: int, _2: int, _3: Cuda) -> int: ...

# HashInputs, HashGrid, float32*, Cpu
@overload
def hash_encode(_0: HashInputs, _1: HashGrid, _2: Tensor | None, _3: Cpu) -> None: ...
# HashInputs, HashGrid, float32*, Cuda
@overload
def hash_encode(_0: HashInputs, _1: HashGrid, _2: Tensor | None, _3: Cuda) -> None: ...

# HashInputs, HashGrid, const float32*, float32*, float32*, Cpu
@overload
def hash_encode_backward(_0: HashInputs, _1: HashGrid, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...
# HashInputs, HashGrid, const float32*, float32*, float32*, Cuda
@overload
def hash_encode_backward(_0: HashInputs, _1: HashGrid, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cuda) -> None: ...

# Isa
def isa_supported(_0: str) -> bool: ...

# 
def keep_freed_memory() -> None: ...

# const float32*, const float32*, const int32*, const int32*, int32*, int32*, int64, int64, int32, Cpu
@overload
def locate_cell(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Tensor | None, _6: int, _7: int, _8: int, _9: Cpu) -> bool: ...
# const float64*, const float64*, const int32*, const int32*, int32*, int32*, int64, int64, int32, Cpu
# const float32*, const float32*, const int32*, const int32*, const int32*, int32*, int64, int64, int64, int32, Cuda
@overload
def locate_cell(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Tensor | None, _6: int, _7: int, _8: int, _9: int, _10: Cuda) -> None: ...
# const float64*, const float64*, const int32*, const int32*, const int32*, int32*, int64, int64, int64, int32, Cuda

# const int32*, const int32*, int64, int64
def locate_cell_fault(_0: Tensor | None, _1: Tensor | None, _2: int, _3: int) -> str | None: ...

# int64, Cpu
def locate_cell_workspace(_0: int, _1: Cpu) -> int: ...

# MarchInputs, int32*, int32*, int64, Cpu
@overload
def march_rays_count(_0: MarchInputs, _1: Tensor | None, _2: Tensor | None, _3: int, _4: Cpu) -> None: ...
# MarchInputs, int32*, int32*, int64, Cuda
@overload
def march_rays_count(_0: MarchInputs, _1: Tensor | None, _2: Tensor | None, _3: int, _4: Cuda) -> None: ...

# MarchInputs, const int32*, const int32*, int64, int32*, float32*, float32*, float32*, int32*, Cpu
@overload
def march_rays_fill(_0: MarchInputs, _1: Tensor | None, _2: Tensor | None, _3: int, _4: Tensor | None, _5: Tensor | None, _6: Tensor | None, _7: Tensor | None, _8: Tensor | None, _9: Cpu) -> None: ...
# MarchInputs, const int32*, const int32*, int64, int32*, float32*, float32*, float32*, int32*, Cuda
@overload
def march_rays_fill(_0: MarchInputs, _1: Tensor | None, _2: Tensor | None, _3: int, _4: Tensor | None, _5: Tensor | None, _6: Tensor | None, _7: Tensor | None, _8: Tensor | None, _9: Cuda) -> None: ...

# Peak, Cpu
def measure_peak(_0: str, _1: Cpu) -> float: ...

# const float32*, const float32*, int32*, int64, int64, Cpu
@overload
def nearest_centre(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: int, _4: int, _5: Cpu) -> None: ...
# const float64*, const float64*, int32*, int64, int64, Cpu
# const float32*, const float32*, const int32*, int32*, int64, int64, Cuda
@overload
def nearest_centre(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: int, _5: int, _6: Cuda) -> None: ...
# const float64*, const float64*, const int32*, int32*, int64, int64, Cuda

# ObservedSamples, float32*, uint8*, int32*, float32*, Cpu
@overload
def observe_occupancy(_0: ObservedSamples, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...
# ObservedSamples, float32*, uint8*, int32*, float32*, Cuda
@overload
def observe_occupancy(_0: ObservedSamples, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cuda) -> None: ...

# KnownSamples, OwnSamples, Cpu
def own_samples(_0: KnownSamples, _1: OwnSamples, _2: Cpu) -> int: ...

# PixelRaysInputs, PixelRaysOutputs, Cpu
@overload
def pixel_rays(_0: PixelRaysInputs, _1: PixelRaysOutputs, _2: Cpu) -> bool: ...
# PixelRaysInputs, PixelRaysOutputs, Cuda
@overload
def pixel_rays(_0: PixelRaysInputs, _1: PixelRaysOutputs, _2: Cuda) -> None: ...

# RenderLossInputs, RenderLossOutputs, Cpu
@overload
def render_loss(_0: RenderLossInputs, _1: RenderLossOutputs, _2: Cpu) -> None: ...
# RenderLossInputs, RenderLossOutputs, Cuda
@overload
def render_loss(_0: RenderLossInputs, _1: RenderLossOutputs, _2: Cuda) -> None: ...

# MlpTable, MlpInputs, MarchInputs, SeeCells, SeeRule, SeeOutputs, Cpu
def render_opaque(_0: MlpTable, _1: MlpInputs, _2: MarchInputs, _3: SeeCells, _4: SeeRule, _5: SeeOutputs, _6: Cpu) -> bool: ...

# const float32*, const float32*, const float32*, float32*, int64, int64, int64, Cpu
@overload
def resample(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: int, _5: int, _6: int, _7: Cpu) -> None: ...
# const float32*, const float32*, const float32*, float32*, float64*, int64, int64, int64, Cuda
@overload
def resample(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: int, _6: int, _7: int, _8: Cuda) -> None: ...

# RenderLossInputs, const float32*, float32*, float32*, float32*, Cpu
def run_gradients(_0: RenderLossInputs, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...

# RenderLossInputs, const float32*, const int32*, float32*, float32*, Cpu
def run_sums(_0: RenderLossInputs, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Tensor | None, _5: Cpu) -> None: ...

# SparseDepth, float32*, float32*, float32*, Cpu
def sparse_depth_gradient(_0: SparseDepth, _1: Tensor | None, _2: Tensor | None, _3: Tensor | None, _4: Cpu) -> None: ...

# const float32*, float32*, int64, int64, Cpu
@overload
def spherical_harmonics(_0: Tensor | None, _1: Tensor | None, _2: int, _3: int, _4: Cpu) -> None: ...
# const float32*, float32*, int64, int64, Cuda
@overload
def spherical_harmonics(_0: Tensor | None, _1: Tensor | None, _2: int, _3: int, _4: Cuda) -> None: ...

# const float32*, const float32*, float32*, int64, int64, Cpu
@overload
def spherical_harmonics_backward(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: int, _4: int, _5: Cpu) -> None: ...
# const float32*, const float32*, float32*, int64, int64, Cuda
@overload
def spherical_harmonics_backward(_0: Tensor | None, _1: Tensor | None, _2: Tensor | None, _3: int, _4: int, _5: Cuda) -> None: ...
