"""Figures of a comparison of methods: error against run time, pictures with insets."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ginn_jax import report
from ginn_jax.compare_networks import OTHER, OURS
from ginn_jax.compare_report import pareto_front
from ginn_jax.evaluate import Row
from ginn_jax.metrics import foreground, tone_map

# The same in every figure; no line where a group's methods are not of one kind.
STYLES = {
    "ours": ("tab:blue", "o-"),
    "ours, fewer samples": ("tab:orange", "o-"),
    "ours, fewer pixels": ("tab:green", "o-"),
    "ours, mean of draws": ("tab:red", "o"),
    "ours, codes kept": ("tab:purple", "o-"),
    "ours, samples and light counted": ("tab:brown", "o-"),
    "other runs": ("tab:cyan", "s"),
    "ablations": ("tab:pink", "s"),
    "screen space": ("tab:olive", "s"),
    "traced": ("tab:gray", "^-"),
    "traced and denoised": ("black", "^-"),
    "traced and denoised fast": ("black", "v--"),
}


def draw_front(path: Path, rows: list[Row], counted: Sequence[Row]) -> None:
    """Error against run time, one line a kind of method; of those with samples and
    light `counted`, the ones that no other of them beats."""
    mine = [r for r in rows if r["method"].startswith(OURS)]
    fresh = [r for r in mine if "kept" not in r]
    fewer = [r for r in fresh if "samples" in r["method"]]
    rates = [r for r in fresh if "scale" in r["method"] and r not in fewer]
    means = [r for r in fresh if "mean" in r["method"]]
    best = pareto_front(counted)
    denoised = [r for r in rows if "denoised" in r]
    quick = [r for r in denoised if r["method"].endswith("fast")]
    groups = {
        OURS: [r for r in fresh if r not in fewer + rates + means],
        f"{OURS}, fewer samples": fewer,
        f"{OURS}, fewer pixels": rates,
        f"{OURS}, mean of draws": means,
        f"{OURS}, codes kept": [r for r in mine if "kept" in r],
        f"{OURS}, samples and light counted": [
            r for r in counted if r["method"] in best
        ],
        "other runs": [r for r in rows if r["method"].startswith(OTHER)],
        "ablations": [r for r in rows if r["method"] in ("2D only", "3D only")],
        "screen space": [
            r for r in rows if r["method"] in ("screen space", "visibility bitmask")
        ],
        "traced": [r for r in rows if "traced" in r],
        "traced and denoised": [r for r in denoised if r not in quick],
        "traced and denoised fast": quick,
    }
    kept = {n: [_short(r) for r in group] for n, group in groups.items() if group}
    report.draw_error_against_time(path, kept, STYLES)


def _short(row: Row) -> Row:
    """A row whose label leaves out what its line in the figure says."""
    name = row["method"].removesuffix(" fast").removesuffix(", denoised")
    name = name.removesuffix(", codes kept")
    name = name.removeprefix(f"{OURS}, ").removeprefix(OTHER)
    name = name.replace(" of samples, scale", " at").replace(" of samples", "")
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
