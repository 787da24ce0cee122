"""What `benchmarks.poisson_radii` says and draws, beside the paper's table."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ginn_jax import report

# The paper's table TimingPD, AO rows: object, radius -> thousands of points, ms.
PAPER = {
    ("Elephant", 0.01): (8.6, 203.6),
    ("Elephant", 0.015): (4.1, 66.1),
    ("Elephant", 0.02): (2.3, 34.6),
    ("Horse", 0.01): (3.5, 35.7),
    ("Horse", 0.015): (1.7, 20.5),
    ("Horse", 0.02): (0.9, 15.9),
}

ERRORS = {"mse_3d": "3D MSE", "mse_2d": "2D MSE", "dssim_2d": "DSSIM"}


def write_report(metrics: dict[str, Any]) -> str:
    """report.md: our table beside the paper's."""
    columns = {"object": "object", "radius": "radius", "points": "points"}
    columns |= {"ms_f_3D": "f_3D ms", "ms_f_2D": "f_2D ms", "pixels": "pixels"}
    columns |= ERRORS if metrics["trained"] else {}
    ours = report.table_of(metrics["rows"], columns)
    heads = ["object", "radius", "points (k)", "ms"]
    paper, options = report.markdown_table(heads, metrics["paper"]), metrics["options"]
    levels = ", ".join(map(str, metrics["network"]["levels"][1:]))
    weights = f"Weights: {options['run']}."
    if not metrics["trained"]:
        weights = "**Untrained weights: times hold, errors would mean nothing.**"
    return f"""# Poisson disk radius at test time, ambient occlusion

{weights}

- levels: the radius below, then {levels}; f_2D radius
  {metrics["network"]["query"]["radius"]}
- occlusion radius: {metrics["occlusion_radius"]}
- {options["points"]} samples of an object before the disk; image
  {options["resolution"]} x {options["resolution"]}, `pixels` of it in the foreground
- times: median of {options["repeats"]} calls, search included, compilation and
  G-buffer apart
- errors: against Mitsuba at {options["rays"]} rays, whose noise is subtracted from the
  MSE; 3D at {metrics["asked"]} points that the network is not given; DSSIM tone-mapped
  as in the paper, over the foreground

{metrics["machine"]}

{ours}
The paper's table TimingPD: AO, the whole network, 1024 x 1024, NVIDIA GTX 1080:

{paper}
![time and error against radius](poisson_radii.png)
"""


def draw(path: Path, rows: list[dict[str, Any]], trained: bool) -> None:
    """Time and error against the radius: a colour for each object."""
    panels = {"ms": ("ms_f_3D", "ms_f_2D")}
    panels |= {"MSE": ("mse_3d", "mse_2d"), "DSSIM": ("dssim_2d",)} if trained else {}
    figure = Figure(figsize=(5 * len(panels), 4), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    objects = list(dict.fromkeys(row["object"] for row in rows))
    for axes, (unit, keys) in zip(grid, panels.items(), strict=True):
        for i, name in enumerate(objects):
            own = [row for row in rows if row["object"] == name]
            radii = [row["radius"] for row in own]
            for key, style in zip(keys, ("-o", "--s"), strict=False):
                values = [row[key] for row in own]
                axes.plot(radii, values, style, color=f"C{i}", label=f"{name}, {key}")
        axes.set(xlabel="Poisson disk radius", ylabel=unit)
    for name, style in (("Elephant", ":^"), ("Horse", ":v")):
        ends = [(r, ms) for (who, r), (_, ms) in PAPER.items() if who == name]
        title = f"paper, {name}, GTX 1080"
        grid[0].plot(*zip(*ends, strict=True), style, color="gray", label=title)
    for axes in grid:
        axes.set_ylim(0, None)
        axes.legend(fontsize=6)
    figure.savefig(path, dpi=130)
