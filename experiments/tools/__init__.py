"""Commands of their own beside `experiments.run`."""
