"""Every kernel once on a few blocks, for a process under a sanitizer: ``sanitize.py MODULE [hostile]``.

``hostile``: instead what the host cannot refuse without reading it, offsets that fall or leave the batch, trees and
cells that are none. Nothing outside of the tensors may be touched; results, and who writes them, are undefined.

Without torch, which takes a sanitizer minutes. Results are test_ops.py's matter; here only memory and order count, and
that every element of an output is written.
"""

import sys

import numpy as np
from emulation_build import load

GPU = (0, 0)
"""Device and stream."""
RANDOM = np.random.default_rng(0)


def at(array):
    return 0 if array is None else array.ctypes.data


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
    for dtype, name in ((np.float32, "float32"), (np.float64, "float64")):
        points, centres, weights, cells = floats(300, 3, dtype=dtype), floats(530, 3, dtype=dtype), None, None
        for weights in (None, floats(530, dtype=dtype)):
            cells = unwritten(300, dtype=np.int32)
            arguments = at(points), at(centres), at(weights), at(cells), 300, 530
            getattr(module, f"nearest_centre_cuda_{name}")(*arguments, *GPU)
            written(cells)


def locate_cell(module):
    points, centres, leaves = floats(300, 3), floats(5, 3), unwritten(300, dtype=np.int32)
    child_offsets, child = integers(0, 3, 5), integers(-1, 1, -4, -2, -3)
    addresses = at(points), at(centres), 0, at(child_offsets), at(child), at(leaves)
    module.locate_cell_cuda_float32(*addresses, 300, 5, 2, 2, *GPU)
    written(leaves)


def draw_cell(module):
    points, centres, uniforms = floats(300, 3), floats(5, 3), floats(300, 2)
    child_offsets, child = integers(0, 3, 5), integers(-1, 1, -4, -2, -3)
    for weights in (None, floats(5)):
        leaves = unwritten(300, dtype=np.int32)
        addresses = at(points), at(centres), at(weights), at(child_offsets), at(child), at(uniforms), at(leaves)
        module.draw_cell_cuda(*addresses, 300, 5, 2, 2, 0.3, *GPU)
        written(leaves)


def cell_sort(module):
    # By counting and by radix. Keys of 4 bytes would need 65,535 cells, each a thread: too many for a sanitizer.
    for n, k, way in ((3000, 5, 0), (9000, 2, 1), (600, 3, 2), (300, 1100, 0)):
        cells = RANDOM.integers(-1, k + 1, n).astype(np.int32)
        order, offsets = unwritten(n, dtype=np.int32), unwritten(k + 1, dtype=np.int32)
        workspace = np.full(module.cell_sort_workspace_cuda(n, k, way, GPU[0]), 255, np.uint8)
        module.cell_sort_cuda(at(cells), at(order), at(offsets), at(workspace), n, k, way, *GPU)
        assert (np.sort(order) == np.arange(n)).all()
        written(offsets)


def composite(module):
    m, r = 180, 5
    ray_offsets = integers(2, 2, 3, 73, 140, 177)
    for c, background in ((3, floats(3)), (5, floats(r, 5)), (1, None)):
        inputs = floats(m), floats(m, c), floats(m), floats(m), ray_offsets, background
        sizes = [r, 0, m, c, int(background is not None and background.ndim == 2)]
        results = unwritten(r, c), unwritten(r), unwritten(r), unwritten(m)
        module.composite_cuda([at(x) for x in inputs], sizes, [at(x) for x in results], *GPU)
        written(*results)
        incoming = floats(r, c), floats(r), floats(r), floats(m)
        outgoing = [unwritten(*x.shape) for x in inputs[:4]]
        outgoing += [] if background is None else [unwritten(*background.shape)]
        targets = [at(x) for x in outgoing] + [0] * (5 - len(outgoing)) + [at(workspace := unwritten(r))]
        module.composite_backward_cuda([at(x) for x in inputs], sizes, [at(x) for x in incoming], targets, *GPU)
        written(*outgoing, *([] if background is None else [workspace]))


def encode(module):
    x, gradient = floats(90, 3), floats(90, 27)
    for variances, include in ((None, True), (None, False), (floats(90, 3), False)):
        width = 3 * (8 + include)
        out, grad_x, grad_variances = unwritten(90, width), unwritten(90, 3), unwritten(90, 3)
        module.encode_cuda(at(x), at(variances), at(out), 90, 3, 4, include, *GPU)
        second = None if variances is None else grad_variances
        addresses = at(gradient), at(x), at(variances), at(grad_x), at(second)
        module.encode_backward_cuda(*addresses, 90, 3, 4, include, *GPU)
        written(out, grad_x, *([] if second is None else [second]))


def resample(module):
    r, s, count = 6, 45, 70
    for uniforms in (None, floats(r, count)):
        weights, edges = floats(r, s), np.cumsum(floats(r, s + 1), axis=1)
        depths, workspace = unwritten(r, count), unwritten(r, s, dtype=np.float64)
        addresses = at(weights), at(edges), at(uniforms), at(depths), at(workspace)
        module.resample_cuda(*addresses, r, s, count, *GPU)
        written(depths)


# Sine 20 of 2 octaves of positions, softplus 70 of that and positions, sigmoid 18 of that and directions; out come the
# last and the first. As voronerf/native/grouped_mlp.py writes it.
TABLE = [3, 3, 2, -1, 0, 0, 0, 3, 2, 20, 4, 1, -1, 70, 2, 2, 0, -1, 18, 3, 2, 1, -2, 2, 0]
SHAPES = [(20, 15), (70, 35), (18, 73)]


def grouped_mlp(module):
    counts = [37, 0, 20, 3]
    n, k, r = 64, len(counts), 5
    offsets = np.cumsum([2, *counts]).astype(np.int32)
    positions, directions, gradient = floats(n, 3), floats(r, 3), floats(n, 38)
    index, order = RANDOM.integers(0, r, n).astype(np.int32), RANDOM.permutation(n).astype(np.int32)
    weights, biases = [floats(k, o, i) for o, i in SHAPES], [floats(k, o) for o, _ in SHAPES]
    arguments = [at(positions), at(directions), at(index), at(offsets), at(order), n, r, k]
    given = TABLE, arguments, [at(x) for x in weights], [at(x) for x in biases]
    # Values in registers, with weights that stay or pass through; in shared memory, where that is asked for; and what
    # fits no fused network: layer by layer. Last, in registers with products of four warps.
    for precision, shared, way in (
        *((0, 227, 0), (1, 40, 2), (3, 64, 0), (1, 227, 0), (2, 30, 0), (1, 1, 0)),
        *((1, 227, 4), (2, 40, 4)),
    ):
        module.device(90, 120, shared * 1024)

        def workspace(backward, precision=precision, way=way):
            size = module.grouped_mlp_workspace_cuda(TABLE, precision, n, k, backward, True, 0, way)
            assert isinstance(size, int), size
            return np.full(size, 255, np.uint8)

        out, memory = unwritten(n, 38), workspace(False)
        module.grouped_mlp_cuda(*given, at(out), precision, at(memory), *GPU, way)
        grad_weights, grad_biases = [unwritten(*x.shape) for x in weights], [unwritten(*x.shape) for x in biases]
        grad_positions, grad_directions, memory = unwritten(n, 3), unwritten(n, 3), workspace(True)
        results = [at(x) for x in grad_weights], [at(x) for x in grad_biases], at(grad_positions), at(grad_directions)
        module.grouped_mlp_backward_cuda(*given, at(gradient), *results, precision, at(memory), *GPU, way)
        written(out, *grad_weights, *grad_biases, grad_positions, grad_directions)


def hostile(module):
    least, most = -(2**31), 2**31 - 1
    cells = RANDOM.choice([least, -1, 0, 4, 5, 6, 65_536, most], 700).astype(np.int32)
    for k, way in ((1, 1), (5, 1), (5, 2), (1100, 0)):
        for n in (0, 1, 700):
            order, offsets = unwritten(n, dtype=np.int32), unwritten(k + 1, dtype=np.int32)
            workspace = np.full(module.cell_sort_workspace_cuda(n, k, way, 0), 255, np.uint8)
            module.cell_sort_cuda(at(cells), at(order), at(offsets), at(workspace), n, k, way, *GPU)
            assert (np.sort(order) == np.arange(n)).all() and (np.diff(offsets) >= 0).all()

    points, centres = floats(300, 3), floats(5, 3)
    points[::3] = np.array([np.nan, np.inf, 1e38])
    trees = [([0, 3, 5], [-1, 1, 2, -2, most]), ([0, 3, 5], [0, 1, 1, 0, 1]), ([-4, 9, 5], [1] * 5)]
    for child_offsets, child in [*trees, ([3, 3, 0], [-1] * 5), ([0, most, least], [1, 1, 1, 0, 0])]:
        tables, leaves = [integers(*child_offsets), integers(*child)], unwritten(300, dtype=np.int32)
        addresses = at(points), at(centres), 0, *(at(table) for table in tables), at(leaves)
        module.locate_cell_cuda_float32(*addresses, 300, 5, 2, 3, *GPU)
        written(leaves)
        uniforms, leaves = floats(300, 3), unwritten(300, dtype=np.int32)
        uniforms[::4] = np.array([np.nan, -1, 7])
        addresses = at(points), at(centres), 0, *(at(table) for table in tables), at(uniforms), at(leaves)
        module.draw_cell_cuda(*addresses, 300, 5, 2, 3, 0.1, *GPU)
        written(leaves)

    m, r, c = 180, 5, 3
    for offsets in ([5, 3, -4, 500, 90, 7], [least, most, least, most, 0, 180], [180, 180, 181, 0, -1, most]):
        inputs = floats(m), floats(m, c), floats(m), floats(m), integers(*offsets), floats(c)
        inputs[0][::5], inputs[2][::7] = np.inf, np.nan
        sizes, results = [r, 0, m, c, 0], [floats(r, c), floats(r), floats(r), floats(m)]
        module.composite_cuda([at(x) for x in inputs], sizes, [at(x) for x in results], *GPU)
        outgoing = [*(unwritten(*x.shape) for x in inputs[:4]), unwritten(c), unwritten(r)]
        addresses = [at(x) for x in inputs], sizes, [at(x) for x in results], [at(x) for x in outgoing]
        module.composite_backward_cuda(*addresses, *GPU)

    weights, edges, depths = floats(6, 45), floats(6, 46), unwritten(6, 70)
    weights[0], weights[1, ::2], weights[2], weights[3] = 0, np.nan, np.inf, -1
    edges[4, 3], uniforms = np.nan, floats(6, 70)
    uniforms[:, ::4], uniforms[:, 1::8] = np.nan, 1e30
    workspace = unwritten(6, 45, dtype=np.float64)
    module.resample_cuda(at(weights), at(edges), at(uniforms), at(depths), at(workspace), 6, 45, 70, *GPU)

    n, k = 64, 4
    for offsets in ([9, 3, -5, 200, 64], [least, most, least, most, 0], [64, 0, 64, 0, 64], [-7, -5, -3, -2, -1]):
        # Chained forward, also by four warps, in tiles and layer by layer forward and backward.
        for forward, backward in ((1, 2), (4, 2), (2, 2), (3, 3)):
            module.device(90, 120, 227 * 1024)
            given, sums = network(n, k, integers(*offsets))
            ways = ((False, forward), (True, backward))
            sizes = [module.grouped_mlp_workspace_cuda(TABLE, 1, n, k, back, True, 0, way) for back, way in ways]
            memory = [np.full(size, 255, np.uint8) for size in sizes]
            module.grouped_mlp_cuda(*given[:4], at(sums[0]), 1, at(memory[0]), *GPU, forward)
            addresses = at(sums[1]), *given[4:], at(sums[2]), at(sums[3]), 1, at(memory[1])
            module.grouped_mlp_backward_cuda(*given[:4], *addresses, *GPU, backward)


KEPT = []
"""What addresses have been taken of."""


def network(n, k, offsets):
    """Arguments up to the gradients of biases; output, its gradient, and those of positions and directions."""
    positions, directions, index = floats(n, 3), floats(5, 3), RANDOM.integers(0, 5, n).astype(np.int32)
    weights, biases = [floats(k, o, i) for o, i in SHAPES], [floats(k, o) for o, _ in SHAPES]
    grad_weights, grad_biases = [unwritten(*x.shape) for x in weights], [unwritten(*x.shape) for x in biases]
    order = RANDOM.permutation(n).astype(np.int32)
    arguments = [at(positions), at(directions), at(index), at(offsets), at(order), n, 5, k]
    KEPT.append((positions, directions, index, weights, biases, grad_weights, grad_biases, order, offsets))
    lists = [[at(x) for x in part] for part in (weights, biases, grad_weights, grad_biases)]
    return (TABLE, arguments, *lists), [unwritten(n, 38), floats(n, 38), unwritten(n, 3), unwritten(n, 3)]


def main(path, kind="usual"):
    module = load(path)
    usual = (nearest_centre, locate_cell, draw_cell, cell_sort, composite, encode, resample, grouped_mlp)
    for run in (hostile,) if kind == "hostile" else usual:
        run(module)
    print("clean")


if __name__ == "__main__":
    main(*sys.argv[1:])
