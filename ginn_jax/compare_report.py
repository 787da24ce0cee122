"""What a comparison of methods comes to: lost cells, Pareto front, report."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ginn_jax import report
from ginn_jax.compare_networks import OURS
from ginn_jax.evaluate import Row, mean_rows
from ginn_jax.metrics import pooled_interval

TITLES = {"ao": "Ambient occlusion", "gi": "Global illumination"}
TITLES |= {"sss": "Subsurface scattering"}
RIVALS = ("screen space", "visibility bitmask", "2D only", "3D only")
CELLS = ("mse_3d", "mse_2d", "dssim_2d")
KEPT = ("mse_3d", "relative_mse_3d", "equal_rays", "memory_mib")
UNITS = (
    "MSE is of the transported light, in units of the squared mean light of each scene "
    "and channel."
)


def lost_cells(rows: Sequence[Row]) -> list[str]:
    """The paper's cells that another method wins: metric, rival and both numbers."""
    by_name = {row["method"]: row for row in rows}
    lost = []
    for cell in CELLS:
        for rival in RIVALS:
            mine, other = by_name[OURS].get(cell), by_name.get(rival, {}).get(cell)
            if mine is not None and other is not None and other < mine:
                lost.append(f"{cell}: {rival} {other:.4g}, ours {mine:.4g}")
    return lost


def pareto_front(rows: Sequence[Row], error: str = "mse_2d") -> list[str]:
    """Methods that none beats in both time and error, fastest first."""
    front, least = [], np.inf
    for row in sorted(rows, key=lambda r: (r["seconds"], r[error])):
        if row[error] < least:
            front.append(row["method"])
            least = row[error]
    return front


def summary(
    effect: str,
    at_points: Mapping[str, Row],
    rows: Sequence[Row],
    front_rows: Sequence[Row],
    counted_rows: Sequence[Row],
) -> dict[str, Any]:
    """What all shots together say of the methods, and the errors at points."""
    results = mean_rows(rows)
    for row in results:
        known = at_points.get(row["method"], {})
        row |= {k: known[k] for k in KEPT if k in known}
        row |= _interval([r for r in rows if r["method"] == row["method"]])
    front = mean_rows(front_rows)
    fresh = [row for row in front if "kept" not in row]
    counted = mean_rows(counted_rows)
    traced = [row for row in front if "traced" in row or "denoised" in row]
    ours = next(r for r in results if r["method"] == OURS)
    openness = "Errors are of openness, 1 where nothing is near."
    return {
        "results": results,
        "lost_cells": lost_cells(results),
        "error_against_time": front,
        "light_counted": counted,
        "front_mse": pareto_front(fresh),
        "front_dssim": pareto_front(fresh, "dssim_2d"),
        "front_kept": pareto_front(front),
        "front_counted": pareto_front([*counted, *traced]),
        "share_2d": ours["seconds_2d"] / ours["seconds"],
        "denoiser": any("denoised" in row for row in front),
        "units": openness if effect == "ao" else UNITS,
    }


def _interval(rows: Sequence[Row]) -> Row:
    """What the relative 2D error of a method might be on other scenes."""
    names = dict.fromkeys(row["name"] for row in rows)
    scenes = [mean_rows([r for r in rows if r["name"] == name])[0] for name in names]
    parts = ([scene[part] for scene in scenes] for part in ("mse_2d", "variance_2d"))
    low, high = pooled_interval(*parts)
    return {"low_2d": low, "high_2d": high}


def write_report(m: Mapping[str, Any]) -> str:
    """report.md of a comparison."""
    env, options = m["environment"], m["options"]
    cells = {"method": "method", "shots": "shots", "mse_3d": "3D MSE"}
    cells |= {"relative_mse_3d": "relative 3D", "mse_2d": "2D MSE"}
    cells |= {"relative_mse_2d": "relative 2D", "low_2d": "from", "high_2d": "to"}
    cells |= {"dssim_2d": "2D DSSIM"}
    times = {"method": "method", "seconds_3d": "f_3D s", "seconds_2d": "f_2D s"}
    times |= {"seconds": "total s", "memory_mib": "memory MiB"}
    against = {"method": "method", "seconds": "s", "mse_2d": "2D MSE"}
    against |= {"relative_mse_2d": "relative 2D", "dssim_2d": "2D DSSIM"}
    rows = report.beside_tracing(m["error_against_time"], "traced")
    lost = "\n".join(f"- {line}" for line in m["lost_cells"]) or "None."
    ours = next(row for row in m["results"] if row["method"] == OURS)
    denoiser = "" if m["denoiser"] else " It was not installed."
    return f"""# {TITLES[options["effect"]]}

`{m["command"]}`, {m["objects"]} unseen
scenes, {options["views"]} views each at {options["resolution"]} x
{options["resolution"]}: {", ".join(m["names"])}. {env["processor"]}, {env["cores"]}
cores, {env["devices"]} JAX devices, jax {env["packages"]["jax"]}, mitsuba
{env["packages"]["mitsuba"]}.

{m["units"]} Noise of the reference ({options["reference"]} rays or paths a pixel, which
also bounds how small an error can be told) is subtracted from every MSE. DSSIM is of
the displayed image after the paper's tone mapping, over the foreground; the noise of
the reference, which cannot be subtracted here, makes up about
{ours["noise_dssim"]:.2g} (as much again on top of it does). 3D MSE is at points that no
network was given and that light reaches by one of 32 rays.

## The paper's table

{report.table_of(m["results"], cells)}
Relative errors are MSE over the variance of the reference: to predict its mean has 1.
In 95 % of draws of as many scenes from these, relative 2D is "from" ... "to".
Cells that our network loses against screen space of either kind, 2D only or 3D only:

{lost}

## Scene by scene

Relative 2D error over the views of each; "pixels" are in the foreground of one.

{_by_scene(m["rows"])}
## Time and memory

Same pixels, same machine, one method after the other: of every view the median of three
calls after a first one, of those the median. Compilation, G-buffer and direct light are
left out, and the samples of the surface: {ours["seconds_sampling"]:.2g} s, once for
all views of a scene. Screen space is plain JAX, which nobody made fast. Memory is what
methods ask for beside inputs and outputs.

{report.table_of(m["results"], times)}
f_2D takes {m["share_2d"]:.0%} of our network's time (paper: 60 %).

## Error against run time

Over the first view of every scene, times as above. What is traced is stratified over
the pixel's rays or paths, the reference is not; denoised is by Open Image Denoise of
high quality, or fast.{denoiser} Where one path takes longer than a network, tracing's
MSE "at equal time" is that of one path. Codes kept:
the time of another view of the same scene in the same light, f_2D alone.

{report.table_of(rows, against | report.TRACING)}
Pareto front by 2D MSE: {", ".join(m["front_mse"])}.
By DSSIM: {", ".join(m["front_dssim"])}. By 2D MSE where codes
are kept: {", ".join(m["front_kept"])}.

{_of_light(m)}
![error against run time](error_against_time.png)

![methods on the same pixels](ablation.png)
"""


def _by_scene(rows: Sequence[Row]) -> str:
    """A line a scene: how many pixels it covers, and every method's error there."""
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        pooled = mean_rows([row for row in rows if row["name"] == name])
        errors = {row["method"]: row["relative_mse_2d"] for row in pooled}
        lines.append({"scene": name, "pixels": round(pooled[0]["pixels"])} | errors)
    return report.table_of(lines, {column: column for column in lines[0]})


def _of_light(m: Mapping[str, Any]) -> str:
    """Our network with what its samples and light take, which is in no other time."""
    columns = {"method": "method", "seconds_sampling": "samples s"}
    columns |= {"seconds_samples": "their light s"}
    columns |= {"seconds_pixels": "of pixels s", "seconds_network": "network s"}
    columns |= {"seconds": "total s", "mse_2d": "2D MSE", "dssim_2d": "2D DSSIM"}
    known = m["light_counted"][0]
    columns = {k: head for k, head in columns.items() if k in known} | report.TRACING
    traced = [row for row in m["error_against_time"] if "traced" in row]
    rows = report.beside_tracing([*m["light_counted"], *traced], "traced")
    rows = rows[: len(m["light_counted"])]
    return f"""## With samples and direct light counted

The networks are given samples and, where there is light, direct light, which are in
none of the times above. Here they are, with fewer samples, fewer looks (directions of
the light) a point and fewer pixels as well, and the error that then is left. Light of
pixels counts where the network asks for it; else it is the display alone that needs it,
with tracing as well.

{report.table_of(rows, columns)}
Pareto front of these and tracing, plain and denoised, by 2D MSE:
{", ".join(m["front_counted"])}.
"""
