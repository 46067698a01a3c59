"""One-line faults that the tests must detect: ``python tests/attack --mutate``.

Most faults have an effect only past a boundary, for one kind of input or on one of several paths.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """A replacement of one source line.

    Attributes:
        what: A description of the fault.
        file: The file's path from the root of the repository.
        line: The replaced part of a line, which occurs once in the file.
        wrong: The replacement.
        tests: Pytest arguments that select the tests of the changed part from `make test-all`.
    """

    what: str
    file: str
    line: str
    wrong: str
    tests: tuple[str, ...]


def _kernel(op: str, what: str, file: str, line: str, wrong: str) -> Fault:
    """Returns a fault in an op's kernel, which the op's tests or the tests of all ops should detect."""
    tests = ("tests/attack/test_blocks.py", f"tests/ops/test_{op}.py", "tests/ops/test_every_op.py", "-k", op)
    return Fault(f"{op}: {what}", f"csrc/{file}", line, wrong, tests)


def _on_cuda(op: str, what: str, file: str, line: str, wrong: str) -> Fault:
    """Returns a fault in an op's CUDA kernel, which the op's tests should detect on the emulated device."""
    tests = (f"tests/ops/test_{op}.py", "-k", "native-cpu and not compile and not opcheck", "--emulate-cuda", "1")
    return Fault(f"{op} on CUDA: {what}", f"csrc/{file}", line, wrong, tests)


def _python(what: str, file: str, line: str, wrong: str, *tests: str) -> Fault:
    return Fault(what, f"voronerf/{file}", line, wrong, tests)


def _router(what: str, file: str, line: str, wrong: str, *tests: str) -> Fault:
    return _python(what, f"router/{file}", line, wrong, *(f"tests/router/{name}" for name in tests))


def _recording(what: str, file: str, line: str, wrong: str) -> Fault:
    return _python(f"A recording: {what}", file, line, wrong, "tests/native/test_calls.py", "-k", "recording")


def _step(what: str, file: str, line: str, wrong: str) -> Fault:
    return _python(f"A recorded step: {what}", file, line, wrong, "tests/nerf/test_step.py", "tests/nerf/test_hooks.py")


FAULTS = (
    _kernel(
        "cell_sort",
        "row 100,000 is lost",
        "geometry/cell_sort.cpp",
        "order[place] =",
        "if (row != 100000) order[place] =",
    ),
    _kernel(
        "cell_sort",
        "negative cells are not refused",
        "geometry/cell_sort.cpp",
        "return static_cast<uint32_t>(cell) < static_cast<uint32_t>(k);",
        "return cell < k;",
    ),
    _kernel(
        "nearest_centre",
        "blocks behind the first lose their last point",
        "geometry/nearest_centre.cpp",
        "std::min(kBlock, n - start)",
        "std::min(kBlock - (b > 0), n - start)",
    ),
    _kernel(
        "nearest_centre",
        "near ties with a centre of another 256 are not decided in float64",
        "geometry/nearest_centre_isa.cpp",
        "second[u] = min(max(v, best[u]), min(as_float(next[u]), second[u]));",
        "second[u] = min(as_float(next[u]), second[u]);",
    ),
    _kernel(
        "nearest_centre",
        "an index gives any of the nearest centres",
        "geometry/centre_index_isa.cpp",
        "if (v < best || (v == best && numbers[i] < cell)) {",
        "if (v < best) {",
    ),
    _kernel(
        "nearest_centre",
        "an index leaves out boxes as far as the best",
        "geometry/centre_index_isa.cpp",
        "if (!(remaining[nearest] <= best)) continue;",
        "if (!(remaining[nearest] < best)) continue;",
    ),
    _kernel(
        "nearest_centre",
        "an index of too few words is searched",
        "geometry/nearest_centre.cpp",
        "words != shape.words || ",
        "",
    ),
    _kernel(
        "nearest_centre",
        "an index leaves out boxes within the rounding of the best",
        "geometry/centre_index_isa.cpp",
        "reach = best + (kMargin * best + kFloor);",
        "reach = best;",
    ),
    _kernel(
        "nearest_centre",
        "the bound from the last point's centre has no margin",
        "geometry/centre_index_isa.cpp",
        "bound = v + 2.0f * (kMargin * v + kFloor);",
        "bound = v;",
    ),
    _on_cuda(
        "nearest_centre",
        "the bound from the last point's centre has no margin",
        "geometry/nearest_centre.cu",
        "bound = fminf(v + 2.0f * (kMargin * v + kFloor), bound);",
        "bound = fminf(v, bound);",
    ),
    _on_cuda(
        "nearest_centre",
        "an index leaves out boxes within the rounding of the best",
        "geometry/nearest_centre.cu",
        "reach = exact ? best : best + (kMargin * best + kFloor);",
        "reach = best;",
    ),
    _kernel(
        "nearest_centre",
        "float32 decides between distances closer than its rounding",
        "geometry/nearest_centre_math.h",
        "kMargin = 2e-6f;",
        "kMargin = 2e-7f;",
    ),
    _kernel(
        "nearest_centre",
        "an infinite bound leads to children that do not exist",
        "geometry/centre_index_isa.cpp",
        "bound = bound < kHuge ? bound : kHuge;",
        "",
    ),
    _kernel(
        "march_rays",
        "uniforms behind the last stratum are read",
        "rays/march_rays_isa.cpp",
        "size = left < kMarchWord ? left : kMarchWord;",
        "size = kMarchWord;",
    ),
    _kernel(
        "march_rays",
        "leaps do not allow for the rounding of positions",
        "rays/march_rays_isa.cpp",
        "walk.slack[j] = 1e-3f + 1e-6f *",
        "walk.slack[j] = 0.0f *",
    ),
    _kernel(
        "hash_encode",
        "a block at the end reads points behind the last",
        "encoding/hash_encode_tile.h",
        "if (rows == kHashBlock) return from;",
        "if (rows >= kLanes) return from;",
    ),
    _kernel(
        "keep_heaviest",
        "a part collects one sample more than it has memory for",
        "rays/keep_heaviest.cpp",
        "if (count < 2 * q) continue;",
        "if (count <= 2 * q) continue;",
    ),
    _kernel(
        "adam",
        "the last line of a dense parameter is updated past its end",
        "encoding/adam_isa.cpp",
        "rule.dense && line + kLine <= end;",
        "rule.dense && line < end;",
    ),
    _kernel(
        "spherical_harmonics",
        "a tile at the end reads rows behind the last",
        "encoding/encode_isa.cpp",
        "in.n - first >= kEncodeRows + kEncodeLanes;",
        "in.n - first >= kEncodeRows;",
    ),
    _kernel(
        "render_loss",
        "float32 is taken beside float64",
        "bindings/tensor_rules.h",
        "(wide && first != kFloat64 ? kFloat32 : first)",
        "(wide ? kFloat32 : first)",
    ),
    _python(
        "march_rays: more strata than int32 can count are not refused",
        "ops/march_rays/__init__.py",
        'check_count("march_rays", "samples of all rays", arguments.origins.shape[0] * arguments.samples)',
        "pass",
        "tests/ops/test_checks.py",
    ),
    _kernel(
        "locate_cell",
        "points of a block behind the first take the groups of its last",
        "geometry/tree_descent.h",
        "levels[0].groups[0] = {0, 0, n};",
        "levels[0].groups[0] = {0, 0, n < kDescentBlock ? n : n - 1};",
    ),
    _kernel(
        "march_rays",
        "cells three away from an occupied one count as farther",
        "rays/march_rays.cpp",
        "away < std::min<int64_t>(kMarchRoom, in.z)",
        "away < std::min<int64_t>(kMarchRoom - 1, in.z)",
    ),
    _kernel(
        "march_rays",
        "a ray that has all its samples goes on at the last of them",
        "rays/march_rays_isa.cpp",
        "if (++filled == in.max_samples) next = stratum + 1;",
        "if (++filled == in.max_samples) next = stratum;",
    ),
    _kernel(
        "composite",
        "the last of 128 samples hides nothing behind it",
        "rays/composite_isa.cpp",
        "before += static_cast<double>(optical[i]);",
        "if (i + 1 < kChunk) before += static_cast<double>(optical[i]);",
    ),
    _kernel(
        "render_loss",
        "the optical depth in front is forgotten between blocks of 128",
        "rays/render_tile.h",
        "double before = front[ray];",
        "double before = first == in.offsets[from] ? front[ray] : 0.0;",
    ),
    _kernel(
        "render_loss",
        "what is behind is forgotten between blocks of 128",
        "rays/render_loss_isa.cpp",
        "double behind = sums.behind[ray];",
        "double behind = together || end < kChunk ? sums.behind[ray] : 0.0;",
    ),
    _kernel(
        "render_loss",
        "the gradient of NaN light is 0",
        "rays/render_loss_isa.cpp",
        "const Bits seen = ~(light <= splat(hidden));",
        "const Bits seen = light > splat(hidden);",
    ),
    _kernel(
        "resample",
        "a target on the edge of two bins belongs to the earlier",
        "rays/resample.cpp",
        "target >= upper)",
        "target > upper)",
    ),
    _kernel(
        "keep_heaviest",
        "one of those that stay is lost when a part is full",
        "rays/keep_heaviest.cpp",
        "      count = q;",
        "      count = q - 1;",
    ),
    _kernel(
        "draw_pixels",
        "pixels of known depth are moved",
        "rays/draw_pixels.cpp",
        "const int64_t first = std::min(std::max<int64_t>(begin, in.known_count), end);",
        "const int64_t first = begin;",
    ),
    _kernel(
        "observe_occupancy",
        "the last cell of each thread's part is left out",
        "rays/observe_occupancy.cpp",
        "(part + 1) / parts) - first;",
        "(part + 1) / parts) - first - (parts > 1 ? 1 : 0);",
    ),
    _kernel(
        "pixel_rays",
        "the pixel behind the last image is taken",
        "rays/pixel_rays.cpp",
        "in.pixels[i] >= all)",
        "in.pixels[i] > all)",
    ),
    Fault(
        "sparse_depth_loss: samples whose ends reach the point are not near it",
        "csrc/rays/ray_losses.cpp",
        "<= in.nearby * in.distances[ray] + in.deltas[i];",
        "< in.nearby * in.distances[ray];",
        ("tests/attack/test_blocks.py", "tests/ops/test_ray_losses.py", "-k", "sparse_depth_loss"),
    ),
    _kernel(
        "adam",
        "blocks of 16,384 entries behind the first lose the last",
        "encoding/adam.cpp",
        "std::min(sizes[i], begin + kBlock)",
        "std::min(sizes[i], begin + kBlock - (begin > 0))",
    ),
    _kernel(
        "frequency_encode",
        "ranges of rows behind the first lose the last",
        "encoding/encode.cpp",
        "std::min(in.n, (i + 1) * rows));",
        "std::min(in.n, (i + 1) * rows - (i > 0)));",
    ),
    _kernel(
        "hash_encode",
        "runs of 1,024 points behind the first lose the last",
        "encoding/hash_encode.cpp",
        "run(i * kRun, std::min(n, (i + 1) * kRun));",
        "run(i * kRun, std::min(n, (i + 1) * kRun - (i > 0)));",
    ),
    _kernel(
        "hash_encode",
        "the cell behind the last table is taken",
        "encoding/hash_encode.cpp",
        "*last < in.tables)",
        "*last <= in.tables)",
    ),
    _kernel(
        "spherical_harmonics",
        "a last tile that is not whole loses its last direction",
        "encoding/encode_isa.cpp",
        "rows = tile.rows; row < rows",
        "rows = tile.rows - (first > begin); row < rows",
    ),
    _kernel(
        "grouped_program",
        "gradients of cells without rows are not written",
        "network/cpu/program.cpp",
        "if (count > 0 || empty)",
        "if (count > 0)",
    ),
    _kernel(
        "grouped_program",
        "a row with a gradient goes to the cell before",
        "network/cpu/program.cpp",
        "std::lower_bound(result.rows.begin()",
        "std::upper_bound(result.rows.begin()",
    ),
    _kernel(
        "grouped_program",
        "the second of three parts of a cell's sum is left out",
        "network/cpu/program_isa.cpp",
        "for (int64_t part = 1; part < count; ++part) {",
        "for (int64_t part = count > 2 ? 2 : 1; part < count; ++part) {",
    ),
    _kernel(
        "grouped_program",
        "the third derivative of GELU is another",
        "network/function_table.h",
        "nearby(x) * nearby(x) - splat(4.0f)",
        "nearby(x) * nearby(x) - splat(3.0f)",
    ),
    _python(
        "Sorted rows come back in another order in the backward pass",
        "router/grouping.py",
        "return gradient.index_select(0, inverse), None, None",
        "return gradient.index_select(0, index), None, None",
        "tests/router/test_router_rules.py",
        "tests/router/test_router_use.py",
        "tests/router/test_router.py",
    ),
    _step(
        "after a hook on a parameter whose gradient is there it is replayed without that",
        "nerf/replay.py",
        '_HOOKS = ("_backward_hooks", "_post_accumulate_grad_hooks")',
        '_HOOKS = ("_backward_hooks",)',
    ),
    _step(
        "where gradients are off it is replayed and learns",
        "nerf/replay.py",
        "    torch.is_grad_enabled,",
        "",
    ),
    _step(
        "betas that are changed in place are not seen",
        "nerf/adam.py",
        'for name in ("params", "betas"))',
        'for name in ("params",))',
    ),
    _step(
        "a parameter of a second optimiser keeps no step from being replayed",
        "nerf/step.py",
        "if parameter.requires_grad and id(parameter) not in learning:",
        "if parameter.requires_grad and not learning:",
    ),
    _step(
        "only the first gradient is given back",
        "nerf/step.py",
        'for parameter, gradient in results["gradients"]:',
        'for parameter, gradient in results["gradients"][:1]:',
    ),
    _step(
        "a call of many steps forgets averages and decay in between",
        "nerf/step.py",
        "min(schedule.GROUP - at % schedule.GROUP, until_update)",
        "until_update",
    ),
    _step(
        "a call of many steps goes on after the grid has begun to learn",
        "nerf/step.py",
        "min(schedule.GROUP - at % schedule.GROUP, until_update)",
        "schedule.GROUP - at % schedule.GROUP",
    ),
    _step(
        "a tensor may move after a view of it was taken",
        "ops/_core/recording.py",
        "self._calls.add_tensor(args[0])",
        "pass",
    ),
    _step(
        "tensors may move to other memory",
        "ops/_core/recording.py",
        "if not self._calls.hold():",
        "if False:",
    ),
    _step(
        "gradients are cleared in another segment than they are made in",
        "nerf/step.py",
        "[draw, *evaluate, clear, learn,",
        "[draw, clear, *evaluate, learn,",
    ),
    _step(
        "a segment is recorded with the rows of an earlier step",
        "nerf/replay.py",
        "dict(earlier.recording.counted_now(earlier.value))",
        "dict(earlier.value)",
    ),
    _step(
        "what a hook returns may have another name",
        "nerf/replay.py",
        "[*held] if isinstance(held, dict) else len(entries)",
        "len(entries)",
    ),
    _step(
        "what a hook calls may be overridden",
        "nerf/replay.py",
        "return hook in overridden or any(",
        "return hook in overridden or False and any(",
    ),
    _step(
        "nothing that it depends on is noted",
        "nerf/replay.py",
        "self._note(False)  # before the hooks, which may change the dependencies",
        "pass",
    ),
    _step(
        "attributes of a subclass of one's own are not followed",
        "nerf/replay.py",
        "noted.contents(members, read=reads[-1][1])",
        "noted.contents(members, read=set())",
    ),
    _step(
        "entries of a container in an attribute are not followed",
        "nerf/replay.py",
        "return entries or ()",
        "return [each for each in entries or () if type(each) in _REPLAYED]",
    ),
    _step(
        "a method that is replaced on an object runs while the step is recorded, and never again",
        "nerf/replay.py",
        '_methods(kind).intersection(getattr(part, "__dict__", ()))',
        "_methods(kind).intersection(())",
    ),
    _step(
        "a replaced method that is removed again stays",
        "nerf/replay.py",
        "noted.entries(members, [*_methods(cast(Any, type(part)))])",
        "pass",
    ),
    _step(
        "a change within a hook waits for the next step",
        "nerf/replay.py",
        "if has_called and not self._dependencies.holds():",
        "if False:",
    ),
    _step(
        "a step may be called within its own hook",
        "nerf/step.py",
        "        if self._is_running:\n            raise",
        "        if False:\n            raise",
    ),
    _step(
        "a copy of the optimiser lacks its own attributes",
        "nerf/adam.py",
        "return {**super().__getstate__(), **own}",
        "return super().__getstate__()",
    ),
    _recording(
        "an interrupted recording stays on",
        "ops/_core/recording.py",
        "        finally:\n            self._end()\n",
        "        finally:\n            pass\n",
    ),
    _recording(
        "torch's flags stay after an interrupt",
        "ops/_core/modes.py",
        "vars(_python_dispatch).update(flags)",
        "pass",
    ),
    Fault(
        "A recorded step: a call that takes rows may have a number of rows that stays",
        "csrc/bindings/frame.h",
        "return has_rows_ && counted_.empty();",
        "return false;",
        ("tests/nerf/test_step.py",),
    ),
    _kernel(
        "rendered_gradient",
        "what lies behind a sample is forgotten",
        "rays/rendered_gradient.cpp",
        "behind += weight * worth;",
        "behind = weight * worth;",
    ),
    Fault(
        "A recorded step: a replay does not refuse what a call finds wrong",
        "csrc/bindings/bind.cpp",
        "type->kind == Type::Kind::boolean && !result.boolean) {",
        "type->kind == Type::Kind::boolean && !result.boolean && false) {",
        ("tests/nerf/test_step.py",),
    ),
    _python(
        "Adam goes down where it is to go up",
        "nerf/adam.py",
        '("weight_decay", "amsgrad", "maximize", "differentiable")',
        '("weight_decay", "amsgrad", "differentiable")',
        "tests/nerf/test_optimizer.py",
    ),
    _python(
        "What few samples have shown is not looked at again with more of them",
        "router/dispatch.py",
        "most = FEWEST - 1 if plan.small else MAX_COUNT",
        "most = MAX_COUNT",
        "tests/router/test_call_cache.py",
    ),
    _python(
        "A loop over cells has PyTorch's third derivatives of layer norms",
        "router/grouped.py",
        "mode = mode if mode.met else None",
        "mode = None",
        "tests/router/test_router_rules.py",
    ),
    _router(
        "The samples of a value between fused runs are in its first dimension",
        "fused.py",
        'dim = source.meta["axis"].dim if isinstance(source, fx.Node) else 0',
        "dim = 0",
        "test_conventions.py",
    ),
    _router(
        "A grouped call does not compare its integers with its record",
        "grouped.py",
        "value == m * self.n if m else value == constant",
        "True",
        "test_router_state.py",
    ),
    _router(
        "New steps of a grouped module are not compared with the loop",
        "probe.py",
        "if not self._agrees(Grouped([steps], quiet=True), loop, self._outcome(loop)):",
        "if False:",
        "test_router_state.py",
    ),
    _router(
        "A trace with a number as an input need not hold for the number's earlier value",
        "probe.py",
        "if candidate.others:",
        "if False:",
        "test_router_state.py",
    ),
    _router(
        "Items that forward changes stay changed for the next cell",
        "double.py",
        "                    restore_items(items)",
        "                    pass",
        "test_router_state.py",
    ),
    _router(
        "Submodules that only lists hold are shared by all cells",
        "cells.py",
        "hidden[id(item)] = item",
        "pass",
        "test_router_state.py",
    ),
    _router(
        "Modules may differ in attributes",
        "cells.py",
        "if not _same(ours_by_name.get(key), theirs_by_name.get(key), seen):",
        "if False:",
        "test_router_state.py",
    ),
    _router(
        "A result that counts samples counts those of one cell",
        "dispatch.py",
        "        if plan.counts:",
        "        if False:",
        "test_router_state.py",
    ),
    _router(
        "Batch norms normalise by the samples of a cell in training",
        "dispatch.py",
        "        refuse_statistics(checked.statistics)",
        "        pass",
        "test_conventions_refused.py",
    ),
    _router(
        "Methods keep their cells after a write to the centres",
        "router.py",
        "centres = self.diagram.snapshot() if keeps and not labelled else None",
        "centres = None",
        "test_call_cache.py",
    ),
    _router(
        "Methods keep the cells of labels that the caller has overwritten",
        "router.py",
        "positions = positions.clone() if keeps else positions",
        "positions = positions",
        "test_router_inference.py",
    ),
    _router(
        "What methods share is of inference mode",
        "router.py",
        "with outside(), torch.inference_mode(False):",
        "with outside():",
        "test_router_inference.py",
    ),
    _router(
        "The dependencies on parameters are seen before they are complete",
        "dispatch.py",
        "        checked = self._checked = _Checked(k, cell_shapes, statistics, module_dependencies(call.module))",
        "        self._checked = _Checked(k, cell_shapes, statistics, module_dependencies(nn.Module()))\n"
        "        checked = self._checked = _Checked(k, cell_shapes, statistics, module_dependencies(call.module))",
        "test_router_threads.py",
    ),
    _router(
        "A tensor in a list is a constant of the trace",
        "watch.py",
        "for item in (value, *items)",
        "for item in (value,)",
        "test_router_schedules.py",
    ),
    _router(
        "A view of a parameter keeps its old memory",
        "program.py",
        "if p._base is not None:  #",
        "if False:  #",
        "test_program_arguments.py",
    ),
    _router(
        "A module that is computed again is observed where a checkpoint keeps tensors",
        "double.py",
        "with _unobserved_hooks() if mode else contextlib.nullcontext(), mode",
        "with mode",
        "test_router_transforms.py",
    ),
    _python(
        "A write by tensor.data is not noticed",
        "ops/_core/unchanged.py",
        "is_copied = self._is_plain and tensor.is_cpu and tensor.nbytes <= most",
        "is_copied = False",
        "tests/native/test_unchanged.py",
    ),
    _python(
        "The index of centres is of inference mode",
        "diagram/voronoi.py",
        "with _disable_current_modes(), torch.inference_mode(False):",
        "with _disable_current_modes():",
        "tests/router/test_router_inference.py",
    ),
    _python(
        "float64 positions are compared with the index of float32 centres",
        "ops/network/cells.py",
        "index = self.centre_index if centres.dtype is self.centres.dtype else None",
        "index = self.centre_index",
        "tests/router/test_call_cache.py",
    ),
    _python(
        "The gradient of one table reads the kept features of another",
        "ops/network/native.py",
        "    keeps = keeps and lower(derived.text).lookups == lower(text).lookups",
        "",
        "tests/ops/test_grouped_program.py",
    ),
    Fault(
        "The tensors of a guard are not collected in cycles",
        "csrc/bindings/unchanged.cpp",
        "for (const Tensor& noted : tensors_) held.insert(held.end(), {noted.tensor.ptr(), noted.storage.ptr()});",
        "",
        ("tests/native/test_unchanged.py",),
    ),
    Fault(
        "A guard compares the first entries of a strided tensor",
        "csrc/bindings/unchanged.cpp",
        "at + i * view.strides[d] * size",
        "at + i * size",
        ("tests/native/test_unchanged.py",),
    ),
    _python(
        "A gradient passes a detached value",
        "ops/_core/program.py",
        'if not exists or step.name in ("stop", "step", "at_least"):',
        "if not exists:",
        "tests/router/test_missing_gradients.py",
    ),
    _python(
        "A module that does something else for a subclass of tensors is not told",
        "router/probe.py",
        'why = "" if same else "its results differ"',
        'why = ""',
        "tests/router/test_router_use.py",
    ),
    _python(
        "A tensor that was one for all samples is one for each",
        "router/dispatch.py",
        "has_rays, *call.kinds.items()]",
        "has_rays]",
        "tests/router/test_call_cache.py",
    ),
    _python(
        "A contraction's inverse is that of a ball of radius 1",
        "nerf/contraction.py",
        "clamp_min(1e-3) * length.clamp_min(1))",
        "clamp_min(1e-3))",
        "tests/nerf",
    ),
    _python(
        "The oldest batch of a reservoir does not come first",
        "diagram/reservoir.py",
        "start = added % self.batches if added > self.batches else 0",
        "start = 0",
        "tests/diagram",
    ),
    _python(
        "A cell with just enough samples is not split",
        "diagram/subdivision.py",
        "counts[cell] >= max(k, min_samples)",
        "counts[cell] > max(k, min_samples)",
        "tests/diagram",
    ),
    _python(
        "One checkpoint more is kept than was asked for",
        "app/train/checkpoint.py",
        "if number < keep:",
        "if number <= keep:",
        "tests/app/train/test_checkpoint.py",
        "tests/app/train/test_resume.py",
    ),
    _python(
        "A checkpoint's sums leave out its values",
        "app/train/checkpoint.py",
        '        checked[_VALUES] = zlib.crc32(metadata["values"].encode())',
        "        sums.pop(_VALUES, None)",
        "tests/app/train/test_checkpoint.py",
    ),
    _python(
        "A second new start is the first again",
        "app/train/start.py",
        "seed=config.seed + STRIDE * draw",
        "seed=config.seed + STRIDE",
        "tests/app/train/test_start.py",
    ),
    _python(
        "A ray has all its strata while the grid settles",
        "nerf/samplers.py",
        "return max(1, self.samples // SETTLING_PART) if self.settling else self.samples",
        "return self.samples",
        "tests/nerf/test_occupancy.py",
    ),
    _python(
        "Half transparent pixels have no features",
        "app/scenes/process.py",
        "pixels[..., 3] >= OPAQUE",
        "pixels[..., 3] > OPAQUE",
        "tests/app/scenes/test_process.py",
    ),
    _python(
        "Images are matched with those that share least",
        "app/scenes/process.py",
        "sorted(best, reverse=True)[:NEIGHBOURS]",
        "sorted(best)[:NEIGHBOURS]",
        "tests/app/scenes/test_process.py",
    ),
    _python(
        "The smallest features are kept",
        "app/scenes/process.py",
        "np.argsort(-area",
        "np.argsort(area",
        "tests/app/scenes/test_process.py",
    ),
    _python(
        "Masks drawn on turned photographs are taken as they are stored",
        "app/scenes/gather.py",
        "drawn(image, header.size, header.turns, ",
        "drawn(image, header.size, 0, ",
        "tests/app/scenes/test_process.py",
    ),
    _python(
        "Frames of videos keep the matrix of the video, which JPEG cannot state",
        "app/scenes/gather.py",
        '["out_color_matrix=bt601"] * (matrix != "unknown")',
        "list[str]()",
        "tests/app/scenes/test_videos.py",
    ),
    _python(
        "Two lenses of a phone share a camera",
        "app/scenes/gather.py",
        '[text.strip("\\0 ") for text in camera.values()] + [f"{value} mm" for value in lens.values()]',
        '[text.strip("\\0 ") for text in camera.values()]',
        "tests/app/scenes/test_process.py",
    ),
    _python(
        "A missing test image is replaced by the training image of this name",
        "app/scenes/transforms.py",
        'path.name != "transforms.json"',
        "False",
        "tests/app/scenes/test_scenes.py",
    ),
    _python(
        "A finished capture of another video is trained",
        "app/cli/train.py",
        '(capture / "colmap" / RECORD).is_file() and wanted.is_done(capture)',
        '(capture / "sparse").is_dir()',
        "tests/app/cli/test_one_command.py",
    ),
    _python(
        "Runs are aligned by a mirror image",
        "editing/edits.py",
        "torch.sign(torch.linalg.det(u) * torch.linalg.det(v))",
        "1.0",
        "tests/editing/test_edits.py",
    ),
    _python(
        "A resumed training forgets how many steps were left out",
        "app/train/state.py",
        "self.guard.begin(skipped)",
        "self.guard.begin(0)",
        "tests/app/train/test_resume.py",
    ),
    _python(
        "A checkpoint may have taken infinite seconds",
        "app/train/resume.py",
        "all(0 <= each < math.inf for each in times)",
        "all(0 <= each for each in times)",
        "tests/app/train/test_resume.py",
    ),
    _python(
        "A page of the viewer may set other properties beside a value",
        "app/viewer/door.py",
        'set(message.get("updates", ("value",))) == {"value"}',
        '"value" in message.get("updates", ("value",))',
        "tests/app/viewer",
    ),
    _python(
        "The viewer may be asked by any name that ends in .local",
        "app/viewer/door.py",
        'name in ("localhost", machine, f"{machine}.local", host.lower())',
        'name in ("localhost", machine, host.lower()) or name.endswith(".local")',
        "tests/app/viewer",
    ),
    _python(
        "Pages of other sites may use the viewer",
        "app/viewer/door.py",
        "if site is not None and site != requested:",
        "if site is not None and not requested:",
        "tests/app/viewer",
    ),
    _python(
        "COLMAP's points that two images see are kept",
        "app/scenes/colmap.py",
        "if seen >= LEAST_SEEN and",
        "if seen >= LEAST_SEEN - 1 and",
        "tests/app/scenes",
    ),
    _python(
        "A partial file replaces the old one before it is whole",
        "app/files.py",
        '            with open(partial, "xb") as file:',
        '            with open(path, "wb") as file:',
        "tests/app/train/test_checkpoint.py",
    ),
    _python(
        "A placed part keeps the densities of its own scale",
        "editing/parts.py",
        "density if self.frame.is_identity else density / self.frame.scale",
        "density",
        "tests/editing/test_parts.py",
        "tests/editing/test_edits.py",
    ),
    _python(
        "Steps of a parameter in parts are counted for each of them",
        "nerf/adam.py",
        "UpdateRule(step.clone() if number else step, *rule)",
        "UpdateRule(step, *rule)",
        "tests/nerf/test_optimizer.py",
    ),
    Fault(
        "Columns behind a block of 16 in tile registers are what was there before",
        "csrc/network/cpu/gemm_tiles.h",
        "if (kLeft) store(pairs + p.pairs_left + column / 2, zero);",
        "",
        ("tests/native/test_native_tiles.py",),
    ),
    _python(
        "A product has one source more than there is room for",
        "ops/network/lowering.py",
        "count >= native.compiled.most_sources",
        "count > native.compiled.most_sources",
        "tests/native/test_bindings.py",
    ),
    _python(
        "A shader reads a run of columns in the place of one that is broadcast",
        "app/web/shader.py",
        "at = columns.start + (0 if columns.spread else number)",
        "at = columns.start + number",
        "tests/app/web/test_shader.py",
    ),
    _python(
        "A shader has no layer before its ReLU where something else reads it",
        "app/web/shader.py",
        " and readers.count(step.out) == 1:",
        ":",
        "tests/app/web/test_shader.py",
    ),
    _python(
        "A shader takes points behind the near plane of a forward scene as they are",
        "app/web/march.wgsl",
        "max(dot(local, AHEAD), PLANE.x / 2.0)",
        "dot(local, AHEAD)",
        "tests/app/web/test_shader.py",
    ),
)
