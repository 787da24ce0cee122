"""The timing module counts what it says it counts, on work of known length."""

import json

import jax
import numpy as np
import pytest

from benchmarks import timing


def test_measure_takes_turns_in_an_order_of_their_own(monkeypatch):
    monkeypatch.setattr(timing, "WARM", 0.0)
    calls = []
    names = ["c", "b", "a"]
    variants = {name: lambda name=name: calls.append(name) for name in names}
    timings = timing.measure(variants, repeats=9)
    assert calls[:3] == names
    rounds = [tuple(calls[i : i + 3]) for i in range(3, len(calls), 3)]
    assert len(rounds) == 9
    assert all(sorted(turn) == ["a", "b", "c"] for turn in rounds)
    assert len(set(rounds)) > 3
    assert list(timings) == names
    assert all(len(t.seconds) == 9 for t in timings.values())


@pytest.mark.parametrize(("seconds", "calls"), [(0.09, 1 + 4 + 3), (0.3, 1 + 1 + 2)])
def test_short_calls_are_warmed_up(monkeypatch, seconds, calls):
    """What fills the time to warm up in does not count; long calls need it once."""
    made = []

    def clock(call):
        made.append(call)
        return seconds

    monkeypatch.setattr(timing, "clock", clock)
    found = timing.measure({"a": lambda: None}, repeats=2)["a"]
    assert found.seconds == (seconds, seconds)
    assert len(made) == calls


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
