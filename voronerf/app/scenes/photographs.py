"""Makes a scene of photographs with known cameras: its kind, its frame, and its near and far bounds.

c images, n sparse points. A scene is moved, turned and scaled so that the networks' inputs do not depend on the units
of its files: the point that the cameras look at, or else their mean position, becomes the origin, their mean up
direction becomes the z axis, and the farthest camera is at distance 1.
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
from voronerf.app.scenes.images import DYNAMIC_MASK, OPAQUE, Decoded, Header, read_images, read_masks
from voronerf.app.scenes.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, Lens, have_rays
from voronerf.app.scenes.names import listed_split, stay_inside
from voronerf.app.scenes.scene import KnownDepths, Scene, Split
from voronerf.app.scenes.soundness import camera_faults, lost_cameras, some_of, spread_of_lenses
from voronerf.nerf.cameras import Cameras, focus_point, shared_focus
from voronerf.nerf.contraction import Contraction, Perspective

HOLD_OUT = 8
# The longest side of images by default: about the resolution that can be learnt in minutes.
LONGEST_SIDE = 512
# The near bound of scenes without sparse points, as a fraction of the distance between the point that the cameras
# face and the nearest camera. Photographs rarely show closer objects sharply.
NEAR = 0.35
# The smallest near bound, as a fraction of the distance of the farthest camera; disparity needs a near bound above 0.
NEAREST = 0.05
FAR = 4.0
# Points nearer than `LEAST_NEAR` count as noise if at most the fraction `NOISY` of the views has such points. A smaller
# near bound costs samples: half of the samples lie nearer than twice the near bound.
LEAST_NEAR, NOISY = 0.02, 0.1
# Factors of the views' bounds: surfaces may be a little nearer than the nearest point, or farther than the farthest
# point.
NEARER, FARTHER = 0.75, 1.5
# The length of the mean of the viewing directions above which a scene is forward facing.
PARALLEL = 0.95
# In a picture of a cut-out object, at least these fractions of all pixels and of the border pixels are transparent.
# Masks of people, edges after undistortion and single pixels stay below one of these fractions.
CLEAR, CLEAR_BORDER = 0.25, 0.5
# If a corner of an image has no ray, a grid with this number of positions a side determines the field of view.
ACROSS = 65
# The minimum fraction of an image's pixels that have a ray.
LEAST_RAYS = 0.25
# The tolerance in pixels for the aspect ratio of a reduced image: sizes are integers, and exporters that scale images
# may write fractions.
ROUNDED = 2
# The cause and the remedy of an image and a camera with different aspect ratios.
CROPPED = (
    "it was cropped or has another aspect ratio; use the images for which the cameras were computed, or correct the "
    "size, focal length and principal point of its camera"
)
KIND_LINES = {
    "object": "an object on white, from the images' alpha",
    "forward": "forward facing, the cameras look the same way",
    "inside-out": "inside-out, the cameras look around and not at one place",
    "unbounded": "unbounded, the cameras look at one place with surroundings",
}


class View(NamedTuple):
    """A photograph with its camera.

    Attributes:
        path: the image file.
        pose: float64 [4, 4], camera to world.
        lens: the lens.
        size: (width, height) of the image in the pixels to which ``lens`` refers.
        mask: the mask file, or None.
        bounds: the least and the largest depth of the sparse points that the photograph shows, or None if unknown.
        points: float64 [s, 3], these sparse points, or None.
        header: the header of the file; None if it has not been read yet.
        circle: the radius of a fisheye's image circle in pixels of ``size``, outside of which pixels are masked, or
            None.
        name: the name of the image in lists of test images; "" for the path of its file.
    """

    path: Path
    pose: Tensor
    lens: Lens
    size: tuple[float, float]
    mask: Path | None = None
    bounds: tuple[float, float] | None = None
    points: Tensor | None = None
    header: Header | None = None
    circle: float | None = None
    name: str = ""


@dataclass(frozen=True)
class Reading:
    """The options of `load_scene` for reading a folder."""

    downscale: int | None = None
    allow_outside: bool = False
    kind: str = "auto"
    normalise: bool = True
    images: str = "auto"
    keep_far: bool = False


def least_factor(longest: float) -> int:
    """Returns the smallest downscale factor that leaves at most `LONGEST_SIDE` of ``longest`` pixels."""
    return max(math.ceil(longest / LONGEST_SIDE), 1)


def distinct_names(paths: list[Path], folder: Path) -> list[str]:
    """Returns a unique name for each image, used for files of rendered pictures.

    The names are the stems of the files if these are unique; otherwise the paths inside the scene's folder, such as
    a_00 for a/00.png. If some paths are equal, each name is the image's number and its path.
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
        folder: the scene's folder.
        views: the c views, sorted by name.
        held_out: bool [c], True for test views; None for the views in lists of test images, see `listed_split`, or
            else for every 8th view, from the first.
        reading: the options for reading the folder.
        factor: the remaining downscale factor of the files.
        notes: the loader's lines for the user.
        transform: float64 [4, 4], the transform from the original coordinates to the coordinates of the poses.
    """
    views, held_out, repeats = _listed_once(views, held_out)
    notes = [*notes, *repeats]
    if held_out is None:
        inside = [view.name or Path(os.path.relpath(view.path, folder)).as_posix() for view in views]
        split, lines = listed_split(source, folder, inside, reading.allow_outside)
        notes += lines
        if split is not None:
            views, held_out = [views[place] for place in split[0]], split[1]
            if split[2]:
                notes.append(f"{split[2]} images are in no list and are left out")
    views, more = _with_dynamic_masks(views, folder, reading.allow_outside)
    stored = stored_views(views)
    turned = [view.path.name for view, changed in zip(views, stored) if changed is not view]
    if turned:
        more.append(f"cameras are those of pictures turned upright by their orientation tags: {some_of(turned)}")
    views = stored
    if deep := [view.path.name for view in views if view.header is not None and view.header.deep]:
        more.append(f"{len(deep)} images have 16 bits a channel, of which the upper 8 are read: {some_of(deep)}")
    places = torch.stack([view.pose[:3, 3] for view in views])
    lost = lost_cameras(places)
    notes = [*notes, *more, *_far_notes(views, lost, reading.keep_far)]
    if not reading.keep_far:
        views = [view for view, left_out in zip(views, lost.tolist()) if not left_out]
        held_out = None if held_out is None else held_out[~lost]
    views, count = _training_first(views, held_out, source)
    name = folder.resolve().name
    poses = torch.stack([view.pose for view in views])
    pictures, masks, kind, masked = _read_pictures(views, poses, factor, reading, source, name)
    bounds = torch.tensor([view.bounds for view in views if view.bounds is not None], dtype=torch.float64, device="cpu")
    upright = turned_cameras(_of_poses(poses), pictures.turns).poses
    frame = find_frame(upright, kind, bounds if len(bounds) else None, normalise=reading.normalise)
    cameras = _cameras(frame.poses(poses), views, pictures.sizes, source)
    contraction = _contraction(kind, frame, cameras)
    # Cameras are turned after they are downscaled, since downscaling drops rows and columns of the stored images.
    cameras = turned_cameras(cameras.downscaled(factor), pictures.turns)
    try:
        _ = cameras.lenses
    except ValueError as error:
        raise SceneError(f"{source}: {error}") from None
    masks, ray_notes = _masked_by_lenses(cameras, masks, source, views, factor, pictures.turns)
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
    if spread := spread_of_lenses([(view.lens, max(view.size)) for view in views]):
        faults.append(spread)
    notes = [
        *notes,
        *masked,
        *ray_notes,
        _note(kind, frame, reading),
        *(f"check the cameras: {fault}" for fault in faults),
    ]
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
    """Returns (views without repeated files, their ``held_out``, notes): no file may be both trained and tested."""
    first: dict[Path, int] = {}
    for index, view in enumerate(views):
        first.setdefault(view.path.resolve(), index)
    if len(first) == len(views):
        return views, held_out, ()
    kept = list(first.values())
    names = [views[index].path.name for index in sorted(set(range(len(views))) - set(kept))]
    note = f"images are listed twice; only the first entry counts: {some_of(names)}"
    return [views[index] for index in kept], None if held_out is None else held_out[kept], (note,)


def _with_dynamic_masks(views: Sequence[View], folder: Path, allow_outside: bool) -> tuple[Sequence[View], list[str]]:
    """Adds instant-ngp's masks, see `DYNAMIC_MASK`, to views without another mask; returns the views and notes."""
    masks = [view.path.with_name(f"{DYNAMIC_MASK}{view.path.stem}.png") for view in views]
    found = {place: mask for place, mask in enumerate(masks) if os.path.isfile(mask)}
    used = {place: mask for place, mask in found.items() if views[place].mask is None}
    for mask in used.values():
        stay_inside(mask, folder, allow_outside)
    notes = []
    if used:
        some = f"{len(used)} of {len(views)} images have a mask {DYNAMIC_MASK}NAME.png"
        notes.append(f"{some}, whose pixels that are not black do not count")
    if unused := len(found) - len(used):
        notes.append(f"{unused} masks {DYNAMIC_MASK}NAME.png are not used, since their images have other masks")
    return [view._replace(mask=used.get(place, view.mask)) for place, view in enumerate(views)], notes


def _fits(size: Sequence[float], stated: tuple[float, float]) -> bool:
    """Returns whether an image of ``size`` may be a scaled copy of an image of the size ``stated``."""
    scale_x, scale_y = size[0] / stated[0], size[1] / stated[1]
    return abs(scale_x - scale_y) * max(stated) <= ROUNDED * max(scale_x, 1)


def _is_upright(view: View) -> bool:
    """Returns whether a camera fits a picture only after the quarter turn of the picture's orientation tag."""
    if view.header is None or view.header.turns % 2 == 0 or view.lens.model == EQUIRECTANGULAR:
        return False
    return _fits(view.header.size[::-1], view.size) and not _fits(view.header.size, view.size)


def stored_views(views: Sequence[View]) -> list[View]:
    """Returns views with the cameras of the stored pictures, of views with headers.

    If one camera fits its picture only after the turn, all cameras see upright pictures: the camera of a square or
    upside-down picture fits both.
    """
    return [_as_stored(view) for view in views] if any(map(_is_upright, views)) else [*views]


def _as_stored(view: View) -> View:
    """Turns the camera of a view from the upright to the stored picture, if the camera fits the upright picture."""
    assert view.header is not None
    turns = view.header.turns
    upright = view.header.size[::-1] if turns % 2 else view.header.size
    if turns == 0 or view.lens.model == EQUIRECTANGULAR or not _fits(upright, view.size):
        return view
    poses, model = view.pose[None], torch.tensor([view.lens.model], dtype=torch.int32, device="cpu")
    intrinsics, coefficients = (poses.new_tensor([row]) for row in (view.lens.intrinsics, view.lens.coefficients))
    sizes = torch.tensor([view.size], dtype=torch.float32, device="cpu")
    cameras = Cameras.of_images(poses, intrinsics, sizes, coefficients, model)
    stored = turned_cameras(cameras, [4 - turns])
    assert stored.distortion is not None
    lens = Lens(tuple(stored.intrinsics[0].tolist()), tuple(stored.distortion[0].tolist()), view.lens.model)
    return view._replace(pose=stored.poses[0], lens=lens, size=view.size[::-1] if turns % 2 else view.size)


def _training_first(views: Sequence[View], held_out: Tensor | None, source: Path) -> tuple[list[View], int]:
    """Returns the views, training views first so that both splits are slices, and the number of training views."""
    if held_out is None:
        held_out = torch.arange(len(views), device="cpu") % HOLD_OUT == 0
    order = held_out.int().argsort(stable=True).tolist()
    count = int((~held_out).sum())
    if not 0 < count < len(views):
        rule = "needs at least one image for training and one that is held out for testing"
        raise SceneError(f"{source}: {rule}, got {count} and {len(views) - count}")
    return [views[index] for index in order], count


def _read_pictures(
    views: Sequence[View], poses: Tensor, factor: int, reading: Reading, source: Path, name: str
) -> tuple[Decoded, Tensor | None, str, tuple[str, ...]]:
    """Reads the images and masks of views; returns both, the kind of scene, and a note if alpha was used as a mask.

    An object keeps its alpha. In other scenes transparent pixels are masked, for example erased passers-by, or border
    pixels without colour after undistortion.
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
    # Around the image circle of a fisheye, pixels may be transparent.
    cut_out = not models & {EQUIRECTANGULAR, FISHEYE} and sum(map(_is_cut_out, alphas)) > len(alphas) / 2
    kind = _kind(poses, with_alpha > 0, cut_out, EQUIRECTANGULAR in models, reading, source)
    as_mask = with_alpha > 0 and kind != "object"
    masks = read_masks([view.mask for view in views], paths, pictures, factor, name=name, alpha=as_mask)
    if as_mask:
        some = f"{with_alpha} of {len(views)} images"
        notes = (f"transparent pixels, in {some}, are masked (--kind object puts them on white)",)
    if kind != "object" and has_alpha:
        # On disk, images are stored again without alpha: slicing the channels of a mapped file would need a copy.
        again = read(keep="disk", most_channels=3) if pictures.on_disk else None
        pictures = again or pictures._replace(images=pictures.images[..., :3].contiguous())
    return pictures, masks, kind, notes


def _alphas(pictures: Decoded, factor: int) -> list[Tensor]:
    """Returns the alpha [h, w] of each image, without the padding of smaller images."""
    alphas = []
    for image, size, turns in zip(pictures.images, pictures.sizes, pictures.turns):
        width, height = ((size.flip(0) if turns % 2 else size) // factor).tolist()
        alphas.append(image[:height, :width, 3])
    return alphas


def _is_cut_out(alpha: Tensor) -> bool:
    """Returns whether an image with this alpha [h, w] shows a cut-out object on a transparent background."""
    clear = alpha < 128
    border = torch.cat((clear[0], clear[-1], clear[:, 0], clear[:, -1]))
    return float(clear.float().mean()) >= CLEAR and float(border.float().mean()) >= CLEAR_BORDER


def _far_notes(views: Sequence[View], far: Tensor, kept: bool) -> list[str]:
    """Returns a note on the views whose cameras lie far from the others (``far``, bool [c]); [] without such views.

    One such camera would determine the scale of the scene. ``kept`` tells whether these views are used.
    """
    names = [view.path.name for view, is_far in zip(views, far.tolist()) if is_far]
    start = f"{len(names)} of {len(views)} cameras lie far from the others"
    treatment = "and are kept (--keep-far)" if kept else "and are left out (--keep-far keeps them)"
    return [f"{start} {treatment}: {some_of(names)}"] if names else []


def find_depths(split: Split, views: Sequence[View], frame: Frame) -> KnownDepths | None:
    """Returns the pixels that show sparse points, and the points' distances; None if a split's views see no points.

    Pixels that are masked do not count.
    """
    pixels, distances = [], []
    for index, view in enumerate(views):
        if view.points is None:
            continue
        points = (view.points @ frame.matrix[:3, :3].T + frame.matrix[:3, 3]).float()
        places, depth = split.cameras.project(points, index)
        inside = (depth > 0) & (places >= 0).all(-1) & (places < places.new_tensor(split.cameras.size(index))).all(-1)
        points, (column, row) = points[inside], places[inside].long().unbind(-1)
        if (mask := split.mask(index)) is not None:
            points, row, column = (part[mask[row, column]] for part in (points, row, column))
        pixels.append((index * split.cameras.height + row) * split.cameras.width + column)
        distances.append((points - split.cameras.origins[index]).norm(dim=-1))
    if not sum(map(len, pixels)):
        return None
    return KnownDepths(torch.cat(pixels), torch.cat(distances))


@dataclass(frozen=True)
class Frame:
    """The frame of a scene: a similarity transform, and bounds in the transformed coordinates.

    Attributes:
        matrix: float64 [4, 4], transform from the files' coordinates to the scene's.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which the scene ends.
        centre: float64 [3], the centre of the foreground.
        radius: the radius of the foreground.
        axes: float64 [3, 3], whose rows are the directions right, up and ahead.
        measured: whether near and far come from sparse points.
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
        """The ratio of lengths in the scene to lengths in the files."""
        return float(torch.linalg.det(self.matrix[:3, :3])) ** (1 / 3)

    def poses(self, poses: Tensor) -> Tensor:
        """Returns poses float64 [c, 4, 4] in the scene's coordinates, still with orthonormal axes."""
        moved = self.matrix @ poses
        moved[:, :3, :3] /= self.scale
        return moved


def find_frame(poses: Tensor, kind: str, bounds: Tensor | None = None, *, normalise: bool = True) -> Frame:
    """Finds the coordinates of a scene.

    The origin is the cameras' focus or, without a focus and in forward-facing and inside-out scenes, their mean
    position. The cameras' mean up direction becomes z, and for a forward-facing scene their mean viewing direction
    becomes y. The farthest camera is at distance 1.

    With bounds, two kinds of scenes have another unit of length. In a forward-facing scene, it is the minimum of the
    views' least depths. In an inside-out scene, whose cameras may share one place, it is the distance of the farthest
    camera, but not below the median of the views' least depths, and not above the median of their largest depths.

    Args:
        poses: float64 [c, 4, 4].
        kind: the kind of the scene.
        bounds: float64 [m, 2], the least and the largest depth of the points of m views.
        normalise: False to keep the coordinates of the files.
    """
    cameras = _of_poses(poses)
    outward = kind in ("forward", "inside-out")
    centre = None if outward else focus_point(cameras)
    if centre is None:
        centre = cameras.origins.mean(0)
    rotation = _upright(poses[:, :3, 1].mean(0), cameras.forward.mean(0) if kind == "forward" else None)
    distances = (cameras.origins - centre).norm(dim=-1)
    length = float(distances.max())
    if outward and bounds is not None:
        low, high = bounds.median(0).values.tolist()  # a longer unit would leave too few cells for near objects
        length = float(bounds[:, 0].min()) if kind == "forward" else min(max(length, low), high)
    length = length if length > 0 else 1.0
    matrix = torch.eye(4, dtype=torch.float64, device="cpu")
    matrix[:3, :3] = rotation / length
    matrix[:3, 3] = -rotation @ centre / length
    nearest = float(distances.min()) / length
    near, far, measured = max(NEAR * nearest, NEAREST), FAR, False
    if kind == "object":
        near, far = 0.05 * nearest, 2.0
    elif bounds is not None:
        measured = True
        nearest_points = NEARER * bounds[:, 0] / length
        near = max(float(nearest_points.min()), min(LEAST_NEAR, float(nearest_points.quantile(NOISY))))
        far = max(FARTHER * float(bounds[:, 1].max()) / length, FAR)
    axes = matrix.new_tensor([[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    if normalise:
        return Frame(matrix, near, far, matrix.new_zeros(3), 1.0, axes, measured)
    identity = torch.eye(4, dtype=torch.float64, device="cpu")
    return Frame(identity, near * length, far * length, centre.double(), length, axes @ rotation, measured)


def _contraction(kind: str, frame: Frame, cameras: Cameras) -> Contraction | Perspective | None:
    """Returns the contraction of a scene without a box: NDC for perspective forward-facing cameras, or a sphere."""
    centre = frame.centre.float()
    if kind == "object":
        return None
    if kind != "forward" or cameras.models is not None:  # a fisheye may see sideways or backwards
        return Contraction(centre, frame.radius)
    axes = frame.axes.float()
    slopes = axes.new_zeros(2)
    for index in range(len(cameras)):
        width, height = cameras.size(index)
        x, y = torch.cartesian_prod(axes.new_tensor([0.0, width]), axes.new_tensor([0.0, height])).T
        if not (valid := have_rays(cameras, index, x, y)).all():  # corners of a wide lens may have no ray
            steps = (torch.linspace(0, side, ACROSS, dtype=torch.float32, device="cpu") for side in (width, height))
            x, y = torch.cartesian_prod(*steps).T
            valid = have_rays(cameras, index, x, y)
        rays = cameras.rays(index, x[valid], y[valid])
        for distance in (frame.near, frame.far):
            local = (rays.origins + distance * rays.directions - centre) @ axes.T
            slopes = torch.maximum(slopes, (local[:, :2].abs() / local[:, 2:].clamp_min(frame.near / 2)).amax(0))
    return Perspective(centre, axes, frame.near, (float(slopes[0]), float(slopes[1])))


def _upright(up: Tensor, forward: Tensor | None) -> Tensor:
    """Returns a rotation [3, 3] that maps `up` to z and `forward` to y; ignores None and directions near zero."""
    if forward is not None and forward.norm() > 0.1:
        y = torch.nn.functional.normalize(forward, dim=0)
        x = torch.linalg.cross(y, up)
        if x.norm() > 1e-3:
            x = torch.nn.functional.normalize(x, dim=0)
            return torch.stack((x, y, torch.linalg.cross(x, y)))
    if up.norm() <= 0.1:
        return torch.eye(3, dtype=up.dtype, device=up.device)
    z = up / up.norm()
    axis = torch.eye(3, dtype=up.dtype, device=up.device)[int(z.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(axis, z), dim=0)
    return torch.stack((x, torch.linalg.cross(z, x), z))


def _kind(poses: Tensor, transparent: bool, cut_out: bool, panoramic: bool, reading: Reading, source: Path) -> str:
    """Returns the requested kind of scene or, for "auto", the kind that fits the images and cameras.

    The flags tell whether images have transparent pixels, whether most images show a cut-out, and whether any camera is
    a panorama.
    """
    if reading.kind == "object" and not transparent:
        raise SceneError(f"{source}: --kind object needs images with transparent pixels, got opaque images")
    if reading.kind != "auto":
        return reading.kind
    if cut_out:
        return "object"
    if panoramic:
        return "inside-out"
    return kind_of(_of_poses(poses))


def _of_poses(poses: Tensor) -> Cameras:
    """Returns cameras with these poses and placeholder intrinsics."""
    return Cameras(poses, poses.new_ones(len(poses), 4), 1, 1)


def kind_of(cameras: Cameras) -> str:
    """Returns the kind of scene by the viewing directions of the cameras alone."""
    if float(cameras.forward.mean(0).norm()) > PARALLEL:
        return "forward"
    return "inside-out" if shared_focus(cameras) is None else "unbounded"


def _cameras(poses: Tensor, views: Sequence[View], sizes: Tensor, source: Path) -> Cameras:
    """Returns the cameras of image files of ``sizes`` [c, 2].

    The intrinsics are scaled from the image size to which the lens refers, `View.size`, to the size of the file.
    """
    intrinsics = []
    for view, (width, height) in zip(views, sizes.tolist()):
        if not _fits((width, height), view.size):
            raise SceneError(
                f"{view.path}: is {width} x {height} pixels as stored, but {source} says {view.size[0]:g} x "
                f"{view.size[1]:g}: {CROPPED}"
            )
        scale_x, scale_y = width / view.size[0], height / view.size[1]
        fx, fy, cx, cy = view.lens.intrinsics
        intrinsics.append((fx * scale_x, fy * scale_y, cx * scale_x, cy * scale_y))
    coefficients = torch.tensor([view.lens.coefficients for view in views], dtype=torch.float32, device="cpu")
    models = torch.tensor([view.lens.model for view in views], dtype=torch.int32, device="cpu")
    others = models if bool((models != PERSPECTIVE).any()) else None
    distortion = coefficients if others is not None or bool(coefficients.any()) else None
    return Cameras.of_images(poses.float(), coefficients.new_tensor(intrinsics), sizes, distortion, others)


def turned_cameras(cameras: Cameras, turns: Sequence[int]) -> Cameras:
    """Returns cameras of images turned anticlockwise by ``turns`` quarters; the turned pixels keep their rays.

    A quarter turn moves the pixel at (x, y) to (y, width - x). The normalised image coordinates (u, v), which the lens
    distorts, become (v, -u).
    """
    if not any(turns):
        return cameras
    poses, intrinsics, coefficients = cameras.poses.clone(), cameras.intrinsics.clone(), cameras.distortion
    coefficients = intrinsics.new_zeros(len(cameras), 8) if coefficients is None else coefficients.clone()
    turns_of = torch.tensor(turns, device="cpu")
    prism = torch.zeros_like(turns_of, dtype=torch.bool) if cameras.models is None else cameras.models == FISHEYE
    sizes = turns_of.new_tensor([cameras.size(index) for index in range(len(cameras))])
    for step in range(3):
        turning = turns_of > step
        right, up = poses[turning, :3, :2].unbind(-1)
        poses[turning, :3, :2] = torch.stack((-up, right), -1)
        fx, fy, cx, cy = intrinsics[turning].unbind(-1)
        intrinsics[turning] = torch.stack((fy, fx, cy, sizes[turning, 0] - cx), -1)
        coefficients[turning, 2:4] = torch.stack((-coefficients[turning, 3], coefficients[turning, 2]), -1)  # p1 and p2
        rows = turning & prism
        coefficients[rows, 6:8] = torch.stack((coefficients[rows, 7], -coefficients[rows, 6]), -1)  # s1 and s2
        sizes[turning] = sizes[turning].flip(1)
    distortion = None if cameras.distortion is None else coefficients
    return Cameras.of_images(poses, intrinsics, sizes, distortion, cameras.models)


def _masked_by_lenses(
    cameras: Cameras, masks: Tensor | None, source: Path, views: Sequence[View], factor: int, turns: Sequence[int]
) -> tuple[Tensor | None, tuple[str, ...]]:
    """Masks the pixels without a ray or outside a fisheye's image circle; returns the masks and a note."""
    seen: dict[int, Tensor] = {}
    for index, view in enumerate(views):
        valid = cameras.has_ray(index)
        ray_share = 1.0 if valid is None else float(valid.float().mean())
        if ray_share < LEAST_RAYS:
            raise SceneError(
                f"{source}: the lens of {view.path.name} gives a ray to {ray_share:.0%} of its pixels, at least "
                f"{LEAST_RAYS:.0%} must have one; check its focal length and distortion"
            )
        if view.circle is not None:
            circle = _circle(view, factor).rot90(turns[index])
            valid = circle if valid is None else valid & circle
        if valid is not None and not valid.all():
            seen[index] = valid
    if not seen:
        return masks, ()
    if masks is None:
        masks = torch.ones(len(cameras), cameras.height, cameras.width, dtype=torch.bool, device="cpu")
    masks = masks.clone()  # the tensor may be mapped from a file, read-only
    for index, valid in seen.items():
        height, width = valid.shape
        masks[index, :height, :width] &= valid
        if not masks[index].any():
            raise SceneError(f"{views[index].path}: its mask and its lens exclude all pixels")
    valid = torch.cat([valid.flatten() for valid in seen.values()])
    share = 1 - valid.sum().float() / len(valid)
    names = some_of([views[index].path.name for index in seen])
    return masks, (f"{share:.0%} of the pixels of these images have no ray of their lens, and are masked: {names}",)


def _circle(view: View, factor: int) -> Tensor:
    """Returns bool [h, w] in the stored orientation: whether pixels of a reduced image lie in the fisheye's circle."""
    assert view.header is not None and view.circle is not None
    width, height = view.header.size
    counts = (torch.arange(side // factor, dtype=torch.float32, device="cpu") for side in (height, width))
    y, x = (factor * (count + 0.5) - side / 2 for count, side in zip(counts, (height, width)))
    y, x = torch.meshgrid(y, x, indexing="ij")
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
