"""Gradients of the convolution: finite differences, and none from what is not there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conv_cases import (
    CHANNELS,
    MIXES,
    OUTPUTS,
    VARIANTS,
    apply,
    dense_case,
    field_of,
    make_kernel,
)
from strategies import POINTS, QUERIES

from ginn_jax import receptive_field as rf


def loss(parameters, field, cotangent, mixes):
    kernel, features = parameters
    return jnp.vdot(cotangent, apply(kernel, features, field, mixes))


gradient = jax.jit(jax.grad(loss), static_argnames="mixes")


def problem(case, variant, mixes):
    """Kernel and features, their field, a direction to differentiate in."""
    field = field_of(case.senders, case.receivers, np.float32(case.radius), variant)
    count = CHANNELS * (OUTPUTS if mixes else 1)
    kernel = make_kernel(case.seed, field.inputs.shape[0], count, 2)
    width = OUTPUTS if mixes else CHANNELS
    cotangent = np.random.default_rng(6).normal(size=(QUERIES, width))
    return (kernel, case.features), field, cotangent


def double(tree):
    return jax.tree.map(
        lambda a: np.asarray(a, np.float64 if a.dtype == np.float32 else a.dtype), tree
    )


@VARIANTS
@MIXES
def test_gradients_equal_finite_differences(variant, mixes):
    parameters, field, cotangent = double(problem(dense_case(), variant, mixes))
    rng, step = np.random.default_rng(7), 1e-6
    with jax.enable_x64(True):
        slopes = gradient(parameters, field, cotangent, mixes)
        leaves, tree = jax.tree.flatten(parameters)
        for i, leaf in enumerate(leaves):
            direction = rng.normal(size=leaf.shape)
            ends = [
                loss(
                    tree.unflatten([*leaves[:i], moved, *leaves[i + 1 :]]),
                    field,
                    cotangent,
                    mixes,
                )
                for moved in (leaf + step * direction, leaf - step * direction)
            ]
            expected = float(ends[0] - ends[1]) / (2 * step)
            slope = np.vdot(jax.tree.leaves(slopes)[i], direction)
            assert abs(expected) > 1e-3
            assert slope == pytest.approx(expected, rel=1e-5)


@VARIANTS
@MIXES
def test_empty_neighbourhoods_are_zero_with_their_gradients(variant, mixes):
    dense = dense_case()
    far = dense.receivers.position + np.float32(50)
    case = dense._replace(receivers=dense.receivers._replace(position=far))
    nobody = np.zeros(POINTS, bool)
    masked = dense._replace(senders=dense.senders._replace(mask=nobody))
    for empty in (case, masked):
        parameters, field, cotangent = problem(empty, variant, mixes)
        assert (np.asarray(field.receiver) == QUERIES).all()
        assert not np.asarray(apply(*parameters, field, mixes)).any()
        slopes = gradient(parameters, field, cotangent.astype(np.float32), mixes)
        for slope in jax.tree.leaves(slopes):
            np.testing.assert_array_equal(slope, 0)


@VARIANTS
@MIXES
@pytest.mark.parametrize("first", [False, True])
def test_padding_contributes_nothing_to_values_and_gradients(variant, mixes, first):
    """Results are bit-equal whatever masked rows hold, with and without row 0 in use.

    Row 0 is what padded edges name as their sender.
    """
    dense, results = dense_case(), []
    for garbage in (0.0, 0.5, -1e6):
        mask = np.array(dense.senders.mask)
        mask[0] = first
        rows = np.where(mask[:, None], 1, 0)
        position, normal, features = (
            np.where(rows, a, garbage).astype(np.float32)
            for a in (*dense.senders[:2], dense.features)
        )
        case = dense._replace(
            senders=rf.Oriented(position, normal, mask), features=features
        )
        parameters, field, cotangent = problem(case, variant, mixes)
        padded = np.asarray(field.receiver) == QUERIES
        assert padded.any()
        assert not np.asarray(field.weight)[padded].any()
        assert not np.asarray(field.inputs)[:, padded].any()
        slopes = gradient(parameters, field, cotangent.astype(np.float32), mixes)
        assert not np.asarray(slopes[1])[~mask].any()
        results.append((apply(*parameters, field, mixes), slopes))
        assert not np.asarray(results[-1][0])[~case.receivers.mask].any()
    for result in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, result, results[0])
