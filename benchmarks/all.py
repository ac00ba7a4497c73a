"""The set that is run on a GPU: plan, fit, rollout, env and trace, in 8 to 12 minutes.

Then prints all rows beside those that are committed for the same kind of device, and
the plans of other systems. What is slower than nine tenths of its committed speed, both
in units of a plain program (`against`), is timed once more, as hosts are slow for a
while. The exit code is 1 if it is slower again, or if a program cannot run of which
this kind of GPU has rows.
"""

import functools
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from benchmarks import against, env, fit, plan, rollout, rows, trace

Row = against.Row
Command = tuple[Any, str]  # a module of this folder, and its flags

# A program that cannot run is left out, so kernels have entries of their own.
# `env` has its own batches, since `--tiny` spares those only that nobody says.
SET = (
    (plan, "--precision bf16 tf32 --seeds 1 4 16"),
    (plan, "--precision f32 --seeds 1 4 16"),
    (fit, "--seeds 1 4 16"),
    (rollout, "--precision bf16 tf32 f32"),
    (env, ""),
    (plan, "--seeds 1 4 16"),
    (plan, "--engine kernel --seeds 1 4 16"),
    (plan, "--seeds 1 4 16 --plans 10"),
    (plan, "--engine kernel sm_90 --seeds 1 4 16 --plans 10"),
    (plan, "--seeds 1 --num-samples 125 250 1000 2000 4000 8000"),
    (plan, "--engine kernel --seeds 1 --num-samples 125 250 1000 2000 4000 8000"),
    (trace, "--seeds 1 4 16"),
    (fit, "--engine kernel --seeds 1 4 16"),
)


# What others are counted in, unless they bring it along.
UNIT = (plan, "--precision bf16 --seeds 1")


class Outcome(NamedTuple):
    """What was measured, by which command, and the commands that could not run."""

    rows: list[Row]
    commands: list[Command]  # of each row
    left_out: list[str]


def main(
    argv: Sequence[str] | None = None, commands: Sequence[Command] | None = None
) -> Outcome:
    """Runs the set, or these; every row is on disk as soon as it is measured."""
    parser = rows.parser(__doc__)
    parser.set_defaults(repeats=30)
    args = parser.parse_args(argv)
    common = ["--repeats", str(args.repeats)]
    if args.tiny:
        common.append("--tiny")
    if args.json is not None:
        common += ["--json", str(args.json)]
    begin = time.perf_counter()
    outcome = Outcome([], [], [])
    for command in SET if commands is None else commands:
        module, flags = command
        text = f"{module.__name__} {flags}"
        try:
            found = module.main([*flags.split(), *common])
        except SystemExit as reason:
            if isinstance(reason.code, int):  # of argparse
                raise
            print(f"left out: {text}: {reason}")
            outcome.left_out.append(text)
        else:
            outcome.rows.extend(found)
            outcome.commands.extend([command] * len(found))
        print(f"{time.perf_counter() - begin:.0f} s so far\n", flush=True)
    return outcome


def slower(
    outcome: Outcome,
    committed: Sequence[Row],
    again: Callable[[Sequence[Command]], Outcome],
) -> list[Row]:
    """Returns the rows that are slower than the committed ones, and are so again.

    Args:
      outcome: of the set.
      committed: rows to compare with.
      again: runs commands.
    """
    once = against.report(outcome.rows, committed)
    pairs = zip(outcome.rows, outcome.commands, strict=True)
    commands = [command for row, command in pairs if row in once]
    if not commands:
        return []
    print("\nwhat is slower is timed once more\n", flush=True)
    rows_again = again([UNIT, *dict.fromkeys(commands)]).rows
    twice = against.report(rows_again, committed)
    quick = {*map(against.key, rows_again)} - {*map(against.key, twice)}
    return [row for row in once if against.key(row) not in quick]


def gone(left_out: Sequence[str], committed: Sequence[Row], device: str) -> list[str]:
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
        for row in slower(found, before, functools.partial(main, None))
    ]
    kind = jax.devices()[0].device_kind
    against.peers(before, kind)
    if jax.default_backend() == "gpu":
        failed += [f"gone: {x}" for x in gone(found.left_out, before, kind)]
    for line in failed:
        print(line, file=sys.stderr)
    sys.exit(bool(failed))
