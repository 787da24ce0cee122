"""Clouds encoded and points shaded in lanes, by four threads at once."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import tiny

from ginn_jax import inference, objective
from ginn_jax.example import blank_example

ROOT = Path(__file__).parents[1]
NETWORK, LIMITS, KEY = tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS, jax.random.key(0)


def main():
    """Values at the points of a cloud: 20 times the same."""
    points = tiny.sphere_on_plane(1000, 4)
    ends = points.position, points.normal
    with tiny.cheap_compiling():
        weights = objective.init_variables(NETWORK, blank_example(NETWORK), key=KEY)

    def values(_):
        given = NETWORK, LIMITS, weights
        encoded, _ = inference.encode_cloud(*given, *ends, key=KEY)
        return inference.shade_points(*given, encoded, *ends)[0]

    expected = values(0)
    sys.setswitchinterval(1e-5)  # so that threads meet
    with ThreadPoolExecutor(4) as threads:
        for found in threads.map(values, range(20)):
            np.testing.assert_array_equal(found, expected)
    print("threads agree")


def test_threads_neither_hang_nor_end_the_process():
    """Without a lock this one of its own does either."""
    done = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout == "threads agree\n", done.stderr[-2000:]


if __name__ == "__main__":
    main()
