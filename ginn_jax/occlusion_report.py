"""report.md of the experiment of ambient occlusion."""

from typing import Any

from ginn_jax import report


def write_report(m: dict[str, Any]) -> str:
    """report.md: what was done, how good it is, how long it took."""
    columns = {"name": "object", "points": "points", "mse_3d": "3D MSE"}
    columns |= {"relative_mse_3d": "relative", "noise_floor_3d": "noise floor"}
    times = {"method": "method", "points": "points", "mse_2d": "2D MSE"}
    times |= {"dssim_2d": "DSSIM", "seconds_3d": "f_3D s", "seconds_2d": "f_2D s"}
    times |= {"seconds": "total s"}
    heads = {"set": "set", "clouds": "clouds", "mse_3d": "3D MSE"}
    heads |= {"relative_mse_3d": "relative 3D MSE", "noise_floor_3d": "noise floor"}
    heads |= {"median_relative_mse_3d": "median relative", "equal_rays": "equal rays"}
    env, options = m["environment"], m["options"]
    seconds = {k[8:]: v for k, v in m.items() if k.startswith("seconds_")}
    against = report.beside_tracing(m["error_against_time"], "rays")
    return f"""# Ambient occlusion

Preset {options["preset"]}, levels {m["training"]["network"]["levels"]}, f_2D radius
{m["training"]["network"]["query"]["radius"]}, occlusion radius {options["radius"]},
{report.steps_taken(m)}.
{env["processor"]}, {env["cores"]} cores, {env["devices"]} JAX devices,
jax {env["packages"]["jax"]}, mitsuba {env["packages"]["mitsuba"]}.
Skipped steps (non-finite gradient): {m["skipped_steps"]}. Limits raised on the way:
{", ".join(m["limits_raised"]) or "none"}. Peak memory {m["peak_memory_gib"]:.2f} GiB.

## Error at points

MSE is against the expectation of the ray-traced target (its noise is subtracted);
relative is over the variance of the target, pooled over the clouds; equal rays is the
number of independent rays per point at which ray tracing has the same MSE.

{report.table_of(report.unseen_sets(m), heads)}
## Error against run time

Means over {len(m["foreground_pixels"])} unseen objects at {options["resolution"]} x
{options["resolution"]} ({", ".join(map(str, m["foreground_pixels"]))} foreground
pixels), same pixels, same machine, same run; compilation, G-buffer and
samples of the surface apart. Ray tracing beside is stratified, the reference is not.
DSSIM after the paper's tone mapping, over the foreground.

{report.table_of(against, times | report.TRACING)}
![error against run time](error_against_time.png)

![reference, network, difference](views.png)

## Training

![learning curve](learning_curve.png)

{report.markdown_table(list(seconds), [[f"{v:.1f} s" for v in seconds.values()]])}
## Every unseen object

{report.table_of(report.unseen_clouds(m), columns)}"""
