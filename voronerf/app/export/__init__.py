"""Exports a trained run to files for other programs: points, a mesh, cells, videos."""

from voronerf.app.export.cells import cell_meshes, export_cells
from voronerf.app.export.mesh import export_mesh
from voronerf.app.export.points import export_points
from voronerf.app.export.video import export_video

__all__ = [
    "cell_meshes",
    "export_cells",
    "export_mesh",
    "export_points",
    "export_video",
]
