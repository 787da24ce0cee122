"""A training run of a few steps on small clouds."""

from dataclasses import replace

import jax
import numpy as np
import tiny

from ginn_jax import fit

POINTS = 200
LIT = replace(tiny.ONE_LEVEL, lights=1, local=True)
CONFIG = replace(
    tiny.CONFIG, network=LIT, points=POINTS, queries=32, steps=12, batch_size=1
)
OFTEN = fit.Intervals(report=1, save=3)


def cloud(seed, light=1.0):
    """A small cloud under a light; its target is as bright as that."""
    made = tiny.sphere_on_plane(POINTS, seed)
    shine = np.broadcast_to(np.float32(light), POINTS).copy()
    return made._replace(target=made.target * shine, light=shine[:, None])


def train(folder, clouds, resume=False, progress=lambda *_: None, **more):
    given = CONFIG, clouds, folder, OFTEN, progress, resume
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        return fit.fit(*given, **more)
