"""report.md of the experiments of effects that carry light."""

from collections.abc import Sequence
from typing import Any

from ginn_jax import report
from ginn_jax.evaluate import Row, pool_rows


def halves_by_medium(rows: Sequence[Row]) -> dict[str, Row]:
    """Errors pooled over the clearer half of the media and over the denser, if any."""
    media = sorted(
        (row for row in rows if "extinction" in row), key=lambda row: row["extinction"]
    )
    half = len(media) // 2
    halves = {"clearer": media[:half], "denser": media[half:]}
    return {
        f"unseen, {name} half of the media": pool_rows(part)
        for name, part in halves.items()
        if half
    }


def write_report(title: str, m: dict[str, Any]) -> str:
    """report.md: what was done, how good it is, how long it took."""
    env, options = m["environment"], m["options"]
    heads = {"set": "set", "clouds": "clouds", "relative_mse_3d": "relative 3D MSE"}
    heads |= {"median_relative_mse_3d": "median", "mse_3d": "3D MSE"}
    heads |= {"noise_floor_3d": "noise floor", "equal_rays": "equal paths"}
    times = {"method": "method", "relative_mse_2d": "relative 2D MSE"}
    times |= {"mse_2d": "2D MSE", "dssim_2d": "DSSIM", "seconds_3d": "f_3D s"}
    times |= {"seconds_2d": "f_2D s", "seconds": "total s"}
    each = {
        "name": "object and light",
        "relative_mse_3d": "relative",
        "mse_3d": "3D MSE",
    }
    each |= {"noise_floor_3d": "noise floor", "variance_3d": "variance"}
    rows = report.unseen_clouds(m)
    media = ""
    if any("extinction" in row for row in rows):
        each |= {"extinction": "extinction", "ior": "index of refraction"}
        media = "Extinction is per longest side of the object.\n\n"
    seconds = {k[8:]: v for k, v in m.items() if k.startswith("seconds_")}
    network = m["training"]["network"]
    kind = "linear in light" if network["linear"] else "homogeneous in light"
    against = report.beside_tracing(m["error_against_time"], "paths")
    return f"""# {title}

Network {kind}, levels {network["levels"]}, f_2D radius {network["query"]["radius"]},
{report.steps_taken(m)}.
{env["processor"]}, {env["cores"]} cores, {env["devices"]} JAX devices,
jax {env["packages"]["jax"]}, mitsuba {env["packages"]["mitsuba"]}.
Skipped steps (non-finite gradient): {m["skipped_steps"]}. Limits raised on the way:
{", ".join(m["limits_raised"]) or "none"}. Peak memory {m["peak_memory_gib"]:.2f} GiB.

## Error at points

In units of the squared mean light of each cloud and channel, against the expectation of
the path-traced target (its noise is subtracted). Relative is over the variance of the
target, pooled over clouds and channels as a ratio of means; equal paths is the number
of independent paths per point at which path tracing has the same MSE.

{report.table_of(report.unseen_sets(m), heads)}
## Error against run time

Means over {len(m["error_against_time_rows"]) // len(m["error_against_time"])} unseen
objects at {options["resolution"]} x {options["resolution"]}, RGB, same pixels, same
machine, same run; compilation, G-buffer, samples and direct light apart. The reference
has {m["reference_paths"]} independent paths a pixel, whose noise is subtracted; path
tracing beside is stratified. DSSIM of what is displayed, after the paper's tone
mapping, over the foreground.

{report.table_of(against, times | report.TRACING)}
![error against run time](error_against_time.png)

![reference and network](views.png)

## Training

![learning curve](learning_curve.png)

{report.markdown_table(list(seconds), [[f"{v:.1f} s" for v in seconds.values()]])}
## Every unseen object

{media}{report.table_of(rows, each)}"""
