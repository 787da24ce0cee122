"""What an animation leaves behind: flicker, the strip, the moving image, report.md."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ginn_jax import compare_figures, report, sequences
from ginn_jax.metrics import tone_map

KNOWN = "reference", "variance", "mask", "albedo"
RIVAL = "screen space"
Rows = list[dict[str, Any]]


def flicker_rows(frames: dict[str, np.ndarray]) -> Rows:
    """Flicker and error of every method, in units of the reference's squared mean."""
    reference, variance, mask, _ = (frames[name] for name in KNOWN)
    unit = float(np.mean(reference[mask].astype(np.float64)) ** 2)
    rows = []
    for name in (name for name in frames if name not in KNOWN):
        images = frames[name]
        error = (images.astype(np.float64) - reference) ** 2 - variance
        change = sequences.flicker(images, reference, variance, mask)
        error = float(error[mask].mean()) / unit
        rows.append({"method": name, "flicker": change / unit, "mse_2d": error})
    return beside_rival(rows)


def beside_rival(rows: Rows) -> Rows:
    """Rows with the share of screen space's flicker that each method has."""
    rival = next(row["flicker"] for row in rows if row["method"] == RIVAL)
    return [row | {"share": row["flicker"] / rival} for row in rows]


def pooled(found: list[Rows]) -> Rows:
    """Means over the sequences of what each method has."""
    methods = [row["method"] for row in found[0]]
    rows = []
    for number, name in enumerate(methods):
        of_method = [rows[number] for rows in found]
        means = {
            key: float(np.mean([row[key] for row in of_method]))
            for key in ("flicker", "mse_2d")
        }
        rows.append({"method": name} | means)
    return beside_rival(rows)


def draw_frames(out: Path, frames: dict[str, np.ndarray]) -> None:
    """strip.png, a row a method; animation.gif, all methods side by side."""
    out.mkdir(parents=True, exist_ok=True)
    albedo = frames["albedo"]
    names = [name for name in frames if name not in KNOWN] + ["reference"]
    seen = {name: frames[name] * albedo for name in names}
    reference = seen["reference"]
    whole = reference.reshape(-1, *reference.shape[2:])
    foreground = compare_figures.foreground(whole)

    def shown(images: np.ndarray) -> np.ndarray:
        flat = images.reshape(whole.shape)
        return tone_map(flat, whole, foreground).reshape(images.shape)

    mapped = {name: shown(images) for name, images in seen.items()}
    report.draw_strip(out / "strip.png", mapped)
    side_by_side = np.concatenate(list(mapped.values()), axis=2)
    moving = [Image.fromarray((255 * f).astype(np.uint8)) for f in side_by_side]
    moving[0].save(
        out / "animation.gif", save_all=True, append_images=moving[1:], duration=60
    )


def write_report(m: dict[str, Any]) -> str:
    """report.md of an animation."""
    options, env, found = m["options"], m["environment"], m["sequences"]
    columns = {"method": "method", "flicker": "flicker"}
    columns |= {"share": f"of {RIVAL}'s", "mse_2d": "2D MSE"}
    several = len(found) > 1
    return f"""# Animation, {options["effect"]}

`{m["command"]}`

{", ".join(f"{name} ({m['frames'][name]} frames)" for name in found)} at
{options["resolution"]} x {options["resolution"]}, reference of {options["reference"]}
rays or paths a pixel. Networks are given {m["samples"]} samples of a frame.
{env["processor"]}, {env["cores"]} cores.

Flicker is the mean squared change from frame to frame that the reference does not have,
over pixels seen in both; error and flicker are in units of the squared mean of the
reference, its noise subtracted. Samples of the object move with their faces, and levels
keep those that they kept; "frame by frame" they do not, though lots stay the same.

{report.table_of(m["flicker"], columns)}
{_table_of_sequences(found) if several else ""}
{"".join(_pictures(name if several else "") for name in found)}"""


def _table_of_sequences(found: dict[str, Rows]) -> str:
    """The flicker of each sequence, and in brackets its share of screen space's."""
    rows = []
    for number, first in enumerate(next(iter(found.values()))):
        of_method = (of_sequence[number] for of_sequence in found.values())
        cells = (f"{row['flicker']:.4g} ({row['share']:.3f})" for row in of_method)
        rows.append([first["method"], *cells])
    table = report.markdown_table(["method", *found], rows)
    return f"Of each sequence (the table above: their means):\n\n{table}"


def _pictures(folder: str) -> str:
    """The strip and the moving image; of several sequences only what moves."""
    if folder:
        return f"![{folder}]({folder}/animation.gif)\n\n"
    return "![frames](strip.png)\n\n![moving](animation.gif)\n"
