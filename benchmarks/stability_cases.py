"""What `benchmarks.stability` runs on: extreme clouds, lights and materials."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ginn_jax.architecture import Network
from ginn_jax.presets import compact_network

POINTS = 1000
SMALL = {"k": 4, "levels": (0.0625, 0.1875), "query_radius": 0.125, "latent": 4}


class Case(NamedTuple):
    """A cloud in float64 with unit normals, material and light, and what it is called.

    `scale` multiplies all radii. Light and material are [C N 1], albedo and what the
    surface sends out. Rows beyond `count` are padding.
    """

    name: str
    position: np.ndarray
    normal: np.ndarray
    light: np.ndarray
    albedo: np.ndarray
    count: int = POINTS
    scale: float = 1.0


def small_network(scale: float = 1.0) -> Network:
    """A lit network of two levels, all its radii times `scale`."""
    levels = tuple(scale * r for r in SMALL["levels"])
    more = SMALL | {"levels": levels, "query_radius": scale * SMALL["query_radius"]}
    return compact_network(**more, materials=1, lights=1, local=True)


def plain(seed: int = 0) -> Case:
    """Points on a sphere of diameter 1 and on the plane under it."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(POINTS // 2, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ground = rng.uniform(-0.8, 0.8, (POINTS - len(normal), 3)) * [1, 0, 1]
    position = np.concatenate([0.5 * normal + [0, 0.5, 0], ground])
    normal = np.concatenate([normal, np.tile([0.0, 1, 0], (len(ground), 1))])
    # As float32 holds it, so that float64 starts from the same.
    return case("plain", as_float32(position), as_float32(normal))


def case(name: str, position: np.ndarray, normal: np.ndarray, **more) -> Case:
    """Three channels of light that vary over the cloud."""
    phase = position @ [[3.0, 1, 2], [2, 3, 1], [1, 2, 3]]
    phase = np.where(np.abs(phase) < 1e3, phase, 0.0)
    light = as_float32(1 + 0.9 * np.sin(phase)).T[..., None]
    given = {"light": light, "albedo": np.full((3, len(position), 1), 0.5)} | more
    return Case(name, position, normal, **given)


def as_float32(values: np.ndarray) -> np.ndarray:
    """What float32 holds of the values, in float64."""
    return np.asarray(values, np.float32).astype(np.float64)


def clouds() -> Iterator[Case]:
    """Geometry that is stiff, extreme or not there."""
    rng, base = np.random.default_rng(1), plain()
    position, normal = base.position, base.normal
    turned = rng.permutation(normal)

    def at(name: str, place: np.ndarray, facing: np.ndarray = normal, **more) -> Case:
        return case(name, as_float32(place), facing, **more)

    yield base
    for count in (2, 500, POINTS):
        same = position.copy()
        same[:count] = same[0]
        yield at(f"{count} coincident points", same, turned)
    yield base._replace(name="one point", count=1)
    lattice = np.stack(np.unravel_index(np.arange(POINTS), (10, 10, 10)), axis=1)
    yield at("none in reach", 10.0 * lattice)
    for power in (1, 2, 4, 6):
        dense = position.copy()
        dense[::2] = [0.5, 0, 0.5] + 10.0 ** (-power / 2) * (dense[::2] - [0.5, 0, 0.5])
        yield at(f"density 1 to 1e{power}", dense)
    yield at("all in one cell", 0.02 * position)
    yield at("on cell faces", 0.0625 * lattice)
    yield at("aspect ratio 1e4", rng.random((POINTS, 3)) * [1, 1e-4, 0.3])
    yield at("line", np.outer(np.linspace(0, 1, POINTS), [1, 1, 1]), turned)
    flat = rng.random((POINTS, 3)) * [1, 0, 1]
    up = np.tile([0.0, 1, 0], (POINTS, 1))
    yield at("plane", flat, up)
    side = np.where(np.arange(POINTS) % 2, 1.0, -1.0)[:, None]
    yield at("two sheets 1e-4 apart", flat + 5e-5 * side * up, side * up)
    yield base._replace(name="flipped normals", normal=-normal)
    yield base._replace(name="normals of length 2", normal=2 * normal)
    yield at(
        "coordinates with subnormals",
        np.where(rng.random((POINTS, 3)) < 0.3, 1e-41 * position, position),
    )
    for power in (-6, 6):
        scale = 10.0**power
        yield at(
            f"box times 1e{power}", scale * position, scale=scale, light=base.light
        )
    for power in (3, 4, 6):
        moved = 10.0**power
        name = f"at 1e{power}"
        yield case(name, position + moved, normal, light=base.light)


def lights() -> Iterator[Case]:
    """Light and material on the plain cloud."""
    base = plain()
    for value in (0.0, 1e-41, 1e-38, 1e-8, 1e6, 1e36):
        yield base._replace(name=f"light {value:g}", light=value * base.light)
    sun = np.array(base.light)
    sun[:, 7] = 1e5
    yield base._replace(name="one sun point of 1e5", light=sun)
    alone = base.light * np.array([0.0, 1, 0])[:, None, None]
    yield base._replace(name="one channel only", light=alone)
    for albedo in (0.0, 1.0):
        given = np.full_like(base.albedo, albedo)
        yield base._replace(name=f"albedo {albedo:g}", albedo=given)


def all_cases(quick: bool) -> list[Case]:
    """Every case, or a few of them."""
    found = [*clouds(), *lights()]
    few = ("plain", "500 coin", "one point", "line", "at 1e6", "light 0", "light 1e-41")
    return [c for c in found if c.name.startswith(few)] if quick else found


def many_points(count: int) -> np.ndarray:
    """Points on a sphere of diameter 1."""
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(count, 3))
    return 0.5 * normal / np.linalg.norm(normal, axis=1, keepdims=True)
