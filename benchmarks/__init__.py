"""Benchmarks: each prints a table and takes --quick and --json FILE; run as python -m."""
