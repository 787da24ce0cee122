"""What an experiment leaves behind: metrics.json, report.md, figures."""

import importlib.metadata
import json
import platform
import resource
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from adjustText import adjust_text
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ginn_jax.files import writing
from ginn_jax.metrics import equal_tracing, foreground, tone_map
from ginn_jax.process import available_cores
from ginn_jax.run_record import RESULTS

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "mitsuba", "trimesh")
# What `beside_tracing` adds to a row, and what it is called.
TRACING = {
    "equal_count": "rays of equal MSE",
    "equal_seconds": "they take s",
    "equal_time": "traced MSE at equal time / this",
}
matplotlib.use("Agg")


def environment() -> dict[str, Any]:
    """Versions, device and cores: what a number has to be read with."""
    return {
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": jax.devices()[0].device_kind,
        "devices": len(jax.devices()),
        "processor": processor_name(),
        "cores": available_cores(),
    }


def processor_name() -> str:
    """The processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [
        line.split(":")[1].strip() for line in lines if line.startswith("model name")
    ]
    return names[0] if names else platform.processor()


def peak_memory_gib() -> float:
    """Largest resident memory of this process and of any of its children so far."""
    unit = 2**30 if platform.system() == "Darwin" else 2**20
    usage = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(who).ru_maxrss for who in usage) / unit


def write_results(folder: Path, metrics: Mapping[str, Any], report: str) -> None:
    """Write metrics.json and report.md into the folder, making it if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(metrics, indent=1, default=_plain) + "\n"
    for name, content in zip(RESULTS, (text, report), strict=True):
        with writing(folder / name) as new:
            new.write_text(content)


def steps_taken(metrics: Mapping[str, Any]) -> str:
    """How long a run trained, from which weights if not from new ones, and its seed."""
    options = metrics["options"]
    begun = options["start"]
    trained_on = "" if begun is None else f" on the weights of {begun}"
    clouds = f"{metrics['steps']} steps of {options['batch']} clouds"
    return f"{clouds}{trained_on}, seed {options['seed']}"


def _plain(value: Any) -> Any:
    """NumPy and JAX numbers as JSON numbers, paths as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown; floats to four significant digits."""
    lines = [header, ["---"] * len(header), *rows]
    return (
        "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines) + "\n"
    )


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def table_of(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """A table of some columns of result rows: {key: heading}; a dash where missing."""
    cells = [[row.get(key, "-") for key in columns] for row in rows]
    return markdown_table(list(columns.values()), cells)


def unseen_sets(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The errors pooled over every set of unseen clouds, and over parts of them."""
    return [
        {"set": name, **found}
        for name, found in metrics.items()
        if name.startswith("unseen") and not name.endswith(", each")
    ]


def unseen_clouds(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The errors of every unseen cloud."""
    each = (rows for name, rows in metrics.items() if name.endswith(", each"))
    return [row for rows in each for row in rows]


def beside_tracing(
    rows: Sequence[Mapping[str, Any]], count: str
) -> list[Mapping[str, Any]]:
    """Rows, with what tracing comes to beside each that is not traced: `TRACING`.

    Traced rows, two at least, are those with the key `count`.
    """
    traced = [(r[count], r["mse_2d"], r["seconds"]) for r in rows if count in r]
    if len(traced) < 2 or not min(traced)[1] > 0:
        return list(rows)

    def beside(row: Mapping[str, Any]) -> Mapping[str, Any]:
        if count in row or "denoised" in row or not row["mse_2d"] > 0:
            return row
        found = equal_tracing(row["mse_2d"], row["seconds"], traced)
        return {**row, **dict(zip(TRACING, found, strict=True))}

    return [beside(row) for row in rows]


def draw_curve(path: Path, losses: Float[np.ndarray, "S"], floor: float) -> None:
    """The training loss of every step, its running median, and the ray noise in it."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(losses, linewidth=0.4, alpha=0.4, color="tab:blue", label="step")
    width = max(len(losses) // 60, 1)
    blocks = losses[: len(losses) // width * width].reshape(-1, width)
    middle = (np.arange(len(blocks)) + 0.5) * width
    axes.plot(
        middle, np.median(blocks, axis=1), color="tab:blue", label="running median"
    )
    axes.axhline(floor, color="gray", linestyle=":", label="ray noise")
    axes.set(xlabel="step", ylabel="MSE", yscale="log")
    axes.legend()
    figure.savefig(path, dpi=120)


def draw_views(path: Path, views: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> None:
    """Rows of (title, reference, prediction): both, and their difference."""
    figure = Figure(figsize=(9.3, 3.1 * len(views)), layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(views), 3, squeeze=False))
    for row, (title, reference, prediction) in zip(grid, views, strict=True):
        panels = (reference, prediction, prediction - reference)
        names = (f"{title}: reference", "network", "difference (red: too open)")
        for axes, panel, name in zip(row, panels, names, strict=True):
            signed = panel is panels[2]
            low, high = (-0.3, 0.3) if signed else (0.0, 1.0)
            axes.imshow(panel, cmap="RdBu_r" if signed else "gray", vmin=low, vmax=high)
            axes.set_title(name, fontsize=8)
            axes.axis("off")
    figure.savefig(path, dpi=165)


def draw_color_views(
    path: Path,
    views: Sequence[tuple[str, Sequence[np.ndarray]]],
) -> None:
    """Rows of a title and panels: reference, prediction, transport of both if any."""
    wide = len(views[0][1])
    figure = Figure(figsize=(3.1 * wide, 3.1 * len(views)), layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(views), wide, squeeze=False))
    names = ("reference", "network", "transported light alone", "network, alone")
    for row, (title, panels) in zip(grid, views, strict=True):
        for number, (axes, panel) in enumerate(zip(row, panels, strict=True)):
            reference = panels[number // 2 * 2]
            axes.imshow(tone_map(panel, reference, foreground(reference)))
            axes.set_title(f"{title}: {names[number]}" if not number else names[number])
            axes.title.set_fontsize(8)
            axes.axis("off")
    figure.savefig(path, dpi=90)


def draw_strip(
    path: Path, rows: Mapping[str, Float[np.ndarray, "T H W *C"]], most: int = 6
) -> None:
    """A row of frames for every title, at most so many of them, evenly spread."""
    frames = len(next(iter(rows.values())))
    picks = np.linspace(0, frames - 1, min(frames, most)).astype(int)
    size = (1.8 * len(picks), 1.9 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(rows), len(picks), squeeze=False))
    for line, (title, images) in zip(grid, rows.items(), strict=True):
        for axes, pick in zip(line, picks, strict=True):
            axes.imshow(images[pick], cmap="gray", vmin=0, vmax=1)
            axes.axis("off")
        line[0].set_title(title, fontsize=8, loc="left")
    figure.savefig(path, dpi=110)


def draw_error_against_time(
    path: Path,
    groups: Mapping[str, Sequence[Mapping[str, Any]]],
    styles: Mapping[str, tuple[str, str]] | None = None,
) -> None:
    """2D error against time, log-log: a group in its color and format of `styles` or
    that of its turn, a labelled dot a method."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes, dots = figure.add_subplot(), list[tuple[str, float, float]]()
    for turn, (name, rows) in enumerate(groups.items()):
        ordered = sorted(rows, key=lambda row: row["seconds"])
        seconds = [1e3 * row["seconds"] for row in ordered]
        errors = [max(row["mse_2d"], 1e-7) for row in ordered]
        color, style = (styles or {}).get(name) or (f"C{turn}", "o-")
        axes.plot(seconds, errors, style, color=color, label=name)
        dots += zip([row["method"] for row in ordered], seconds, errors, strict=True)
    axes.margins(0.09)
    axes.set(xlabel="ms per image", ylabel="2D MSE", xscale="log", yscale="log")
    axes.xaxis.set(
        major_locator=LogLocator(subs=(1, 2, 5)),
        major_formatter="{x:g}",
        minor_formatter=NullFormatter(),
    )
    axes.grid(alpha=0.3)
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    label_dots(axes, dots)
    figure.savefig(path, dpi=140)


def label_dots(axes: Axes, dots: Sequence[tuple[str, float, float]]) -> None:
    """Name every dot, clear of the others."""
    figure: Any = axes.figure
    names = [axes.text(x, y, name, fontsize=7) for name, x, y in dots]
    places = [dot[1] for dot in dots], [dot[2] for dot in dots]
    figure.draw_without_rendering()  # places are known once the layout is
    line = {"arrowstyle": "-", "lw": 0.4}
    adjust_text(names, *places, ax=axes, expand=(1.15, 1.3), arrowprops=line)
