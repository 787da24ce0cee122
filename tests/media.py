"""Objects filled with a medium, and points on them."""

import numpy as np
import trimesh

from ginn_jax.irradiance import light_scene
from ginn_jax.mesh import Mesh
from ginn_jax.subsurface import Medium

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
SLAB = trimesh.creation.box((1, 1, 0.1))
IORS = [1.0, 1.3, 1.5]


def scene_of(shape, light, opaque=None):
    """The shape as material 0 and what stands beside it as material 1."""
    parts = [shape] if opaque is None else [shape, opaque]
    material = [np.full(len(p.faces), i, np.int32) for i, p in enumerate(parts)]
    both = trimesh.util.concatenate(parts)
    mesh = Mesh(
        both.vertices.astype(np.float32),
        both.faces.astype(np.int32),
        np.concatenate(material),
    )
    return light_scene(mesh, np.full((2, 3), 0.5), light)


def medium_of(albedo, extinction, ior):
    albedo = np.broadcast_to(np.float32(albedo), 3)
    return Medium(np.ascontiguousarray(albedo), extinction, ior)


def surface(shape, count, seed=0):
    points, faces = trimesh.sample.sample_surface(shape, count, seed=seed)
    normals = shape.face_normals[faces]
    return points.astype(np.float32), normals.astype(np.float32)
