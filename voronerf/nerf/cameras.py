"""Cameras with lens distortion: pixels to rays, points to pixels.

c cameras, r rays, b chosen pixels, n points.

Frames. A pose maps camera to world coordinates; camera axes are OpenGL's: x right, y up, the camera looks along -z. The
world is z up. Pixels: x to the right, y down, the image covers [0, width] x [0, height], the centre of the first pixel
is at (0.5, 0.5). Distortion acts on image-plane coordinates u = (x - cx) / fx, v = (y - cy) / fy. See
`voronerf.nerf.lenses.distort` for its models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
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

#: Largest median of `axis_misses` of cameras around something: 24 degrees, within the pictures of most lenses. Captures
#: around something have 0.06 to 0.13, those that are aimed 12 degrees off 0.22; 1 % of random walks have less than 0.4.
AROUND = 0.4


@dataclass(frozen=True, eq=False)
class Rays:
    """A batch of rays in world coordinates.

    Attributes:
        origins: float32 [r, 3].
        directions: float32 [r, 3], unit length.
        radii: float32 [r], radius at distance 1 of the cone around each ray, or None.

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
        """The same rays on a device."""
        radii = None if self.radii is None else self.radii.to(device)
        return Rays(self.origins.to(device), self.directions.to(device), radii)


@dataclass(frozen=True, eq=False)
class Cameras:
    """c cameras.

    Attributes:
        poses: float32 [c, 4, 4], camera to world.
        intrinsics: float32 [c, 4], (fx, fy, cx, cy) in pixels.
        width: of every image, in pixels; of the widest where they differ.
        height: of every image, in pixels; of the highest where they differ.
        distortion: float32 [c, 8], coefficients of the lenses, see `voronerf.nerf.lenses.distort`, or None for none.
        models: int32 [c], the camera model of each: 0 perspective, 1 fisheye, 2 FOV, 3 equirectangular (360 degrees).
            It needs coefficients. None is perspective for all.
        sizes: int64 [c, 2], (width, height) of each image, or None if they are of one size. See `size`.

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
        """The cameras after a similarity [4, 4] of the world, such as the change from one frame to another."""
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
        """Cameras of images whose (width, height) `sizes` int64 [c, 2] may differ; at least one."""
        width, height = sizes.amax(0).tolist()
        differ = bool((sizes != sizes[:1]).any())
        return cls(poses, intrinsics, width, height, distortion, models, sizes if differ else None)

    @classmethod
    def joined(cls, several: Sequence[Cameras]) -> Cameras:
        """The cameras of all, one after another."""

        def every(name: str, missing: Callable[[int], Tensor]) -> Tensor | None:
            there = [getattr(cameras, name) for cameras in several]
            if all(tensor is None for tensor in there):
                return None
            pairs = zip(several, there, strict=True)
            return torch.cat([missing(len(cameras)) if tensor is None else tensor for cameras, tensor in pairs])

        sizes = [
            torch.tensor([[each.width, each.height]]).expand(len(each), 2) if each.sizes is None else each.sizes
            for each in several
        ]
        return cls.of_images(
            torch.cat([cameras.poses for cameras in several]),
            torch.cat([cameras.intrinsics for cameras in several]),
            torch.cat(sizes),
            every("distortion", lambda n: torch.zeros(n, 8)),
            every("models", lambda n: torch.zeros(n, dtype=torch.int32)),
        )

    def __len__(self) -> int:
        return self.poses.shape[0]

    def __getitem__(self, index: Tensor | slice | Sequence[int]) -> Cameras:
        """The cameras chosen by a slice, a list or an index tensor."""
        return self._each(lambda tensor: tensor[index])

    def size(self, index: int) -> tuple[int, int]:
        """(width, height) of one image."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes[index].tolist()
        return width, height

    @property
    def smallest(self) -> tuple[int, int]:
        """The least width and the least height of the images."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes.amin(0).tolist()
        return width, height

    @property
    def origins(self) -> Tensor:
        """Camera centres, [c, 3]."""
        return self.poses[:, :3, 3]

    @property
    def forward(self) -> Tensor:
        """Unit viewing directions (optical axes), [c, 3]."""
        return -self.poses[:, :3, 2]

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on a device."""
        return self._each(lambda tensor: tensor.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Cameras:
        """With another tensor for each; the tables of the lenses are shared."""
        members = ((field.name, getattr(self, field.name)) for field in fields(self))
        changed: dict[str, Any] = {name: change(value) for name, value in members if isinstance(value, Tensor)}
        return replace(self, **changed)._with_lenses(change(self.lenses[0]), self.lenses[1])

    def _with_lenses(self, lens: Tensor, tables: LensTables | None) -> Cameras:
        self.__dict__["lenses"] = lens, tables
        return self

    @cached_property
    def lenses(self) -> tuple[Tensor, LensTables | None]:
        """The lens of each camera, int32 [c], -1 for one without distortion; and the tables of the distinct ones.

        Cameras that are indexed, moved or sent to a device share the tables.

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
        every = torch.cat((self.intrinsics, self.distortion, models[:, None].to(self.intrinsics)), dim=1)
        distinct, of = every[bent].unique(dim=0, return_inverse=True)
        lens[bent] = of.to(torch.int32)
        return lens, LensTables(distinct, self.width, self.height)

    def perspective(self) -> Cameras:
        """The cameras without their lenses; one that sees all around looks ahead, 90 degrees wide."""
        if self.models is None:
            return replace(self, distortion=None)
        around = self.models == EQUIRECTANGULAR
        sizes = torch.tensor([self.size(index) for index in range(len(self))], device=self.poses.device)
        sides = (sizes[:, 1:] // 2).clamp_min(1).expand(-1, 2)
        ahead = torch.cat((sides, sides), 1).to(self.intrinsics) / 2
        intrinsics = torch.where(around[:, None], ahead, self.intrinsics)
        return Cameras.of_images(self.poses, intrinsics, torch.where(around[:, None], sides, sizes))

    @classmethod
    def all_around(cls, poses: Tensor, height: int) -> Cameras:
        """Cameras that see all around, in equirectangular images of `height` x twice as many pixels.

        Args:
            poses: [c, 4, 4]; the middle of the image is what they look at, up is its upper edge.
            height: of the images, in pixels.

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
        """Cameras of the images averaged over blocks of `factor` x `factor` pixels.

        Incomplete blocks at the right and at the bottom are dropped, so that focal lengths and the principal point are
        divided by exactly `factor`.

        Raises:
            ValueError: `factor` is below 1, or no whole block is left.
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
        """Rays through pixels.

        Args:
            image_index: integer [b], the camera of each pixel, or one camera for all.
            x: [b] column. Integers are pixels (the ray goes through their centre), floats are positions in the image.
            y: [b] row, in pixels from the upper edge.
            cones: give the rays radii of 2 / sqrt(12) of the width of a pixel, so that the variance of a cone across
                its axis is that of the pixel (Barron et al. 2021, section 3.1). A pixel away from the optical axis is
                farther away and so appears narrower, but that of a fisheye or a picture all around, which covers the
                same angle. Lens distortion of the size of a pixel is ignored.
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
        """Which pixels of one image its lens gives a ray to, bool [h, w] on the CPU; None for all."""
        lenses, tables = self.lenses
        lens, (width, height) = int(lenses[index]), self.size(index)
        return None if tables is None or lens < 0 else tables.there(lens)[:height, :width]

    def _model(self, index: int) -> int:
        return PERSPECTIVE if self.models is None else int(self.models[index])

    def radii(self, directions: Tensor, camera: Tensor) -> Tensor:
        """The radii [b] of cones along `directions` [b, 3] of the cameras int [b]."""
        widths = self.intrinsics[:, :2].prod(-1).rsqrt() * (2 / math.sqrt(12))
        slant = (directions * self.forward[camera]).sum(-1)
        if self.models is not None:
            by_angle = (self.models == FISHEYE) | (self.models == EQUIRECTANGULAR)
            slant = torch.where(by_angle[camera], 1.0, slant)
        return widths[camera] * slant

    def image_rays(self, index: int, *, cones: bool = False, backend: str = "auto") -> Rays:
        """Rays through all pixel centres of one camera, row by row: [height * width], of its own image."""
        return self.image_rays_between(index, near=0.0, far=1.0, cones=cones, backend=backend)[0]

    def image_rays_between(
        self, index: int, *, cones: bool = False, backend: str = "auto", **bounds: Any
    ) -> tuple[Rays, Tensor, Tensor]:
        """`image_rays`, and where they begin and end [r]; ``bounds`` are those of `voronerf.ops.pixel_rays`."""
        device = self.poses.device
        width, height = self.size(index)
        pixels = torch.arange(height, device=device)[:, None] * self.width + torch.arange(width, device=device)
        blank = torch.zeros(1, self.height, self.width, 3, dtype=torch.uint8, device=device)
        one = self[[index]]
        rays = one.pixel_rays(blank, pixels.reshape(-1), **bounds, backend=backend)
        radii = one.radii(rays.directions, torch.zeros_like(pixels.reshape(-1))) if cones else None
        return Rays(rays.origins, rays.directions, radii), rays.near, rays.far

    def pixel_rays(self, images: Tensor, index: Tensor, **options: Any) -> PixelRays:
        """`voronerf.ops.pixel_rays` of these cameras and their images, uint8 [c, height, width, 3 or 4]."""
        lens, tables = self.lenses
        if tables is not None:
            options |= {"lens": lens, "tables": tables.on(self.poses.device)}
        return pixel_rays(self.poses, self.intrinsics, images, index, **options)

    def project(self, points: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Projects points into the image of one camera.

        Args:
            points: [n, 3], world.
            index: the camera.

        Returns:
            (pixels [n, 2], depth [n]): positions (x, y) in the image, and distance along the optical axis in world
            units. Points with depth <= 0 are behind the camera, and their pixels are meaningless but for a fisheye. An
            equirectangular camera sees all around, and depth is the distance.
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
    """The point closest to all optical axes (least squares), float32 [3].

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
    """Returns how far each optical axis passes from a point, as a share of the camera's distance from it, [c].

    A camera that looks at the point has 0, one that looks past it at an angle of 30 degrees 0.5, and one that has it
    behind itself 1.

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
    """Returns the `focus_point` of cameras that stand around something, [3], or None for others.

    The point closest to all optical axes of people who walk and look around lies ahead of most cameras by chance. Only
    cameras around something look at it.
    """
    focus = focus_point(cameras)
    return focus if focus is not None and float(axis_misses(cameras, focus).median()) < AROUND else None


def look_at(origins: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Poses [c, 4, 4] of cameras at `origins` [c, 3] that look at `target` [3] with `up` [3] upwards in the image.

    A camera that looks along `up` uses another axis instead.
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
    """Cameras evenly spaced on a circle around the z axis, looking at `centre`.

    Args:
        count: number of cameras, >= 1.
        radius: distance to the centre, world units.
        elevation: above the horizon, degrees.
        width: pixels.
        height: pixels.
        focal: pixels; the principal point is the middle of the image.
        centre: the point that the cameras look at.
        start: azimuth of the first camera, degrees.

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
    azimuth = math.radians(start) + torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    climb = math.radians(elevation)
    around = torch.stack(
        (azimuth.cos() * math.cos(climb), azimuth.sin() * math.cos(climb), torch.full_like(azimuth, math.sin(climb))),
        dim=-1,
    )
    target = torch.tensor(centre, dtype=torch.float64)
    poses = look_at(target + radius * around, target, torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64))
    intrinsics = torch.tensor((focal, focal, width / 2, height / 2)).repeat(count, 1)
    return Cameras(poses.float(), intrinsics.float(), width, height)


def turntable_cameras(cameras: Cameras, count: int) -> Cameras:
    """An orbit like the given cameras: around their focus, at their mean distance, elevation and focal length.

    The pictures have the size of the first camera's.

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
