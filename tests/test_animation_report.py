"""Flicker of several sequences together."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import tiny

from ginn_jax import train
from ginn_jax.animation_report import RIVAL, flicker_rows, pooled, write_report
from ginn_jax.compare_frames import shade_next, start_playing
from ginn_jax.evaluate import Model, View
from ginn_jax.reference import GBuffer


def rows(rival, ours):
    return [
        {"method": RIVAL, "flicker": rival, "mse_2d": 2 * rival, "share": 1.0},
        {"method": "ours", "flicker": ours, "mse_2d": 3 * ours, "share": ours / rival},
    ]


def test_means_are_over_sequences_and_shares_of_the_means():
    found = pooled([rows(1.0, 0.5), rows(3.0, 0.3)])
    assert [row["method"] for row in found] == [RIVAL, "ours"]
    assert found[1]["flicker"] == pytest.approx(0.4)
    assert found[1]["mse_2d"] == pytest.approx(1.2)
    assert found[1]["share"] == pytest.approx(0.2)


def test_every_sequence_has_its_column_and_its_moving_image():
    sequences = {"fox": rows(1.0, 0.5), "frog": rows(4.0, 0.3)}
    options = {"effect": "ao", "frames": "2", "resolution": "9", "reference": "4"}
    metrics = {
        "sequences": sequences,
        "flicker": pooled(list(sequences.values())),
        "options": options,
        "frames": {"fox": 2, "frog": 3},
        "samples": 1234,
        "command": "python -m experiments.animation --frames 2",
        "environment": {"processor": "some", "cores": 2},
    }
    text = write_report(metrics)
    assert "| ours | 0.5 (0.500) | 0.3 (0.075) |" in text
    assert "fox (2 frames), frog (3 frames)" in text
    assert "1234 samples" in text
    assert "`python -m experiments.animation --frames 2`" in text
    assert "(fox/animation.gif)" in text
    assert "(frog/animation.gif)" in text
    one = write_report(metrics | {"sequences": {"fox": sequences["fox"]}})
    assert "(strip.png)" in one
    assert "Of each sequence" not in one


def test_flicker_is_what_the_reference_does_not_do():
    """A constant offset is an error and no flicker; a flash is both."""
    reference = np.ones((3, 4, 4, 1), np.float32)
    flash = reference.copy()
    flash[1] += 0.5
    frames = {
        "reference": reference,
        "variance": np.zeros_like(reference),
        "mask": np.ones((3, 4, 4), bool),
        "albedo": reference,
        RIVAL: flash,
        "ours": reference + 0.25,
    }
    found = {row["method"]: row for row in flicker_rows(frames)}
    assert found[RIVAL]["flicker"] == pytest.approx(0.25)
    assert found[RIVAL]["mse_2d"] == pytest.approx(0.25 / 3)
    assert found["ours"]["flicker"] == pytest.approx(0, abs=1e-6)
    assert found["ours"]["mse_2d"] == pytest.approx(0.0625)


def test_flicker_and_error_are_in_units_less_noise_and_of_the_foreground():
    mask = np.zeros((3, 4, 4), bool)
    mask[..., :2] = True
    right = np.where(mask[..., None], 2.0, 0.0).astype(np.float32)
    flash, offset = right.copy(), right + np.float32(0.25)
    flash[1] += 0.5
    flash[1, :, 2:] = 7
    offset[:, :, 2:] = 9
    variance = np.full_like(right, 0.09)
    frames = {"reference": right, "variance": variance, "mask": mask, "albedo": right}
    rival, ours = flicker_rows(frames | {RIVAL: flash, "ours": offset})
    assert rival["flicker"] == pytest.approx((0.25 - 0.18) / 4, rel=1e-4)
    assert rival["mse_2d"] == pytest.approx((0.25 / 3 - 0.09) / 4, rel=1e-3)
    assert ours["flicker"] == pytest.approx(-0.18 / 4, rel=1e-4)
    assert ours["mse_2d"] == pytest.approx((0.0625 - 0.09) / 4, rel=1e-4)


@pytest.mark.usefixtures("cheap_compiling")
def test_frames_hand_on_what_levels_kept():
    """Other draws of the Poisson disks keep what the frame before kept."""
    cloud = tiny.sphere_on_plane(1000, 4)
    mask = np.ones((4, 4), bool)
    ends = (a[:16].reshape(4, 4, 3) for a in cloud[:2])
    shot = View(None, GBuffer(*ends, np.zeros((4, 4), np.int32), mask), None, None)
    config = replace(tiny.CONFIG, network=tiny.ONE_LEVEL)
    variables = train.init_state(config).variables
    one, two = (
        (tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS, Model(variables, jax.random.key(k)))
        for k in (0, 1)
    )
    _, first = shade_next(start_playing(one, 1, 1000), cloud, shot)
    _, again = shade_next(first._replace(draws=[two]), cloud, shot)
    np.testing.assert_array_equal(again.kept[0], first.kept[0])
    _, anew = shade_next(start_playing(two, 1, 1000), cloud, shot)
    assert (np.asarray(anew.kept[0]) != np.asarray(first.kept[0])).any()
