"""f_3D, f_2D, both at host level and a training step, in float32 and float64."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stability_cases import Case, plain, small_network
from benchmarks.stability_stages import (
    KEY,
    Row,
    double,
    error,
    in_double,
    oriented,
    row,
)
from ginn_jax import geometry, inference, objective, recipe, shading, train
from ginn_jax.dataset import ShadedPoints, stack_clouds
from ginn_jax.limits import Limits, exceeded, raise_limits
from ginn_jax.neighbors import bucket
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import limit_names

# The network


def roomy(network: Any) -> Limits:
    """Capacities that hold every case."""
    sizes = {
        "columns": 1 << 15,
        "candidates": 1 << 17,
        "words": 1 << 13,
        "edges": 1 << 17,
        "points": 1024,
    }
    limits = Limits(
        tuple((n, sizes[n.rsplit(".", 1)[1]]) for n in limit_names(network))
    )
    return raise_limits(limits, {"level_0.edges": 1 << 20}, 1.0)


@partial(jax.jit, static_argnums=(0, 1))
def whole(
    network: Any,
    limits: Limits,
    variables: Any,
    cloud: Oriented,
    material: Any,
    light: Any,
    queries: Oriented,
) -> Any:
    """f_3D and f_2D with all their geometry, points in the order given."""
    built, demands = geometry.build_geometry(
        network, limits, cloud, key=jax.random.key(KEY)
    )
    order = jnp.arange(cloud.mask.shape[0], dtype=jnp.int32)
    code, scale = shading.encode_channels(
        network, variables, built, order, cloud.mask, material, light
    )
    encoded = shading.Encoded(built.levels[0], built.grid, built.area, code, scale)
    values, more = shading.shade(network, limits, variables, encoded, queries)
    return encoded, values, demands | more


_shade = jax.jit(shading.shade, static_argnums=(0, 1))


@cache
def weights() -> Any:
    """Variables of the network; they do not depend on its radii."""
    config = recipe.Training(small_network(), 1, batch_size=1, points=256, queries=64)
    return jax.tree.map(np.asarray, train.init_state(config).variables)


def network_rows(case: Case) -> list[Row]:
    """f_3D, f_2D and both against the same in float64."""
    network, variables = small_network(case.scale), weights()
    limits, cloud = roomy(network), oriented(case)
    numbers = case.albedo.astype(np.float32), case.light.astype(np.float32)
    given = variables, cloud, *numbers, cloud

    def run() -> Any:
        return jax.device_get(whole(network, limits, *given))

    encoded, _, demands = run()
    if short := exceeded(limits, demands):
        limits = raise_limits(limits, short, 1.0)
        encoded = run()[0]
    with double():
        exact = jax.device_get(whole(network, limits, *in_double(given)))
        alone = in_double((variables, encoded, cloud))
        flat = jax.device_get(_shade(network, limits, *alone)[0])

    def shade() -> Any:
        values, _ = _shade(network, limits, variables, encoded, cloud)
        return jax.device_get(values)

    rows = [
        row(
            "f_3D",
            case.name,
            run,
            lambda f: error((f[0].code, f[0].scale), (exact[0].code, exact[0].scale)),
        ),
        row("f_2D", case.name, shade, lambda f: error(f, flat)),
        row("shading", case.name, run, lambda f: error(f[1], exact[1])),
    ]
    return [*rows, host_row(case, network, variables)]


def host_row(case: Case, network: Any, variables: Any) -> Row:
    """`encode_cloud` and `shade_points`, in lanes where they run, against JAX's f_3D
    and f_2D in float64 of the same samples, as drawn by the same key."""
    points = case.position[: case.count], case.normal[: case.count]
    numbers = tuple(a[:, : case.count] for a in (case.albedo, case.light))
    limits = roomy(network)

    def run() -> Any:
        given = variables, *points, *numbers
        encoded, sufficed = inference.encode_cloud(
            network, limits, *given, key=jax.random.key(KEY)
        )
        return inference.shade_points(network, sufficed, variables, encoded, *points)[0]

    def exact(found: Any) -> tuple[float, int]:
        with double():
            values = exact_values(network, limits, variables, *points, *numbers)
        return error(found, values)

    return row("encode_cloud, shade_points", case.name, run, exact)


def exact_values(
    network: Any,
    limits: Limits,
    variables: Any,
    position: np.ndarray,
    normal: np.ndarray,
    *numbers: np.ndarray,
) -> np.ndarray:
    """Values at the samples, [N C]; to call where x64 is enabled."""
    more = bucket(len(position)) - len(position)
    place, facing = (np.pad(a, ((0, more), (0, 0))) for a in (position, normal))
    real = np.arange(len(position) + more) < len(position)
    cloud = Oriented(place, facing, real)
    padded = (np.pad(a, ((0, 0), (0, more), (0, 0))) for a in numbers)
    given = in_double(variables), cloud, *padded, None, jax.random.key(KEY)
    encoded, demands = inference.encode_whole(network, limits, *given)
    values, asked = _shade(network, limits, given[0], encoded, cloud)
    if short := exceeded(limits, jax.device_get(demands | asked)):
        more_room = raise_limits(limits, short, 1.0)
        return exact_values(network, more_room, variables, position, normal, *numbers)
    return np.asarray(values)[:, : len(position)].T


# A training step


@cache
def training(scale: float) -> tuple[recipe.Training, Limits, Any]:
    """How to train, in which capacities, and the state before the first step."""
    network = small_network(scale)
    config = recipe.Training(network, 10, points=1000, queries=128, warm_up=0)
    limits = roomy(network)
    limits = raise_limits(limits, {n: 2 * s for n, s in limits.sizes}, 1.0)
    return config, limits, jax.tree.map(np.asarray, train.init_state(config))


def train_row(case: Case) -> Row:
    """Loss and norm of the gradient of a step on the plain cloud and this one."""
    config, limits, state = training(case.scale)

    def cloud(case: Case, rows: Any) -> ShadedPoints:
        light, albedo = case.light[0], case.albedo[0]
        target = (light[:, 0] * (1 + case.normal[:, 1]) / 2)[rows]
        columns = case.position, case.normal, light, albedo
        position, normal, light, albedo = (c[rows].astype(np.float32) for c in columns)
        target = target.astype(np.float32)
        return ShadedPoints(position, normal, target, 0 * target, albedo, light)

    first = plain(1)
    first = first._replace(position=case.scale * first.position)
    rows = np.arange(len(case.position)) % case.count
    batch = stack_clouds([cloud(first, slice(None)), cloud(case, rows)])

    def step(state: Any, batch: Any) -> Any:
        after, told = train.train_step(
            config, limits, train.place(config, state), batch
        )
        assert not exceeded(limits, jax.device_get(told.demands)), case.name
        params, _ = objective.split_variables(after.variables)
        return jax.device_get((told.loss, told.gradient_norm, params))

    with double():
        exact = step(in_double(state), in_double(batch))
    return row(
        "train step",
        case.name,
        lambda: step(state, batch),
        lambda f: (error(f[:2], exact[:2])[0], error(f, exact)[1]),
    )
