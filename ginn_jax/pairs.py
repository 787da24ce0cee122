"""Pairs that a search on the host found: which are near enough, all in order."""

from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# So rarely is a pair to be left out that copying what lies between them is faster.
FEW = 1000


class Pairs(NamedTuple):
    """Pairs of some queries, sorted by query; which of them float32 cannot decide."""

    query: Int[np.ndarray, "E"]
    point: Int[np.ndarray, "E"]
    doubtful: Bool[np.ndarray, "E"]


def decide(
    pairs: Pairs,
    points: Float[np.ndarray, "N 3"],
    queries: Float[np.ndarray, "M 3"],
    radius: float,
) -> tuple[Pairs, Int[np.ndarray, "K"]]:
    """The pairs and which of them float64 finds to be as far apart as the radius.

    Where those are many they are left out here, not by `join`.
    """
    doubtful = np.flatnonzero(pairs.doubtful)
    offset = points[pairs.point[doubtful]] - queries[pairs.query[doubtful]]
    wrong = doubtful[np.sum(offset**2, axis=-1) >= radius**2]
    if len(wrong) * FEW <= len(pairs.query):
        return pairs, wrong
    return Pairs(*(np.delete(column, wrong) for column in pairs)), wrong[:0]


def join(
    parts: list[tuple[Pairs, Int[np.ndarray, "K"]]], pool: ThreadPoolExecutor
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """Query and point of all pairs but the wrong ones of every part.

    Copied once and on all cores: fresh memory is slow.
    """
    sizes = (len(pairs.query) - len(wrong) for pairs, wrong in parts)
    *places, total = accumulate(sizes, initial=0)
    query, point = (np.empty(total, np.int32) for _ in range(2))

    def put(part: tuple[Pairs, Int[np.ndarray, "K"]], place: int) -> None:
        pairs, wrong = part
        ends = [*wrong.tolist(), len(pairs.query)]
        for start, end in zip([0, *(wrong + 1).tolist()], ends, strict=True):
            run = slice(place, place + end - start)
            query[run], point[run] = pairs.query[start:end], pairs.point[start:end]
            place += end - start

    list(pool.map(put, parts, places))
    return query, point


def in_order(
    query: Int[np.ndarray, "E"],
    point: Int[np.ndarray, "E"],
    order: Int[np.ndarray, "M"],
) -> tuple[Int[np.ndarray, "E"], Int[np.ndarray, "E"]]:
    """Pairs of queries that were taken in an order, sorted by what they were before."""
    count = np.bincount(query, minlength=len(order))
    place = np.empty_like(order)
    place[order] = np.arange(len(order), dtype=order.dtype)
    own = count[place]
    ends, before = np.cumsum(own), np.cumsum(count)
    shift = np.repeat((before - count)[place] - (ends - own), own)
    rows = np.arange(len(query)) + shift
    return np.repeat(np.arange(len(order), dtype=np.int32), own), point[rows]
