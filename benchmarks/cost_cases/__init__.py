"""What `benchmarks/cost_models.py` measures: each file makes rows of its table."""
