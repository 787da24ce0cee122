"""A small state of a training, saved and restored."""

import jax.numpy as jnp

from ginn_jax import checkpoint
from ginn_jax.train import TrainState

STATE = TrainState(
    {"encoder": {"kernel": jnp.ones((3, 4))}, "shader": {}},
    (),
    jnp.int32(3),
    jnp.int32(0),
)


def save_state(folder, state=STATE):
    manager = checkpoint.open_manager(folder)
    checkpoint.save_state(manager, state)
    checkpoint.finish(manager)


def restore(folder, like=STATE):
    manager = checkpoint.open_manager(folder)
    try:
        return checkpoint.restore_state(manager, like)
    finally:
        manager.close()
