"""Benchmarks, one script per question: `python -m benchmarks.NAME`.

Each takes --out DIR, where it writes metrics.json, report.md and what figures it has,
and --quick but for `paper_tables`, which only sets other reports side by side.
Times are wall times, compilation apart, of variants that take turns in one process.
"""
