"""From photographs with known cameras to a scene: which kind it is, where it lies, and how near and far it reaches.

c images, n sparse points. A scene is moved, turned and scaled so that the networks meet the same numbers whatever the
units of its files: what the cameras look at becomes the origin, their mean up direction the z axis, and the farthest
camera is at distance 1.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.app.scenes.carving import carve_box
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.images import OPAQUE, Decoded, Header, read_images, read_masks
from voronerf.app.scenes.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Lens, have_rays
from voronerf.app.scenes.scene import Scene, SparseDepth, Split
from voronerf.app.scenes.soundness import camera_faults, lost_cameras, some_of
from voronerf.nerf.cameras import Cameras, focus_point, shared_focus
from voronerf.nerf.contraction import Contraction, Perspective

HOLD_OUT = 8
# To which images are reduced where nobody says by how much: about what minutes of training can learn.
LONGEST_SIDE = 512
# Near bound without bounds of the views, as a share of the distance from the focus to the nearest camera; closer things
# are rarely in focus.
NEAR = 0.35
# Smallest near bound, as a share of the distance of the farthest camera; disparity needs a near bound above 0.
NEAREST = 0.05
FAR = 4.0
# Points nearer than this are taken for noise if only this share of the views has any: half of the samples lie before
# twice the near bound.
LEAST_NEAR, NOISY = 0.02, 0.1
# Of the bounds of the views: things may be a little nearer than the nearest point, and farther than the farthest.
NEARER, FARTHER = 0.75, 1.5
# Mean of the viewing directions, a unit vector each, from which on they count as one direction.
PARALLEL = 0.95
# A picture of an object on white: so much of it is transparent, and so much of its border. Masks of people, edges after
# straightening and single pixels are less of one of both.
CLEAR, CLEAR_BORDER = 0.25, 0.5
# Positions along each side of an image whose rays say how far it sees, where its corners have none.
ACROSS = 65
# Share of the pixels of an image to which its lens must give a ray.
LEAST_RAYS = 0.25
# By how many pixels a reduced image may have another shape than the one before: sizes are whole numbers, and exporters
# that scale images may write fractions.
ROUNDED = 2
KIND_LINES = {
    "object": "an object on white, from the images' alpha",
    "forward": "forward facing, the cameras look the same way",
    "inside-out": "inside-out, the cameras look around and not at one place",
    "unbounded": "unbounded, the cameras look at one place with surroundings",
}


class View(NamedTuple):
    """A photograph: its file, its pose float64 [4, 4], camera to world, its lens and the (width, height) that this is
    for; and where known its mask, the depths between which its points lie, these points float64 [s, 3], the header of
    the file, and the radius of the circle around its middle outside of which nothing counts, in pixels of ``size``."""

    path: Path
    pose: Tensor
    lens: Lens
    size: tuple[float, float]
    mask: Path | None = None
    bounds: tuple[float, float] | None = None
    points: Tensor | None = None
    header: Header | None = None
    circle: float | None = None


@dataclass(frozen=True)
class Reading:
    """How a folder is read, the options of `load_scene`."""

    downscale: int | None = None
    allow_outside: bool = False
    kind: str = "auto"
    normalise: bool = True
    images: str = "auto"
    keep_far: bool = False


def least_factor(longest: float) -> int:
    """The factor that leaves a side of so many pixels at most `LONGEST_SIDE`."""
    return max(math.ceil(longest / LONGEST_SIDE), 1)


def distinct_names(paths: list[Path], folder: Path) -> list[str]:
    """A unique name for each image, under which pictures of it are stored.

    The names are the stems of the files if these differ; otherwise the paths inside the folder of the scene, such as
    a_00 for a/00.png; and if some of these are the same, the paths behind the number of the image.
    """
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        inside = [Path(os.path.relpath(path, folder)).with_suffix("") for path in paths]
        names = ["_".join(part for part in path.parts if part != "..") for path in inside]
    if len(set(names)) < len(names):
        names = [f"{position:04d}_{name}" for position, name in enumerate(names)]
    return names


def photograph_scene(
    source: Path,
    folder: Path,
    views: Sequence[View],
    held_out: Tensor | None,
    reading: Reading,
    *,
    factor: int,
    notes: Sequence[str] = (),
    transform: Tensor | None = None,
) -> Scene:
    """Makes the scene of photographs.

    Args:
        source: the file to name in errors.
        folder: of the scene.
        views: in the order of their names.
        held_out: bool [c], the test views; None for every 8th, from the first.
        reading: how the folder is read.
        factor: by which the files are still to be reduced.
        notes: what the loader has to say.
        transform: float64 [4, 4], from the original coordinates to those of the poses.
    """
    views, held_out, repeats = _listed_once(views, held_out)
    places = torch.stack([view.pose[:3, 3] for view in views])
    lost = lost_cameras(places)
    notes = [*notes, *repeats, *_far_notes(views, lost, reading.keep_far)]
    if not reading.keep_far:
        views = [view for view, left_out in zip(views, lost.tolist()) if not left_out]
        held_out = None if held_out is None else held_out[~lost]
    views, count = _training_first(views, held_out, source)
    name = folder.resolve().name
    poses = torch.stack([view.pose for view in views])
    pictures, masks, kind, masked = _read_pictures(views, poses, factor, reading, source, name)
    bounds = torch.tensor([view.bounds for view in views if view.bounds is not None], dtype=torch.float64)
    upright = _turned(Cameras(poses, torch.ones(len(poses), 4), 1, 1), pictures.turns).poses
    frame = find_frame(upright, kind, bounds if len(bounds) else None, normalise=reading.normalise)
    cameras = _cameras(frame.poses(poses), views, pictures.sizes, source)
    contraction = _contraction(kind, frame, cameras)
    # Last, since the rows and columns that a reduction drops are those of the files.
    cameras = _turned(cameras.downscaled(factor), pictures.turns)
    try:
        _ = cameras.lenses
    except ValueError as error:
        raise SceneError(f"{source}: {error}") from None
    masks, shown = _masked_by_lenses(cameras, masks, source, views, factor, pictures.turns)
    box = None
    if kind == "object":
        box = carve_box(cameras[:count], pictures.images[:count, ..., 3], frame.near, frame.far)
        if box is None and cameras.models is None:
            notes = [*notes, "check the cameras: the silhouettes of the object give no box around it"]
    names = tuple(distinct_names([view.path for view in views], folder))
    train, test = (
        Split(
            cameras[part], pictures.images[part], names[part], None if masks is None else masks[part], pictures.on_disk
        )
        for part in (slice(count), slice(count, None))
    )
    faults = camera_faults(places, bounds, ((view.lens, view.size[0]) for view in views))
    notes = [*notes, *masked, *shown, _note(kind, frame, reading), *(f"check the cameras: {fault}" for fault in faults)]
    if reading.downscale is None and factor > 1:
        size = f"{cameras.width} x {cameras.height}"
        notes.append(f"images are reduced by {factor}, to {size} (--downscale 1 keeps their size)")
    return Scene(
        name=name,
        train=replace(train, sparse_depth=find_depths(train, views[:count], frame)),
        test=test,
        near=frame.near,
        far=frame.far,
        box=box,
        background="white" if kind == "object" else None,
        kind=kind,
        contraction=contraction,
        transform=frame.matrix if transform is None else frame.matrix @ transform,
        notes=tuple(notes),
    )


def _listed_once(
    views: Sequence[View], held_out: Tensor | None
) -> tuple[Sequence[View], Tensor | None, tuple[str, ...]]:
    """Views of different files, and which are held out: one file could be trained and tested. A line names repeats."""
    first: dict[Path, int] = {}
    for index, view in enumerate(views):
        first.setdefault(view.path.resolve(), index)
    if len(first) == len(views):
        return views, held_out, ()
    kept = list(first.values())
    names = [views[index].path.name for index in sorted(set(range(len(views))) - set(kept))]
    note = f"of images that are listed twice the first counts: {some_of(names)}"
    return [views[index] for index in kept], None if held_out is None else held_out[kept], (note,)


def _training_first(views: Sequence[View], held_out: Tensor | None, source: Path) -> tuple[list[View], int]:
    """The training views and then the others, so that the images of both are slices and no copies; how many train."""
    if held_out is None:
        held_out = torch.arange(len(views)) % HOLD_OUT == 0
    order = held_out.int().argsort(stable=True).tolist()
    count = int((~held_out).sum())
    if not 0 < count < len(views):
        raise SceneError(f"{source}: one image is too few, one is held out for testing")
    return [views[index] for index in order], count


def _read_pictures(
    views: Sequence[View], poses: Tensor, factor: int, reading: Reading, source: Path, name: str
) -> tuple[Decoded, Tensor | None, str, tuple[str, ...]]:
    """Reads images and masks of views, and tells the kind of scene and whether alpha was a mask.

    An object keeps its alpha. Elsewhere transparent pixels are masked: people who walk through, and what straightening
    has left without colour.
    """
    paths, headers = [view.path for view in views], [view.header for view in views]
    read = functools.partial(read_images, paths, factor, headers=headers, name=name, upright=True)
    pictures, notes = read(keep=reading.images), tuple[str, ...]()
    for view, turns in zip(views, pictures.turns):
        if view.lens.model == EQUIRECTANGULAR and turns % 2:
            raise SceneError(f"{view.path}: a picture all around must have no orientation tag of a quarter turn")
    has_alpha = pictures.images.shape[-1] == 4
    alphas = _alphas(pictures, factor) if has_alpha else []
    models = {view.lens.model for view in views}
    with_alpha = sum(bool((alpha < OPAQUE).any()) for alpha in alphas)
    # Of a fisheye, what surrounds its circle may be transparent.
    cut_out = not models & {EQUIRECTANGULAR, FISHEYE} and sum(map(_is_cut_out, alphas)) > len(alphas) / 2
    kind = _kind(poses, with_alpha > 0, cut_out, EQUIRECTANGULAR in models, reading, source)
    as_mask = with_alpha > 0 and kind != "object"
    masks = read_masks([view.mask for view in views], paths, pictures, factor, name=name, alpha=as_mask)
    if as_mask:
        some = f"{with_alpha} of {len(views)} images"
        notes = (f"transparent pixels, in {some}, are masked (--kind object puts them on white)",)
    if kind != "object" and has_alpha:
        # On disk they are stored again: a part of each pixel cannot be drawn from a mapped file without a copy.
        again = read(keep="disk", most_channels=3) if pictures.on_disk else None
        pictures = again or pictures._replace(images=pictures.images[..., :3].contiguous())
    return pictures, masks, kind, notes


def _alphas(pictures: Decoded, factor: int) -> list[Tensor]:
    """The alpha [h, w] of each image, without what lies around smaller ones."""
    alphas = []
    for image, size, turns in zip(pictures.images, pictures.sizes, pictures.turns):
        width, height = ((size.flip(0) if turns % 2 else size) // factor).tolist()
        alphas.append(image[:height, :width, 3])
    return alphas


def _is_cut_out(alpha: Tensor) -> bool:
    """Whether an image with this alpha [h, w] shows an object before nothing."""
    clear = alpha < 128
    border = torch.cat((clear[0], clear[-1], clear[:, 0], clear[:, -1]))
    return float(clear.float().mean()) >= CLEAR and float(border.float().mean()) >= CLEAR_BORDER


def _far_notes(views: Sequence[View], far: Tensor, kept: bool) -> list[str]:
    """A line about the views whose cameras lie far from the others, bool [c]: one would give the scene its scale."""
    names = [view.path.name for view, apart in zip(views, far.tolist()) if apart]
    which = f"{len(names)} of {len(views)} cameras lie far from the others"
    done = "and are kept, as asked" if kept else "and are left out (--keep-far keeps them)"
    return [f"{which} {done}: {some_of(names)}"] if names else []


def find_depths(split: Split, views: Sequence[View], frame: Frame) -> SparseDepth | None:
    """The pixels in which views of a split see their points, inside the image and the mask."""
    pixels, distances = [], []
    for index, view in enumerate(views):
        if view.points is None:
            continue
        points = (view.points @ frame.matrix[:3, :3].T + frame.matrix[:3, 3]).float()
        places, depth = split.cameras.project(points, index)
        inside = (depth > 0) & (places >= 0).all(-1) & (places < torch.tensor(split.cameras.size(index))).all(-1)
        points, (column, row) = points[inside], places[inside].long().unbind(-1)
        if (mask := split.mask(index)) is not None:
            points, row, column = (part[mask[row, column]] for part in (points, row, column))
        pixels.append((index * split.cameras.height + row) * split.cameras.width + column)
        distances.append((points - split.cameras.origins[index]).norm(dim=-1))
    if not sum(map(len, pixels)):
        return None
    return SparseDepth(torch.cat(pixels), torch.cat(distances))


@dataclass(frozen=True)
class Frame:
    """The frame of a scene: a similarity, and bounds that are measured after it.

    Attributes:
        matrix: float64 [4, 4], from the coordinates of the files to those of the scene.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which it ends.
        centre: float64 [3], the middle of the foreground.
        radius: of the foreground.
        axes: float64 [3, 3], its rows are the directions right, up and ahead.
        measured: near and far come from the points.
    """

    matrix: Tensor
    near: float
    far: float
    centre: Tensor
    radius: float
    axes: Tensor
    measured: bool

    @property
    def scale(self) -> float:
        """Lengths in the scene over those in the files."""
        return float(torch.linalg.det(self.matrix[:3, :3])) ** (1 / 3)

    def poses(self, poses: Tensor) -> Tensor:
        """Poses float64 [c, 4, 4] in the scene, rigid as before."""
        moved = self.matrix @ poses
        moved[:, :3, :3] /= self.scale
        return moved


def find_frame(poses: Tensor, kind: str, bounds: Tensor | None = None, *, normalise: bool = True) -> Frame:
    """Finds the coordinates of a scene.

    The cameras' focus becomes the origin, or their middle where they have none in common; their mean up direction
    becomes z, and for a forward-facing scene their mean direction becomes y. The farthest camera is at distance 1; with
    bounds, the nearest near bound of a forward-facing scene. In one that is seen from within 1 is no nearer than the
    median near bound, since cameras may only turn, and no farther than the median far bound.

    Args:
        poses: float64 [c, 4, 4].
        kind: of the scene.
        bounds: float64 [m, 2], the least and the largest depth of the points of m views.
        normalise: False for the same space in the coordinates of the files.
    """
    cameras = Cameras(poses, torch.ones(len(poses), 4), 1, 1)
    outward = kind in ("forward", "inside-out")
    centre = None if outward else focus_point(cameras)
    if centre is None:
        centre = cameras.origins.mean(0)
    turn = _upright(poses[:, :3, 1].mean(0), cameras.forward.mean(0) if kind == "forward" else None)
    distances = (cameras.origins - centre).norm(dim=-1)
    length = float(distances.max())
    if outward and bounds is not None:
        least, most = bounds.median(0).values.tolist()  # cells as far as views reach would be too few for near things
        length = float(bounds[:, 0].min()) if kind == "forward" else min(max(length, least), most)
    length = length if length > 0 else 1.0
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = turn / length
    matrix[:3, 3] = -turn @ centre / length
    nearest = float(distances.min()) / length
    near, far, measured = max(NEAR * nearest, NEAREST), FAR, False
    if kind == "object":
        near, far = 0.05 * nearest, 2.0
    elif bounds is not None:
        measured = True
        nearest_points = NEARER * bounds[:, 0] / length
        near = max(float(nearest_points.min()), min(LEAST_NEAR, float(nearest_points.quantile(NOISY))))
        far = max(FARTHER * float(bounds[:, 1].max()) / length, FAR)
    axes = torch.eye(3, dtype=torch.float64)[[0, 2, 1]]
    if normalise:
        return Frame(matrix, near, far, torch.zeros(3, dtype=torch.float64), 1.0, axes, measured)
    same = torch.eye(4, dtype=torch.float64)
    return Frame(same, near * length, far * length, centre.double(), length, axes @ turn, measured)


def _contraction(kind: str, frame: Frame, cameras: Cameras) -> Contraction | Perspective | None:
    """The contraction of a scene without a box: a cube around all that forward-facing cameras see, or a ball."""
    centre = frame.centre.float()
    if kind == "object":
        return None
    if kind != "forward" or cameras.models is not None:  # a fisheye may see to the side, or behind
        return Contraction(centre, frame.radius)
    slopes = torch.zeros(2)
    axes = frame.axes.float()
    for index in range(len(cameras)):
        width, height = cameras.size(index)
        x, y = torch.cartesian_prod(torch.tensor([0.0, width]), torch.tensor([0.0, height])).T
        if not (there := have_rays(cameras, index, x, y)).all():  # corners of a wide lens
            x, y = torch.cartesian_prod(torch.linspace(0, width, ACROSS), torch.linspace(0, height, ACROSS)).T
            there = have_rays(cameras, index, x, y)
        rays = cameras.rays(index, x[there], y[there])
        for distance in (frame.near, frame.far):
            local = (rays.origins + distance * rays.directions - centre) @ axes.T
            slopes = torch.maximum(slopes, (local[:, :2].abs() / local[:, 2:].clamp_min(frame.near / 2)).amax(0))
    return Perspective(centre, axes, frame.near, (float(slopes[0]), float(slopes[1])))


def _upright(up: Tensor, forward: Tensor | None) -> Tensor:
    """A rotation [3, 3] that turns `up` to z, and `forward`, if given, to y; leaves a direction of no length alone."""
    if forward is not None and forward.norm() > 0.1:
        y = torch.nn.functional.normalize(forward, dim=0)
        x = torch.linalg.cross(y, up)
        if x.norm() > 1e-3:
            x = torch.nn.functional.normalize(x, dim=0)
            return torch.stack((x, y, torch.linalg.cross(x, y)))
    if up.norm() <= 0.1:
        return torch.eye(3, dtype=up.dtype)
    z = up / up.norm()
    spare = torch.eye(3, dtype=up.dtype)[int(z.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(spare, z), dim=0)
    return torch.stack((x, torch.linalg.cross(z, x), z))


def _kind(poses: Tensor, transparent: bool, cut_out: bool, around: bool, reading: Reading, source: Path) -> str:
    """The kind that was asked for, or the one that pictures and cameras show.

    Pixels may be transparent, most pictures cut out, and some cameras may see all around.
    """
    if reading.kind == "object" and not transparent:
        raise SceneError(f"{source}: --kind object needs images with transparent pixels, these are opaque")
    if reading.kind != "auto":
        return reading.kind
    if cut_out:
        return "object"
    if around:
        return "inside-out"
    return kind_of(Cameras(poses, torch.ones(len(poses), 4), 1, 1))


def kind_of(cameras: Cameras) -> str:
    """Returns the kind of scene that the directions of cameras show, without their images."""
    if float(cameras.forward.mean(0).norm()) > PARALLEL:
        return "forward"
    return "inside-out" if shared_focus(cameras) is None else "unbounded"


def _cameras(poses: Tensor, views: Sequence[View], sizes: Tensor, source: Path) -> Cameras:
    """Cameras of the image files, whose size may be another one of the same shape than the lens is for."""
    intrinsics = []
    for view, (width, height) in zip(views, sizes.tolist()):
        across, down = width / view.size[0], height / view.size[1]
        if abs(across - down) * max(view.size) > ROUNDED * max(across, 1):
            raise SceneError(
                f"{view.path}: is {width} x {height} pixels as stored, but {source} says {view.size[0]:g} x "
                f"{view.size[1]:g}"
            )
        fx, fy, cx, cy = view.lens.intrinsics
        intrinsics.append((fx * across, fy * down, cx * across, cy * down))
    bent = torch.tensor([view.lens.coefficients for view in views])
    models = torch.tensor([view.lens.model for view in views], dtype=torch.int32)
    others = models if bool((models != PERSPECTIVE).any()) else None
    distortion = bent if others is not None or bool(bent.any()) else None
    return Cameras.of_images(poses.float(), torch.tensor(intrinsics), sizes, distortion, others)


def _turned(cameras: Cameras, turns: Sequence[int]) -> Cameras:
    """Cameras of images that are turned anticlockwise by so many quarters each: of the same rays, in another order.

    A quarter brings what is at (x, y) to (y, width - x), so that u becomes v, and v becomes -u.
    """
    if not any(turns):
        return cameras
    poses, intrinsics, bent = cameras.poses.clone(), cameras.intrinsics.clone(), cameras.distortion
    bent = torch.zeros(len(cameras), 8) if bent is None else bent.clone()
    prism = torch.zeros(len(cameras), dtype=torch.bool) if cameras.models is None else cameras.models == FISHEYE
    sizes = torch.tensor([cameras.size(index) for index in range(len(cameras))])
    for step in range(3):
        turning = torch.tensor(turns) > step
        right, up = poses[turning, :3, :2].unbind(-1)
        poses[turning, :3, :2] = torch.stack((-up, right), -1)
        fx, fy, cx, cy = intrinsics[turning].unbind(-1)
        intrinsics[turning] = torch.stack((fy, fx, cy, sizes[turning, 0] - cx), -1)
        bent[turning, 2:4] = torch.stack((-bent[turning, 3], bent[turning, 2]), -1)  # p1 and p2
        both = turning & prism
        bent[both, 6:8] = torch.stack((bent[both, 7], -bent[both, 6]), -1)  # s1 and s2
        sizes[turning] = sizes[turning].flip(1)
    distortion = None if cameras.distortion is None else bent
    return Cameras.of_images(poses, intrinsics, sizes, distortion, cameras.models)


def _masked_by_lenses(
    cameras: Cameras, masks: Tensor | None, source: Path, views: Sequence[View], factor: int, turns: Sequence[int]
) -> tuple[Tensor | None, tuple[str, ...]]:
    """The masks without the pixels that have no ray of a lens or lie outside of a fisheye's circle, and a line."""
    shown: dict[int, Tensor] = {}
    for index, view in enumerate(views):
        there = cameras.has_ray(index)
        share = 1.0 if there is None else float(there.float().mean())
        if share < LEAST_RAYS:
            raise SceneError(
                f"{source}: the lens of {view.path.name} gives a ray to {share:.0%} of its pixels, at least "
                f"{LEAST_RAYS:.0%} must have one; check its focal length and distortion"
            )
        if view.circle is not None:
            circle = _circle(view, factor).rot90(turns[index])
            there = circle if there is None else there & circle
        if there is not None and not there.all():
            shown[index] = there
    if not shown:
        return masks, ()
    if masks is None:
        masks = torch.ones(len(cameras), cameras.height, cameras.width, dtype=torch.bool)
    masks = masks.clone()  # it may be mapped from a file
    for index, there in shown.items():
        height, width = there.shape
        masks[index, :height, :width] &= there
        if not masks[index].any():
            raise SceneError(f"{views[index].path}: its mask and its lens must leave a pixel")
    dark = 1 - sum(map(torch.sum, shown.values())) / sum(map(torch.numel, shown.values()))
    return masks, (f"{dark:.0%} of the pixels of {len(shown)} images are none that their lens shows, and are masked",)


def _circle(view: View, factor: int) -> Tensor:
    """The pixels of a reduced image within the circle of its fisheye, bool [h, w] as it is stored."""
    assert view.header is not None and view.circle is not None
    width, height = view.header.size
    y, x = torch.meshgrid(
        factor * (torch.arange(height // factor) + 0.5) - height / 2,
        factor * (torch.arange(width // factor) + 0.5) - width / 2,
        indexing="ij",
    )
    return torch.hypot(x, y) <= view.circle * width / view.size[0]


def _note(kind: str, frame: Frame, reading: Reading) -> str:
    asked = "" if reading.kind == "auto" else ", as asked"
    origin = "the sparse points" if frame.measured else "the cameras"
    where = (
        f"moved, turned and scaled by {frame.scale:.4g}"
        if reading.normalise
        else "in the coordinates of its files (--no-normalise)"
    )
    return f"{KIND_LINES[kind]}{asked} (--kind); {where}; near {frame.near:.3g} and far {frame.far:.3g} from {origin}"
