"""Benchmarks of jaxpets, each a program: `python -m benchmarks.plan --help`."""
