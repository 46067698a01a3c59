"""The published figures (Elsner et al. 2023, "Adaptive Voronoi NeRFs"): 400 x 400 images, 24 h on an RTX 2080 Ti."""

from __future__ import annotations

from typing import NamedTuple

CONDITIONS = "published: 400 x 400, 24 h, RTX 2080 Ti"


class Scores(NamedTuple):
    """PSNR in dB, SSIM, LPIPS."""

    psnr: float
    ssim: float
    lpips: float


#: Hierarchical sampling: (field, scene) -> one network of width 256, 12 Voronoi cells of width 64.
HIERARCHICAL: dict[tuple[str, str], tuple[Scores, Scores]] = {
    ("nerf", "lego"): (Scores(27.355, 0.9451, 0.0910), Scores(27.652, 0.9483, 0.0831)),
    ("mipnerf", "lego"): (Scores(30.538, 0.9712, 0.0507), Scores(31.234, 0.9752, 0.0417)),
    ("nerf", "ship"): (Scores(26.717, 0.8967, 0.2016), Scores(27.373, 0.9068, 0.1820)),
    ("mipnerf", "ship"): (Scores(28.226, 0.9164, 0.1658), Scores(29.007, 0.9250, 0.1439)),
    ("nerf", "drums"): (Scores(23.077, 0.9145, 0.1320), Scores(23.490, 0.9230, 0.1128)),
    ("mipnerf", "drums"): (Scores(24.474, 0.9354, 0.1054), Scores(24.760, 0.9409, 0.0869)),
}
#: Stratified sampling, Lego: field -> one network of width 256 (the row "Uniform" is named after its sampling),
#: 12 Voronoi cells of width 64.
STRATIFIED: dict[str, tuple[Scores, Scores]] = {
    "nerf": (Scores(25.450, 0.912, 0.144), Scores(25.603, 0.917, 0.134)),
    "mipnerf": (Scores(27.401, 0.945, 0.111), Scores(27.979, 0.949, 0.105)),
}
#: The same networks for the same time, Lego: KiloNeRF's 512 uniform cells, 16 x 16 Voronoi cells.
KILONERF = (Scores(27.080, 0.938, 0.098), Scores(27.765, 0.952, 0.078))
#: The number of cells of both, with networks of width 64.
CELLS = 12
#: std(W / max W) before and after balancing, the median of 100 diagrams.
BALANCE = (0.246, 0.0018)
