"""What every benchmark leaves in its folder."""

import json


def check_files(folder, figure):
    """The three files, and what every metrics.json has."""
    metrics = json.loads((folder / "metrics.json").read_text())
    assert {"options", "environment", "seconds_total"} <= set(metrics)
    assert (folder / "report.md").read_text().startswith("# ")
    assert (folder / figure).stat().st_size > 1000
