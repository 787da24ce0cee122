"""What methods are compared on, and by: shots, pictures of them, errors.

A shot is one scene under one camera, of ambient occlusion (`View`) or of light
(`LitView`). A method makes a picture of it: a row of numbers and the foreground values.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax import evaluate, evaluate_light, lit_views
from ginn_jax.camera import Camera
from ginn_jax.dataset import count_asked
from ginn_jax.estimates import ColorEstimate
from ginn_jax.evaluate import Row, View
from ginn_jax.lighting import find_environments
from ginn_jax.lit_scenes import Illumination, Lit, Scattering, light_up
from ginn_jax.lit_views import LitView
from ginn_jax.mesh import Mesh, find_meshes
from ginn_jax.metrics import relative_error
from ginn_jax.objects import (
    UNSEEN_SEED,
    Source,
    file_lights,
    file_sources,
    load_object,
    procedural_lights,
    procedural_sources,
)
from ginn_jax.pairing import pair_up, spread
from ginn_jax.reference import Estimate
from ginn_jax.scenes import Occlusion, Settings

Shot = View | LitView
Stage = Mesh | Lit
Truth = Estimate | ColorEstimate
Values = Float[np.ndarray, "P *C"]
# Samples of an object at which every pixel has some within the reach of f_2D.
SAMPLES = {"ao": 64_000, "gi": 32_000, "sss": 32_000}


class Picture(NamedTuple):
    """What a method made of a shot: numbers, and values of the foreground."""

    row: Row
    values: Values


class Compared(NamedTuple):
    """What all methods made of a scene.

    rows     the table, a row for each method and view
    front    error against run time, in the first view
    shown    the first view's pictures
    counted  ours by samples, looks and pixels, samples and light counted in its time
    """

    rows: list[Row]
    front: list[Row]
    shown: dict[str, np.ndarray]
    counted: list[Row]


def unseen_sources(
    effect: str, count: int, meshes: Path | None, envmaps: Path | None, *, seed: int
) -> list[Source]:
    """Unseen objects, under unseen lights where the effect has light.

    So many, evenly spread over the files of a folder; without one, procedural.
    """
    first = UNSEEN_SEED + seed
    objects = (
        procedural_sources(count, first)
        if meshes is None
        else file_sources(find_meshes(meshes))
    )
    objects = spread(objects, count)
    if effect == "ao":
        return objects
    lights = (
        procedural_lights(count, first)
        if envmaps is None
        else file_lights(find_environments(envmaps))
    )
    return pair_up(objects, spread(lights, count), 1)


def set_stage(source: Source, settings: Settings) -> Stage:
    """The scene of a source."""
    if isinstance(settings, Occlusion):
        return load_object(source)
    return light_up(source, settings)


def take_shot(stage: Stage, camera: Camera, settings: Settings, *, seed: int) -> Shot:
    """A scene seen by a camera, with no reference yet."""
    if isinstance(stage, Mesh):
        return evaluate.frame(stage, camera)
    assert not isinstance(settings, Occlusion)
    return lit_views.lit_frame(stage, camera, settings, seed=seed)


def with_truth(shot: Shot, truth: Truth) -> Shot:
    """The shot with a reference."""
    if isinstance(shot, View):
        assert isinstance(truth, Estimate)
        return evaluate.with_truth(shot, truth)
    assert isinstance(truth, ColorEstimate)
    return lit_views.with_truth(shot, truth)


def target_of(shot: Shot) -> Values:
    """The reference of the foreground pixels."""
    if isinstance(shot, View):
        return shot.reference[shot.gbuffer.mask]
    return shot.pixels.target


def albedo_of(shot: Shot) -> np.ndarray:
    """What the transported light is multiplied by to be seen."""
    mask = shot.gbuffer.mask
    if isinstance(shot, View):
        return mask.astype(np.float32)
    albedo = shot.pixels.albedo[shot.pixels.material]
    if shot.pixels.medium.size:
        albedo = np.ones_like(albedo)
    return evaluate.fill(mask, albedo)


def displayed(shot: Shot, pictures: list[Picture]) -> dict[str, np.ndarray]:
    """What the methods show, and the reference."""
    values = {p.row["method"]: p.values for p in pictures}
    values["reference"] = target_of(shot)
    if isinstance(shot, View):
        mask = shot.gbuffer.mask
        return {name: evaluate.fill(mask, v) for name, v in values.items()}
    return {name: lit_views.displayed(shot, v) for name, v in values.items()}


def errors(shot: Shot, values: Values, units: Float[np.ndarray, "C"] | None) -> Row:
    """2D errors of a picture; `units` are those of the light, see `evaluate_light`."""
    if isinstance(shot, View):
        row = evaluate.image_errors(
            shot, evaluate.fill(shot.gbuffer.mask, values, evaluate.OPEN)
        )
    else:
        assert units is not None
        row = evaluate_light.lit_image_errors(shot, values, units)
    return row | of_variance(shot, row)


def noise_dssim(shot: Shot, *, seed: int) -> float:
    """DSSIM of the reference with as much Gaussian noise again as it has itself.

    No method can be told to be better than about that.
    """
    target = target_of(shot)
    variance = shot.variance if isinstance(shot, View) else shot.pixels.variance
    noise = np.random.default_rng(seed).normal(size=target.shape) * np.sqrt(variance)
    noisy = np.asarray(target + noise, np.float32)
    return errors(shot, noisy, np.ones(3))["dssim_2d"]


def of_variance(shot: Shot, row: Row) -> Row:
    """The error of a row over the variance of the reference, and that variance."""
    if isinstance(shot, View):
        noise = float(np.mean(shot.variance))
        variance = float(np.var(target_of(shot))) - noise
    else:
        variance = row["variance_2d"]
    relative = relative_error(row["mse_2d"], variance)
    return {"variance_2d": variance, "relative_mse_2d": relative}


def scratch_mib(compiled: Any) -> float:
    """Memory that a compiled function asks for beside its inputs and outputs."""
    return compiled.memory_analysis().temp_size_in_bytes / 2**20


def effect_settings(
    effect: str, points: int | None, paths: int, radius: float
) -> Settings:
    """The settings of an effect by its short name; for no points, its `SAMPLES`."""
    kinds: dict[str, Any] = {
        "ao": partial(Occlusion, radius=radius),
        "gi": Illumination,
        "sss": Scattering,
    }
    return kinds[effect](points or SAMPLES[effect], paths)


def with_looks(settings: Settings, looks: int) -> Settings:
    """Settings of clouds to compare on: where there is light it is looked at so often,
    and only the points that are asked have targets."""
    if isinstance(settings, Occlusion):
        return settings
    return replace(settings, looks=looks, targets=count_asked(settings.points))
