"""Animated meshes: one topology, a position of every vertex in every frame.

Samples are taken once and move with their faces, so that what changes from frame to
frame is the scene and not the sampling.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from ginn_jax.checks import LARGEST_INDEX, whole
from ginn_jax.errors import InputError
from ginn_jax.files import files_below
from ginn_jax.mesh import Mesh, add_ground, fit_unit_box, near_origin
from ginn_jax.orientation import turn_outward
from ginn_jax.reference import build_scene
from ginn_jax.samples import Samples
from ginn_jax.shapes import random_shape
from ginn_jax.visible import draw_reached, draw_sides

UP = np.array([0.0, 1.0, 0.0])


class Animation(NamedTuple):
    """Vertices of every frame, and the faces that they share."""

    vertices: Float[np.ndarray, "T V 3"]
    faces: Int[np.ndarray, "F 3"]


class Carried(NamedTuple):
    """Samples by their face, where they lie in it, and whether on its back."""

    face: Int[np.ndarray, "N"]
    barycentric: Float[np.ndarray, "N 3"]
    behind: Bool[np.ndarray, "N"]


def find_animations(path: str | Path) -> list[Path]:
    """The .npz files of a folder and those below it, sorted; or the one file, which
    need not exist.

    Raises `InputError` where there is none in the folder.
    """
    path = Path(path)
    if not path.is_dir():
        return [path]
    found = files_below(path, {".npz"})
    if not found:
        raise InputError(f"{path}: no animation in this folder; put .npz files there")
    return found


def load_animation(path: str | Path) -> Animation:
    """An animation from an .npz of `vertices` [T V 3] and `faces` [F 3].

    Raises:
        InputError: no such file, another kind of file, or numbers that make no mesh.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            vertices, faces = file["vertices"], file["faces"]
    except FileNotFoundError:
        raise InputError(f"{path}: no such animation") from None
    except PermissionError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})") from None
    except Exception:  # zipfile, zlib, tokenize and NumPy each raise what they like
        raise InputError(
            f"{path}: not an .npz of vertices [T V 3] and faces [F 3]"
        ) from None
    if vertices.dtype.kind not in "fiu" or faces.dtype.kind not in "iu":
        raise InputError(f"{path}: give vertices as real, faces as whole numbers")
    whole = vertices.ndim == 3 and faces.ndim == 2 and len(vertices) > 1 and faces.size
    if not (whole and vertices.shape[2] == 3 and faces.shape[1] == 3):
        raise InputError(f"{path}: give vertices [T V 3], two frames up, faces [F 3]")
    if not (np.isfinite(vertices).all() and faces.min() >= 0):
        raise InputError(f"{path}: vertices are not finite, or faces negative")
    if faces.max() >= vertices.shape[1]:
        raise InputError(f"{path}: a face names a vertex that is not there")
    vertices = near_origin(vertices, str(path)).astype(np.float32)
    return Animation(vertices, faces.astype(np.int32))


def procedural_animation(seed: int, frames: int) -> Animation:
    """A procedural shape that sways: it leans over and back and turns a little.

    Raises `InputError` for a negative seed, or less than a frame.
    """
    frames = whole("frames", frames, 1, LARGEST_INDEX)
    mesh = fit_unit_box(random_shape(seed, closed=True))
    # Few frames, too, are to differ from the first on.
    phase = 2 * np.pi * (np.arange(frames)[:, None] + 0.15) / frames
    x, y, z = mesh.vertices.T.astype(np.float64)
    height = y - y.min()
    turn = 0.5 * np.sin(phase) * height
    swayed = x + 0.3 * np.sin(phase) * height**2
    c, s = np.cos(turn), np.sin(turn)
    lift = np.broadcast_to(y, swayed.shape)
    vertices = np.stack([c * swayed + s * z, lift, c * z - s * swayed], axis=2)
    return Animation(vertices.astype(np.float32), mesh.faces)


def frames_of(animation: Animation, count: int, ground: bool) -> list[Mesh]:
    """`count` consecutive frames, all in the unit box of the whole animation.

    The ground, if any, lies under the lowest vertex of all frames. Closed parts that
    are inside out in the first frame are turned, as those of a mesh are. An animation
    that is shorter gives all it has. Raises `InputError` for one without frames, or
    whose vertices coincide.
    """
    count = whole("count", count, 1, LARGEST_INDEX)
    places = animation.vertices
    if places.size == 0:
        raise InputError("animation: no frames; give vertices [T V 3], one frame up")
    faces, _ = turn_outward(places[0], animation.faces)
    low, high = places.min(axis=(0, 1)), places.max(axis=(0, 1))
    scale = float((high - low).max())
    if not scale > 0:
        raise InputError("animation: all vertices coincide; give one of some extent")
    places = ((places - (low + high) / 2) / scale).astype(np.float32)
    material = np.zeros(len(faces), np.int32)
    meshes = [Mesh(place, faces, material) for place in places[:count]]
    if not ground:
        return meshes
    floor = Mesh(places[places[..., 1].min(axis=1).argmin()], faces, material)
    base = add_ground(floor)
    return [
        base._replace(vertices=np.concatenate([place, base.vertices[-4:]]))
        for place in places[:count]
    ]


def carried_samples(
    mesh: Mesh, count: int, both_sides: bool = True, *, seed: int
) -> Carried:
    """Uniform samples of a frame that light can reach, to be carried to the others.

    On both sides of the object's faces, unless `both_sides` is off, and above the
    ground, as `visible_samples` are.

    Raises:
        InputError: a scene that is almost all sealed off.
    """
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)

    def draw(drawn: int) -> tuple[Carried, Samples]:
        place, face = trimesh.sample.sample_surface(shape, drawn, seed=seed)[:2]
        behind, kept = draw_sides(mesh.material[face], both_sides, seed)
        place, face, behind = place[kept], face[kept].astype(np.int32), behind[kept]
        corners = mesh.vertices[mesh.faces[face]]
        barycentric = trimesh.triangles.points_to_barycentric(corners, place)
        carried = Carried(face, barycentric.astype(np.float32), behind)
        return carried, samples_at(mesh, carried)

    return draw_reached(draw, build_scene(mesh), count, seed)


def samples_at(mesh: Mesh, carried: Carried) -> Samples:
    """Where carried samples are in another frame.

    Those of a face without area there, which nothing sees, point up.
    """
    corners = mesh.vertices[mesh.faces[carried.face]]
    position = np.einsum("nk,nkd->nd", carried.barycentric, corners)
    a, b, c = corners.transpose(1, 0, 2).astype(np.float64)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1.0), UP)
    normal = np.where(carried.behind[:, None], -normal, normal)
    material = mesh.material[carried.face].astype(np.int32)
    return Samples(position.astype(np.float32), normal.astype(np.float32), material)


def flicker(
    images: Float[np.ndarray, "T *A"],
    reference: Float[np.ndarray, "T *A"],
    variance: Float[np.ndarray, "T *A"],
    seen: Bool[np.ndarray, "T *S"],
) -> float:
    """Mean squared frame-to-frame change that the reference does not have.

    Over the pixels [T *S] that are seen in both frames; the noise of the reference is
    subtracted.
    """
    change = np.diff(images.astype(np.float64), axis=0)
    right = np.diff(reference.astype(np.float64), axis=0)
    noise = variance[1:].astype(np.float64) + variance[:-1]
    both = seen[1:] & seen[:-1]
    return float(((change - right) ** 2 - noise)[both].mean())
