"""The cells of a diagram as coloured polyhedra.

A cell is where its centre is the nearest one among its siblings, on each level of the diagram. Each of these conditions
is a half-space, `2 (b - a) . x <= |b|^2 - |a|^2` for a centre a and its sibling b, and
the box adds six. Their intersection is convex.
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
from voronerf.diagram import VoronoiDiagram

SUFFIXES = (".glb",)
#: Radius of the smallest cell that is written, as a share of the box.
THINNEST = 1e-6


def export_cells(run: Run, path: Path | str, *, box: Tensor | None = None, to_files: bool = False) -> Any:
    """Writes the cells of a run, clipped to the scene's box, as .glb with an object for each; returns the scene.

    The objects are named `cell_0000` and so on, and have the colours that the cells have in pictures. The file has y
    up, as glTF asks for; the scene that is returned has z up.

    Args:
        run: The run.
        path: File to write, .glb.
        box: [2, 3]; default the scene's, or that around the sphere of the contraction.
        to_files: Positions are those of the scene's files, rather than the scene's.

    Raises:
        ConfigError: No box.
        ImportError: trimesh or scipy is missing.
        ValueError: Another suffix.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_cells
        >>> def names(run: Run) -> list:
        ...     return list(export_cells(run, "cells.glb").geometry)  # cell_0000, cell_0001, ...
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    import trimesh

    scene = trimesh.Scene()
    for cell, mesh in cell_meshes(run.diagram, box_of(run, box)).items():
        name = f"cell_{cell:04}"
        scene.add_geometry(placed(run, mesh, to_files), node_name=name, geom_name=name)
    write_geometry(path, scene)
    return scene


def cell_meshes(diagram: VoronoiDiagram, box: Tensor) -> dict[int, Any]:
    """The leaves of a diagram, clipped to a box, as ``trimesh.Trimesh`` by their numbers; without those outside of it.

    Args:
        diagram: Of any depth.
        box: [2, 3].

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
    """For each leaf the rows (n, d) of unit normals and offsets with n . x + d <= 0 inside of it."""
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
            mine, others = rows[number], np.delete(rows, number)
            normals = 2 * (centres[others] - centres[mine])
            shift = (centres[mine] ** 2).sum() - (centres[others] ** 2).sum(-1)
            length = np.linalg.norm(normals, axis=-1)
            apart = length > 0  # of two centres in one place, one has no points, or both the same
            planes.append(np.concatenate((normals, shift[:, None]), 1)[apart] / length[apart, None])
            node = child[mine]
        leaves.append(np.concatenate(planes))
    return leaves


def _middle(planes: NDArray[np.float64], extent: float) -> NDArray[np.float64] | None:
    """The centre of the largest ball between planes, or None if there is no room for one."""
    from scipy.optimize import linprog

    rows = np.concatenate((planes[:, :3], np.ones((len(planes), 1))), 1)
    solution = linprog((0, 0, 0, -1), A_ub=rows, b_ub=-planes[:, 3], bounds=[(None, None)] * 3 + [(None, None)])
    return solution.x[:3] if solution.status == 0 and solution.x[3] > THINNEST * extent else None
