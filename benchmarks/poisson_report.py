"""What `benchmarks.poisson_radii` says and draws, beside the paper's table."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ginn_jax import report

# The paper's table TimingPD: effect, object, radius -> thousands of points, ms.
PAPER = {
    ("AO", "Elephant", 0.01): (8.6, 203.6),
    ("AO", "Elephant", 0.015): (4.1, 66.1),
    ("AO", "Elephant", 0.02): (2.3, 34.6),
    ("AO", "Horse", 0.01): (3.5, 35.7),
    ("AO", "Horse", 0.015): (1.7, 20.5),
    ("AO", "Horse", 0.02): (0.9, 15.9),
    ("GI", "Elephant", 0.01): (13.2, 280.1),
    ("GI", "Elephant", 0.015): (6.4, 122.9),
    ("GI", "Elephant", 0.02): (3.7, 81.2),
    ("GI", "Horse", 0.01): (9.0, 184.5),
    ("GI", "Horse", 0.015): (4.4, 92.3),
    ("GI", "Horse", 0.02): (2.5, 61.4),
}


def write_report(metrics: dict[str, Any]) -> str:
    """report.md: our table beside the paper's."""
    columns = {"object": "object", "radius": "radius", "points": "points"}
    columns |= {"seconds_3d": "f_3D s", "seconds_2d": "f_2D s", "pixels": "pixels"}
    columns |= {"mse_3d": "3D MSE", "relative_mse_3d": "relative 3D"}
    columns |= {"mse_2d": "2D MSE", "relative_mse_2d": "relative 2D"}
    columns |= {"dssim_2d": "DSSIM"}
    ours, options = report.table_of(metrics["rows"], columns), metrics["options"]
    heads = ["effect", "object", "radius", "points (k)", "ms"]
    paper = report.markdown_table(heads, metrics["paper"])
    levels = ", ".join(map(str, metrics["levels"][1:]))
    weights = options["checkpoint"] or "those that come with the package"
    return f"""# Poisson disk radius at test time, effect {options["effect"]}

Weights: {weights}.

- levels: the radius below, then {levels}; f_2D radius
  {metrics["query_radius"]}; the network was trained at {metrics["levels"][0]}
- {metrics["samples"]} samples of an object, of which the network is given four fifths,
  before the disk; image {options["resolution"]} x {options["resolution"]}, `pixels` of
  it in the foreground
- times: median of {options["rounds"]} rounds in which all radii take turns, search
  included, compilation and G-buffer apart
- errors: against Mitsuba at {options["reference"]} rays or paths, whose noise is
  subtracted from the MSE; 3D at points that the network is not given; DSSIM tone-mapped
  as in the paper, over the foreground

{metrics["machine"]}

{ours}
The paper's table TimingPD: the whole network, 1024 x 1024, NVIDIA GTX 1080:

{paper}
![time and error against radius](poisson_radii.png)
"""


def draw(path: Path, rows: list[dict[str, Any]], effect: str) -> None:
    """Time and error against the radius: a colour for each object."""
    panels = {
        "s": ("seconds_3d", "seconds_2d"),
        "relative MSE": ("relative_mse_3d", "relative_mse_2d"),
        "DSSIM": ("dssim_2d",),
    }
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
        known = {
            r: s
            for (e, who, r), (_, s) in PAPER.items()
            if who == name and e == effect.upper()
        }
        if known:
            title = f"paper, {name}, GTX 1080"
            grid[0].plot(
                list(known),
                [s / 1e3 for s in known.values()],
                style,
                color="gray",
                label=title,
            )
    for axes in grid:
        axes.set_ylim(0, None)
        axes.legend(fontsize=6)
    figure.savefig(path, dpi=130)
