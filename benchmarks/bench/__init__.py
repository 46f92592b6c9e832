"""Benchmarks of both programs against references of the same run, with growth curves and a report."""
