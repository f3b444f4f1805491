"""Benchmarks, studies and releases of this project: run from a clone, never installed."""
