"""Triangles: loading, mending, the unit box, the ground.

Geometry is computed in float64 and returned in float32; units as `fit_unit_box` says.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.exchange.load import mesh_formats

from ginn_jax import orientation
from ginn_jax.checks import positive, real_array
from ginn_jax.errors import InputError, naming, warn
from ginn_jax.files import files_below
from ginn_jax.mesh_files import load_scene, merge

GROUND_GAP = 1e-4
# Clouds on disk number materials by a byte.
LAST_MATERIAL = 255
ROUNDED = 1e-5


class Mesh(NamedTuple):
    """Triangles with one material index a face: 0 is the object, 1 the ground."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    material: Int[np.ndarray, "F"]


def make_mesh(
    vertices: np.ndarray, faces: np.ndarray, material: np.ndarray | None = None
) -> Mesh:
    """A clean `Mesh` from vertices [V 3], faces [F 3] and materials [F] (default 0).

    Degenerate faces (area below 1e-12 of the longest side squared) and vertices that no
    face uses are dropped, and closed parts that are inside out are turned (see
    `orientation`); an `InputWarning` counts the dropped and the turned. Raises
    `InputError` for wrong shapes, an empty or all-degenerate mesh, coordinates that are
    not finite in float32, indices out of range, and materials outside 0..255.
    """
    vertices, faces, material = _checked_arrays(vertices, faces, material)
    corners = vertices[faces].astype(np.float64)
    area = np.linalg.norm(area_vectors(corners), axis=1)
    solid = area > 1e-12 * np.ptp(corners.reshape(-1, 3), axis=0).max() ** 2
    if not solid.any():
        raise InputError("mesh: all faces have zero area; give triangles with an area")
    if dropped := int((~solid).sum()):
        warn(f"dropped {dropped} of {len(faces)} faces: they have zero area")
    faces, turned = orientation.turn_outward(vertices, faces[solid])
    if turned:
        warn(f"turned {turned} closed part(s) that were inside out")
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    return Mesh(vertices[used], faces, material[solid])


def load_mesh(path: str | Path) -> Mesh:
    """The triangles of any file trimesh reads, cleaned by `make_mesh`.

    All parts of a scene are merged into one mesh, each with its transform applied. One
    that lies so far away that float32 would round its shape is moved, with a warning.
    Raises `InputError` where the file is missing, unreadable or has no triangles.
    """
    scene = load_scene(Path(path))
    merged = merge(Path(path), scene)
    if not isinstance(merged, trimesh.Trimesh) or len(merged.faces) == 0:
        if any(isinstance(g, trimesh.PointCloud) for g in scene.geometry.values()):
            raise InputError(f"{path}: a point cloud, no triangles; use load_points")
        raise InputError(f"{path}: no triangles in it; the file is empty or corrupt")
    if merged.vertices.shape[1:] != (3,):
        raise InputError(f"{path}: vertices have no three coordinates; export it anew")
    with naming(str(path)):
        return make_mesh(near_origin(merged.vertices, "mesh"), merged.faces)


def find_meshes(path: str | Path) -> list[Path]:
    """The mesh files in a folder and the folders below it, sorted; or the one file.

    Raises `InputError` where there is no such file or folder, or no mesh file in it.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give one with meshes")
    if path.is_file():
        return [path]
    # Of .xyz none has triangles.
    endings = {f".{name}" for name in mesh_formats()} - {".xyz"}
    found = files_below(path, endings)
    if not found:
        raise InputError(f"{path}: no mesh in this folder; put .ply, .obj, .glb there")
    return found


def fit_unit_box(mesh: Mesh) -> Mesh:
    """The mesh moved and scaled: longest side 1, centred at the origin.

    Call it before `add_ground`. Raises `InputError` where the mesh has no extent.
    """
    return mesh._replace(vertices=into_unit_box(mesh.vertices))


def add_ground(mesh: Mesh, half_extent: float = 0.8) -> Mesh:
    """The mesh and, just below its lowest vertex, a square of material 1 facing +y.

    The gap keeps a flat base from lying in the same plane: what starts on either would
    be on the wrong side of the other.

    The square is centred at x = z = 0; `half_extent` is half its side. Raises
    `InputError` for what is no mesh, as `make_mesh` does.
    """
    half_extent = positive("half_extent", half_extent)
    vertices, faces, material = _checked_arrays(*mesh)
    low, h = vertices[:, 1].min() - GROUND_GAP, half_extent
    square = [[-h, low, -h], [-h, low, h], [h, low, h], [h, low, -h]]
    two = np.array([[0, 1, 2], [0, 2, 3]]) + len(vertices)
    return Mesh(
        np.concatenate([vertices, square]).astype(np.float32),
        np.concatenate([faces, two]).astype(np.int32),
        np.concatenate([material, [1, 1]]).astype(np.int32),
    )


def check_mesh(mesh: Mesh) -> Mesh:
    """The mesh in NumPy's arrays of the types that all else expects.

    `make_mesh` makes only such; a `Mesh` put together by hand may be anything. Raises
    `InputError` unless these are triangles with an area, each of a material.
    """
    if not isinstance(mesh, Mesh):
        kind = type(mesh).__name__
        raise InputError(f"mesh is a {kind}: give what load_mesh or make_mesh returns")
    vertices, faces, material = _checked_arrays(*mesh)
    if not area_vectors(vertices[faces].astype(np.float64)).any():
        raise InputError("mesh: all faces have zero area; give triangles with an area")
    return Mesh(vertices, faces.astype(np.int32), material)


def _checked_arrays(vertices, faces, material):
    """float32 vertices, int64 faces and int32 materials that belong together."""
    vertices, faces = real_array("vertices", vertices), real_array("faces", faces)
    if vertices.size == 0 or faces.size == 0:
        raise InputError("mesh: empty; give vertices and faces")
    if (
        vertices.shape[1:] != (3,)
        or faces.shape[1:] != (3,)
        or faces.dtype.kind not in "iu"
    ):
        raise InputError(
            "mesh: wrong shape; give vertices [V 3] and integer faces [F 3]"
        )
    with np.errstate(over="ignore"):
        vertices = vertices.astype(np.float32)
    if bad := int((~np.isfinite(vertices).all(1)).sum()):
        raise InputError(f"mesh: {bad} vertices are not finite; remove them")
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            f"mesh: a face index is outside 0..{len(vertices) - 1}; mend it"
        )
    material = np.zeros(len(faces), np.int32) if material is None else material
    material = real_array("material", material)
    if material.shape != (len(faces),):
        raise InputError(f"mesh: give one material a face, {len(faces)} in all")
    if not ((material >= 0) & (material <= LAST_MATERIAL)).all():
        raise InputError(f"mesh: a material is outside 0..{LAST_MATERIAL}; mend it")
    if (material % 1 != 0).any():
        raise InputError("mesh: a material is no whole number; mend it")
    return vertices, faces, material.astype(np.int32)


def into_unit_box(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points moved and scaled as `fit_unit_box` says."""
    points = real_array("points", points).astype(np.float64)
    if points.size == 0 or not np.isfinite(points).all():
        raise InputError("object: empty or not finite; give points with an extent")
    low, high = points.min(axis=0), points.max(axis=0)
    if not (extent := (high - low).max()) > 0:
        raise InputError("object: all points coincide; give one with an extent")
    return ((points - (low + high) / 2) / extent).astype(np.float32)


def near_origin(
    points: Float[np.ndarray, "*N 3"], what: str
) -> Float[np.ndarray, "*N 3"]:
    """Points as they are, or counted from their middle where float32 would round away
    more than `ROUNDED` of their extent there, with a warning that says so."""
    points = np.asarray(points)
    flat = points.reshape(-1, 3).astype(np.float64)
    if flat.size == 0 or not np.isfinite(flat).all():
        return points
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = float((high - low).max())
    lost = np.finfo(np.float32).eps * np.abs(flat).max()
    if not lost > ROUNDED * size > 0:
        return points
    # What is left of the middle is to be no more than the object.
    unit = min(1.0, 2.0 ** np.ceil(np.log2(size)))
    middle = np.round((low + high) / (2 * unit)) * unit
    warn(f"{what}: too far away for single precision; moved by {-middle}")
    return (flat - middle).reshape(points.shape)


def area_vectors(corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F 3"]:
    """Normals whose length is the area of their triangle."""
    edges = corners[:, 1:] - corners[:, :1]
    return np.cross(edges[:, 0], edges[:, 1]) / 2
