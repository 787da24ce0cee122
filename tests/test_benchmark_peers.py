"""What is compared with peers agrees with them, or the benchmark stops."""

import numpy as np
import pytest
from left_behind import check_files

from benchmarks import mc_conv, neighbors

pytestmark = pytest.mark.usefixtures("at_once", "cheap_compiling")


def test_pairs_may_differ_at_the_radius_only():
    points = np.array([[0.0, 0, 0], [1 + 1e-7, 0, 0], [0.5, 0, 0]])
    queries = np.zeros((1, 3))
    two, three = ((np.zeros(n, int), np.array([0, 2, 1][:n])) for n in (2, 3))
    same = neighbors.same_but_for_rounding
    assert same(two, three, points, queries, 1.0)
    assert not same(two, three, points, queries, 1.1)
    assert not same(three, (two[0][:1], two[1][:1]), points, queries, 1.0)
    assert not same(two, (np.zeros(3, int), np.array([0, 2, 2])), points, queries, 1.0)


def test_neighbors(tmp_path, monkeypatch):
    def absent():
        raise ImportError

    monkeypatch.setitem(neighbors.PEERS, "absent", absent)
    options = neighbors.Options(
        tmp_path, points=300, queries=(500,), radii=(0.1,), repeats=1
    )
    metrics = neighbors.main(options)
    assert "absent ()" in metrics["missing"]
    assert [case["cloud"] for case in metrics["cases"]] == list(neighbors.CLOUDS)
    assert all(case["pairs"] > 0 for case in metrics["cases"])
    check_files(tmp_path, "neighbors.png")


def test_neighbors_stops_at_a_search_that_is_wrong(tmp_path, monkeypatch):
    def wrong(points, queries, radius):
        return tuple(a[1:] for a in neighbors.find_neighbors(points, queries, radius))

    monkeypatch.setitem(neighbors.PEERS, "wrong", lambda: wrong)
    options = neighbors.Options(tmp_path, points=200, queries=(200,), radii=(0.1,))
    with pytest.raises(AssertionError, match="wrong found other pairs"):
        neighbors.main(options)


def test_mc_conv_without_peers(tmp_path, monkeypatch):
    def absent(*_):
        raise ImportError

    monkeypatch.setitem(mc_conv.PEERS, "PyTorch", absent)
    monkeypatch.setitem(mc_conv.PEERS, "PyTorch, a thread a cloud", absent)
    monkeypatch.setattr(mc_conv, "in_open3d", absent)
    options = mc_conv.Options(tmp_path, points=200, radii=(0.2,), repeats=1)
    metrics = mc_conv.main(options)
    assert metrics["cases"][0]["missing"][:2] == list(mc_conv.PEERS)
    assert metrics["cases"][0]["edges"] > 200
    assert "PyTorch" in (tmp_path / "report.md").read_text()


def test_mc_conv_compares_with_a_peer():
    """A stand-in peer: ours with the blocks of its kernel taken apart."""
    points = mc_conv.uniform(np.random.default_rng(0), 200)
    mine = mc_conv.ours(mc_conv.make_layer([points], 0.2, 24, 16, seed=0))

    def flat(wrong=0.0):
        kernel, features = mine["gradient"]()
        return [*(a[0] for a in kernel), features + wrong]

    peer = {"forward": mine["forward"], "gradient": flat}
    assert mc_conv.check(mine, peer) == 0
    with pytest.raises(AssertionError, match="differ"):
        mc_conv.check(mine, peer | {"gradient": lambda: flat(1.0)})
