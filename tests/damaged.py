"""Files that cannot be used: how to make them, and the one way they are refused.

Nothing may be written, and nothing that was there may change.
"""

import resource
from typing import Any, NamedTuple

import numpy as np
import pytest
import trimesh

from ginn_jax.errors import InputError

GIGABYTE = 1 << 30
NOISE = np.random.default_rng(0).bytes(3000)
BOX = trimesh.creation.box()
PLY = BOX.export(file_type="ply", encoding="binary")


class Row(NamedTuple):
    """What is wrong, how to make it, what is called with it, what is said."""

    name: str
    make: Any
    call: Any
    message: str


def holds(content, name="bad"):
    """A file of these bytes."""

    def make(folder):
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def zeros(name):
    """A gigabyte of nothing."""

    def make(folder):
        with open(folder / name, "wb") as file:
            file.truncate(GIGABYTE)
        return folder / name

    return make


def directory(name):
    def make(folder):
        (folder / name).mkdir()
        return folder / name

    return make


def missing(name):
    return lambda folder: folder / name


def contents(folder):
    """Every path below a folder, and how large it is."""
    return {str(p): p.stat().st_size for p in folder.rglob("*") if not p.is_dir()}


def refused(call, folder, message):
    """The one line that a call ends in, having left the folder as it was."""
    before = contents(folder)
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert str(caught.value).isprintable()
    assert contents(folder) == before
    return str(caught.value)


def each_row(rows):
    """A test of every row."""
    return pytest.mark.parametrize("row", rows, ids=lambda row: row.name)


def assert_refused(row, folder):
    """In one line that names the file and the mend, and taking no memory for it."""
    path = row.make(folder)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    said = refused(lambda: row.call(path), folder, row.message)
    assert "".join(c if c.isprintable() else " " for c in str(path)) in said
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert grown * 1024 < GIGABYTE / 2
