"""What a comparison of methods comes to: lost cells, Pareto front, report, figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ginn_jax import report
from ginn_jax.compare_networks import OURS
from ginn_jax.evaluate import Row
from ginn_jax.metrics import relative_error, tone_map

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


def pool_shots(rows: Sequence[Row]) -> list[Row]:
    """Means over the shots of each method; relative errors as ratios of means."""
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row["method"], []).append(row)
    pooled = []
    for method, group in methods.items():
        numbers = [k for k, v in group[0].items() if isinstance(v, int | float)]
        mean = {k: float(np.mean([row[k] for row in group])) for k in numbers}
        mean["relative_mse_2d"] = relative_error(mean["mse_2d"], mean["variance_2d"])
        pooled.append({"method": method, "shots": len(group)} | mean)
    return pooled


def summary(
    effect: str,
    at_points: Mapping[str, Row],
    rows: Sequence[Row],
    front_rows: Sequence[Row],
) -> dict[str, Any]:
    """What all shots together say of the methods, and the errors at points."""
    results = pool_shots(rows)
    for row in results:
        known = at_points.get(row["method"], {})
        row |= {k: known[k] for k in KEPT if k in known}
    front = pool_shots(front_rows)
    fresh = [row for row in front if "kept" not in row]
    ours = next(r for r in results if r["method"] == OURS)
    openness = "Errors are of openness, 1 where nothing is near."
    return {
        "results": results,
        "lost_cells": lost_cells(results),
        "error_against_time": front,
        "front_mse": pareto_front(fresh),
        "front_dssim": pareto_front(fresh, "dssim_2d"),
        "front_kept": pareto_front(front),
        "share_2d": ours["seconds_2d"] / ours["seconds"],
        "denoiser": any("denoised" in row for row in front),
        "units": openness if effect == "ao" else UNITS,
    }


def write_report(title: str, m: Mapping[str, Any]) -> str:
    """report.md of a comparison."""
    env, options = m["environment"], m["options"]
    cells = {"method": "method", "shots": "shots", "mse_3d": "3D MSE"}
    cells |= {"relative_mse_3d": "relative 3D", "mse_2d": "2D MSE"}
    cells |= {"relative_mse_2d": "relative 2D", "dssim_2d": "2D DSSIM"}
    times = {"method": "method", "seconds_3d": "f_3D s", "seconds_2d": "f_2D s"}
    times |= {"seconds": "total s", "memory_mib": "memory MiB"}
    against = {"method": "method", "seconds": "s", "mse_2d": "2D MSE"}
    against |= {"relative_mse_2d": "relative 2D", "dssim_2d": "2D DSSIM"}
    rows = report.beside_tracing(m["error_against_time"], "traced")
    lost = "\n".join(f"- {line}" for line in m["lost_cells"]) or "None."
    denoiser = "" if m["denoiser"] else " Open Image Denoise was not installed."
    return f"""# {title}

`python -m experiments.evaluate --effect {options["effect"]}`, {m["objects"]} unseen
scenes, {options["views"]} views each at {options["resolution"]} x
{options["resolution"]}: {", ".join(m["names"])}. {env["processor"]}, {env["cores"]}
cores, {env["devices"]} JAX devices, jax {env["packages"]["jax"]}, mitsuba
{env["packages"]["mitsuba"]}.

{m["units"]} Noise of the reference ({options["reference"]} rays or paths a pixel, which
also bounds how small an error can be told) is subtracted from every MSE. DSSIM is of
the displayed image after the paper's tone mapping, over the foreground. 3D MSE is at
points that no network was given.

## The paper's table

{report.table_of(m["results"], cells)}
Cells that our network loses against screen space of either kind, 2D only or 3D only:

{lost}

## Time and memory

Same pixels, same machine, in turns; compilation, G-buffer and direct light apart.
Memory is what the compiled functions ask for beside their inputs and outputs.

{report.table_of(m["results"], times)}
f_2D takes {m["share_2d"]:.0%} of our network's time (paper: 60 %).
{_of_light(m["seconds_of_light"], options["looks"])}

## Error against run time

Over the first view of every scene.{denoiser} Codes kept: the time of another view of
the same scene in the same light, f_2D alone.

{report.table_of(rows, against | report.TRACING)}
Pareto front by 2D MSE: {", ".join(m["front_mse"])}.
By DSSIM: {", ".join(m["front_dssim"])}. By 2D MSE where codes
are kept: {", ".join(m["front_kept"])}.

![error against run time](error_against_time.png)

![methods on the same pixels](ablation.png)
"""


def _of_light(seconds: Mapping[str, float], looks: Any) -> str:
    """What the times leave out of what networks are given."""
    if not seconds:
        return ""
    return f"""
The direct light that networks are given is not in their times, nor in those of what
they are compared with below: at {looks} looks a point it takes {seconds["samples"]:.3g}
s more for the samples of a scene and {seconds["pixels"]:.3g} s for the pixels of a
view. Tracing needs none of the former, and of scattering none of the latter."""


def draw_front(path: Path, rows: list[Row]) -> None:
    """Error against run time, one line a kind of method."""
    mine = [r for r in rows if r["method"].startswith(OURS)]
    fresh = [r for r in mine if "kept" not in r]
    rates = [r for r in fresh if "scale" in r["method"]]
    means = [r for r in fresh if "mean" in r["method"]]
    groups = {
        OURS: [r for r in fresh if r not in rates + means],
        f"{OURS}, fewer pixels": rates,
        f"{OURS}, mean of draws": means,
        f"{OURS}, codes kept": [r for r in mine if "kept" in r],
        "ablations": [r for r in rows if r["method"] in ("2D only", "3D only")],
        "screen space": [
            r for r in rows if r["method"] in ("screen space", "visibility bitmask")
        ],
        "traced": [r for r in rows if "traced" in r],
        "traced and denoised": [r for r in rows if "denoised" in r],
    }
    kept = {n: [_short(r) for r in group] for n, group in groups.items() if group}
    report.draw_error_against_time(path, kept)


def _short(row: Row) -> Row:
    """A row whose label leaves out what its line in the figure says."""
    name = row["method"].removesuffix(", denoised").removesuffix(", codes kept")
    name = name.removeprefix(f"{OURS}, ")
    return row | {"method": name}


def draw_methods(
    path: Path,
    shots: Sequence[tuple[str, Mapping[str, Float[np.ndarray, "H W *C"]]]],
) -> None:
    """A row a shot, a column a method, "reference" too, each with an enlarged inset."""
    names = list(shots[0][1])
    figure = Figure(figsize=(2.6 * len(names), 2.8 * len(shots)), layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(shots), len(names), squeeze=False))
    for line, (title, pictures) in zip(grid, shots, strict=True):
        right = pictures["reference"]
        corner, size = inset_place(right)
        for axes, name in zip(line, names, strict=True):
            shown = tone_map(pictures[name], right, foreground(right))
            axes.imshow(shown, cmap="gray", vmin=0, vmax=1)
            axes.set_title(f"{title}\n{name}" if name == names[0] else name, fontsize=8)
            axes.axis("off")
            _inset(axes, shown, corner, size)
    figure.savefig(path, dpi=110)


def foreground(image: Float[np.ndarray, "H W *C"]) -> np.ndarray:
    """Pixels that hold something in a reference."""
    return (image.sum(-1) if image.ndim == 3 else image) > 0


def inset_place(image: Float[np.ndarray, "H W *C"]) -> tuple[tuple[int, int], int]:
    """The square, a fifth of the image, in which the reference varies most."""
    gray = image.mean(-1) if image.ndim == 3 else image
    size = max(min(gray.shape) // 5, 4)
    tiles = [
        (float(np.std(np.sqrt(np.maximum(gray[i : i + size, j : j + size], 0)))), i, j)
        for i in range(size, gray.shape[0] - 2 * size + 1, size // 2)
        for j in range(size, gray.shape[1] - 2 * size + 1, size // 2)
        if foreground(image[i : i + size, j : j + size]).all()
    ]
    _, row, column = max(tiles, default=(0.0, 2 * size, 2 * size))
    return (row, column), size


def _inset(axes: Any, image: np.ndarray, corner: tuple[int, int], size: int) -> None:
    row, column = corner
    square = image[row : row + size, column : column + size]
    small = axes.inset_axes((0.62, 0.0, 0.38, 0.38))
    small.imshow(square, cmap="gray", vmin=0, vmax=1)
    small.set(xticks=[], yticks=[])
    for frame in small.spines.values():
        frame.set_color("tab:red")
    axes.add_patch(
        Rectangle((column, row), size, size, fill=False, edgecolor="tab:red")
    )
