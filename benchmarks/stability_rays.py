"""What the ray tracer makes in extreme cases, against closed forms."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from ginn_jax.errors import InputError
from ginn_jax.irradiance import indirect_irradiance, light_scene
from ginn_jax.lighting import PointLight, constant_sky
from ginn_jax.mesh import Mesh
from ginn_jax.reference import ambient_occlusion
from ginn_jax.slab import external_reflectance
from ginn_jax.subsurface import Medium, subsurface_exitance

Row = dict[str, Any]


def mesh_of(shape: Any) -> Mesh:
    """A shape of one material."""
    faces = np.asarray(shape.faces, np.int32)
    return Mesh(
        np.asarray(shape.vertices, np.float32), faces, np.zeros(len(faces), np.int32)
    )


def samples(shape: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a shape and its outward normals there."""
    points, faces = trimesh.sample.sample_surface(shape, count, seed=0)[:2]
    return points.astype(np.float32), shape.face_normals[faces].astype(np.float32)


def ray_row(
    stage: str, case: str, call: Callable[[], tuple[Any, Any]], exact: float
) -> Row:
    """Error of the mean over all points, its own noise, and non-finite numbers."""
    begin = time.perf_counter()
    row: Row = {"stage": stage, "case": case}
    try:
        mean, variance = (np.asarray(a, np.float64) for a in call())
    except InputError as refusal:
        return row | {"note": f"refused: {refusal}"}
    scale = abs(exact) or 1.0
    noise = np.sqrt(variance.mean() / len(mean)) / scale
    return row | {
        "error": float(abs(mean.mean() - exact) / scale),
        "bad": int((~np.isfinite(mean)).sum()),
        "ms": 1e3 * (time.perf_counter() - begin),
        "note": f"noise {noise:.1e}",
    }


def cavity_rows(albedos: tuple[float, ...]) -> list[Row]:
    """A lamp in the middle of a closed ball: a / (1 - a) times the direct light.

    That is what its walls get on average, all that the lamp sends out over their area.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    points, normals = samples(ball, 64)
    lamp = PointLight(np.zeros(3, np.float32), np.ones(3, np.float32))
    direct, rows = 4 * np.pi / ball.area, []
    for albedo in albedos:
        scene = light_scene(mesh_of(ball), np.full((1, 3), albedo), lamp)
        rows.append(
            ray_row(
                "indirect light",
                f"closed cavity of albedo {albedo:g}",
                lambda scene=scene: indirect_irradiance(
                    scene, points, -normals, paths=64, seed=0
                ),
                direct * albedo / (1 - albedo),
            )
        )
    return rows


def medium_rows(extinctions: tuple[float, ...]) -> list[Row]:
    """Without absorption all that enters leaves; of a thick block its albedo does."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    block = trimesh.creation.box((1, 1, 1))
    middle = (
        np.tile(np.array([0, 0, 0.5], np.float32), (64, 1)),
        np.tile(np.array([0, 0, 1], np.float32), (64, 1)),
    )
    rows = []

    def add(shape: Any, at: Any, albedo: float, extinction: float, ior: float) -> None:
        medium = Medium(np.full(3, albedo, np.float32), extinction, ior)
        scene = light_scene(mesh_of(shape), np.full((1, 3), 0.5), constant_sky())
        rows.append(
            ray_row(
                "subsurface",
                f"albedo {albedo:g}, {extinction:g} mean free paths, index {ior:g}",
                lambda: subsurface_exitance(scene, medium, *at, paths=256, seed=0)[0],
                np.pi * albedo * (1 - external_reflectance(ior)),
            )
        )

    for ior in (1.0, 1.5):
        for extinction in extinctions:
            add(ball, samples(ball, 64), 1.0, extinction, ior)
        add(block, middle, 0.5, 1000.0, ior)
    return rows


def occlusion_rows() -> list[Row]:
    """In a closed ball nothing is open to far rays, everything to short ones."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    points, normals = samples(ball, 64)
    radii = {0.0: 1.0, 1e-6: 1.0, 1e-5: 1.0, 2.0: 0.0, 1e6: 0.0, 1e30: 0.0}
    return [
        ray_row(
            "occlusion",
            f"radius {radius:g} in a closed ball",
            lambda radius=radius: ambient_occlusion(
                mesh_of(ball), points, -normals, radius=radius, rays=64, seed=0
            ),
            exact,
        )
        for radius, exact in radii.items()
    ]


def ray_rows(quick: bool) -> list[Row]:
    """All of them; short ones only if `quick`."""
    albedos = (0.0, 0.5, 0.9) if quick else (0.0, 0.5, 0.9, 0.97, 0.99, 0.999)
    extinctions = (0.0, 1.0) if quick else (0.0, 1e-3, 1.0, 30.0)
    return occlusion_rows() + cavity_rows(albedos) + medium_rows(extinctions)
