"""Exports the cells of a diagram as coloured polyhedra.

A point is in a cell if, on each level of the diagram, the centre of the cell or of its ancestor is nearer than the
centres of all its siblings. Each such condition is a half-space, `2 (b - a) . x <= |b|^2 - |a|^2` for a centre a and
its sibling b. The box adds six half-spaces. Their intersection is a convex polyhedron.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.evaluate.panels import palette
from voronerf.app.export.space import box_of, check_export, placed, write_geometry
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.contraction import Perspective

SUFFIXES = (".glb",)
#: The minimum inscribed radius of an exported cell, as a fraction of the box's longest side.
THINNEST = 1e-6


def export_cells(run: Run, path: Path | str, *, box: Tensor | None = None, to_files: bool = False) -> Any:
    """Writes the cells of a run as .glb, clipped to a box, with an object per cell; returns the ``trimesh.Scene``.

    The objects are named `cell_0000` and so on, and have the cells' colours in pictures. The file has y up, as glTF
    requires; the returned scene has z up.

    Args:
        run: The run.
        path: File to write, .glb.
        box: [2, 3]; default the scene's box, or the box around the sphere of the contraction.
        to_files: Write coordinates of the scene's files instead of scene coordinates.

    Raises:
        ConfigError: The scene has no box, and none is given; or its cells are in normalised device coordinates.
        ImportError: trimesh or scipy is missing.
        ValueError: The suffix is not .glb.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_cells
        >>> def names(run: Run) -> list:
        ...     return list(export_cells(run, "cells.glb").geometry)  # cell_0000, cell_0001, ...
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    if isinstance(run.renderer.contraction, Perspective):
        raise ConfigError(
            "--cells needs cells with flat sides, got cells of a forward-facing scene (--contraction ndc)"
        )
    import trimesh

    scene = trimesh.Scene()
    for cell, mesh in cell_meshes(run.diagram, box_of(run, box)).items():
        name = f"cell_{cell:04}"
        scene.add_geometry(placed(run, mesh, to_files), node_name=name, geom_name=name)
    write_geometry(path, scene)
    return scene


def cell_meshes(diagram: VoronoiDiagram, box: Tensor) -> dict[int, Any]:
    """Returns the leaves of a diagram that reach into a box, clipped to it, as ``trimesh.Trimesh`` by cell number.

    Args:
        diagram: The diagram, of any depth.
        box: [2, 3], the lowest and the highest corner.

    Raises:
        ImportError: trimesh or scipy is missing.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiDiagram
        >>> from voronerf.app.export import cell_meshes
        >>> diagram = VoronoiDiagram(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]))
        >>> meshes = cell_meshes(diagram, torch.tensor([[-1.0, 0, 0], [1.0, 1, 1]]))
        >>> {cell: round(float(mesh.volume), 6) for cell, mesh in meshes.items()}
        {0: 1.5, 1: 0.5}
    """
    import trimesh
    from scipy.spatial import HalfspaceIntersection

    colours = palette(diagram.num_cells).numpy()
    low, high = box.double().cpu().numpy()
    walls = np.concatenate(
        (np.concatenate((-np.eye(3), low[:, None]), 1), np.concatenate((np.eye(3), -high[:, None]), 1))
    )
    meshes = {}
    for cell, planes in enumerate(_half_spaces(diagram)):
        planes = np.concatenate((walls, planes))
        inside = _middle(planes, float((high - low).max()))
        if inside is None:
            continue
        mesh = trimesh.convex.convex_hull(HalfspaceIntersection(planes, inside).intersections)
        material = trimesh.visual.material.PBRMaterial(
            name=f"cell_{cell:04}",
            baseColorFactor=[*colours[cell].tolist(), 255],
            metallicFactor=0.0,
            roughnessFactor=0.9,
        )
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        meshes[cell] = mesh
    return meshes


def _half_spaces(diagram: VoronoiDiagram) -> list[NDArray[np.float64]]:
    """Returns for each leaf the half-spaces, rows (n, d) of unit normal and offset, with n . x + d <= 0 inside."""
    centres = diagram.centres.double().cpu().numpy()
    offsets, paths = diagram.child_offsets.tolist(), diagram.paths().tolist()
    child = diagram.child.tolist()
    leaves = []
    for path in paths:
        node, planes = 0, [np.zeros((0, 4))]
        for number in path:
            if number < 0:
                break
            rows = np.arange(offsets[node], offsets[node + 1])
            row, siblings = rows[number], np.delete(rows, number)
            normals = 2 * (centres[siblings] - centres[row])
            shift = (centres[row] ** 2).sum() - (centres[siblings] ** 2).sum(-1)
            length = np.linalg.norm(normals, axis=-1)
            distinct = length > 0  # coincident centres have no plane between them
            planes.append(np.concatenate((normals, shift[:, None]), 1)[distinct] / length[distinct, None])
            node = child[row]
        leaves.append(np.concatenate(planes))
    return leaves


def _middle(planes: NDArray[np.float64], extent: float) -> NDArray[np.float64] | None:
    """Returns the centre of the largest ball between planes, or None if it is smaller than `THINNEST`."""
    from scipy.optimize import linprog

    rows = np.concatenate((planes[:, :3], np.ones((len(planes), 1))), 1)
    solution = linprog((0, 0, 0, -1), A_ub=rows, b_ub=-planes[:, 3], bounds=[(None, None)] * 3 + [(None, None)])
    return solution.x[:3] if solution.status == 0 and solution.x[3] > THINNEST * extent else None
