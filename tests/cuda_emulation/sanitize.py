"""Every kernel once on a few blocks, for a process under a sanitizer: ``sanitize.py MODULE [hostile]``.

``hostile``: instead what the host cannot refuse without reading it, offsets that fall or leave the batch, trees and
cells that are none. Nothing outside of the tensors may be touched; results, and who writes them, are undefined.

Without torch, which takes a sanitizer minutes. Results are test_ops.py's matter; here only memory and order count, and
that every element of an output is written.
"""

import sys

import numpy as np
from emulation_build import load

RANDOM = np.random.default_rng(0)
DTYPES = {name: name for name in ("float32", "float64", "int32", "int64", "uint8", "bool")}


class Memory:
    """An array as the module takes tensors."""

    def __init__(self, array):
        self.array, self.dtype = array, DTYPES[array.dtype.name]

    def contiguous(self):
        return self

    def is_contiguous(self):
        return True

    def is_neg(self):
        return False

    def data_ptr(self):
        return self.array.ctypes.data


def at(array):
    return None if array is None else Memory(array)


def every(arrays):
    return [at(array) for array in arrays]


def floats(*shape, dtype=np.float32):
    return RANDOM.random(shape).astype(dtype)


def integers(*values):
    return np.array(values, np.int32)


def unwritten(*shape, dtype=np.float32):
    return np.full(shape, np.nan if dtype is not np.int32 else -7777, dtype)


def written(*arrays):
    for array in arrays:
        assert not (np.isnan(array) if array.dtype != np.int32 else array == -7777).any()


def nearest_centre(module):
    for dtype in (np.float32, np.float64):
        points, centres = floats(300, 3, dtype=dtype), floats(530, 3, dtype=dtype)
        for weights in (None, floats(530, dtype=dtype)):
            cells = unwritten(300, dtype=np.int32)
            module.nearest_centre(*every((points, centres, weights, None, cells)), 300, 530, module.Cuda(0, 0))
            written(cells)


def locate_cell(module):
    points, centres, leaves = floats(300, 3), floats(5, 3), unwritten(300, dtype=np.int32)
    tables = integers(0, 3, 5), integers(-1, 1, -4, -2, -3)
    module.locate_cell(*every((points, centres, None, *tables, None, leaves)), 300, 5, 2, 2, module.Cuda(0, 0))
    written(leaves)


def sort(module, cells, k, way):
    n, gpu = len(cells), module.Cuda(0, 0)
    order, offsets = unwritten(n, dtype=np.int32), unwritten(k + 1, dtype=np.int32)
    workspace = np.full(module.cell_sort_workspace(n, k, way, gpu), 255, np.uint8)
    module.cell_sort(*every((cells, order, offsets, workspace)), n, k, way, gpu)
    assert (np.sort(order) == np.arange(n)).all()
    return order, offsets


def cell_sort(module):
    # By counting and by radix. Keys of 4 bytes would need 65,535 cells, each a thread: too many for a sanitizer.
    for n, k, way in ((3000, 5, "automatic"), (9000, 2, "counting"), (600, 3, "radix"), (300, 1100, "automatic")):
        _, offsets = sort(module, RANDOM.integers(-1, k + 1, n).astype(np.int32), k, way)
        written(offsets)


def composite(module):
    m, r = 180, 5
    for c, background in ((3, floats(3)), (5, floats(r, 5)), (1, None)):
        inputs = floats(m), floats(m, c), floats(m), floats(m), integers(2, 2, 3, 73, 140, 177), background
        results, outgoing = composited(module, inputs, r, c)
        written(*results, *(x for x in outgoing if x is not None))


def composited(module, inputs, r, c):
    """Results, and the gradients of them with the workspace."""
    background, gpu = inputs[-1], module.Cuda(0, 0)
    m, per_ray = len(inputs[0]), background is not None and background.ndim == 2
    given = module.CompositeInputs(*every(inputs), per_ray, r, 0, m, c)
    results = [unwritten(r, c), unwritten(r), unwritten(r), unwritten(m)]
    module.composite(given, module.CompositeOutputs(*every(results)), gpu)
    outgoing = [unwritten(*x.shape) for x in inputs[:4]]
    outgoing += [None, None] if background is None else [unwritten(*background.shape), unwritten(r)]
    incoming = floats(r, c), floats(r), floats(r), floats(m)
    module.composite_backward(given, module.CompositeGradients(*every((*incoming, *outgoing))), gpu)
    return results, outgoing


def step(module):
    """What surrounds the networks in a step of training."""
    gpu, offsets = module.Cuda(0, 0), integers(2, 2, 3, 73, 140, 177)
    for background in (floats(3), floats(5, 3), None):
        written(*rendered(module, offsets, background))
    poses, lenses, bent, box = floats(3, 4, 4), floats(3, 4) + 9, floats(3, 8) / 99, np.array([[-1, -1, -1], [1, 1, 1]])
    images, pixels = RANDOM.integers(0, 256, (3, 12, 17, 4), dtype=np.uint8), RANDOM.integers(0, 612, 300)
    models = np.arange(3, dtype=np.int32)
    given = module.PixelRaysInputs(
        *every((poses, lenses, bent, models, images, pixels, box.astype(np.float32), floats(3))), False,
        3, 12, 17, 4, 300, 1.0, 4.0
    )  # fmt: skip
    results = [unwritten(300, 3), unwritten(300, 3), unwritten(300), unwritten(300), unwritten(300, 3)]
    module.pixel_rays(given, module.PixelRaysOutputs(*every(results)), gpu)
    written(*results)
    density, occupied, before = floats(60), np.zeros(60, np.uint8), unwritten(700)
    cells, corners = unwritten(700, dtype=np.int32), np.array([[0, 0, 0], [1, 1, 1]], np.float32)
    samples = every((floats(700, 3), floats(700), floats(700), floats(700), corners))
    seen = module.ObservedSamples(*samples, 3, 4, 5, 700, 0.9, 0.8, 0.01)
    module.observe_occupancy(seen, *every((density, occupied, cells, before)), gpu)
    assert (occupied == (density >= 0.8)).all()
    rule, gradient = module.SparseAdam(0.01, 0.9, 0.99, 1e-8, False), floats(700)
    gradient[::3] = 0
    module.sparse_adam(rule, *every((gradient, floats(700), floats(700), floats(700))), 700, gpu)
    sizes = [1100, 33, 1100]  # ThreadSanitizer knows some thousand threads of a launch
    rules = [module.AdamRule(0.0, at(floats(1)), at(floats(1)), 0.9, 0.99, 1e-8, n > 33) for n in sizes]
    tensors = [[floats(n) for n in sizes] for _ in range(4)]
    guard = module.AdamGuard(at(floats(1)), 9.0, *every([floats(1) for _ in range(4)]))
    module.adam(rules, guard, *map(every, tensors), sizes, at(unwritten(2 * len(sizes))), gpu)
    marched(module, 7, 70)
    ends, first = np.cumsum(RANDOM.integers(1, 9, 40)), RANDOM.integers(0, 1, 99).astype(np.int32)
    drawn, uniforms = np.full(300, -7777), unwritten(300, 3)
    given = module.DrawPixelsInputs(*every((integers(5), ends, ends - 9, first)), 3, int(ends[-1]), 300)
    module.draw_pixels(given, *every((drawn, uniforms)), gpu)
    written(uniforms)
    rows, result = RANDOM.integers(-1, 61, 700).astype(np.int32), unwritten(60)
    given = every((floats(60), rows, floats(700), result, occupied))
    module.update_occupancy(*given, 60, 700, 0.9, 0.5, gpu)
    written(result)
    assert (occupied == (result >= 0.5)).all()


def marched(module, r, s):
    """Rays through a grid of which half of the cells are taken, cut at 90 samples in 100 rows."""
    gpu, box, words = module.Cuda(0, 0), np.array([[0, 0, 0], [1, 1, 1]], np.float32), -(-s // 32)
    for sphere, start, capacity in ((None, None, 90), (floats(4) + 1, RANDOM.integers(0, s, r).astype(np.int32), 9999)):
        rays = every((floats(r, 3), floats(r, 3) - 0.5, floats(r) / 9, floats(r) + 1))
        taken, drawn = RANDOM.integers(0, 2, (3, 4, 5), dtype=np.uint8), (None, integers(3))
        if start is None:
            drawn = floats(r, s), None
        space = module.MarchSpace(at(sphere), None)
        given = module.MarchInputs(*rays, *every((taken, box, *drawn, start)), r, s, 3, 4, 5, False, s // 2, space)
        mask, offsets = unwritten(r, words, dtype=np.int32), unwritten(r + 1, dtype=np.int32)
        module.march_rays_count(given, *every((mask, offsets)), capacity, gpu)
        rows = max(int(offsets[-1]), 100)
        assert (np.diff(offsets) >= 0).all() and offsets[-1] <= capacity
        results = [unwritten(rows, dtype=np.int32), unwritten(rows), unwritten(rows), unwritten(rows, 3)]
        results.append(unwritten(r, dtype=np.int32))
        module.march_rays_fill(given, *every((mask, offsets)), rows, *every(results), gpu)
        written(offsets, *results)


def rendered(module, offsets, background):
    """All that render_loss gives of 180 samples."""
    r, per_ray = len(offsets) - 1, background is not None and background.ndim == 2
    inputs = every((floats(180, 4), floats(180), offsets, floats(r, 3), background))
    results = [unwritten(1), unwritten(r, 3), unwritten(180), unwritten(180), unwritten(r), unwritten(180, 4)]
    given = module.RenderLossInputs(*inputs, per_ray, 10.0, 0.0, r, 180)
    module.render_loss(given, module.RenderLossOutputs(*every(results)), module.Cuda(0, 0))
    return results


def encode(module):
    x, gradient, gpu = floats(90, 3), floats(90, 27), module.Cuda(0, 0)
    for variances, include in ((None, True), (None, False), (floats(90, 3), False)):
        width = 3 * (8 + include)
        out, grad_x, grad_variances = unwritten(90, width), unwritten(90, 3), unwritten(90, 3)
        second = None if variances is None else grad_variances
        given = module.Encoding(at(x), at(variances), 90, 3, 4, include, width)
        module.encode(given, at(out), gpu)
        module.encode_backward(given, *every((gradient, grad_x, second)), gpu)
        written(out, grad_x, *([] if second is None else [second]))


def hash_encode(module):
    encode_hashes(module, None, None)
    encode_hashes(module, floats(300, 3), RANDOM.integers(0, 3, 300).astype(np.int32))


def encode_hashes(module, direction, cells):
    """Two levels, a dense and a hashed one, in as many tables as cells may name."""
    gpu, tables = module.Cuda(0, 0), 1 if cells is None else 3
    levels = module.GridLevel(3.0, 0.5, 4, 64, 0, False), module.GridLevel(80.0, 0.5, 81, 1024, 64, True)
    grid = module.HashGrid(levels=levels, low=(0.1,) * 3, high=(0.9,) * 3, features=2, smooth=True)
    table, positions = floats(tables, 1088, 2), floats(300, 3)
    given = module.HashInputs(*every((positions, direction, table)), "float32", at(cells), 300, tables, 1088)
    out, of_table, of_positions = unwritten(300, 4), unwritten(tables, 1088, 2), unwritten(300, 3)
    module.hash_encode(given, grid, at(out), gpu)
    module.hash_encode_backward(given, grid, *every((floats(300, 4), of_table, of_positions)), gpu)
    written(out, of_table, of_positions)


def resample(module):
    r, s, count = 6, 45, 70
    for uniforms in (None, floats(r, count)):
        weights, edges = floats(r, s), np.cumsum(floats(r, s + 1), axis=1)
        depths, workspace = unwritten(r, count), unwritten(r, s, dtype=np.float64)
        module.resample(*every((weights, edges, uniforms, depths, workspace)), r, s, count, module.Cuda(0, 0))
        written(depths)


def table(module, harmonics):
    """Sine 20 of 2 octaves of positions (-1), softplus 70 of that and positions, sigmoid 18 of that and the
    directions (-2), or their harmonics of degree 2; out come the last and the first."""
    layers = (module.MlpLayer(20, "sine", (-1,)), module.MlpLayer(70, "softplus", (0, -1)))
    return module.MlpTable(
        layers=(*layers, module.MlpLayer(18, "sigmoid", (1, -2))),
        outputs=(2, 0),
        positions=3,
        directions=3,
        position=module.MlpEncoding("frequency", 2),
        direction=module.MlpEncoding(*(("spherical", 2) if harmonics else ("none", 0))),
        grid=module.HashGrid([], [], [], 0, False),
        half=False,
        caller="grouped_mlp",
    )


def network(module, n, k, offsets, precision, ways):
    """Forward and backward of random numbers; the output and the gradients of everything."""
    r, gpu = 5, module.Cuda(0, 0)
    harmonics = precision == "float32" or ways[0] in ("tiles", "layers")  # a chain of products refuses them
    layers, shapes = table(module, harmonics), [(20, 15), (70, 35), (18, 74 if harmonics else 73)]
    positions, directions, gradient = floats(n, 3), floats(r, 3), floats(n, 38)
    index, order = RANDOM.integers(0, r, n).astype(np.int32), RANDOM.permutation(n).astype(np.int32)
    weights, biases = [floats(k, o, i) for o, i in shapes], [floats(k, o) for o, _ in shapes]
    given = module.MlpInputs(
        *every((positions, directions, index, offsets)),
        every(weights),
        every(biases),
        n,
        r,
        k,
        at(order),
        None,
        "float32",
        1,
        None,
    )

    def rest(backward):
        way = ways[backward]
        size = module.grouped_mlp_workspace(layers, n, k, backward, True, precision, way, gpu)
        return precision, way, at(np.full(size, 255, np.uint8)), gpu

    out, grad_positions, grad_directions = unwritten(n, 38), unwritten(n, 3), unwritten(n, 3)
    grad_weights, grad_biases = [unwritten(*x.shape) for x in weights], [unwritten(*x.shape) for x in biases]
    module.grouped_mlp(layers, given, at(out), *rest(False))
    gradients = module.MlpGradients(
        at(gradient), every(grad_weights), every(grad_biases), at(grad_positions), at(grad_directions), None
    )
    module.grouped_mlp_backward(layers, given, gradients, *rest(True))
    return [out, *grad_weights, *grad_biases, grad_positions, grad_directions]


# Values in registers, with weights that stay or pass through; in shared memory, where that is asked for; what fits no
# fused network: layer by layer; and in registers with products of four warps.
NETWORKS = (
    *(("float32", 227, "auto"), ("bfloat16", 40, "tiles"), ("bfloat16", 227, "auto"), ("bfloat16", 1, "auto")),
    *(("bfloat16", 227, "wgmma"), ("tf32", 64, "auto"), ("float16", 30, "auto"), ("float16", 40, "wgmma")),
)


def grouped_mlp(module):
    for precision, shared, way in NETWORKS:
        module.device(90, 120, shared * 1024)
        offsets = np.cumsum([2, 37, 0, 20, 3]).astype(np.int32)
        written(*network(module, 64, 4, offsets, precision, (way, way)))
    module.device(90, 120, 227 * 1024)
    written(*hashed_network(module, integers(2, 39, 39, 62)))


def hashed_network(module, offsets):
    """A layer on a hash grid of two levels, with a table for each of three cells: its output and all gradients."""
    n, k, gpu = 64, 3, module.Cuda(0, 0)
    levels = module.GridLevel(3.0, 0.5, 4, 64, 0, False), module.GridLevel(80.0, 0.5, 81, 1024, 64, True)
    grid = module.HashGrid(levels=levels, low=(0.1,) * 3, high=(0.9,) * 3, features=2, smooth=True)
    layers = (module.MlpLayer(20, "relu", (-1,)),)
    none, hashed = module.MlpEncoding("none", 0), module.MlpEncoding("hash", 4)
    one = module.MlpTable(layers, (0,), 3, 0, hashed, none, grid, False, "grouped_mlp")
    positions, weight, features, order = floats(n, 3), floats(k, 20, 4), floats(k, 1088, 2), RANDOM.permutation(n)
    encoded = unwritten(n, 16)
    given = module.MlpInputs(
        at(positions), None, None, at(offsets), [at(weight)], [None], n, 0, k,
        at(order.astype(np.int32)), at(features), "float32", k, at(encoded),
    )  # fmt: skip

    def rest(backward):
        size = module.grouped_mlp_workspace(one, n, k, backward, True, "bfloat16", "auto", gpu)
        return "bfloat16", "auto", at(np.full(size, 255, np.uint8)), gpu

    out, results = unwritten(n, 20), [unwritten(k, 20, 4), unwritten(n, 3), unwritten(k, 1088, 2)]
    module.grouped_mlp(one, given, at(out), *rest(False))
    of_weight, of_positions, of_features = every(results)
    gradients = module.MlpGradients(at(floats(n, 20)), [of_weight], [None], of_positions, None, of_features)
    module.grouped_mlp_backward(one, given, gradients, *rest(True))
    return [out, *results]


def hostile(module):
    least, most, gpu = -(2**31), 2**31 - 1, module.Cuda(0, 0)
    cells = RANDOM.choice([least, -1, 0, 4, 5, 6, 65_536, most], 700).astype(np.int32)
    for k, way in ((1, "counting"), (5, "counting"), (5, "radix"), (1100, "automatic")):
        for n in (0, 1, 700):
            _, offsets = sort(module, cells[:n].copy(), k, way)
            assert (np.diff(offsets) >= 0).all()

    points, centres = floats(300, 3), floats(5, 3)
    points[::3] = np.array([np.nan, np.inf, 1e38])
    trees = [([0, 3, 5], [-1, 1, 2, -2, most]), ([0, 3, 5], [0, 1, 1, 0, 1]), ([-4, 9, 5], [1] * 5)]
    for child_offsets, child in [*trees, ([3, 3, 0], [-1] * 5), ([0, most, least], [1, 1, 1, 0, 0])]:
        tables, leaves = [integers(*child_offsets), integers(*child)], unwritten(300, dtype=np.int32)
        module.locate_cell(*every((points, centres, None, *tables, None, leaves)), 300, 5, 2, 3, gpu)
        written(leaves)

    m, r, c = 180, 5, 3
    for offsets in ([5, 3, -4, 500, 90, 7], [least, most, least, most, 0, 180], [180, 180, 181, 0, -1, most]):
        inputs = floats(m), floats(m, c), floats(m), floats(m), integers(*offsets), floats(c)
        inputs[0][::5], inputs[2][::7] = np.inf, np.nan
        composited(module, inputs, r, c)
        rendered(module, integers(*offsets), None)

    encode_hashes(module, None, RANDOM.choice([least, -1, 0, 2, 3, most], 300).astype(np.int32))

    weights, edges, depths = floats(6, 45), floats(6, 46), unwritten(6, 70)
    weights[0], weights[1, ::2], weights[2], weights[3] = 0, np.nan, np.inf, -1
    edges[4, 3], uniforms = np.nan, floats(6, 70)
    uniforms[:, ::4], uniforms[:, 1::8] = np.nan, 1e30
    workspace = unwritten(6, 45, dtype=np.float64)
    module.resample(*every((weights, edges, uniforms, depths, workspace)), 6, 45, 70, gpu)

    for offsets in ([9, 3, -5, 200, 64], [least, most, least, most, 0], [64, 0, 64, 0, 64], [-7, -5, -3, -2, -1]):
        # Chained forward, also by four warps, in tiles and layer by layer forward and backward.
        for ways in (("chain", "tiles"), ("wgmma", "tiles"), ("tiles", "tiles"), ("layers", "layers")):
            module.device(90, 120, 227 * 1024)
            network(module, 64, 4, integers(*offsets), "bfloat16", ways)
        hashed_network(module, integers(*offsets[:4]))


def main(path, kind="usual"):
    module = load(path)
    module.name_dtypes(DTYPES)
    usual = (
        nearest_centre,
        locate_cell,
        cell_sort,
        composite,
        step,
        encode,
        hash_encode,
        resample,
        grouped_mlp,
    )
    for run in (hostile,) if kind == "hostile" else usual:
        run(module)
    print("clean")


if __name__ == "__main__":
    main(*sys.argv[1:])
