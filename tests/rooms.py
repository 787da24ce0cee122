"""Rooms whose light has closed forms, points in them, and means over those points."""

import numpy as np
import trimesh

from ginn_jax.lighting import PointLight
from ginn_jax.mesh import Mesh

UP = np.array([0, 1, 0], np.float32)
WHITE = np.ones((2, 3))
LAMP = PointLight(np.array([0.3, 1.2, 0.4]), np.array([1.0, 2.0, 5.0]))


def quad(corner, edge_u, edge_v, material=0):
    """A parallelogram whose normal is edge_u x edge_v."""
    corner, u, v = np.array([corner, edge_u, edge_v], np.float32)
    vertices = np.stack([corner, corner + u, corner + u + v, corner + v])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(vertices, faces, np.full(2, material, np.int32))


def joined(*parts):
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = [p.faces + first for p, first in zip(parts, starts, strict=True)]
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([p.material for p in parts]),
    )


def solid(shape):
    """The triangles of a shape of trimesh."""
    material = np.zeros(len(shape.faces), np.int32)
    vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int32)
    return Mesh(vertices, faces, material)


def floor(half=1.0):
    return quad((-half, 0, -half), (0, 0, 2 * half), (2 * half, 0, 0))


def floor_and_wall(size):
    """A floor, and a wall in the plane x = 0 that stands on it."""
    return joined(floor(size), quad((0, 0, -size), (0, size, 0), (0, 0, 2 * size)))


def cup():
    """A box of side 1 without lid, whose floor lies at y = 0; its walls are material 1.

    All normals point inward.
    """
    return joined(
        quad((0, 0, 0), (0, 0, 1), (1, 0, 0)),
        quad((0, 0, 0), (0, 1, 0), (0, 0, 1), 1),
        quad((1, 0, 0), (0, 0, 1), (0, 1, 0), 1),
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), 1),
        quad((0, 0, 1), (0, 1, 0), (1, 0, 0), 1),
    )


def sampled(mesh, count, seed=0):
    """Points of the surface, their normals as the faces are wound."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(shape, count, seed=seed)[:2]
    edges = mesh.vertices[mesh.faces[faces]].astype(float)
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points.astype(np.float32), normals.astype(np.float32)


def copies(point, count, normal=UP):
    return np.tile(np.float32(point), (count, 1)), np.tile(
        np.float32(normal), (count, 1)
    )


def total(estimate):
    """The mean over all points, and its standard deviation."""
    mean = estimate.mean.astype(float).mean(0)
    return mean, np.sqrt(estimate.variance.astype(float).sum(0)) / len(estimate.mean)


def spread(values):
    """The mean over all rows, and its standard deviation by their differences."""
    values = values.astype(float)
    return values.mean(0), values.std(0, ddof=1) / np.sqrt(len(values))
