"""Measurements of configurations, cost models fitted to them, and the search that chooses what to measure."""
