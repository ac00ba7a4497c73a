"""Folders of runs whose logs are written by hand, for the tests of the report."""

import json

from jaxpets.envs.half_cheetah import TASK_NAMES

EXPLORED = 3


def write_run(folder, rows, **config):
    folder.mkdir(parents=True)
    config = {"preset": "laptop", "trial_length": 10, "num_bits": 16, **config}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "env.json").write_text(
        json.dumps({"jax": "9.9", "device_kind": "abacus"})
    )
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (folder / "metrics.jsonl").write_text(text)


def explore_rows(arm, seeds):
    return [
        {
            "phase": "explore",
            "arm": arm,
            "seed": seed,
            "trial": trial,
            "steps": 10 * trial,
            "planner": "random" if trial == 1 else "plan",
            "returns": {name: -float(trial + seed) for name in TASK_NAMES},
            "value": 0.0 if trial == 1 else 3.0 + trial,
            "turns": 0.5 * trial,
            "seconds": {"act": 2.0 + trial, "fit": 1.0},
        }
        for trial in range(1, EXPLORED + 1)
        for seed in seeds
    ]
