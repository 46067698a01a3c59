"""Cameras with lens distortion, which map pixels to rays and points to pixels.

c cameras, r rays, b chosen pixels, n points.

Frames. A pose maps camera to world coordinates. Camera axes are OpenGL's: x right, y up, the camera looks along -z. The
world's z axis points up. Pixels: x to the right, y down, the image covers [0, width] x [0, height], the centre of the
first pixel is at (0.5, 0.5). Distortion acts on image-plane coordinates u = (x - cx) / fx, v = (y - cy) / fy. See
`voronerf.nerf.lenses.distort` for the distortion models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from voronerf.nerf.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, LensTables, distort, unproject
from voronerf.ops.pixel_rays import PixelRays, pixel_rays

__all__ = [
    "Cameras",
    "Rays",
    "axis_misses",
    "focus_point",
    "look_at",
    "orbit_cameras",
    "shared_focus",
    "turntable_cameras",
]

#: Cameras count as standing around an object if the median of their `axis_misses` is below this value. At this value,
#: the object is 24 degrees off the optical axis, still inside the field of view of most lenses. The median is 0.06 to
#: 0.13 for captures around an object, 0.22 for captures aimed 12 degrees off, and below 0.4 for 1 % of random walks.
AROUND = 0.4


@dataclass(frozen=True, eq=False)
class Rays:
    """A batch of rays in world coordinates.

    Attributes:
        origins: float32 [r, 3], the origins of the rays.
        directions: float32 [r, 3], unit directions.
        radii: float32 [r], the radius of the cone around each ray at distance 1, or None.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays
        >>> rays = Rays(torch.zeros(2, 3), torch.tensor([[0.0, 0, -1], [0.0, 1, 0]]))
        >>> len(rays), rays[:1].directions
        (2, tensor([[ 0.,  0., -1.]]))
    """

    origins: Tensor
    directions: Tensor
    radii: Tensor | None = None

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        radii = None if self.radii is None else self.radii[index]
        return Rays(self.origins[index], self.directions[index], radii)

    def to(self, device: torch.device | str) -> Rays:
        """Returns the same rays on a device."""
        radii = None if self.radii is None else self.radii.to(device)
        return Rays(self.origins.to(device), self.directions.to(device), radii)


@dataclass(frozen=True, eq=False)
class Cameras:
    """A set of c cameras with poses, intrinsics and lenses.

    Attributes:
        poses: float32 [c, 4, 4], camera to world.
        intrinsics: float32 [c, 4], (fx, fy, cx, cy) in pixels.
        width: The width of the images in pixels; of the widest image if they differ.
        height: The height of the images in pixels; of the highest image if they differ.
        distortion: float32 [c, 8], coefficients of the lenses, see `voronerf.nerf.lenses.distort`; None for no
            distortion.
        models: int32 [c], the model of each camera: 0 perspective, 1 fisheye, 2 FOV, 3 equirectangular (360 degrees);
            requires `distortion`. None if all are perspective.
        sizes: int64 [c, 2], (width, height) of each image, or None if all have one size. See `size`.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Cameras
        >>> intrinsics = torch.tensor([[100.0, 100.0, 50.0, 40.0]])
        >>> cameras = Cameras(torch.eye(4)[None], intrinsics, width=100, height=80)  # at the origin, looking along -z
        >>> len(cameras), cameras.forward
        (1, tensor([[-0., -0., -1.]]))
        >>> rays = cameras.image_rays(0)
        >>> len(rays)
        8000
        >>> pixels, depth = cameras.project(torch.tensor([[0.0, 0.0, -2.0]]), 0)
        >>> pixels, depth
        (tensor([[50., 40.]]), tensor([2.]))
    """

    poses: Tensor
    intrinsics: Tensor
    width: int
    height: int
    distortion: Tensor | None = None
    models: Tensor | None = None
    sizes: Tensor | None = None

    def __post_init__(self) -> None:
        if self.poses.dim() != 3 or self.poses.shape[1:] != (4, 4):
            raise ValueError(f"Cameras: poses must have shape [c, 4, 4], got {list(self.poses.shape)}")
        for name, rest in (("intrinsics", [4]), ("distortion", [8]), ("models", []), ("sizes", [2])):
            value, expected = getattr(self, name), [len(self.poses), *rest]
            if value is not None and list(value.shape) != expected:
                raise ValueError(f"Cameras: {name} must have shape {expected}, got {list(value.shape)}")
        if self.models is not None and self.distortion is None:
            raise ValueError("Cameras: distortion must be given with models, got None")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Cameras: width and height must be >= 1, got {self.width} x {self.height}")

    def moved(self, move: Tensor) -> Cameras:
        """Returns the cameras after a similarity transform [4, 4] of the world, such as a change of the frame."""
        scale = torch.linalg.det(move[:3, :3]).abs() ** (1 / 3)
        poses = (move @ self.poses.to(move)).clone()
        poses[:, :3, :3] /= scale
        return replace(self, poses=poses.to(self.poses))._with_lenses(*self.lenses)

    @classmethod
    def of_images(
        cls,
        poses: Tensor,
        intrinsics: Tensor,
        sizes: Tensor,
        distortion: Tensor | None = None,
        models: Tensor | None = None,
    ) -> Cameras:
        """Returns the cameras of c >= 1 images, which may have different `sizes`, int64 [c, 2], (width, height)."""
        width, height = sizes.amax(0).tolist()
        differ = bool((sizes != sizes[:1]).any())
        return cls(poses, intrinsics, width, height, distortion, models, sizes if differ else None)

    @classmethod
    def joined(cls, several: Sequence[Cameras]) -> Cameras:
        """Returns the concatenation of several sets of cameras."""

        def concatenated(name: str, missing: Callable[[int], Tensor]) -> Tensor | None:
            values = [getattr(cameras, name) for cameras in several]
            if all(tensor is None for tensor in values):
                return None
            pairs = zip(several, values, strict=True)
            return torch.cat([missing(len(cameras)) if tensor is None else tensor for cameras, tensor in pairs])

        device = several[0].poses.device
        sizes = [
            torch.tensor([[each.width, each.height]], device=device).expand(len(each), 2)
            if each.sizes is None
            else each.sizes
            for each in several
        ]
        return cls.of_images(
            torch.cat([cameras.poses for cameras in several]),
            torch.cat([cameras.intrinsics for cameras in several]),
            torch.cat(sizes),
            concatenated("distortion", lambda n: torch.zeros(n, 8, dtype=torch.float32, device=device)),
            concatenated("models", lambda n: torch.zeros(n, dtype=torch.int32, device=device)),
        )

    def __len__(self) -> int:
        return self.poses.shape[0]

    def __getitem__(self, index: Tensor | slice | Sequence[int]) -> Cameras:
        """Returns the cameras of a slice, a list or an index tensor."""
        return self._mapped(lambda tensor: tensor[index])

    def size(self, index: int) -> tuple[int, int]:
        """Returns (width, height) of one image."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes[index].tolist()
        return width, height

    @property
    def smallest(self) -> tuple[int, int]:
        """The smallest width and the smallest height of the images."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes.amin(0).tolist()
        return width, height

    @property
    def origins(self) -> Tensor:
        """The camera centres, [c, 3]."""
        return self.poses[:, :3, 3]

    @property
    def forward(self) -> Tensor:
        """The unit viewing directions (optical axes), [c, 3]."""
        return -self.poses[:, :3, 2]

    def to(self, device: torch.device | str) -> Cameras:
        """Returns the same cameras on a device."""
        return self._mapped(lambda tensor: tensor.to(device))

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        """Returns new cameras with `change` applied to every tensor; old and new cameras share the lens tables."""
        members = ((field.name, getattr(self, field.name)) for field in fields(self))
        changed: dict[str, Any] = {name: change(value) for name, value in members if isinstance(value, Tensor)}
        return replace(self, **changed)._with_lenses(change(self.lenses[0]), self.lenses[1])

    def _with_lenses(self, lens: Tensor, tables: LensTables | None) -> Cameras:
        self.__dict__["lenses"] = lens, tables
        return self

    @cached_property
    def lenses(self) -> tuple[Tensor, LensTables | None]:
        """The lens index of each camera (int32 [c], -1 for no distortion), and the tables of the distinct lenses.

        Indexing, moving and copying cameras does not copy the tables: the new cameras share them.

        Raises:
            ValueError: The tables would take too much memory.
        """
        lens = torch.full((len(self),), -1, dtype=torch.int32, device=self.poses.device)
        if self.distortion is None:
            return lens, None
        models = torch.zeros_like(lens) if self.models is None else self.models
        bent = (self.distortion != 0).any(1) | (models == FISHEYE) | (models == EQUIRECTANGULAR)
        if not bool(bent.any()):
            return lens, None
        parameters = torch.cat((self.intrinsics, self.distortion, models[:, None].to(self.intrinsics)), dim=1)
        distinct, inverse = parameters[bent].unique(dim=0, return_inverse=True)
        lens[bent] = inverse.to(torch.int32)
        return lens, LensTables(distinct, self.width, self.height)

    def perspective(self) -> Cameras:
        """Returns the cameras without lens models; equirectangular cameras become 90-degree cameras looking ahead."""
        if self.models is None:
            return replace(self, distortion=None)
        panoramic = self.models == EQUIRECTANGULAR
        sizes = torch.tensor([self.size(index) for index in range(len(self))], device=self.poses.device)
        sides = (sizes[:, 1:] // 2).clamp_min(1).expand(-1, 2)
        ahead = torch.cat((sides, sides), 1).to(self.intrinsics) / 2
        intrinsics = torch.where(panoramic[:, None], ahead, self.intrinsics)
        return Cameras.of_images(self.poses, intrinsics, torch.where(panoramic[:, None], sides, sizes))

    @classmethod
    def all_around(cls, poses: Tensor, height: int) -> Cameras:
        """Returns equirectangular cameras, whose images are twice as wide as high and show all directions.

        Args:
            poses: [c, 4, 4], camera to world; the viewing direction is in the middle of the image.
            height: The height of the images in pixels.

        Examples:
            >>> import torch
            >>> from voronerf.nerf import Cameras
            >>> cameras = Cameras.all_around(torch.eye(4)[None], height=90)
            >>> cameras.width, cameras.project(torch.tensor([[2.0, 0.0, 0.0]]), 0)[0]  # to the right
            (180, tensor([[135.,  45.]]))
        """
        count, scale = len(poses), height / math.pi
        intrinsics = poses.new_tensor((scale, scale, height, height / 2)).repeat(count, 1)
        models = torch.full((count,), EQUIRECTANGULAR, dtype=torch.int32, device=poses.device)
        return cls(poses, intrinsics, 2 * height, height, poses.new_zeros(count, 8), models)

    def downscaled(self, factor: int) -> Cameras:
        """Returns the cameras of the images averaged over blocks of `factor` x `factor` pixels.

        Incomplete blocks at the right and at the bottom are dropped. So focal lengths and the principal point are
        divided by exactly `factor`.

        Raises:
            ValueError: `factor` is below 1, or larger than an image.
        """
        if factor < 1:
            raise ValueError(f"downscaled: factor must be >= 1, got {factor}")
        if factor > min(self.smallest):
            raise ValueError("downscaled: factor {} leaves no pixel of {} x {}".format(factor, *self.smallest))
        return replace(
            self,
            intrinsics=self.intrinsics / factor,
            width=self.width // factor,
            height=self.height // factor,
            sizes=None if self.sizes is None else self.sizes // factor,
        )

    def rays(self, image_index: Tensor | int, x: Tensor, y: Tensor, *, cones: bool = False) -> Rays:
        """Returns the rays through pixels.

        Args:
            image_index: integer [b], the camera of each pixel, or one camera for all.
            x: [b], columns. Integers are pixels (the ray goes through the centre), floats are positions in the image.
            y: [b], rows, from the upper edge; integers or floats, as for ``x``.
            cones: Whether the rays have radii of 2 / sqrt(12) pixel widths. The variance of a cone across its axis is
                then the variance of the pixel (Barron et al. 2021, section 3.1). A pixel away from the optical axis
                appears narrower, except for fisheye and equirectangular cameras, whose pixels all cover the same angle.
                The effect of lens distortion on the pixel width is ignored.
        """
        x, y = _position(x).to(self.poses.dtype), _position(y).to(self.poses.dtype)
        camera = torch.full_like(x, image_index, dtype=torch.int64) if isinstance(image_index, int) else image_index
        fx, fy, cx, cy = self.intrinsics[camera].unbind(-1)
        local = torch.stack(((x - cx) / fx, -(y - cy) / fy, -torch.ones_like(x)), dim=-1)
        if self.distortion is not None:
            for index in camera.unique().tolist():
                of_camera = camera == index
                lens = self.intrinsics[index], self.distortion[index], self._model(index)
                local[of_camera] = unproject(x[of_camera], y[of_camera], *lens)[0].to(local)
        pose = self.poses[camera]
        directions = torch.nn.functional.normalize((pose[:, :3, :3] * local[:, None, :]).sum(-1), dim=-1)
        return Rays(pose[:, :3, 3], directions, self.radii(directions, camera) if cones else None)

    def has_ray(self, index: int) -> Tensor | None:
        """Returns the mask bool [h, w], on the CPU, of the pixels of an image that have a ray; None if all have one."""
        lenses, tables = self.lenses
        lens, (width, height) = int(lenses[index]), self.size(index)
        return None if tables is None or lens < 0 else tables.has_direction(lens)[:height, :width]

    def _model(self, index: int) -> int:
        return PERSPECTIVE if self.models is None else int(self.models[index])

    def radii(self, directions: Tensor, camera: Tensor) -> Tensor:
        """Returns the radii [b] of cones with `directions` [b, 3] from the cameras `camera`, int [b]."""
        widths = self.intrinsics[:, :2].prod(-1).rsqrt() * (2 / math.sqrt(12))
        slant = (directions * self.forward[camera]).sum(-1)
        if self.models is not None:
            by_angle = (self.models == FISHEYE) | (self.models == EQUIRECTANGULAR)
            slant = torch.where(by_angle[camera], 1.0, slant)
        return widths[camera] * slant

    def image_rays(self, index: int, *, cones: bool = False, backend: str = "auto") -> Rays:
        """Returns the rays [height * width] through all pixel centres of one camera's image, row by row."""
        return self.image_rays_between(index, near=0.0, far=1.0, cones=cones, backend=backend)[0]

    def image_rays_between(
        self, index: int, *, cones: bool = False, backend: str = "auto", **bounds: Any
    ) -> tuple[Rays, Tensor, Tensor]:
        """Returns the rays of `image_rays`, and their starts and ends [r]; for ``bounds`` see `ops.pixel_rays`."""
        device = self.poses.device
        width, height = self.size(index)
        pixels = torch.arange(height, device=device)[:, None] * self.width + torch.arange(width, device=device)
        blank = torch.zeros(1, self.height, self.width, 3, dtype=torch.uint8, device=device)
        camera = self[[index]]
        rays = camera.pixel_rays(blank, pixels.reshape(-1), **bounds, backend=backend)
        radii = camera.radii(rays.directions, torch.zeros_like(pixels.reshape(-1))) if cones else None
        return Rays(rays.origins, rays.directions, radii), rays.near, rays.far

    def pixel_rays(self, images: Tensor, index: Tensor, **options: Any) -> PixelRays:
        """Returns rays through pixels of the cameras' images, with the pixels' colours; see `voronerf.ops.pixel_rays`.

        Args:
            images: uint8 [c, height, width, 3 or 4], the images.
            index: int64 [b], the flat indices of the pixels over all images.
            **options: The further arguments of `voronerf.ops.pixel_rays`.
        """
        lens, tables = self.lenses
        if tables is not None:
            options |= {"lens": lens, "tables": tables.on(self.poses.device)}
        return pixel_rays(self.poses, self.intrinsics, images, index, **options)

    def project(self, points: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Projects points into the image of one camera.

        Args:
            points: [n, 3], in world coordinates.
            index: The index of the camera.

        Returns:
            (pixels [n, 2], depth [n]): positions (x, y) in the image, and distances along the optical axis in world
            units. Points with depth <= 0 are behind the camera; only a fisheye has meaningful pixels for them. For an
            equirectangular camera, depth is the distance from the camera.
        """
        pose = self.poses[index]
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = -local[:, 2]
        model = self._model(index)
        if model == FISHEYE:
            across = local[:, :2].norm(dim=-1)
            share = torch.atan2(across, depth) / across.clamp_min(1e-12)
            u, v = local[:, 0] * share, -local[:, 1] * share
        elif model == EQUIRECTANGULAR:
            u = torch.atan2(local[:, 0], depth)
            v = torch.atan2(-local[:, 1], torch.hypot(local[:, 0], depth))
            depth = local.norm(dim=-1)
        else:
            safe = torch.where(depth > 0, depth, torch.ones_like(depth))
            u, v = local[:, 0] / safe, -local[:, 1] / safe
        if self.distortion is not None:
            u, v = distort(u, v, self.distortion[index], model)
        fx, fy, cx, cy = self.intrinsics[index].unbind(-1)
        return torch.stack((u * fx + cx, v * fy + cy), dim=-1), depth


def focus_point(cameras: Cameras) -> Tensor | None:
    """Returns the point closest to all optical axes (least squares), float32 [3].

    Returns:
        The point, or None if it is not in front of the cameras: the axes are nearly parallel, or point outwards.

    Examples:
        >>> from voronerf.nerf import focus_point, orbit_cameras
        >>> cameras = orbit_cameras(8, radius=3.0, elevation=30.0, width=64, height=64, focal=70.0, centre=(1, 0, 0))
        >>> focus_point(cameras).round(decimals=4).abs()
        tensor([1., 0., 0.])
    """
    origins, forward = cameras.origins.double(), cameras.forward.double()
    across = torch.eye(3, dtype=torch.float64, device=origins.device) - forward[:, :, None] * forward[:, None, :]
    matrix = across.mean(0)
    if torch.linalg.eigvalsh(matrix)[0] < 1e-3:
        return None
    point = torch.linalg.solve(matrix, (across @ origins[:, :, None]).mean(0)[:, 0])
    ahead = ((point - origins) * forward).sum(-1)
    return point.to(cameras.poses.dtype) if (ahead > 0).double().mean() > 0.5 else None


def axis_misses(cameras: Cameras, point: Tensor) -> Tensor:
    """Returns [c], the distance between a point and each optical axis, divided by the camera's distance from the point.

    The result is 0 for a camera that looks at the point, 0.5 if the point is 30 degrees off the axis, and 1 if the
    point is behind the camera.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.nerf.cameras import axis_misses
        >>> cameras = orbit_cameras(2, radius=4.0, elevation=0.0, width=64, height=64, focal=70.0)
        >>> axis_misses(cameras, torch.tensor([0.0, 3.0, 0.0])).round(decimals=4)
        tensor([0.6000, 0.6000])
    """
    offset = point - cameras.origins
    distance = offset.norm(dim=-1).clamp_min(1e-12)
    share = torch.linalg.cross(offset, cameras.forward, dim=-1).norm(dim=-1) / distance
    return torch.where((offset * cameras.forward).sum(-1) > 0, share, 1)


def shared_focus(cameras: Cameras) -> Tensor | None:
    """Returns the `focus_point` [3] of cameras that stand around an object, or None for other cameras.

    For cameras of a person who walks and looks around, the focus point lies ahead of most cameras by chance, but few
    cameras look at it.
    """
    focus = focus_point(cameras)
    return focus if focus is not None and float(axis_misses(cameras, focus).median()) < AROUND else None


def look_at(origins: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Returns the poses [c, 4, 4] of cameras at `origins` [c, 3] that look at `target` [3]; `up` [3] points upwards.

    For a camera that looks along `up`, another axis replaces `up`.
    """
    back = torch.nn.functional.normalize(origins - target, dim=-1)
    along = torch.cross(up.expand_as(back), back, dim=-1)
    spare = torch.cross(up.roll(1).expand_as(back), back, dim=-1)
    right = torch.where(along.norm(dim=-1, keepdim=True) > 1e-4, along, spare)
    right = torch.nn.functional.normalize(right, dim=-1)
    poses = torch.eye(4, dtype=origins.dtype, device=origins.device).repeat(len(origins), 1, 1)
    poses[:, :3] = torch.stack((right, torch.cross(back, right, dim=-1), back, origins), dim=-1)
    return poses


def orbit_cameras(
    count: int,
    *,
    radius: float,
    elevation: float,
    width: int,
    height: int,
    focal: float,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    start: float = 0.0,
) -> Cameras:
    """Returns cameras evenly spaced on a circle around the z axis, which look at `centre`.

    Args:
        count: The number of cameras, >= 1.
        radius: The distance of the cameras to the centre, in world units.
        elevation: The angle above the horizon, in degrees.
        width: The width of the images in pixels.
        height: The height of the images in pixels.
        focal: The focal length in pixels; the principal point is the middle of the image.
        centre: The point that the cameras look at.
        start: The azimuth of the first camera, in degrees.

    Examples:
        >>> from voronerf.nerf import orbit_cameras
        >>> cameras = orbit_cameras(4, radius=2.0, elevation=0.0, width=64, height=64, focal=70.0)
        >>> cameras.origins.round(decimals=3).abs()
        tensor([[2., 0., 0.],
                [0., 2., 0.],
                [2., 0., 0.],
                [0., 2., 0.]])
    """
    if count < 1:
        raise ValueError(f"orbit_cameras: count must be >= 1, got {count}")
    exact = partial(torch.tensor, dtype=torch.float64, device="cpu")
    azimuth = math.radians(start) + exact(range(count)) * (2 * math.pi / count)
    climb = math.radians(elevation)
    around = torch.stack(
        (azimuth.cos() * math.cos(climb), azimuth.sin() * math.cos(climb), torch.full_like(azimuth, math.sin(climb))),
        dim=-1,
    )
    target = exact(centre)
    poses = look_at(target + radius * around, target, exact((0.0, 0.0, 1.0)))
    intrinsics = exact((focal, focal, width / 2, height / 2)).repeat(count, 1)
    return Cameras(poses.float(), intrinsics.float(), width, height)


def turntable_cameras(cameras: Cameras, count: int) -> Cameras:
    """Returns an orbit around the cameras' focus, with the cameras' mean distance, elevation and focal length.

    The pictures have the size of the first camera's picture.

    Examples:
        >>> from voronerf.nerf import orbit_cameras, turntable_cameras
        >>> seen = orbit_cameras(3, radius=2.0, elevation=20.0, width=64, height=64, focal=70.0)
        >>> len(turntable_cameras(seen, 60))
        60
    """
    cameras = cameras.perspective()
    centre = focus_point(cameras)
    if centre is None:
        centre = (cameras.origins + cameras.forward).mean(0)
    offset = cameras.origins - centre
    radius = float(offset.norm(dim=-1).mean())
    width, height = cameras.size(0)
    climb = float((offset[:, 2] / offset.norm(dim=-1).clamp_min(1e-9)).mean().clamp(-0.95, 0.95))
    return orbit_cameras(
        count,
        radius=radius,
        elevation=math.degrees(math.asin(climb)),
        width=width,
        height=height,
        focal=float(cameras.intrinsics[:, :2].mean()),
        centre=centre.tolist(),
    ).to(cameras.poses.device)


def _position(pixel: Tensor) -> Tensor:
    return pixel if pixel.is_floating_point() else pixel + 0.5
