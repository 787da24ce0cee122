"""Training: limits measured once, then one jitted step that does everything.

The step draws rotations, thins the clouds, builds the hierarchy, searches, weighs,
convolves, differentiates and updates. A batch is shared out between the devices.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh as DeviceMesh
from jax.sharding import NamedSharding, PartitionSpec, Sharding
from jaxtyping import Array, Bool, Float, Int, Key

from ginn_jax.dataset import ShadedPoints
from ginn_jax.example import Example, blank_example, thin_and_search
from ginn_jax.limits import Demands, Limits, fits
from ginn_jax.network import Variables
from ginn_jax.objective import batch_loss, init_variables, split_variables
from ginn_jax.process import ALONE
from ginn_jax.recipe import Training, make_optimizer

Pooled = TypeVar("Pooled")


class TrainState(NamedTuple):
    """Everything that a step changes. `skipped` counts non-finite gradients."""

    variables: Variables
    optimizer: optax.OptState
    step: Int[Array, ""]
    skipped: Int[Array, ""]


class StepReport(NamedTuple):
    """What a step says of itself; `fits` is False where a limit was too small.

    `asked` counts the queries that carried the loss.
    """

    loss: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    fits: Bool[Array, ""]
    asked: Int[Array, ""]
    demands: Demands


def batch_mesh(batch_size: int) -> DeviceMesh:
    """As many devices as share a batch evenly."""
    devices = jax.devices()
    count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
    return DeviceMesh(np.array(devices[:count]), ("batch",))


def _share_gradient(
    config: Training,
    limits: Limits,
    params: Variables,
    moments: Variables,
    key: Key[Array, ""],
    batch: ShadedPoints,
) -> tuple[Variables, Variables, Array, Array, Demands]:
    """Gradient, moments and loss, averaged over the devices, queries and demands."""
    key = jax.random.fold_in(key, jax.lax.axis_index("batch"))
    example, demands = make_example(config, limits, batch, key=key)
    example = jax.lax.optimization_barrier(example)
    (loss, moments), gradient = jax.value_and_grad(batch_loss, has_aux=True)(
        params, moments, config.network, example
    )
    gradient, moments, loss = _pooled(jax.lax.pmean, (gradient, moments, loss))
    asked = jax.lax.psum(jnp.sum(example.queries.mask, dtype=jnp.int32), "batch")
    return gradient, moments, loss, asked, _pooled(jax.lax.pmax, demands)


def _pooled(reduce: Callable[[Array, str], Array], tree: Pooled) -> Pooled:
    """What the devices agree on, all leaves as one array: they wait for each other at
    every array by itself, which cost a step 4 % of its time."""
    flat, unravel = ravel_pytree(tree)
    return unravel(reduce(flat, "batch"))


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=2, compiler_options=ALONE)
def train_step(
    config: Training, limits: Limits, state: TrainState, batch: ShadedPoints
) -> tuple[TrainState, StepReport]:
    """One step on a batch [B, N]; the randomness is that of the seed and the step.

    Where a demand exceeds its limit the state comes back untouched. Where the gradient
    is not finite only `step` and `skipped` advance.
    """
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    params, moments = split_variables(state.variables)
    replicated, shared = PartitionSpec(), PartitionSpec("batch")
    gradient, new_moments, loss, asked, demands = jax.shard_map(
        partial(_share_gradient, config, limits),
        mesh=batch_mesh(config.batch_size),
        in_specs=(replicated, replicated, replicated, shared),
        out_specs=replicated,
        check_vma=False,
    )(params, moments, key, batch)
    norm = optax.tree.norm(gradient)
    finite, fitting = jnp.isfinite(norm) & jnp.isfinite(loss), fits(limits, demands)
    update, optimizer = make_optimizer(config).update(gradient, state.optimizer, params)
    trained: Any = optax.apply_updates(params, update)
    fresh = {part: trained[part] | new_moments[part] for part in trained}
    usable = finite & fitting
    variables, optimizer = jax.tree.map(
        lambda new, old: jnp.where(usable, new, old),
        (fresh, optimizer),
        (state.variables, state.optimizer),
    )
    step = state.step + fitting
    skipped = state.skipped + (fitting & ~finite)
    report = StepReport(loss, norm, fitting, asked, demands)
    return TrainState(variables, optimizer, step, skipped), report


def make_example(
    config: Training, limits: Limits, batch: ShadedPoints, *, key: Key[Array, ""]
) -> tuple[Example, Demands]:
    """What a step needs of a batch's share before any parameter enters."""
    sizes = config.points, config.queries, config.sparsest
    return thin_and_search(config.network, limits, batch, *sizes, key=key)


def init_state(config: Training, variables: Variables | None = None) -> TrainState:
    """The state before the first step, of these weights or, by default, random ones."""
    if variables is None:
        return place(config, _random_state(config))
    # A step gives its state's memory away: not that of whoever gave the weights.
    return place(config, _first_state(config, jax.tree.map(jnp.array, variables)))


def state_shapes(config: Training, where: Sharding | None = None) -> TrainState:
    """Shapes and types of a state that lies there, without any computation."""
    shapes = jax.eval_shape(partial(_random_state, config))
    there = partial(jax.ShapeDtypeStruct, sharding=where)
    return jax.tree.map(lambda leaf: there(leaf.shape, leaf.dtype), shapes)


@partial(jax.jit, static_argnums=0)
def _random_state(config: Training) -> TrainState:
    example, key = blank_example(config.network), jax.random.key(config.seed)
    return _first_state(config, init_variables(config.network, example, key=key))


@partial(jax.jit, static_argnums=0)
def _first_state(config: Training, variables: Variables) -> TrainState:
    params, _ = split_variables(variables)
    optimizer = make_optimizer(config).init(params)
    return TrainState(variables, optimizer, jnp.int32(0), jnp.int32(0))


def place(config: Training, state: TrainState) -> TrainState:
    """The state on every device that shares a batch, as the step returns it."""
    return jax.device_put(state, on_devices(config))


def on_devices(config: Training) -> NamedSharding:
    """A copy on every device that shares a batch."""
    return NamedSharding(batch_mesh(config.batch_size), PartitionSpec())


@partial(jax.jit, static_argnums=(0, 1))
def probe_step(
    config: Training, limits: Limits, share: ShadedPoints, *, key: Any
) -> Demands:
    """Demands of one device's share of a batch."""
    return make_example(config, limits, share, key=key)[1]


def share_key(config: Training, step: int, device: int) -> Key[Array, ""]:
    """The randomness of one device's share of the batch of a step."""
    key = jax.random.fold_in(jax.random.key(config.seed), step)
    return jax.random.fold_in(key, device)
