"""Folders of runs whose logs are written by hand, for the tests of the report."""

import json

import pytest
from matplotlib.figure import Figure

from experiments.report import style
from experiments.report.report import write_report
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


def report_in(out):
    """Reports with figures that are small and have no layout, which takes the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(style.STYLE, "savefig.dpi", 30)
        patch.setattr(style, "Figure", lambda figsize, layout: Figure(figsize))
        written = write_report(out, out / "report")
    return written, (out / "report" / "report.md").read_text()
