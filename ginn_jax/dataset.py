"""Shaded points, the one type for a cloud and a G-buffer, and clouds on disk."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.errors import InputError
from ginn_jax.files import writing
from ginn_jax.neighbors import offsets_from
from ginn_jax.receptive_field import Oriented

# Clouds of a batch stand this far apart, or this many times as far as any point lies
# from the middle of its own: more than both extents and, for all but the smallest
# clouds, the largest radius of a preset beside.
SPACING, APART = 4.0, 3.0


class ShadedPoints(NamedTuple):
    """Points with what shades them and what they are shaded to.

    Leading dimensions are [N] for a cloud, [B, N] for a batch, [H, W] for an image: a
    pixel is a point. `variance` is the Monte Carlo variance of `target`. What an effect
    does not need is None: `material` numbers such as albedo, and `light`, to which the
    target is proportional; its first number sets the scale (`unit_light`).
    """

    position: Float[Any, "*P 3"]
    normal: Float[Any, "*P 3"]
    target: Float[Any, "*P"]
    variance: Float[Any, "*P"]
    material: Float[Any, "*P A"] | None = None
    light: Float[Any, "*P L"] | None = None


def count_given(points: int) -> int:
    """How many samples of a cloud a network is given: it is asked at the others."""
    return points * 4 // 5


def count_asked(points: int) -> int:
    """At how many of a cloud's samples, the last ones, a network is asked."""
    return points - count_given(points)


def save_cloud(path: Path, cloud: ShadedPoints, origin: dict[str, Any]) -> None:
    """Write a cloud and what made it, atomically: a killed run leaves no half file."""
    arrays = {name: a for name, a in cloud._asdict().items() if a is not None}
    save_arrays(path, arrays, origin)


def save_arrays(
    path: Path, arrays: dict[str, np.ndarray], origin: dict[str, Any]
) -> None:
    """Write named arrays and what made them, atomically.

    Raises `InputError` where the disk is full or may not be written to.
    """
    with writing(path) as partial, open(partial, "wb") as file:
        np.savez(file, origin=json.dumps(origin, sort_keys=True), **arrays)  # type: ignore[arg-type]


def load_cloud(path: Path, origin: dict[str, Any] | None = None) -> ShadedPoints:
    """Read a cloud back.

    Raises:
        InputError: a missing or damaged file, or one made by something else than
            `origin`.
    """
    with another_kind(path):
        cloud = ShadedPoints(**load_arrays(path, origin))
        check_rows(cloud._asdict(), {"position": 3, "normal": 3})
    return cloud


@contextmanager
def another_kind(path: Path) -> Iterator[None]:
    """Say of arrays that make no cloud of the kind wanted what to do about them."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError(
            f"{path} holds another kind of cloud: choose another folder"
        ) from None


def check_rows(columns: dict[str, Any], widths: dict[str, int]) -> None:
    """Raise `ValueError` unless these are numbers of the same points.

    `widths` says how many numbers a point has in a column: else any, or one.
    """
    count = len(columns["position"])
    for name, column in columns.items():
        if column is None:
            continue
        width = column.shape[1:]
        if len(column) != count or column.dtype.kind not in "fi" or len(width) > 1:
            raise ValueError(name)
        if name in widths and width != (widths[name],):
            raise ValueError(name)


def load_arrays(
    path: Path,
    origin: dict[str, Any] | None,
    mend: str = "delete it to have it made again",
) -> dict[str, np.ndarray]:
    """Read named arrays back; `InputError` as in `load_cloud`.

    `mend` is what helps where the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = json.loads(str(file["origin"]))
            arrays = {name: file[name] for name in file.files if name != "origin"}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (PermissionError, IsADirectoryError) as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): mend that or choose another"
        ) from None
    except Exception:  # zipfile, zlib, NumPy and json each raise what they like
        raise InputError(f"{path} is damaged: {mend}") from None
    if origin is not None and found != json.loads(json.dumps(origin)):
        raise InputError(f"{path} was made with other settings: choose another folder")
    return arrays


def stack_clouds(clouds: Sequence[ShadedPoints]) -> ShadedPoints:
    """A batch from clouds of equal size, each counted from its own `center_of`."""
    near = [
        c._replace(position=relative_to(center_of(c.position), c.position))
        for c in clouds
    ]
    return jax.tree.map(lambda *arrays: np.stack(arrays), *near)


def center_of(position: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Where to count a cloud's coordinates from: 0, unless it lies far from there.

    A multiple of a power of two beyond the cloud's size, so that float32 holds it, and
    nothing is rounded when float32 coordinates are counted from there.
    """
    # Ten times as fast along rows of memory as across.
    along = np.ascontiguousarray(np.asarray(position).T)
    low, high = (f(along, axis=1).astype(np.float64) for f in (np.min, np.max))
    size = max(float((high - low).max()), float(np.finfo(np.float32).tiny))
    unit = 2.0 ** (2 + np.ceil(np.log2(size)))
    return (np.round((low + high) / (2 * unit)) * unit).astype(np.float32)


def relative_to(
    center: Float[Any, "3"] | None, position: Float[np.ndarray, "*N 3"]
) -> Float[np.ndarray, "*N 3"]:
    """Coordinates counted from there, the difference taken in float64."""
    position = np.asarray(position)
    if center is None or (position.dtype == np.float32 and not np.any(center)):
        return np.asarray(position, np.float32)
    return offsets_from(center, position)


def unit_light(
    light: Float[Array, "N L"], mask: Bool[Array, "N"]
) -> tuple[Float[Array, "N L"], Float[Array, ""]]:
    """Light in units of its mean over a cloud, and that mean; zero light stays zero.

    Transport is linear in light: a network that sees unit light only, and whose output
    is scaled back, is exactly homogeneous, and a sun of 1e5 looks like any other light.
    """
    count = jnp.maximum(jnp.sum(mask, dtype=jnp.float32), 1.0)
    scale = jnp.sum(jnp.where(mask, light[:, 0] / count, 0.0))
    return light * safe_inverse(scale), scale


def safe_inverse(scale: Float[Array, ""]) -> Float[Array, ""]:
    """1 / scale, or 0 for 0 and for subnormal numbers, whose inverse would be infinite.

    Most devices take those for 0 as well.
    """
    least = float(np.finfo(np.float32).tiny)
    normal = scale >= least
    return jnp.where(normal, 1 / jnp.where(normal, scale, 1.0), 0.0)


def rotate_about_up(cloud: ShadedPoints, *, key: Key[Array, ""]) -> ShadedPoints:
    """Turn positions and normals together by a random angle about the vertical axis."""
    angle = jax.random.uniform(key, (), jnp.float32, maxval=2 * jnp.pi)
    c, s = jnp.cos(angle), jnp.sin(angle)
    turn = jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    product = jax.lax.Precision.HIGHEST
    return cloud._replace(
        position=jnp.matmul(cloud.position, turn.T, precision=product),
        normal=jnp.matmul(cloud.normal, turn.T, precision=product),
    )


def side_by_side(batch: ShadedPoints) -> ShadedPoints:
    """One cloud from a batch: the clouds stand next to each other, out of reach.

    Every stage is written for one cloud; this batches them all without a `vmap`, and
    one capacity serves the whole batch.
    """
    reach = APART * jnp.max(jnp.abs(batch.position))
    spacing = jnp.maximum(SPACING, reach)
    shift = spacing * jnp.arange(batch.position.shape[0], dtype=jnp.float32)
    position = batch.position.at[..., 0].add(shift[:, None])
    return jax.tree.map(
        lambda a: a.reshape(-1, *a.shape[2:]), batch._replace(position=position)
    )


def oriented(cloud: ShadedPoints) -> Oriented:
    """The geometry of a cloud, no point masked out."""
    return Oriented(
        cloud.position, cloud.normal, jnp.ones(cloud.position.shape[:-1], bool)
    )


def batch_order(
    clouds: int, batch_size: int, step: int, *, seed: int
) -> Int[np.ndarray, "B"]:
    """Which clouds step number `step` trains on: epochs are permutations of the set."""
    first = step * batch_size
    places = np.arange(first, first + batch_size)
    epochs, offsets = np.divmod(places, clouds)
    orders = {
        e: np.random.default_rng((seed, e)).permutation(clouds) for e in set(epochs)
    }
    return np.array([orders[e][o] for e, o in zip(epochs, offsets, strict=True)])
