"""What a process may use up."""

import sys

import jax
import numpy as np
import pytest

from ginn_jax import limits as lm
from ginn_jax import process

linux = pytest.mark.skipif(sys.platform != "linux", reason="no /proc tells elsewhere")


def programs_left(share, work, monkeypatch):
    """How many of two compiled programs `work` leaves."""
    monkeypatch.setattr(process, "SHARE_OF_MAPS", share)
    double = jax.jit(lambda x: 2 * x)
    double(1.0)
    double(1)
    work()
    return double._cache_size()


@linux
@pytest.mark.parametrize(("share", "left"), [(0.0, 0), (1.0, 2)])
def test_programs_are_let_go_where_memory_maps_run_out(
    share, left, monkeypatch, caplog
):
    assert programs_left(share, process.spare_memory_maps, monkeypatch) == left
    assert ("vm.max_map_count" in caplog.text) == (left == 0)


@linux
@pytest.mark.parametrize(("need", "left"), [(5, 2), (9, 0)])
def test_limits_that_are_raised_make_room_for_another_program(need, left, monkeypatch):
    def work():
        lm.with_room(
            lm.Limits((("a", 5),)), lambda limits: (None, [{"a": np.int32(need)}])
        )

    assert programs_left(0.0, work, monkeypatch) == left
