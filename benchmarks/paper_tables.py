"""The paper's tables next to ours, from what `experiments.evaluate` measured.

    python -m benchmarks.paper_tables --evaluations runs

reads evaluate_ao, evaluate_gi and evaluate_sss in that folder. Units of the errors are
not the paper's, so each method is set against screen space in the same table.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from ginn_jax import report
from ginn_jax.commandline import start
from ginn_jax.errors import InputError
from ginn_jax.run_record import damaged

EFFECTS = ("ao", "gi", "sss")
METHODS = ("screen space", "2D only", "3D only", "ours")
# Tables "Results" (3D MSE, 2D MSE, 2D DSSIM) and "Timing" (ms at 1024 x 1024 on a GTX
# 1080) of the paper.
PAPER_RESULTS: dict[str, dict[str, tuple[float | None, float, float]]] = {
    "ao": {
        "screen space": (None, 0.24, 0.013),
        "2D only": (0.086, 0.25, 0.015),
        "3D only": (0.073, 0.21, 0.014),
        "ours": (0.073, 0.16, 0.012),
    },
    "gi": {
        "screen space": (None, 0.11, 0.041),
        "2D only": (0.062, 0.15, 0.043),
        "3D only": (0.047, 0.12, 0.043),
        "ours": (0.047, 0.12, 0.042),
    },
    "sss": {
        "screen space": (None, 0.49, 0.034),
        "2D only": (0.0215, 0.43, 0.018),
        "3D only": (0.0164, 0.29, 0.013),
        "ours": (0.0164, 0.19, 0.017),
    },
}
PAPER_MS = {
    "ao": {"screen space": 1.8, "2D only": 26.5, "3D only": 71.8, "ours": 43.3},
    "gi": {"screen space": 65.0, "2D only": 41.7, "3D only": 121.9, "ours": 107.6},
    "sss": {"screen space": 31.0, "2D only": 49.6, "3D only": 104.0, "ours": 105.6},
}
CELLS = ("mse_3d", "mse_2d", "dssim_2d")


@dataclass(frozen=True)
class Options:
    """Set the paper's tables next to ours."""

    evaluations: Path = Path("runs")
    """Folder with evaluate_ao, evaluate_gi and evaluate_sss."""
    out: Path = Path("runs/paper_tables")
    """Folder for metrics.json and report.md."""


def main(options: Options) -> dict[str, Any]:
    """Write the tables; returns what metrics.json holds."""
    found = {effect: load(options.evaluations, effect) for effect in EFFECTS}
    metrics: dict[str, Any] = {"rows": []}
    metrics |= {name: {} for name in ("lost_cells", "resolution", "processor")}
    for effect, measured in found.items():
        with damaged(measured_at(options.evaluations, effect), "evaluate again"):
            metrics["rows"] += [row_of(effect, name, measured) for name in METHODS]
            metrics["lost_cells"][effect] = measured["lost_cells"]
            metrics["resolution"][effect] = measured["options"]["resolution"]
            metrics["processor"][effect] = measured["environment"]["processor"]
    report.write_results(options.out, metrics, write_report(metrics))
    Console().print(f"{options.out / 'report.md'}")
    return metrics


def measured_at(folder: Path, effect: str) -> Path:
    """Where what was measured of an effect is."""
    return folder / f"evaluate_{effect}" / "metrics.json"


def load(folder: Path, effect: str) -> dict[str, Any]:
    """What was measured of an effect."""
    path = measured_at(folder, effect)
    again = (
        f"run python -m experiments.evaluate --effect {effect} --out {path.parent} "
        "first"
    )
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        raise InputError(f"{path} cannot be read: {again}") from None
    with damaged(path, again):
        other = found["options"]["effect"]
    if other != effect:
        raise InputError(f"{path} is of another effect: {again}")
    return found


def row_of(effect: str, method: str, measured: dict[str, Any]) -> dict[str, Any]:
    """One method of one effect: ours and the paper's, each over its screen space."""
    rows = {row["method"]: row for row in measured["results"]}
    mine, screen = rows[method], rows["screen space"]
    theirs, their_screen = (PAPER_RESULTS[effect][m] for m in (method, "screen space"))
    row: dict[str, Any] = {"effect": effect.upper(), "method": method}
    for place, cell in enumerate(CELLS):
        row[cell] = mine.get(cell)
        row[f"paper_{cell}"] = theirs[place]
    for cell, place in (("mse_2d", 1), ("dssim_2d", 2)):
        row[f"{cell}_ratio"] = mine[cell] / screen[cell]
        paper = theirs[place], their_screen[place]
        assert None not in paper
        row[f"paper_{cell}_ratio"] = paper[0] / paper[1]  # type: ignore[operator]
    row["ms"] = 1e3 * mine["seconds"]
    row["memory_mib"] = mine.get("memory_mib")
    row["paper_ms"] = PAPER_MS[effect][method]
    return {key: value for key, value in row.items() if value is not None}


def processors(measured: dict[str, str]) -> str:
    """What each effect was measured on, once where all were on the same."""
    if len(names := set(measured.values())) == 1:
        return names.pop()
    return ", ".join(f"{e.upper()} on {name}" for e, name in measured.items())


def write_report(m: dict[str, Any]) -> str:
    """report.md: results, timing, lost cells."""
    heads = {"effect": "effect", "method": "method", "mse_3d": "3D MSE"}
    heads |= {"paper_mse_3d": "paper's", "mse_2d": "2D MSE", "paper_mse_2d": "paper's"}
    heads |= {"mse_2d_ratio": "over SS", "paper_mse_2d_ratio": "paper's over SS"}
    heads |= {"dssim_2d": "DSSIM", "paper_dssim_2d": "paper's"}
    times = {"effect": "effect", "method": "method", "ms": "ms"}
    times |= {"memory_mib": "memory MiB", "paper_ms": "paper's ms, GTX 1080"}
    lost = [
        f"{e.upper()} {cell}" for e, cells in m["lost_cells"].items() for cell in cells
    ]
    sizes = ", ".join(f"{e.upper()} {n}" for e, n in m["resolution"].items())
    return f"""# The paper's tables next to ours

Ours: {processors(m["processor"])}, images of {sizes} pixels a side; the
paper's: 1024 pixels a side on a GTX 1080. Scenes and units of errors differ, so only
ratios within a table compare ("over SS": over screen space of the same table). Reports
of the single effects say how ours were measured.

## Results

{report.table_of(m["rows"], heads)}
Cells that our network loses: {"; ".join(lost) or "none"}. The paper's lost GI 2D MSE
and DSSIM to screen space, and SSS DSSIM to 3D only.

## Timing

{report.table_of(m["rows"], times)}"""


if __name__ == "__main__":
    start(Options, main, {}, __doc__)
