"""Benchmarks: each script prints medians, and the ratio to an opponent of the same run."""
