"""Exact shadows by shadow volumes: one file an algorithm, one signature."""
