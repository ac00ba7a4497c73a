"""The set that is run on a GPU: plan, fit, rollout, env and trace, in 13 minutes.

Then prints all rows beside those that are committed for the same kind of device, and
the plans of other systems. Its exit code is 1 if anything is slower than nine tenths
of its committed speed, both in units of a plain program (`against`), or if a program
cannot run of which this kind of GPU has rows.
"""

import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from benchmarks import against, env, fit, plan, rollout, rows, trace

# A program that cannot run is left out, so kernels have entries of their own.
SET = (
    (plan, "--precision bf16 tf32 --seeds 1 4 16"),
    (plan, "--precision f32 --seeds 1 4 16"),
    (fit, "--seeds 1 4 16"),
    (rollout, "--precision bf16 tf32 f32"),
    (env, "--batch 1 4 16 64 256 4096"),
    (plan, "--seeds 1 4 16"),
    (plan, "--engine kernel --seeds 1 4 16"),
    (plan, "--seeds 1 4 16 --plans 10"),
    (plan, "--engine kernel sm_90 --seeds 1 4 16 --plans 10"),
    (plan, "--seeds 1 --num-samples 125 250 1000 2000 4000 8000"),
    (plan, "--engine kernel --seeds 1 --num-samples 125 250 1000 2000 4000 8000"),
    (trace, "--seeds 1 4 16"),
    (fit, "--engine kernel --seeds 1 4 16"),
)


class Outcome(NamedTuple):
    """What the set has measured, and the commands of it that could not run."""

    rows: list[dict[str, Any]]
    left_out: list[str]


def main(argv: Sequence[str] | None = None) -> Outcome:
    """Runs the set; every row is on disk as soon as it is measured."""
    parser = rows.parser(__doc__)
    parser.set_defaults(repeats=30)
    args = parser.parse_args(argv)
    common = ["--repeats", str(args.repeats)]
    if args.tiny:
        common.append("--tiny")
    if args.json is not None:
        common += ["--json", str(args.json)]
    begin = time.perf_counter()
    outcome = Outcome([], [])
    for module, flags in SET:
        command = f"{module.__name__} {flags}"
        try:
            outcome.rows.extend(module.main([*flags.split(), *common]))
        except SystemExit as reason:
            if isinstance(reason.code, int):  # of argparse
                raise
            print(f"left out: {command}: {reason}")
            outcome.left_out.append(command)
        print(f"{time.perf_counter() - begin:.0f} s so far\n", flush=True)
    return outcome


def gone(
    left_out: Sequence[str], committed: Sequence[dict[str, Any]], device: str
) -> list[str]:
    """Returns the commands that could not run of which a device has committed rows."""
    known = {
        row.get("benchmark")
        for row in committed
        if row["device"] == device and row.get("sizes", {}).get("engine") != "scan"
    }
    return [
        command
        for command in left_out
        if command.split()[0].removeprefix("benchmarks.") in known
    ]


if __name__ == "__main__":
    before = against.committed_rows()  # those of today will be among them
    found = main()
    failed = [
        f"slower: {row['benchmark']} {row['sizes']}"
        for row in against.report(found.rows, before)
    ]
    if jax.default_backend() == "gpu":
        kind = jax.devices()[0].device_kind
        failed += [f"gone: {x}" for x in gone(found.left_out, before, kind)]
    for line in failed:
        print(line, file=sys.stderr)
    sys.exit(bool(failed))
