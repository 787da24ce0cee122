"""The geometry of a small sphere, on networks of two levels and of one."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ginn_jax import geometry as ge
from ginn_jax import limits as lm
from ginn_jax import searches as se
from ginn_jax.presets import compact_network
from ginn_jax.receptive_field import Oriented

RADIUS = 0.5
LEVELS = (0.1, 0.25)
NETWORKS = {
    "surface": compact_network(4, LEVELS, query_radius=0.25),
    "kde": compact_network(4, LEVELS[:1], query_radius=0.25, density="kde"),
}
SHALLOW = compact_network(4, (0.25,), query_radius=0.25, density="kde")
GENEROUS = {"points": 512, "edges": 1 << 14, "candidates": 1 << 15}
GENEROUS |= {"columns": 1 << 12, "words": 1 << 10}


def sphere(count, seed):
    normal = np.random.default_rng(seed).normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal.astype(np.float32)
    return Oriented(np.float32(RADIUS) * normal, normal, np.arange(count) < count - 20)


CLOUD, QUERIES = sphere(340, 0), sphere(50, 1)


def build(config, limits, cloud, queries):
    cloud, queries = jax.tree.map(jnp.asarray, (cloud, queries))
    geometry, demands = ge.build_geometry(config, limits, cloud, key=jax.random.key(2))
    ends = geometry.levels[0], geometry.grid, geometry.area, queries
    field, more = ge.build_query_field(config, limits, *ends)
    return geometry, field, demands | more


@partial(jax.jit, static_argnums=(0, 1))
def jitted(config, limits, cloud, queries):
    return build(config, limits, cloud, queries)


@partial(jax.jit, static_argnums=(0, 1, 2))
def demands_of(config, limits, stages, cloud, queries):
    """The demands of some searches; XLA drops whatever comes after them."""
    demands = build(config, limits, cloud, queries)[2]
    return {n: d for n, d in demands.items() if n.startswith(stages)}


def generous(config):
    names = se.limit_names(config)
    return lm.Limits(tuple((n, GENEROUS[n.split(".")[-1]]) for n in names))


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def as_jax(demands):
    return jax.tree.map(jnp.asarray, demands)
