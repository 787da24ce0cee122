"""How far float32 is from float64, stage by stage, on stiff and extreme cases.

    python -m benchmarks.stability

Search and Poisson disk are compared with brute force in NumPy; densities, convolution,
f_3D, f_2D, shading and a training step with themselves in float64, on the same points
and the same random numbers. What the ray tracer makes is compared with closed forms.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.stability_cases import all_cases
from benchmarks.stability_network import network_rows, train_row
from benchmarks.stability_rays import ray_rows
from benchmarks.stability_stages import (
    Row,
    disk_row,
    large_rows,
    layer_rows,
    search_row,
)
from benchmarks.timing import circumstances, describe
from ginn_jax import report
from ginn_jax.commandline import require, start

GOOD = 1e-4
LIT = ("light", "albedo", "one sun", "one channel")


@dataclass(frozen=True)
class Options:
    """Measure the error of float32 on stiff and extreme cases."""

    out: Path = Path("runs/stability")
    """Folder for metrics.json and report.md."""
    points: int = 1_000_000
    """Points of the large cloud that is searched and thinned; 0 for none."""
    quick: bool = False
    """A few cases: to try things, not for numbers."""


QUICK = {"points": 0}


def main(options: Options) -> dict[str, Any]:
    """Run every case through every stage; returns what metrics.json holds."""
    require(options, {"points": 0})
    begin, rows = time.perf_counter(), []
    for case in all_cases(options.quick):
        if not case.name.startswith(LIT):
            rows += [search_row(case), disk_row(case), *layer_rows(case)]
        rows += network_rows(case)
        # Clouds to train on have the size that they have; a step need not be scaled.
        rows += [train_row(case)] if case.scale == 1 else []
        print(f"{case.name}: {time.perf_counter() - begin:.0f} s", flush=True)
    rows += ray_rows(options.quick)
    rows += large_rows(options.points) if options.points else []
    metrics = {"rows": rows} | circumstances(options, begin)
    text = write_report(rows)
    report.write_results(options.out, metrics, text)
    print(text)
    return metrics


def write_report(rows: list[Row]) -> str:
    """report.md: where the error stays small, where it does not, and every number."""
    measured = [r for r in rows if "error" in r]
    stages = list(dict.fromkeys(r["stage"] for r in measured))
    computed = [s for s in stages if s not in ("indirect light", "subsurface")]
    summary = []
    for stage in stages:
        mine = [r for r in measured if r["stage"] == stage]
        good = [r for r in mine if r["error"] < GOOD and not r["bad"]]
        largest: Any = max((r["error"] for r in good), default="-")
        summary.append([stage, len(mine), len(good), largest])
    outside = [
        r
        for r in measured
        if r["stage"] in computed and (r["error"] >= GOOD or r["bad"])
    ]
    columns = {
        "stage": "stage",
        "case": "case",
        "error": "relative error",
        "bad": "non-finite",
        "ms": "ms",
        "note": "note",
    }
    return f"""# Stiff and extreme cases

{describe()}

Largest difference of float32 from float64 on the same points, relative to the largest
number there; for search and Poisson disk the share of pairs or points that differ from
brute force; for what the ray tracer makes the error of the mean against a closed form,
with the noise to expect. The network has two levels of radius .0625 and .1875; clouds
have 1,000 points. Times are of a second call on a machine that may have been busy.

What is outside: a point on a cell face may lie at exactly a radius from others, and
once it is turned, rounding decides which are closer. Float32 at 1e6, where its step is
.06, is probably such a lattice too. Light below 1.2e-38 is none: devices flush such
numbers. Errors of indirect light and subsurface are to be read beside their noise.

Where the error stays under {GOOD:g}:

{report.markdown_table(["stage", "cases", "below", "largest of these"], summary)}
Cases outside:

{report.table_of(outside, columns)}
Refused at the door, or not measured:

{report.table_of([r for r in rows if "error" not in r], columns)}
Everything:

{report.table_of(measured, columns)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)
