"""Where objects and lights come from: seeds and files."""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ginn_jax.checks import LARGEST_SEED, whole
from ginn_jax.errors import InputError, silence
from ginn_jax.lighting import (
    Light,
    PointLight,
    load_environment,
    procedural_environment,
    turned,
)
from ginn_jax.mesh import Mesh, add_ground, fit_unit_box, load_mesh
from ginn_jax.shapes import SHAPES, random_shape

# Seeds of what is trained on lie below UNSEEN_SEED, `SEEDS_APART` for each --seed.
SEEDS_APART, UNSEEN_SEED = 100_000, 10_000_000
# Of what benchmarks measure on: neither trained nor tested on.
BENCHMARK_SEED = 20_000_000


@dataclass(frozen=True)
class LightSource:
    """One light: a file, or the seed of a procedural environment or point light."""

    name: str
    path: str | None
    seed: int
    point: bool = False


@dataclass(frozen=True)
class Source:
    """One object, a mesh file or else the procedural shape of its name, as "shape_7";
    and its light. The seed is that of materials, samples and paths."""

    name: str
    path: str | None
    seed: int
    light: LightSource | None = None


def procedural_sources(count: int, first_seed: int) -> list[Source]:
    """Procedural shapes of consecutive seeds."""
    return [
        Source(f"shape_{s}", None, s) for s in range(first_seed, first_seed + count)
    ]


def file_sources(paths: Sequence[Path]) -> list[Source]:
    """The objects of mesh files, each under a name of its own.

    That is the file's name, or as much of its path as tells it from the others: all
    models of ShapeNetCore are called model_normalized.obj.
    """
    return [
        Source(name, str(path), i)
        for i, (name, path) in enumerate(zip(tell_apart(paths), paths, strict=True))
    ]


def tell_apart(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths, of one length, that are all different.

    Paths of which some differ by their endings alone are numbered, all of them.
    """
    parts = [p.relative_to(p.anchor).with_suffix("").parts for p in paths]
    for length in range(1, max((len(p) for p in parts), default=1) + 1):
        names = ["_".join(p[-length:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{i}_{p[-1]}" for i, p in enumerate(parts)]


def procedural_lights(count: int, first_seed: int) -> list[LightSource]:
    """Procedural environments of consecutive seeds."""
    return [
        LightSource(f"sky_{s}", None, s) for s in range(first_seed, first_seed + count)
    ]


def point_lights(count: int, first_seed: int) -> list[LightSource]:
    """Point lights of consecutive seeds."""
    return [
        LightSource(f"point_{s}", None, s, point=True)
        for s in range(first_seed, first_seed + count)
    ]


def file_lights(paths: Sequence[Path]) -> list[LightSource]:
    """The environment maps of files, each under a name of its own."""
    return [
        LightSource(name, str(path), i)
        for i, (name, path) in enumerate(zip(tell_apart(paths), paths, strict=True))
    ]


def object_or_shape(path: Path | None, seed: int, ground: bool) -> Mesh:
    """The object of a file, or else the procedural shape of that seed, in its unit box,
    on the ground if there is one.

    Without ground it is there for its medium, which only a closed shape can hold.
    """
    mesh = load_mesh(path) if path else random_shape(seed, closed=not ground)
    mesh = fit_unit_box(mesh)
    return add_ground(mesh) if ground else mesh


def load_object(source: Source, ground: bool = True) -> Mesh:
    """`object_or_shape` of a source, without the warnings of files."""
    if source.path is None:
        return object_or_shape(None, shape_seed(source), ground)
    with silence():
        return object_or_shape(Path(source.path), 0, ground)


def shape_seed(source: Source) -> int:
    """The seed of a procedural shape, which its name keeps under any light."""
    number = source.name.split("__")[0].removeprefix("shape_")
    if not number.isdecimal():
        raise InputError(
            f'{source.name} names no shape: call it "shape_7", or give a path'
        )
    return int(number)


def load_light(source: Source) -> Light:
    """The light of a source; one from a file is turned at random by the seed."""
    light = source.light
    if light is None:
        raise InputError(f"{source.name}: no light; pair the object with one")
    if light.point:
        return random_point_light(light.seed)
    if light.path is None:
        return procedural_environment(light.seed)
    seed = whole("seed", source.seed, 0, LARGEST_SEED)
    share = np.random.default_rng((seed, 2)).random()
    return turned(load_environment(light.path), share)


def random_point_light(seed: int) -> PointLight:
    """A white light above and beside the object, out of its unit box."""
    rng = np.random.default_rng((whole("seed", seed, 0, LARGEST_SEED), 3))
    around, up = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.4)
    away = rng.uniform(0.9, 1.6)
    place = away * np.cos(around), up, away * np.sin(around)
    return PointLight(np.array(place), np.full(3, 5.0))


def origin_of(source: Source) -> dict[str, Any]:
    """What a source is, files by the checksum of their contents."""
    found: dict[str, Any] = {"seed": source.seed}
    if source.path:
        found["object"] = _contents(source.path)
    else:
        found |= {"object": source.name, "shapes": SHAPES}
    if light := source.light:
        found["light"] = _contents(light.path) if light.path else light.name
    return found


def check_unseen(seen: Sequence[Source], unseen: Sequence[Source]) -> None:
    """Raise `InputError` where a file to test on, whatever its name, is trained on."""
    known = {_contents(path) for path in _files(seen)}
    for path in sorted(_files(unseen)):
        if _contents(path) in known:
            raise InputError(f"{path} is to be trained on as well: leave it out of one")


def _files(sources: Sequence[Source]) -> set[str]:
    """The files of objects and lights."""
    named = [s.path for s in sources] + [s.light.path for s in sources if s.light]
    return {path for path in named if path}


def _contents(path: str) -> int:
    """A checksum of a file and, of a .gltf, of the files that hold its numbers."""
    try:
        found = (given := Path(path)).read_bytes()
        parts = [given.parent / name for name in _buffers(given, found)]
        return zlib.crc32(b"".join([found, *(part.read_bytes() for part in parts)]))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None


def _buffers(path: Path, text: bytes) -> list[str]:
    """The files that a .gltf names; none where it is damaged: loading will say so."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        named = [buffer.get("uri", "data:") for buffer in json.loads(text)["buffers"]]
        return [unquote(name) for name in named if not name.startswith("data:")]
    except (ValueError, KeyError, TypeError, AttributeError):
        return []
