"""Flicker of several sequences together."""

import numpy as np
import pytest

from ginn_jax.animation_report import RIVAL, flicker_rows, pooled, write_report


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
