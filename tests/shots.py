"""Shots of a plane that nothing was traced for: pixels, light and truth by numbers."""

import numpy as np
import tiny

from ginn_jax import evaluate
from ginn_jax.evaluate import View, fill
from ginn_jax.lit_clouds import LitCloud
from ginn_jax.lit_views import LitView
from ginn_jax.reference import Estimate, GBuffer


def gbuffer():
    """Pixels on a sphere above a plane in a part of an image, and their points."""
    mask = np.zeros((16, 18), bool)
    mask[2:14, 3:16] = True
    cloud = tiny.sphere_on_plane(int(mask.sum()), 0)
    ends = (fill(mask, a) for a in (cloud.position, cloud.normal))
    return GBuffer(*ends, np.zeros(mask.shape, np.int32), mask), cloud


def gray_shot():
    """Openness from .2 to .8, with noise of its own at each pixel."""
    buffer, cloud = gbuffer()
    rng, count = np.random.default_rng(0), len(cloud.target)
    mean, variance = rng.uniform(0.2, 0.8, count), rng.uniform(0, 0.02, count)
    truth = Estimate(mean.astype(np.float32), variance.astype(np.float32))
    return evaluate.with_truth(View(None, buffer, None, None), truth)


def lit_shot(medium=()):
    """Two materials under coloured light, or one medium."""
    buffer, cloud = gbuffer()
    rng, count = np.random.default_rng(0), len(cloud.target)
    light, target = rng.gamma(1.0, size=(2, count, 3)).astype(np.float32)
    variance = np.tile(np.float32([0.01, 0.04, 0.09]), (count, 1))
    material = rng.integers(0, 2, count).astype(np.int32)
    albedo = rng.uniform(0.1, 1, (2, 3)).astype(np.float32)
    known = material, light, target, variance, albedo, np.array(medium)
    return LitView(None, buffer, LitCloud(*cloud[:2], *known))
