"""Benchmarks, one script per question: `python -m benchmarks.NAME`.

Each takes --quick and --out DIR, and writes metrics.json, report.md and a figure there.
Times are wall times, compilation apart, of variants that take turns in one process.
"""
