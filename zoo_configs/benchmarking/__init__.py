"""Benchmarks: many cells with many seeds, on this machine or on a cluster, and what came of them."""
