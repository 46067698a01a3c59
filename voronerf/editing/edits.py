"""Joins runs, cuts runs, and places a run in another one. The result is a new run of several parts.

Positions are in units of the new scene. The source runs are never changed.
"""

from __future__ import annotations

import glob
import itertools
import math
import os
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from voronerf.app.files import json_text, write_text
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import read_scene, write_scene
from voronerf.app.scenes.scene import Split
from voronerf.app.train.build import PICTURE_RESOLUTION, ask_everywhere, make_picture_grid, make_renderer
from voronerf.app.train.checkpoint import checkpoint_paths, is_shown, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.wording import as_typed
from voronerf.editing.geometry import Similarity, Solid
from voronerf.editing.network import StoredRouter, config_of
from voronerf.editing.parts import Part, Parts
from voronerf.editing.run import PARTS, has_parts, is_cut, open_parts, write_parts
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.occupancy import OPACITY, OccupancyGrid

#: The maximum number of voxels of a joined grid; a grid that would have more gets larger voxels.
MOST_VOXELS = 1 << 22
#: The minimum size of a run as a fraction of the joined scene: a smaller run would lie between two samples of a ray.
SMALLEST = 1e-4


@dataclass(frozen=True)
class RunContents:
    """The contents of a run to join, cut or place: settings, scene, parts, grid, and whether the run was cut."""

    name: str
    config: TrainConfig
    scene: Scene
    parts: Parts
    grid: OccupancyGrid | None
    cut: bool = False

    @classmethod
    def of(cls, run: Path | str) -> RunContents:
        """Reads a source from a run directory; an ordinary run becomes one part whose only network is its field.

        A run that was trained with a region is cut to it.
        """
        whole = cls._whole(Path(run))
        if (region := whole.config.region) is None:
            return whole
        whole = replace(whole, config=replace(whole.config, region=None))
        cut = cut_source(whole, Solid.box(region[:3], region[3:]))
        return replace(cut, cut=whole.scene.box is None)  # regions fill the box of a scene

    @classmethod
    def _whole(cls, run: Path) -> RunContents:
        name, record = run.name, run / "scene.json"
        checkpoint = last_checkpoint(run, keep=is_shown)
        if not record.is_file():
            raise ConfigError(f"{run}: must hold a run with the record of its scene, scene.json")
        config, scene, state = config_of(checkpoint), read_scene(record), checkpoint.group("occupancy")
        grid = OccupancyGrid.from_state(state) if state else None
        if has_parts(run):
            return cls(name, config, scene, open_parts(run, checkpoint), grid, is_cut(run))
        if config.field_type.cones:
            raise ConfigError(f"{name}: --field {config.field} cannot be joined or cut: its cones cross borders")
        contraction, network = scene.space(config.contraction).contraction, StoredRouter(checkpoint)
        if isinstance(contraction, Perspective):
            raise ConfigError(f"{name}: --contraction ndc cannot be joined or cut: it belongs to one camera")
        if config.sampling != "stratified":
            network = StoredRouter.of(network.router, config, network.voxels)
        if contraction is not None:
            return cls(name, config, scene, Parts([Part(network, contraction=contraction)]), None)
        region = []
        if scene.box is not None:
            low, high = scene.box.tolist()
            region = [Solid.box(low, high)]
            if grid is None:
                config = replace(config, sampling="stratified")
                grid = make_picture_grid(config, scene, make_renderer(config, scene, {"field": network.router}))
        return cls(name, config, scene, Parts([Part(network, region=region)]), grid)


def join(runs: Sequence[Path | str], out: Path | str, *, frames: Sequence[Similarity] | None = None) -> RunContents:
    """Joins several runs into a new run.

    Where runs overlap, a point is evaluated by the run that has the nearest cell centre.

    Args:
        runs: At least two run directories, which are not changed; the first gives data, background and settings.
        out: A new directory.
        frames: The similarity from the scene of each run to the new scene; None to leave all runs in place.

    Returns:
        The contents of the new run.

    Raises:
        ConfigError: The runs cannot be joined; see the guide.
        OSError: The new run cannot be written; no files are left.

    Examples:
        >>> from voronerf.editing import Similarity, join
        >>> def beside_each_other(east, west, out):
        ...     return join([east, west], out, frames=[Similarity(), Similarity.of((2.0, 0, 0))])
    """
    if len(runs) < 2 or (frames is not None and len(frames) != len(runs)):
        count = "none" if frames is None else f"{len(frames)}"
        raise ConfigError(f"join needs two runs or more, and a frame for each: got {len(runs)} runs, {count} frames")
    sources = {str(run): RunContents.of(run) for run in runs}
    sources_of_runs = [sources[str(run)] for run in runs]
    return _write(join_sources(sources_of_runs, frames or [Similarity()] * len(runs)), Path(out))


def cut(run: Path | str, keep: Solid | Sequence[int], out: Path | str, *, outside: bool = False) -> RunContents:
    """Writes a part of a run as a new run: the contents of a solid, or some cells.

    The new run has only the networks that it needs. Exception: if a solid is removed from a scene without a box, the
    new run has all networks.

    Args:
        run: The run directory, which is not changed.
        keep: A solid of the scene, such as ``Solid.box(low, high)``, or numbers of cells.
        out: A new directory.
        outside: Whether to keep everything except the solid or the cells instead.

    Returns:
        The contents of the new run.

    Raises:
        ConfigError: The result would be empty, or a cell does not exist.
        OSError: The new run cannot be written; no files are left.

    Examples:
        >>> from voronerf.editing import Solid, cut
        >>> def ball_of(run, out):
        ...     return cut(run, Solid(ball=(0, 0, 0.4, 0.5)), out)
    """
    source = RunContents.of(run)
    if isinstance(keep, Solid):
        return _write(cut_source(source, replace(keep, outside=keep.outside != outside)), Path(out))
    k = source.parts.num_cells
    if not keep or not 0 <= min(keep) <= max(keep) < k:
        raise ConfigError(f"--cells must be numbers of 0..{k - 1}, at least one, got {as_typed([*keep][:20])}")
    chosen = torch.full((k,), outside, device="cpu")
    chosen[list(keep)] = not outside
    return _write(cut_source(source, chosen), Path(out))


def place(
    run: Path | str,
    object_run: Path | str,
    at: Sequence[float],
    out: Path | str,
    *,
    degrees: Sequence[float] = (0, 0, 0),
    scale: float = 1.0,
) -> RunContents:
    """Places an object into a scene, as a new run; the object's density is added to the scene's.

    Args:
        run: The run directory of the scene, which is not changed.
        object_run: The run directory of the object; the object must be cut out or trained on a white background.
        at: The position in the scene, (x, y, z), of the bottom centre of the object's box.
        out: A new directory.
        degrees: The rotations of the object about the axes x, y, z of the scene, in this order.
        scale: The factor by which the object is enlarged.

    Returns:
        The contents of the new run.

    Raises:
        ConfigError: The object has no bounds.
        OSError: The new run cannot be written; no files are left.

    Examples:
        >>> from voronerf.editing import place
        >>> def on_the_ground(garden, statue, out):
        ...     return place(garden, statue, (0.2, -0.1, 0), out, scale=0.5)
    """
    source = RunContents.of(object_run)
    box = source.scene.box
    if box is None:
        raise ConfigError(
            f"{source.name}: an object must have bounds; cut it first with voronerf cut --box or --sphere"
        )
    foot = torch.cat(((box[0] + box[1])[:2] / 2, box[0, 2:]))
    standing = Similarity.of(at, degrees, scale) @ Similarity(translation=-foot.double())
    scene = source if Path(run) == Path(object_run) else RunContents.of(run)  # one source: its networks are stored once
    return _write(join_sources([scene, source], [Similarity(), standing], on_top=True), Path(out))


# Joining --------------------------------------------------------------------------------------------------------------


def join_sources(sources: Sequence[RunContents], frames: Sequence[Similarity], *, on_top: bool = False) -> RunContents:
    """Joins sources into one source.

    Where sources overlap, a point is evaluated by the source that has the nearest cell centre.

    Args:
        sources: At least one source. The first gives the settings, the background, and the data.
        frames: The similarity from each source to the new scene.
        on_top: Whether to put the other sources into layers above the first, so that densities are added.
    """
    first = sources[0]
    for index, source in enumerate(sources):
        if source.scene.box is None and (index or (len(sources) > 1 and not on_top)):
            raise ConfigError(
                f"{source.name}: must have bounds to be joined; cut it first with voronerf cut --box or --sphere"
            )
        if source.scene.background != first.scene.background and not on_top:
            ours, theirs = (s.scene.background or "none" for s in (first, source))
            raise ConfigError(f"{source.name}: must have the background of {first.name}, {ours}, got {theirs}")
    parts: list[Part] = []
    for index, (source, frame) in enumerate(zip(sources, frames, strict=True)):
        above = max((part.layer for part in parts), default=-1) + 1 if on_top and index else 0
        parts += [part.changed(frame=frame @ part.frame, layer=part.layer + above) for part in source.parts]
    joined = Parts(parts, backend=first.parts.backend)
    scene = _join_scenes(sources, frames, on_top)
    settings, grid = _settings(sources, frames, scene), _join_grids(sources, frames)
    is_incomplete = any(source.cut for source in (sources[:1] if on_top else sources))  # an object is cut out anyway
    return RunContents(first.name, settings, scene, joined, grid, is_incomplete)


def _settings(sources: Sequence[RunContents], frames: Sequence[Similarity], scene: Scene) -> TrainConfig:
    """Returns the settings of a joined run: the first source's, with stratified sampling and enough samples per ray.

    A ray is divided into strata with one sample each. In a scene with a box, the strata are as short as the shortest
    strata of the sources, but a ray has at most 32,000 strata.
    """
    first = sources[0].config
    samples = (first.samples or (64,))[0]
    if scene.box is not None:
        diagonal = float((scene.box[1] - scene.box[0]).norm())
        for source, frame in zip(sources, frames, strict=True):
            assert source.scene.box is not None
            size = float((source.scene.box[1] - source.scene.box[0]).norm()) * frame.scale
            if not size >= SMALLEST * diagonal:
                raise ConfigError(
                    f"{source.name}: must be at least {SMALLEST:g} times as large as the whole scene, got {size:.3g} "
                    f"of {diagonal:.3g}"
                )
            samples = max(samples, math.ceil((source.config.samples or (64,))[0] * diagonal / size - 1e-6))
    return replace(first, sampling="stratified", samples=(min(samples, 32_000),), out=None)


def _join_scenes(sources: Sequence[RunContents], frames: Sequence[Similarity], on_top: bool) -> Scene:
    """Joins the boxes and, unless ``on_top``, the views of all sources; the coordinates of files are the first's."""
    first, box = sources[0].scene, sources[0].scene.box
    if box is not None:
        corners = torch.cat([frame.points(_corners(s.scene.box)) for s, frame in zip(sources, frames, strict=True)])
        boxes = [(s.scene.box, frame) for s, frame in zip(sources, frames, strict=True)]
        same = all(frame.is_identity and other is not None and torch.equal(other, box) for other, frame in boxes)
        box = box if same else torch.stack((corners.amin(0), corners.amax(0)))
    pairs = [*zip(sources, frames, strict=True)]
    near = min(source.scene.near * frame.scale for source, frame in pairs)
    far = max(source.scene.far * frame.scale for source, frame in pairs)
    train, test = (
        _join_views([(getattr(source.scene, part), frame) for source, frame in (pairs[:1] if on_top else pairs)])
        for part in ("train", "test")
    )
    if box is not None:
        distances = (torch.cat((train.cameras.origins, test.cameras.origins))[:, None] - _corners(box)).norm(dim=-1)
        far = max(far, 1.01 * float(distances.max()))
    transform = frames[0].matrix @ first.transform
    return replace(first, train=train, test=test, near=near, far=far, box=box, transform=transform)


def _corners(box: Tensor | None) -> Tensor:
    assert box is not None
    return torch.cartesian_prod(*box.float().T)


def _join_views(views: Sequence[tuple[Split, Similarity]]) -> Split:
    """Joins the cameras of several splits, without images; ``views`` has each split with its place.

    A view with the name and the pose of an earlier one is left out. A split that has other poses under the names of
    earlier splits is another scene; with several scenes, all names get the number of their scene as a prefix.
    """
    cameras, names, scenes = list[Cameras](), list[tuple[int, str]](), list[dict[str, Tensor]]()
    for split, frame in views:
        moved = split.cameras if frame.is_identity else split.cameras.moved(frame.matrix)
        poses = dict(zip(split.names, moved.poses, strict=True))
        same = [all(torch.equal(seen[name], poses[name]) for name in seen.keys() & poses.keys()) for seen in scenes]
        number = (*same, True).index(True)
        scenes += [{}] * (number == len(scenes))
        known = scenes[number]
        new = [index for index, name in enumerate(split.names) if name not in known]
        known |= poses
        if new:
            cameras.append(moved[new])
            names += [(number, split.names[index]) for index in new]
    none = torch.empty(0, 1, 1, 3, dtype=torch.uint8, device="cpu")
    every = tuple(f"{number}-{name}" if len(scenes) > 1 else name for number, name in names)
    return Split(cameras[0] if len(cameras) == 1 else Cameras.joined(cameras), none, every)


def _join_grids(sources: Sequence[RunContents], frames: Sequence[Similarity]) -> OccupancyGrid | None:
    """Joins the occupancy grids; voxels have the size of the smallest source voxels if `MOST_VOXELS` allows it."""
    grids = [source.grid for source in sources]
    if any(source.scene.box is None for source in sources) or any(grid is None for grid in grids):
        return None
    pairs = [(grid, frame) for grid, frame in zip(grids, frames, strict=True) if grid is not None]
    first = pairs[0][0]
    same_voxels = all(
        frame.is_identity and torch.equal(g.box, first.box) and g.density.shape == first.density.shape
        for g, frame in pairs
    )
    threshold = min(grid.threshold / frame.scale for grid, frame in pairs)
    if same_voxels:
        grid = _empty_grid(first.box, first.density.shape, threshold)
        for other, _ in pairs:
            grid.density = torch.maximum(grid.density, other.density)
            grid.occupied |= other.occupied
        return grid
    corners = torch.cat([frame.points(_corners(grid.box)) for grid, frame in pairs])
    low, high = corners.amin(0), corners.amax(0)
    side = min(float(_voxel_size(grid).min()) * frame.scale for grid, frame in pairs)
    extent = (high - low).double()
    side = max(side, float((extent.prod() / MOST_VOXELS) ** (1 / 3)))
    shape = (extent / side).round().clamp(min=1).long().tolist()
    grid = _empty_grid(torch.stack((low, high)), shape, threshold)
    for source, frame in pairs:
        density, marked = torch.zeros_like(grid.density).view(-1), torch.zeros_like(grid.occupied).view(-1)
        occupied = source.occupied.view(-1).nonzero()[:, 0]
        size = float(_voxel_size(source).max()) * frame.scale
        steps = math.ceil(size / side) + 1  # sample points along an axis of a voxel; no voxel is skipped
        places = torch.linspace(1e-3, 1 - 1e-3, steps, dtype=torch.float32, device="cpu")
        for offset in itertools.product(places.tolist(), repeat=3):
            inside = source.box.new_tensor([offset]).expand(len(occupied), 3)
            voxels = grid.voxels(frame.points(source.points(occupied, inside))).long()
            marked[voxels] = True
            density.scatter_reduce_(0, voxels, source.density.view(-1)[occupied] / frame.scale, "amax")
        filled, values = marked.view(grid.density.shape), density.view(grid.density.shape)
        turned = frame.rotation.abs()
        if bool(((turned > 1e-6) & (turned < 1 - 1e-6)).any()):  # rotated voxels reach beyond the sampled voxels
            around = torch.nn.functional.max_pool3d(filled.float()[None, None], 3, 1, 1)[0, 0] > 0
            values = torch.where(around & ~filled, threshold, values)
            filled = around
        grid.occupied |= filled
        grid.density = torch.maximum(grid.density, values)
    return grid


def _voxel_size(grid: OccupancyGrid) -> Tensor:
    """Returns the size of a grid's voxels, float32 [3]."""
    return (grid.box[1] - grid.box[0]) / grid.box.new_tensor(grid.occupied.shape)


def _empty_grid(box: Tensor, shape: Sequence[int], threshold: float) -> OccupancyGrid:
    """Returns an empty grid."""
    grid = OccupancyGrid(box, list(shape), threshold=threshold)
    grid.density.zero_()
    grid.occupied.zero_()
    return grid


# Cutting --------------------------------------------------------------------------------------------------------------


def cut_source(source: RunContents, keep: Solid | Tensor) -> RunContents:
    """Returns a part of a source as a new source: the contents of a solid, or some cells.

    The new source has only the networks that it needs. Exception: if a solid is removed from a scene without a box, the
    new source has all networks.

    A contraction is the identity inside its sphere, so a source cut inside the sphere needs no contraction.

    Args:
        source: The source.
        keep: A solid in the scene, or bool [k], a mask of cells.
    """
    parts, box = source.parts, source.scene.box
    if isinstance(keep, Tensor):
        parts = keep_cells(parts, keep)
    else:
        changed = []
        for part in parts:
            solid = keep.moved(part.frame.inverse)
            warp = part.contraction
            if warp is not None and not keep.outside:
                if not _inside_ball(solid, warp):
                    where = [round(x, 3) for x in part.frame.points(warp.centre).tolist()]
                    rule = (
                        f"must lie within {warp.radius * part.frame.scale:g} of {where}, where space is not contracted"
                    )
                    raise ConfigError(f"{source.name}: --box or --sphere {rule}")
                warp = None
            changed.append(part.changed(region=(*part.region, solid), contraction=warp))
        parts = Parts(changed, backend=parts.backend)
        if not keep.outside:
            around = keep.bounds()
            box = around if box is None else torch.stack((box[0].maximum(around[0]), box[1].minimum(around[1])))
            if not bool((box[0] < box[1]).all()):
                raise ConfigError(f"{source.name}: nothing is left, the cut is outside of the scene's box")
    if box is None:
        return replace(source, parts=parts, cut=True)
    grid = source.grid
    if grid is None:
        grid = _evaluated_grid(source, parts, box)
    occupied = grid.occupied.view(-1).nonzero()[:, 0]
    size = _voxel_size(grid)
    places = grid.points(occupied)
    near = ((places > box[0] - size) & (places < box[1] + size)).all(-1)
    grid = _trimmed(grid, parts, occupied[near])
    if grid is None:
        raise ConfigError(f"{source.name}: the cut leaves nothing of it")
    if not isinstance(keep, Tensor):
        occupied = grid.occupied.view(-1).nonzero()[:, 0]
        shown = torch.zeros(parts.num_cells, dtype=torch.bool, device="cpu")
        for offset in _LATTICE:
            if not bool(shown.all()):
                places = grid.points(occupied, grid.box.new_tensor([offset]).expand(len(occupied), 3))
                for claim in (claim for layer in range(len(parts.layers)) for claim in parts.claims(layer, places)):
                    shown[parts.cells_of(claim).long()] = True
        if not bool(shown.all()):
            parts = keep_cells(parts, shown)
    config, scene = source.config, replace(source.scene, box=grid.box)
    old_box = source.scene.box
    if old_box is not None:  # so that strata keep their length
        share = float((grid.box[1] - grid.box[0]).norm() / (old_box[1] - old_box[0]).norm())
        config = replace(config, samples=(max(16, math.ceil((config.samples or (64,))[0] * share - 1e-6)),))
    config = _settings([replace(source, config=config, scene=scene)], [Similarity()], scene)
    return RunContents(source.name, config, scene, parts, grid, cut=True)


def keep_cells(parts: Parts, keep: Tensor) -> Parts:
    """Returns the parts with only the cells of a mask, bool [k]."""
    pieces = keep.split([part.num_cells for part in parts])
    remaining = [part.keep(piece.nonzero()[:, 0]) for part, piece in zip(parts, pieces, strict=True)]
    shown = [part for part in remaining if part is not None]
    if not shown:
        raise ConfigError("nothing is left: all cells are cut away")
    lowest = min(part.layer for part in shown)
    if lowest:
        shown = [part.changed(layer=part.layer - lowest) for part in shown]
    return Parts(shown, backend=parts.backend)


def _inside_ball(solid: Solid, contraction: Contraction) -> bool:
    """Returns whether a solid lies inside of a contraction's sphere, where the contraction is the identity."""
    if solid.ball is not None:
        farthest = float((contraction.centre.new_tensor(solid.ball[:3]) - contraction.centre).norm()) + solid.ball[3]
    else:
        farthest = float((_corners(solid.bounds()) - contraction.centre).norm(dim=-1).max())
    return farthest <= contraction.radius * (1 + 1e-4)


#: Sample points in a voxel, as shares of its sides; a part covers the voxel if it covers one of these points.
_LATTICE = [*itertools.product((0.5, 1e-3, 1 - 1e-3), repeat=3)]


def _trimmed(grid: OccupancyGrid, parts: Parts, voxels: Tensor) -> OccupancyGrid | None:
    """Returns a grid with only the ``voxels``, int64 [q], that parts cover, trimmed to the box of these voxels.

    The result is None if no part covers any of the voxels.
    """
    covered = torch.zeros_like(voxels, dtype=torch.bool)
    for offset in _LATTICE:
        uncovered = (~covered).nonzero()[:, 0]
        inside = grid.box.new_tensor([offset]).expand(len(uncovered), 3)
        covered[uncovered] = parts.assign(grid.points(voxels[uncovered], inside)) >= 0
    if not bool(covered.any()):
        return None
    occupied = torch.zeros_like(grid.occupied)
    occupied.view(-1)[voxels[covered]] = True
    indices = occupied.nonzero()
    first, last = indices.amin(0), indices.amax(0) + 1
    shape = grid.box.new_tensor(occupied.shape)
    box = torch.stack([torch.lerp(grid.box[0], grid.box[1], edge / shape) for edge in (first, last)])
    block = tuple(slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True))
    trimmed = _empty_grid(box, (last - first).tolist(), grid.threshold)
    trimmed.occupied = occupied[block].contiguous()
    trimmed.density = torch.where(trimmed.occupied, grid.density[block], 0).contiguous()
    return trimmed


def _evaluated_grid(source: RunContents, parts: Parts, box: Tensor) -> OccupancyGrid:
    """Makes an occupancy grid of a box for a run without a grid: evaluates the field in every voxel."""
    threshold = -math.log1p(-OPACITY) * (source.config.samples or (64,))[0] / float((box[1] - box[0]).norm())
    return ask_everywhere(OccupancyGrid(box, PICTURE_RESOLUTION, threshold=threshold), parts.eval())


# Finding where runs belong --------------------------------------------------------------------------------------------


def align(fixed: Scene, moving: Scene, name: str) -> tuple[Similarity, float, int]:
    """Finds the similarity that maps cameras of a scene to cameras of another scene with the same image names.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".

    Args:
        fixed: The scene that stays.
        moving: The scene that is moved.
        name: The name of the moving run in error messages.

    Returns:
        The similarity, the root mean square distance of the aligned camera centres, and the number of cameras.
    """
    fixed_places, moving_places = (
        {n: place for split in (s.train, s.test) for n, place in zip(split.names, split.cameras.origins, strict=True)}
        for s in (fixed, moving)
    )
    shared = sorted(fixed_places.keys() & moving_places.keys())
    if len(shared) < 3:
        raise ConfigError(f"{name}: --align needs at least 3 images of the same names in both runs, got {len(shared)}")
    targets, sources = (torch.stack([of[n] for n in shared]).double() for of in (fixed_places, moving_places))
    target_mean, source_mean = targets.mean(0), sources.mean(0)
    u, spread, v = torch.linalg.svd((targets - target_mean).T @ (sources - source_mean) / len(shared))
    if float(spread[1]) < 1e-9 * max(float(spread[0]), 1e-30):
        raise ConfigError(
            f"{name}: --align needs cameras that are not on one line; the {len(shared)} shared cameras are"
        )
    sign = torch.ones_like(spread)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(v))
    rotation = u @ torch.diag(sign) @ v
    scale = float((spread * sign).sum() / (sources - source_mean).square().sum(1).mean())
    similarity = Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)
    return similarity, float((similarity.points(sources) - targets).square().sum(1).mean().sqrt()), len(shared)


# Files ----------------------------------------------------------------------------------------------------------------


def check_out(out: Path) -> None:
    """Raises ConfigError if a folder for a new run is not empty."""
    if checkpoint_paths(out):
        raise ConfigError(f"--out must not hold a run already, got {out}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"--out must be a new or an empty folder, got {out}")


def _process_exists(number: int) -> bool:
    """Returns whether a process with this number exists; True if this is unknown."""
    try:
        os.kill(number, 0) if os.name == "posix" else None  # on Windows, os.kill would end the process
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def _write(source: RunContents, out: Path) -> RunContents:
    """Writes a run of parts into a new folder, atomically."""
    check_out(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    host = glob.escape(platform.node())  # other machines may write into a shared folder
    for leftover in out.parent.glob(f".*.{host}.[0-9]*.partial"):
        number = leftover.suffixes[-2][1:]
        if number.isdecimal() and not _process_exists(int(number)):  # the process that wrote it was killed
            shutil.rmtree(leftover, ignore_errors=True)
    partial = out.parent / f".{out.name[:100]}.{platform.node()}.{os.getpid()}.partial"
    try:
        partial.mkdir()
        config = replace(source.config, out=out)
        write_parts(partial, config, source.parts, source.grid)
        write_text(partial / PARTS, json_text({"parts": len(source.parts.parts), "cut": source.cut}) + "\n")
        write_text(partial / "config.json", config.to_json())
        write_scene(partial / "scene.json", source.scene)
        os.replace(partial, out)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(out)) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return source
