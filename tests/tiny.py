"""A network small enough to compile in seconds, and a scene with exact answers.

What takes a compilation is cached by it, so that all test files share it.
"""

from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import cache
from unittest import mock

import jax
import numpy as np
from jax._src import compiler

from ginn_jax import given, image, recipe, train
from ginn_jax.dataset import ShadedPoints, stack_clouds
from ginn_jax.limits import Limits
from ginn_jax.presets import compact_network
from ginn_jax.room import Room
from ginn_jax.searches import limit_names, uniform_limits

NETWORK = compact_network(k=4, levels=(0.08, 0.2), query_radius=0.16, latent=4)
CONFIG = recipe.Training(
    NETWORK,
    steps=200,
    batch_size=2,
    points=1000,
    queries=128,
    learning_rate=0.02,
    warm_up=10,
)


def _capacity(name):
    if name.endswith(".points"):
        return {"level_0.points": 1152, "level_1.points": 256}[name]
    sizes = {"columns": 10240, "candidates": 65536, "words": 2048, "edges": 10240}
    return sizes[name.rsplit(".", 1)[1]]


# What `measure_limits` finds for `CONFIG`, rounded up.
LIMITS = Limits(tuple((name, _capacity(name)) for name in limit_names(NETWORK)))
ROOM = Room(LIMITS, LIMITS)

# One convolution of f_3D: for tests of what is around the network.
ONE_LEVEL = compact_network(k=2, levels=(0.08,), query_radius=0.16, latent=2)
ONE_LEVEL_LIMITS = uniform_limits(ONE_LEVEL, 1 << 15)
ONE_LEVEL_ROOM = Room(ONE_LEVEL_LIMITS, ONE_LEVEL_LIMITS)


def ample_room(network):
    """One size of room for a step of another such network."""
    limits = uniform_limits(network, 1 << 15)
    return Room(limits, limits)


def sphere_on_plane(count, seed):
    """Points on a sphere of diameter 1 and the plane under it, with their openness.

    The sphere hides R^3 / D^3 of a plane's point at the distance D of its centre; the
    plane, were it infinite, hides (1 - n_y) / 2 of a sphere's point.
    """
    rng = np.random.default_rng(seed)
    radius, half = 0.5, 0.8
    upper = count * 11 // 20
    normal = rng.normal(size=(upper, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ground = rng.uniform(-half, half, (count - upper, 3)) * [1, 0, 1]
    up = np.tile([0.0, 1, 0], (count - upper, 1))
    position = np.concatenate([radius * normal + [0, radius, 0], ground])
    normal = np.concatenate([normal, up])
    target = exact_openness(position, normal)
    order = rng.permutation(count)
    columns = (position, normal, target, np.zeros(count))
    return ShadedPoints(*(c[order].astype(np.float32) for c in columns))


def exact_openness(position, normal):
    """What `sphere_on_plane` says of its points, from where they are."""
    distance = np.maximum(np.linalg.norm(position - [0, 0.5, 0], axis=1), 0.5)
    on_plane = np.abs(position[:, 1]) < 1e-6
    return np.where(on_plane, 1 - (0.5 / distance) ** 3, (1 + normal[:, 1]) / 2)


@cache
def batch(first=0):
    """Two clouds of 1200 points."""
    return stack_clouds([sphere_on_plane(1200, first + i) for i in range(2)])


def shade_pixels_by(monkeypatch, function):
    """Let pixels be shaded by that, which is called as `shade_blocks` is, with whatever
    weights and codes."""
    for check in ("check_weights", "check_codes"):
        monkeypatch.setattr(given, check, lambda *_: None)
    monkeypatch.setattr(image, "lanes_for", lambda network: False)
    monkeypatch.setattr(image, "shade_blocks", function)


def step(state, data, config=CONFIG, limits=LIMITS):
    """`train.train_step`; optax does not run where promotion must be explicit."""
    with jax.numpy_dtype_promotion("standard"):
        return train.train_step(config, limits, state, data)


def fresh_state(config=CONFIG, limits=LIMITS):
    """A state before the first step, for the caller to give away."""
    return train.place(config, _initial_state(config, limits))


@cache
def _initial_state(config, limits):
    with cheap_compiling():
        return jax.tree.map(np.array, train.init_state(config))


# XLA's older way to emit kernels, all into one module: no thread waits for it.
SIMPLE = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}
GIVEN_OPTIONS = compiler.get_compile_options


@contextmanager
def cheap_compiling():
    """Compilation at a third of the time, for what runs a few times only.

    JAX has no setting for what is in `SIMPLE`.
    """

    def simple(*args, **options):
        overrides = options.get("env_options_overrides") or {}
        overrides = SIMPLE | overrides
        return GIVEN_OPTIONS(*args, **options | {"env_options_overrides": overrides})

    with _compiling(simple, unoptimised=True):
        yield


@contextmanager
def full_compiling():
    """Within `cheap_compiling`, what users' calls compile to, and nothing else."""
    jax.clear_caches()
    with _compiling(GIVEN_OPTIONS, unoptimised=False):
        yield
    jax.clear_caches()


@contextmanager
def _compiling(get_options, unoptimised):
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", unoptimised)
    try:
        with mock.patch.object(compiler, "get_compile_options", get_options):
            yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


class Here(Executor):
    """What stands in for a pool of processes, each of which takes seconds to begin."""

    def __init__(self, *_, **__):
        pass

    def submit(self, function, /, *args, **kwargs):
        done = Future()
        try:
            done.set_result(function(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done


def identical(a, b):
    """Whether two trees are equal bit for bit."""
    if jax.tree.structure(a) != jax.tree.structure(b):
        return False
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array(x).tobytes() == np.array(y).tobytes() for x, y in pairs)
