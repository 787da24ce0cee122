"""Mesh files as trimesh reads them: whole, or refused in one line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ginn_jax.errors import InputError
from ginn_jax.files import check_file


def load_scene(path: Path) -> trimesh.Scene:
    """All parts of a mesh file; raises `InputError` for one that cannot be read."""
    check_file(path, "the path of a mesh")
    with readable(path), np.errstate(all="ignore"):
        scene = trimesh.load_scene(path, process=False)
    if any(_cut_short(part.metadata) for part in scene.geometry.values()):
        raise InputError(f"{path}: cannot be read (cut short); export it anew")
    return scene


def merge(path: Path, scene: trimesh.Scene) -> Any:
    """All triangles of a scene as one mesh, or whatever else is in it."""
    with readable(path):
        return scene.to_mesh()


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Say of whatever fails inside that the file cannot be read."""
    try:
        yield
    except Exception as error:  # trimesh lets each reader raise what it likes
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        if "charset_normalizer" in reason:  # with which it would guess, were it there
            reason = "no triangles in it: neither binary nor UTF-8 text"
        if "unexpected length" in reason:
            reason += " Cut short, or triangles and larger polygons mixed"
        raise InputError(f"{path}: cannot be read ({reason}); export it anew") from None


def _cut_short(metadata: dict) -> bool:
    """Whether a text PLY ends before all of its rows, which trimesh lets pass."""
    elements = metadata.get("_ply_raw", {}).values()
    columns = [
        (len(np.atleast_1d(column)), element["length"])
        for element in elements
        if isinstance(element.get("data"), dict)
        for column in element["data"].values()
    ]
    return any(rows < promised for rows, promised in columns)
