"""What public functions ask of their arguments, once, at the door.

Each raises `InputError` for anything else; those of one argument, and of points with
normals, return it, in the type to go on with.
"""

from typing import Any

import numpy as np

from ginn_jax.errors import InputError

LARGEST_SEED = 2**32 - 1
LARGEST_INDEX = 2**31 - 1
MOST_PIXELS = 2**28  # of an image, one that is read or one to be made
LARGEST = float(np.finfo(np.float32).max)
# Squares of lengths from 1 / FAR to FAR are normal numbers in float32.
FAR = 1e18


def real_array(name: str, value: Any) -> np.ndarray:
    """An array of real numbers in its own type and shape, which need not be finite."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{name} has rows of unequal length: give an array") from None
    if not np.can_cast(array.dtype, np.float64, "same_kind"):
        raise InputError(f"{name} holds {array.dtype}: give real numbers, as float32")
    return array


def wide_array(name: str, value: Any) -> np.ndarray:
    """Real numbers, in float64 where squares and bounds do not fit their own type."""
    array = real_array(name, value)
    fits = array.dtype.kind == "f" and array.dtype.itemsize >= 4
    return array if fits else array.astype(np.float64)


def whole(name: str, value: Any, least: int, most: int) -> int:
    """A whole number from `least` to `most`."""
    if not (isinstance(value, int | np.integer) and least <= value <= most):
        raise InputError(
            f"{name} {value} must be from {least} to {most}, a whole number"
        )
    return int(value)


def number(name: str, value: Any, least: float, most: float = LARGEST) -> float:
    """A number from `least` to `most`."""
    array = real_array(name, value)
    if array.ndim or not least <= array <= most:
        raise InputError(f"{name} {value} must be a number from {least:g} to {most:g}")
    return float(array)


def positive(name: str, value: Any, most: float = LARGEST) -> float:
    """A number above 0, at most `most`."""
    array = real_array(name, value)
    if array.ndim or not 0 < array <= most:
        raise InputError(
            f"{name} {value} must be positive and finite: give one up to {most:g}"
        )
    return float(array)


def one_of(name: str, value: Any, known: tuple[str, ...]) -> None:
    """One of the words that are known."""
    if value not in known:
        raise InputError(f"{name} is {value!r}: give one of {', '.join(known) or '-'}")


def vector(name: str, value: Any) -> np.ndarray:
    """Three numbers that are finite in float32."""
    array = wide_array(name, value)
    if array.shape != (3,) or not np.all(np.abs(array) <= LARGEST):
        raise InputError(f"{name} {value} must be three finite numbers, as float32")
    return array


def unit_rows(
    points: Any, normals: Any, what: str = "points"
) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals that belong together, all [N, 3] and finite; float32."""
    points, normals = wide_array(what, points), wide_array("normals", normals)
    if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
        raise InputError(
            f"{what} {points.shape} and normals {normals.shape} must both be [N, 3]"
        )
    if not np.all(np.abs(points) <= LARGEST):
        raise InputError(f"{what} holds non-finite numbers: drop those rows")
    if not np.all(np.abs(np.einsum("ij,ij->i", normals, normals) - 1) < 2e-3):
        raise InputError(
            "normals are non-finite or not of unit length: divide them by their length"
        )
    return points.astype(np.float32, copy=False), normals.astype(np.float32, copy=False)


def within_reach(what: str, points: Any) -> None:
    """Points no coordinate of which is so large that its square is not finite."""
    if np.abs(points).max(initial=0.0) > FAR:
        raise InputError(f"{what} holds coordinates beyond {FAR:g}: scale them down")


def numbers_of(
    name: str, value: Any, width: int, rows: int, least: float = -LARGEST
) -> None:
    """So many finite numbers for each of these points, in channels; None for none."""
    if width == 0 and value is not None:
        raise InputError(f"the network takes no {name}: leave it out")
    array = wide_array(name, () if value is None else value)
    shape = array.shape
    if width and (len(shape) != 3 or shape[1:] != (rows, width) or not shape[0]):
        raise InputError(f"{name} is {shape}, the network takes [C {rows} {width}]")
    if not np.all(np.abs(array) <= LARGEST):
        raise InputError(f"{name} holds non-finite numbers: remove those points")
    if not np.all(array >= least):
        raise InputError(f"{name} holds numbers below {least:g}: remove those points")


def channels_alike(*arrays: Any) -> None:
    """As many channels in everything that has some."""
    counts = sorted({np.shape(a)[0] for a in arrays if a is not None})
    if len(counts) > 1:
        raise InputError(
            f"light, material and codes have {counts} channels: give all the same"
        )
