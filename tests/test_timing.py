"""The timing module counts what it says it counts, on work of known length."""

import json

import jax
import numpy as np
import pytest

from benchmarks import timing


def test_measure_alternates_and_keeps_order():
    calls = []
    variants = {name: lambda name=name: calls.append(name) for name in ("b", "a")}
    timings = timing.measure(variants, repeats=3)
    assert calls == ["b", "a"] * 4
    assert list(timings) == ["b", "a"]
    assert all(len(t.seconds) == 3 for t in timings.values())


def test_timing_of_known_seconds():
    found = timing.Timing(5.0, (1.0, 3.0, 2.0, 4.0, 9.0))
    assert (found.median, found.minimum, found.compile) == (3.0, 1.0, 2.0)
    assert found.spread == pytest.approx(2 / 3)
    assert json.loads(json.dumps(found.record()))["first"] == 5.0


def test_measure_counts_compilation_in_the_first_call_only():
    traced = []

    @jax.jit
    def work(x):
        traced.append(x)
        return x + 1

    timing.measure({"work": lambda: work(np.float32(1))}, repeats=3)
    assert len(traced) == 1


def test_describe_is_one_line():
    line = timing.describe()
    assert "\n" not in line
    assert jax.__version__ in line
