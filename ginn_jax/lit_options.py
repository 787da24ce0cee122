"""What an experiment with light can be told, and the objects and lights that follow."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ginn_jax.errors import InputError
from ginn_jax.experiment import RunOptions
from ginn_jax.lighting import find_environments
from ginn_jax.mesh import find_meshes
from ginn_jax.objects import (
    SEEDS_APART,
    UNSEEN_SEED,
    LightSource,
    Source,
    check_unseen,
    file_lights,
    file_sources,
    point_lights,
    procedural_lights,
    procedural_sources,
)
from ginn_jax.pairing import PAPER_SPLIT, mixed, pair_up, split_apart, spread

Preset = Literal[
    "homogeneous", "linear", "narrow", "wide", "released", "only_2d", "only_3d"
]


@dataclass(frozen=True)
class LitOptions(RunOptions):
    """What every effect that carries light can be told."""

    envmaps: Path | None = None
    """An environment map or a folder of them to train under as well, each once or
    more where there are as many objects."""
    lights: int = 1
    """Lights for every object."""
    test_envmaps: Path | None = None
    """Unseen environment maps to evaluate under, instead of procedural ones; where
    there are more than objects, evenly spread over them."""
    split: Literal["default", "paper"] = "default"
    """The paper's: 1,000 x 20, 200 x 5 and 500 x 5 objects and lights, 4,096 paths."""
    paths: int = 32
    """Paths per training point."""


QUICK = {
    "shapes": 4,
    "test_shapes": 2,
    "steps": 10,
    "points": 4000,
    "resolution": 64,
    "paths": 4,
}


def choose_sources(
    options: LitOptions,
) -> tuple[list[Source], dict[str, list[Source]]]:
    """Objects under lights to train on, and those, by name of the set, to test on."""
    seed, each = options.seed, options.lights
    objects = procedural_sources(options.shapes, seed * SEEDS_APART)
    objects += _files(options.meshes, find_meshes, file_sources)
    count = max(options.shapes, each, 30)
    lights = procedural_lights(count, seed * SEEDS_APART)
    maps = _files(options.envmaps, find_environments, file_lights)
    if options.split == "paper":
        return paper_sources(options, objects, maps + lights[: max(30 - len(maps), 0)])
    lights = mixed(lights, maps, len(objects) * each, seed)
    unseen = procedural_sources(options.test_shapes, UNSEEN_SEED + seed)
    maps = _files(options.test_envmaps, find_environments, file_lights)
    skies = procedural_lights(options.test_shapes, UNSEEN_SEED + seed)
    sets = {"shapes": pair_up(unseen, spread(maps, len(unseen)) or skies, 1)}
    lamps = point_lights(4, UNSEEN_SEED + seed)
    sets["point lights"] = pair_up(unseen[:4], lamps, 1)
    if files := _files(options.test_meshes, find_meshes, file_sources):
        sets["meshes"] = pair_up(files, spread(maps, len(files)) or skies, 1)
    seen = pair_up(objects, lights, each)
    for unseen in sets.values():
        check_unseen(seen, unseen)
    return seen, sets


def _files(path: Path | None, find: Callable, name: Callable) -> list[Any]:
    return [] if path is None else name(find(path))


def paper_sources(
    options: LitOptions, objects: Sequence[Source], lights: Sequence[LightSource]
) -> tuple[list[Source], dict[str, list[Source]]]:
    """The paper's split of these objects and lights; test and validation are unseen.

    Raises:
        InputError: files to test on, which the split takes from the others.
    """
    if options.test_meshes or options.test_envmaps:
        raise InputError(
            "--split paper tests on parts of --meshes and --envmaps: leave out "
            "--test-meshes and --test-envmaps"
        )
    split = PAPER_SPLIT
    parts = split.train, split.validation, split.test
    objects_of = split_apart(objects, [count for count, _ in parts], options.seed)
    lights_of = split_apart(lights, [count for _, count in parts], options.seed)
    seen, validation, test = (
        pair_up(o, lit, count)
        for o, lit, (_, count) in zip(objects_of, lights_of, parts, strict=True)
    )
    return seen, {"test": test, "validation": validation}
