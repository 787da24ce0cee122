"""The paper's tables next to ours: ratios are over the same table's screen space."""

import json

import pytest

from benchmarks import paper_tables
from ginn_jax.errors import InputError


def measured(folder, effect, worse, processor="a processor"):
    """An evaluation whose methods have errors in steps."""
    rows = [
        {"method": m, "mse_2d": worse / (i + 1), "dssim_2d": 0.1 * (i + 1)}
        | {"seconds": 0.01 * (i + 1)}
        for i, m in enumerate(paper_tables.METHODS)
    ]
    metrics = {
        "results": rows,
        "lost_cells": ["dssim_2d: screen space 0.1, ours 0.4"],
        "options": {"effect": effect, "resolution": "64"},
        "environment": {"processor": processor},
    }
    place = folder / f"evaluate_{effect}"
    place.mkdir()
    (place / "metrics.json").write_text(json.dumps(metrics))


def test_ratios_are_over_screen_space_of_the_same_effect(tmp_path):
    for worse, effect in enumerate(paper_tables.EFFECTS, 1):
        measured(tmp_path, effect, worse)
    options = paper_tables.Options(tmp_path, tmp_path / "out")
    rows = paper_tables.main(options)["rows"]
    assert [r["mse_2d_ratio"] for r in rows] == pytest.approx(
        [1, 1 / 2, 1 / 3, 1 / 4] * 3
    )
    ours = {r["effect"]: r for r in rows if r["method"] == "ours"}
    assert ours["GI"]["paper_mse_2d_ratio"] == pytest.approx(0.12 / 0.11)
    assert ours["SSS"]["paper_dssim_2d_ratio"] == pytest.approx(0.017 / 0.034)
    assert ours["AO"]["ms"] == pytest.approx(40)
    text = (tmp_path / "out" / "report.md").read_text()
    assert text.count("screen space 0.1, ours 0.4") == 3


def test_a_missing_evaluation_is_named_with_the_command(tmp_path):
    with pytest.raises(InputError, match=r"experiments\.evaluate --effect ao"):
        paper_tables.main(paper_tables.Options(tmp_path, tmp_path / "out"))


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ("a processor", "Ours: a processor, images"),
        ("another", "Ours: AO on a processor, GI on another, SSS on another, images"),
    ],
)
def test_every_processor_is_named(tmp_path, other, said):
    for effect in paper_tables.EFFECTS:
        measured(tmp_path, effect, 1, "a processor" if effect == "ao" else other)
    paper_tables.main(paper_tables.Options(tmp_path, tmp_path / "out"))
    assert said in (tmp_path / "out" / "report.md").read_text()


def test_an_evaluation_of_another_effect_is_refused(tmp_path):
    for effect in paper_tables.EFFECTS:
        measured(tmp_path, effect, 1)
    (tmp_path / "evaluate_sss").rename(tmp_path / "other")
    (tmp_path / "evaluate_gi").rename(tmp_path / "evaluate_sss")
    (tmp_path / "other").rename(tmp_path / "evaluate_gi")
    with pytest.raises(InputError, match=r"evaluate_gi.*is of another effect: run"):
        paper_tables.main(paper_tables.Options(tmp_path, tmp_path / "out"))


@pytest.mark.parametrize("lacking", ["results", "options", "environment", "lost_cells"])
def test_what_is_no_evaluation_is_refused(lacking, tmp_path):
    for effect in paper_tables.EFFECTS:
        measured(tmp_path, effect, 1)
    place = tmp_path / "evaluate_gi" / "metrics.json"
    found = json.loads(place.read_text())
    del found[lacking]
    place.write_text(json.dumps(found))
    with pytest.raises(InputError, match=r"^\S*evaluate_gi/metrics.json is damaged"):
        paper_tables.main(paper_tables.Options(tmp_path, tmp_path / "out"))
