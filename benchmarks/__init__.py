"""Benchmarks: each module is run by `python -m benchmarks.NAME` and writes a table and a picture to `benchmarks/results/`."""
