"""A trained network on a finest level of another Poisson disk radius.

More points cost time and save error without training again: the trade that the paper
shows for its timings (Tbl. TimingPD).
"""

from dataclasses import replace

from ginn_jax.architecture import Network
from ginn_jax.checks import positive
from ginn_jax.errors import InputError
from ginn_jax.limits import Limits, limits_for

# The farthest from a radius that its demands say something of those at another.
FAR = 2.0


def with_disk_radius(network: Network, radius: float) -> Network:
    """The same network on a finest level of another Poisson disk radius.

    Raises:
        InputError: a radius that is not positive, leaves gaps in the f_2D field or is
            beyond that of the next level.
    """
    if not positive("Poisson radius", radius) < network.query.radius:
        raise InputError(
            f"Poisson radius {radius}: must lie between 0 and the f_2D radius "
            f"{network.query.radius}, or pixels are left without a point"
        )
    if not radius <= min(network.levels[1:], default=radius):
        raise InputError(
            f"Poisson radius {radius} exceeds level 1's: give one up to "
            f"{network.levels[1]}"
        )
    return replace(network, levels=(radius, *network.levels[1:]))


def limits_at(network: Network, limits: Limits, radius: float) -> Limits:
    """Capacities to expect at another finest Poisson disk radius.

    A power of the ratio of the radii squared for each. The powers are measured, at
    radii .015, .02 and .03 on 20,000 samples of a procedural shape: points go less than
    with the square, for the samples run out. Beyond `FAR` times as fine or coarse all
    is as there. A guess: whoever uses it still compares demands. Raises `InputError`
    for a radius that is not positive.
    """
    radius = positive("Poisson radius", radius)
    ratio = min(max(network.levels[0] / radius, 1 / FAR), FAR)
    growth = ratio**2
    powers = {"columns": 0.65, "candidates": -0.3, "words": -0.3, "edges": -1.0}
    power = {f"level_0.{p}": n for p, n in (powers | {"points": 0.8}).items()}
    power |= _search_powers("level_1", 0, 0) | {"level_1.points": 0.1}
    for conv in (*network.encoder, network.query):
        power |= _search_powers(conv.name, conv.source, conv.target)
    return limits_for(
        {name: int(n * growth ** power.get(name, 0)) for name, n in limits.sizes}, 1.0
    )


def _search_powers(name: str, source: int, target: int) -> dict[str, float]:
    """How the demands of a search go with the points of level 0 at its ends."""
    senders, receivers = float(source == 0), float(target == 0)
    near = 0.75 * senders + 0.35 * receivers
    return {
        f"{name}.columns": 0.25 * receivers,
        f"{name}.candidates": near,
        f"{name}.words": near,
        f"{name}.edges": 0.85 * (senders + receivers),
    }
