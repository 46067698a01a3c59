"""LPIPS, the learned perceptual distance of two images (Zhang et al. 2018), version 0.1 on AlexNet.

The network is a few lines of plain torch. The user provides its weights as files. c channels, h x w pixels.
"""

from __future__ import annotations

import importlib.util
import os
import re
from pathlib import Path

import torch
from safetensors.torch import load
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

#: Convolutions of AlexNet under torchvision's names: number, (out, in, kernel), stride, padding, and whether a 3 x 3
#: max pooling with stride 2 precedes it.
CONVOLUTIONS = (
    (0, (64, 3, 11), 4, 2, False),
    (3, (192, 64, 5), 1, 2, True),
    (6, (384, 192, 3), 1, 1, True),
    (8, (256, 384, 3), 1, 1, False),
    (10, (256, 256, 3), 1, 1, False),
)
SHAPES = {
    **{f"features.{i}.weight": (o, c, k, k) for i, (o, c, k), *_ in CONVOLUTIONS},
    **{f"features.{i}.bias": (o,) for i, (o, _, _), *_ in CONVOLUTIONS},
    **{f"lin{level}.model.1.weight": (1, o, 1, 1) for level, (_, (o, _, _), *_) in enumerate(CONVOLUTIONS)},
}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
#: Smallest side in pixels; smaller images leave nothing for the third convolution.
SMALLEST = 31
OFF = "off"
VARIABLE = "VORONERF_LPIPS"
SUFFIXES = (".safetensors", ".pth", ".pt")
ALEXNET = "alexnet-owt-7be5be79.pth"  # the name of torchvision's download


class LpipsError(ValueError):
    """Weights that cannot be used; the message is one line and names the file."""


class Lpips:
    """The LPIPS metric: 0 for equal images, about 0.05 for good renderings, 0.5 for unrelated pictures.

    Each of AlexNet's five ReLU maps is scaled to unit length over the channels of a pixel; the squared differences are
    weighted by channel (the learnt linear layers), averaged over the pixels and summed over the maps.

    Args:
        weights: the tensors by their names in `SHAPES`.

    Examples:
        >>> import torch
        >>> from voronerf.app.evaluate.lpips import SHAPES, Lpips
        >>> lpips = Lpips({name: torch.rand(shape) for name, shape in SHAPES.items()})  # find_lpips has real ones
        >>> image = torch.rand(40, 40, 3)
        >>> float(lpips(image, image)), float(lpips(image, 1 - image)) > 0
        (0.0, True)
    """

    def __init__(self, weights: dict[str, Tensor]) -> None:
        self.weights = {name: weights[name].detach().to(torch.float32) for name in SHAPES}

    def __call__(self, image: Tensor, truth: Tensor) -> Tensor:
        """Returns the LPIPS of two images, a float32 scalar.

        Args:
            image: [h, w, 3] in 0..1, at least 31 pixels on a side.
            truth: [h, w, 3] in 0..1, the reference image.

        Raises:
            ValueError: the shapes differ or are not [h, w, 3], or the images are too small.
        """
        if image.shape != truth.shape or image.dim() != 3 or image.shape[-1] != 3:
            raise ValueError(
                f"lpips: image and truth must have the same shape [h, w, 3], got {list(image.shape)} and "
                f"{list(truth.shape)}"
            )
        if min(image.shape[:2]) < SMALLEST:
            raise ValueError(
                f"lpips: images must be at least {SMALLEST} x {SMALLEST}, AlexNet's smallest, got "
                f"{image.shape[0]} x {image.shape[1]}"
            )
        if self.weights["features.0.weight"].device != image.device:
            self.weights = {name: weight.to(image.device) for name, weight in self.weights.items()}
        x = torch.stack((image, truth)).to(torch.float32).permute(0, 3, 1, 2)
        shift, scale = (x.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        x = (2 * x - 1 - shift) / scale
        distance = x.new_zeros(())
        for level, (index, _, stride, padding, pooled) in enumerate(CONVOLUTIONS):
            if pooled:
                x = max_pool2d(x, 3, 2)
            weight, bias = self.weights[f"features.{index}.weight"], self.weights[f"features.{index}.bias"]
            x = conv2d(x, weight, bias, stride, padding).relu()
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            difference = (unit[0] - unit[1]).square().mean((1, 2))
            distance = distance + (self.weights[f"lin{level}.model.1.weight"].flatten() * difference).sum()
        return distance


def find_lpips(setting: Path | None, data: str = "", size: tuple[int, int] = (SMALLEST, SMALLEST)) -> Lpips | None:
    """Finds LPIPS weights on this machine and returns the metric, or None if there are no weights.

    The function looks for weights in this order: `setting`, VORONERF_LPIPS, the folder `lpips` of VORONERF_DATA, the
    folder `lpips` beside the folder of the scene, and the installed `lpips` package with the AlexNet that torchvision
    downloaded for it.

    Args:
        setting: a file, or a folder of files; "off" for no LPIPS.
        data: the folder of the scene.
        size: rows and columns of the images. There is no LPIPS of images that are too small.

    Raises:
        LpipsError: the first weights that exist cannot be used, or the images are too small for the weights of
            `setting`.

    Examples:
        >>> from pathlib import Path
        >>> from voronerf.app.evaluate import find_lpips
        >>> find_lpips(Path("off")) is None
        True
    """
    named = str(setting or os.environ.get(VARIABLE, ""))
    if named == OFF:
        return None
    path = Path(os.path.expanduser(named))  # keeps ~ if nothing tells the home folder
    if named and not path.exists():
        raise LpipsError(f"{path}: there is no such file or folder, as set by {'--lpips' if setting else VARIABLE}")
    if min(size) < SMALLEST:
        if setting:
            why = f"images of {size[0]} x {size[1]} are below AlexNet's smallest, {SMALLEST} x {SMALLEST}"
            raise LpipsError(f"--lpips must be {OFF} or come with larger images: {why}")
        return None
    if named:
        return Lpips(read_weights(_files(path)))
    folders = [Path(root) / "lpips" for root in (os.environ.get("VORONERF_DATA"),) if root]
    if data and Path(data).exists():
        place = Path(data).resolve()  # the scene's folder, or a file in it
        folders.append((place if place.is_dir() else place.parent).parent / "lpips")
    for folder in folders:
        if any(file.suffix in SUFFIXES for file in folder.glob("*")):
            return Lpips(read_weights(_files(folder)))
    return _from_package()


def read_weights(files: list[Path]) -> dict[str, Tensor]:
    """Reads the tensors of `SHAPES` from one or several files, in any of the usual naming schemes.

    The schemes are torchvision's (`features.0.weight`), the `lpips` package's for its linear layers
    (`lin0.model.1.weight`) and for its whole network (`net.slice1.0.weight`).

    Args:
        files: safetensors, or state dicts saved by torch, which are loaded with ``weights_only=True``.

    Raises:
        LpipsError: a file cannot be read, or a tensor is missing or has another shape.
    """
    weights: dict[str, Tensor] = {}
    for file in files:
        try:
            if file.suffix == ".safetensors":
                tensors = load(file.read_bytes())  # not mapped: the file may be cut short while the weights are in use
            else:
                tensors = torch.load(file, map_location="cpu", weights_only=True)
            named = [(name, tensor) for name, tensor in tensors.items() if isinstance(tensor, Tensor)]
        except Exception as error:  # unpickling a damaged file may raise any error
            raise LpipsError(f"{file}: not a readable file of weights: {_first_line(error)}") from None
        for name, tensor in named:
            name = re.sub(r"^net\.slice\d\.", "features.", name)
            if name not in SHAPES:
                continue
            if tuple(tensor.shape) != SHAPES[name]:
                raise LpipsError(f"{file}: {name} must have shape {list(SHAPES[name])}, got {list(tensor.shape)}")
            weights[name] = tensor
    missing = [name for name in SHAPES if name not in weights]
    if missing:
        where = ", ".join(map(str, files))
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise LpipsError(f"{where}: not the weights of LPIPS v0.1 on AlexNet: {', '.join(missing[:3])}{more} missing")
    return weights


def _files(path: Path) -> list[Path]:
    """Lists the weight files of a path: the file itself; of a folder, the files with "alex" in their names, or all."""
    if path.is_file():
        return [path]
    files = sorted(file for file in path.glob("*") if file.suffix in SUFFIXES)
    if not files:
        raise LpipsError(f"{path}: holds no file of weights ({', '.join(SUFFIXES)})")
    return [file for file in files if "alex" in file.name.lower()] or files


def _from_package() -> Lpips | None:
    """Returns LPIPS with the weights of the installed `lpips` package, or None; never downloads."""
    package = importlib.util.find_spec("lpips")
    if package is None or not package.submodule_search_locations:
        return None
    linear = Path(next(iter(package.submodule_search_locations))) / "weights" / "v0.1" / "alex.pth"
    files = [linear, Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET]
    return Lpips(read_weights(files)) if all(file.is_file() for file in files) else None


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
