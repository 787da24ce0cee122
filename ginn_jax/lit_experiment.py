"""What the experiments of effects that carry light share: run, evaluation, report."""

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import jax
import numpy as np
from rich.console import Console

from ginn_jax import evaluate_light, fit, lit_views, report
from ginn_jax.architecture import Network
from ginn_jax.dataset import count_asked, count_given
from ginn_jax.evaluate import Model, fill, mean_rows
from ginn_jax.experiment import (
    Clock,
    check_run,
    closing,
    errors_by_set,
    learned,
    make,
    on_disk,
    train,
    training,
)
from ginn_jax.lit_clouds import LitCloud, split_points, unit_floor
from ginn_jax.lit_options import LitOptions, choose_sources
from ginn_jax.lit_report import halves_by_medium, write_report
from ginn_jax.lit_scenes import Illumination, Scattering
from ginn_jax.objects import Source
from ginn_jax.pairing import PAPER_SPLIT
from ginn_jax.recipe import Training

VALIDATION_PATHS = 512
PATH_COUNTS = (1, 4, 16, 64)
LitSettings = Illumination | Scattering


def check_lit_run(options: LitOptions) -> None:
    """Raise `InputError` for options that cannot be meant, by their flags."""
    check_run(options, {"paths": 2, "lights": 1})


def run_experiment(
    options: LitOptions,
    settings: LitSettings,
    network: Network,
    title: str,
) -> dict[str, Any]:
    """Data, training, evaluation and report of one effect; what metrics.json holds."""
    network = on_disk(options, network)
    console, clock, begin = Console(), Clock(), time.perf_counter()
    seen, unseen = choose_sources(options)
    if options.split == "paper":
        sizes = {"points": PAPER_SPLIT.points, "paths": PAPER_SPLIT.paths}
        options, settings = replace(options, **sizes), replace(settings, **sizes)
    folder = options.out / "data"
    clouds = make(console, "training clouds", seen, settings, folder / "training")
    exact = with_exact_targets(settings, options.quick)
    tests = {
        name: make(console, f"unseen, {name}", sources, exact, folder / name)
        for name, sources in unseen.items()
    }
    clock.lap("data", begin)

    config = training(options, network, settings.points, len(clouds))
    extra = learned(settings, seen)
    run = train(console, config, clouds, options, extra, clock)

    begin = time.perf_counter()
    floor = unit_floor(clouds)
    report.draw_curve(options.out / "learning_curve.png", run.losses, floor)
    metrics = evaluation(options, run, config, exact, unseen, tests)
    clock.lap("evaluation", begin)
    metrics |= closing(options, run, config, clock)
    report.write_results(options.out, metrics, write_report(title, metrics))
    console.print(
        f"relative 3D MSE {metrics['relative_mse_3d']:.2%} on unseen shapes and lights,"
        f" {metrics['seconds_total'] / 60:.1f} minutes: {options.out / 'report.md'}"
    )
    return metrics


def with_exact_targets(settings: LitSettings, quick: bool) -> LitSettings:
    """The same with targets to measure by, at the points where networks are asked."""
    paths = 16 if quick else max(settings.paths, VALIDATION_PATHS)
    return replace(settings, paths=paths, targets=count_asked(settings.points))


def evaluation(
    options: LitOptions,
    run: fit.Fit,
    config: Training,
    settings: LitSettings,
    unseen: dict[str, list[Source]],
    clouds: dict[str, Sequence[LitCloud]],
) -> dict[str, Any]:
    """All errors of the trained network; draws the figures."""
    variables = jax.device_put(run.state.variables, jax.devices()[0])
    model = Model(variables, jax.random.key(options.seed))
    limits, found = run.limits, {}
    for name, sources in unseen.items():
        names = [source.name for source in sources]
        found[name], limits = evaluate_light.evaluate_lit_clouds(
            config.network, limits, model, clouds[name], names, settings
        )
    each = [row for rows in found.values() for row in rows]
    metrics = errors_by_set(found) | halves_by_medium(each)
    # Not all at once: the clouds may stay on disk.
    firsts = (islice(zip(unseen[n], clouds[n], strict=True), 2) for n in unseen)
    shown = [pair for pairs in firsts for pair in pairs][:6]
    images = image_evaluation(options, config, limits, model, settings, shown)
    return metrics | images


def image_evaluation(
    options: LitOptions,
    config: Training,
    limits: Any,
    model: Model,
    settings: LitSettings,
    shown: Sequence[tuple[Source, LitCloud]],
) -> dict[str, Any]:
    """Images of unseen objects, and error against run time on the same pixels."""
    rows, pictures = [], []
    paths = settings.paths // 4
    for source, cloud in shown:
        view = lit_views.lit_view(source, settings, paths, options.resolution)
        cloud = split_points(cloud, count_given(len(cloud.position)))[0]
        ends = model, cloud, view
        row, values, encoded, limits = evaluate_light.lit_network_row(
            config.network, limits, *ends
        )
        units = np.asarray(encoded.scale)
        rows.append(row | {"name": source.name})
        pictures.append((source.name, panels(view, values)))
        if options.resolution_scale < 1:
            row, _, _, limits = evaluate_light.lit_network_row(
                config.network, limits, *ends, options.resolution_scale
            )
            rows.append(row | {"name": source.name})
        for count in PATH_COUNTS:
            row = evaluate_light.path_row(view, count, 1000, units)
            rows.append(row | {"name": source.name})
    means = mean_rows(rows)
    groups = {
        "network (f_3D + f_2D)": [r for r in means if "paths" not in r],
        "path tracing": [r for r in means if "paths" in r],
    }
    report.draw_color_views(options.out / "views.png", pictures)
    report.draw_error_against_time(options.out / "error_against_time.png", groups)
    return {
        "relative_mse_2d": means[0]["relative_mse_2d"],
        "dssim_2d": means[0]["dssim_2d"],
        "reference_paths": paths,
        "error_against_time": means,
        "error_against_time_rows": rows,
    }


def panels(view: lit_views.LitView, values: np.ndarray) -> list[np.ndarray]:
    """Displayed reference and prediction, then the indirect light of both alone.

    What leaves a medium is displayed as it is: there it comes once.
    """
    target, mask = view.pixels.target, view.gbuffer.mask
    whole = [lit_views.displayed(view, light) for light in (target, values)]
    if view.pixels.medium.size:
        return whole
    return [*whole, *(fill(mask, light) for light in (target, values))]
