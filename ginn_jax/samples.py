"""Samples of surfaces: drawn from a mesh, or read from a scan."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ginn_jax.checks import LARGEST_INDEX, positive, unit_rows, whole
from ginn_jax.errors import InputError, warn
from ginn_jax.mesh import (
    Mesh,
    area_vectors,
    check_mesh,
    into_unit_box,
    near_origin,
)
from ginn_jax.mesh_files import load_scene, readable
from ginn_jax.outlying import count_outlying


class Samples(NamedTuple):
    """Points on surfaces with unit normals and the material index of their face."""

    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    material: Int[np.ndarray, "N"]


def load_points(path: str | Path) -> Samples:
    """A PLY point cloud with normals (nx, ny, nz) as samples of material 0.

    Normals are normalised; points that lie as far away as `load_mesh` says are moved.
    Raises `InputError` where the file is missing, unreadable,
    a mesh, without normals, or holds non-finite values or zero normals.
    """
    clouds = list(load_scene(Path(path)).geometry.values())
    if any(isinstance(cloud, trimesh.Trimesh) for cloud in clouds):
        raise InputError(f"{path}: a mesh, not a point cloud; use load_mesh")
    if len(clouds) != 1 or "_ply_raw" not in clouds[0].metadata:
        raise InputError(f"{path}: no PLY point cloud in it; save the points as PLY")
    columns = clouds[0].metadata["_ply_raw"]["vertex"]["data"]
    with readable(Path(path)):
        position = np.asarray(clouds[0].vertices, np.float64).reshape(-1, 3)
    position = near_origin(position, str(path)).astype(np.float32)
    try:
        normal = np.stack([np.ravel(columns[axis]) for axis in ("nx", "ny", "nz")], -1)
        normal = normal.astype(np.float64)
    except (KeyError, ValueError, TypeError):
        raise InputError(
            f"{path}: the points have no normals; estimate them and save nx, ny, nz"
        ) from None
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    usable = np.isfinite(position).all(1) & np.isfinite(length[:, 0])
    if bad := int((~usable | (length[:, 0] == 0)).sum()):
        raise InputError(
            f"{path}: {bad} points have a non-finite value or a zero normal; drop them"
        )
    material = np.zeros(len(position), np.int32)
    return Samples(position, (normal / length).astype(np.float32), material)


def fit_unit_box_points(samples: Samples) -> Samples:
    """The point cloud moved and scaled as `fit_unit_box` does; normals stay.

    Warns of a few points far from all others: what is between is empty, and the others
    become small.
    """
    if far := count_outlying(samples.position):
        warn(
            f"{far} of {len(samples.position)} points lie so far from the others that "
            "these become small in a box for all: drop them first"
        )
    return samples._replace(position=into_unit_box(samples.position))


def sample_surface(mesh: Mesh, count: int, *, seed: int) -> Samples:
    """`count` points uniform by area, with the normals and materials of their faces."""
    whole("count", count, 0, LARGEST_INDEX)
    whole("seed", seed, 0, 2**63 - 1)
    mesh = check_mesh(mesh)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    position, face = trimesh.sample.sample_surface(shape, count, seed=seed)[:2]
    normal = area_vectors(mesh.vertices[mesh.faces[face]].astype(np.float64))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Samples(
        np.asarray(position, np.float32),
        normal.astype(np.float32),
        mesh.material[face].astype(np.int32),
    )


def add_ground_samples(
    samples: Samples, half_extent: float = 0.8, *, seed: int
) -> Samples:
    """The cloud and samples of a ground as in `add_ground`, as dense as the cloud.

    The cloud's density is 8 / (pi d^2), d the median distance to the 8th neighbour.
    Raises `InputError` for fewer than 9 points, or where most points coincide, or a
    ground so large that its samples cannot be numbered.
    """
    half_extent = positive("half_extent", half_extent)
    whole("seed", seed, 0, 2**63 - 1)
    position, normal = unit_rows(samples.position, samples.normal)
    if len(position) < 9:
        raise InputError("point cloud: fewer than 9 points; give a denser one")
    distance = KDTree(position).query(position, 9)[0][:, -1]
    if (spacing := float(np.median(distance))) == 0:
        raise InputError("point cloud: most points coincide; remove the duplicates")
    wanted = 8 / (np.pi * spacing**2) * (2 * half_extent) ** 2
    if wanted > LARGEST_INDEX:
        raise InputError(f"half_extent {half_extent} takes {wanted:.1g} points: lower")
    count = round(wanted)
    place = np.random.default_rng(seed).uniform(-half_extent, half_extent, (count, 3))
    place[:, 1] = position[:, 1].min()
    up = np.tile(np.array([0, 1, 0], np.float32), (count, 1))
    return Samples(
        np.concatenate([position, place.astype(np.float32)]),
        np.concatenate([normal, up]),
        np.concatenate([samples.material, np.ones(count, np.int32)]).astype(np.int32),
    )
