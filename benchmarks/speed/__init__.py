"""Micro-benchmarks of lagros against its peers; run `python benchmarks/speed/run.py`."""
