"""How much room the steps of a run are given: what most batches need, and what all do.

What a batch needs varies twofold and more, and a step takes the longer the larger its
capacities are. So a step is compiled twice: most batches run in limits that hold most,
the few others in limits that hold everything met so far.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ginn_jax.dataset import ShadedPoints, stack_clouds
from ginn_jax.limits import (
    SLACK,
    Limits,
    limits_for,
    measure_demands,
    measure_limits,
    suffices_for,
    widened,
)
from ginn_jax.lit_clouds import Cloud, channel_of
from ginn_jax.recipe import Training
from ginn_jax.searches import uniform_limits
from ginn_jax.train import batch_mesh, probe_step, share_key

# Batches that are probed before a run at the most.
PROBES = 300
# Some 4 % of batches of occlusion and 12 % of scattering need more than is usual.
USUAL_SHARE, USUAL_SLACK = 0.95, 1.1
# Room for the others is seldom taken and costs little; to raise it costs minutes.
MOST_SLACK = 1.5
# To compile a step once more takes as long as so many steps do.
WORTH_COMPILING = 500


@dataclass(frozen=True)
class Room:
    """Capacities that hold most batches, and such as hold all met so far."""

    usual: Limits
    most: Limits

    def each(self) -> tuple[Limits, ...]:
        """Those to try, in order."""
        return tuple(dict.fromkeys((self.usual, self.most)))


def training_room(config: Training, clouds: Sequence[Cloud]) -> Room:
    """Room by what random shares of a batch need, every cloud in one where it can be.

    A run of few steps has one size of room.
    """
    share = config.batch_size // batch_mesh(config.batch_size).size
    rng = np.random.default_rng(config.seed)
    probes = min(len(clouds), PROBES)
    rows = rng.integers(0, len(clouds), (probes, share))
    rows[:, 0] = rng.permutation(len(clouds))[:probes]

    def probe(limits: Limits, i: int) -> dict[str, Any]:
        batch = stack_clouds([channel_of(clouds[int(j)], 0) for j in rows[i]])
        return jax.device_get(probe_step(config, limits, batch, key=jax.random.key(i)))

    generous = uniform_limits(config.network, 16 * share * config.points)
    demands = measure_demands(generous, probe, probes)
    largest, usual = suffices_for(1.0, demands), suffices_for(USUAL_SHARE, demands)
    if config.steps < WORTH_COMPILING:
        one = limits_for(largest, SLACK)
        return Room(one, one)
    return Room(limits_for(usual, USUAL_SLACK), limits_for(largest, MOST_SLACK))


def with_more(
    room: Room, config: Training, batch: ShadedPoints, step: int, short: dict[str, int]
) -> Room:
    """Room for the batch of a step as well, of which `short` did not suffice.

    One size of room stays one.
    """
    more = widened(room.most, batch_limits(config, batch, step), short)
    return Room(more if room.usual == room.most else room.usual, more)


def batch_limits(config: Training, batch: ShadedPoints, step: int) -> Limits:
    """Capacities that hold the batch of a step, with slack."""
    devices = batch_mesh(config.batch_size).size
    size = config.batch_size // devices

    def probe(limits: Limits, i: int) -> dict[str, Any]:
        share = jax.tree.map(lambda a: a[i * size : (i + 1) * size], batch)
        key = share_key(config, step, i)
        return jax.device_get(probe_step(config, limits, share, key=key))

    ample = uniform_limits(config.network, 16 * size * config.points)
    return measure_limits(ample, probe, devices, SLACK)
