"""`python experiments/tools/digests.py CHECKOUT`: what no change of form may change.

Runs preset `smoke` in every arm, phase and engine, and three trials of `laptop`, with
the code of a checkout, and prints a digest of every log, without its seconds, and of
every array of every checkpoint, as JSON. Two checkouts whose digests are equal on one
machine compute the same, bit for bit. It imports nothing of either of them.
"""

import argparse
import concurrent.futures
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ARMS = ("epistemic", "count", "random", "oracle", "one-step", "info-gain", "best")
ENGINES = ("mujoco", "mjx")
PHASES = ("explore", "zero-shot", "finetune")
# Names in a log that have changed while their numbers have not: old -> new.
RENAMED = {"loss": "nll"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs everything, prints the digests, and returns how many runs failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--only", default="", help="runs whose name has this in it")
    args = parser.parse_args(argv)
    chains = {name: steps for name, steps in cases().items() if args.only in name}
    with tempfile.TemporaryDirectory() as out:

        def run(name: str) -> tuple[str, dict[str, Any]]:
            return name, _chain(args, Path(out, name), chains[name])

        with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
            found = dict(pool.map(run, chains))
    print(json.dumps(found, indent=1, sort_keys=True))
    return sum("failed" in digests for digests in found.values())


def cases() -> dict[str, list[list[str]]]:
    """Returns the command lines of every run, without the folder they write to."""
    found = {}
    for engine in ENGINES:
        for arm in ARMS:
            own = ["--preset", "smoke", "--arm", arm, "--engine", engine]
            steps = [["--phase", phase, *own] for phase in PHASES]
            found[f"smoke-{arm}-{engine}"] = steps
    own = ["--preset", "smoke", "--engine", "mujoco", "--seeds", "3", "7"]
    refit = ["--refit.num-epochs", "2", "--tag", "refit", "--pessimism", "0.5"]
    mppi = ["--tag", "mppi", "--task-planner.optimizer", "mppi"]
    mppi.append("--task-planner.no-fused")
    found["smoke-two-seeds"] = [
        ["--phase", "explore", *own],
        ["--phase", "zero-shot", *own, *refit],
        ["--phase", "finetune", *own, *refit],
        ["--phase", "zero-shot", *own, *mppi],
    ]
    own = ["--preset", "laptop", "--num-trials", "3"]
    found["laptop"] = [["--phase", phase, *own] for phase in PHASES[:2]]
    return found


def _chain(args: argparse.Namespace, out: Path, steps: list[list[str]]) -> Any:
    for flags in steps:
        done = subprocess.run(
            [args.python, "-m", "experiments.run", *flags, "--out", str(out)],
            cwd=args.checkout, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(args.checkout.resolve())},
        )  # fmt: skip
        if done.returncode:
            return {"failed": " ".join(flags), "stderr": done.stderr[-2000:]}
    return dict(found_in(out))


def found_in(out: Path) -> Iterator[tuple[str, str]]:
    """Yields names and digests of all logs and checkpoints below a folder."""
    for log in sorted(out.rglob("metrics.jsonl")):
        rows = [json.loads(line) for line in log.read_text().splitlines()]
        text = json.dumps([_comparable(row) for row in rows], sort_keys=True)
        yield str(log.relative_to(out)), hashlib.sha256(text.encode()).hexdigest()
    for step in sorted(out.rglob("checkpoints/[0-9]*")):
        for name, array in sorted(_arrays(step).items()):
            text = f"{array.dtype}{array.shape}".encode() + array.tobytes()
            key = f"{step.relative_to(out)}:{name}"
            yield key, hashlib.sha256(text).hexdigest()


def _comparable(row: dict[str, Any]) -> dict[str, Any]:
    timed = ("seconds", "check")  # the check is of the seconds, too
    row = {key: value for key, value in row.items() if key not in timed}
    if fit := row.get("fit"):
        row["fit"] = {RENAMED.get(key, key): value for key, value in fit.items()}
    return row


def _arrays(step: Path) -> dict[str, Any]:
    import logging

    import numpy as np
    import orbax.checkpoint as ocp

    logging.getLogger("absl").setLevel(logging.CRITICAL)
    tree = ocp.StandardCheckpointer().restore(step.resolve() / "state")
    return {name: np.asarray(array) for name, array in tree.items()}


if __name__ == "__main__":
    sys.exit(main())
