"""The experiments of the paper; run `python -m experiments.run --help`."""
