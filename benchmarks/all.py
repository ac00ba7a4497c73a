"""The set that is run on a GPU: plan, fit, rollout, env and trace, in 13 minutes.

Then prints all rows beside those that are committed for the same kind of device, and
the plans of other systems. Its exit code is 1 if anything is slower than nine tenths
of its committed speed, both as multiples of the plain XLA program's.
"""

import sys
import time
from collections.abc import Sequence
from typing import Any

from benchmarks import against, env, fit, plan, rollout, rows, trace

SET = (
    (plan, "--precision bf16 tf32 --seeds 1 4 16"),
    (plan, "--precision f32 --seeds 1 4 16"),
    (fit, "--seeds 1 4 16"),
    (rollout, "--precision bf16 tf32 f32"),
    (env, "--batch 1 4 16 64 256 4096"),
    # Last: left out where no kernel runs, or where there is no GPU.
    (plan, "--engine scan kernel --seeds 1 4 16"),
    (plan, "--engine scan kernel sm_90 --seeds 1 4 16 --plans 10"),
    (plan, "--engine scan kernel --seeds 1 --num-samples 125 250 1000 2000 4000 8000"),
    (trace, "--seeds 1 4 16"),
    (fit, "--engine kernel --seeds 1 4 16"),
)


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
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
    done = []
    for module, flags in SET:
        try:
            done += module.main([*flags.split(), *common])
        except SystemExit as reason:
            print(f"left out: {module.__name__} {flags}: {reason}")
        print(f"{time.perf_counter() - begin:.0f} s so far\n", flush=True)
    return done


if __name__ == "__main__":
    committed = against.committed_rows()  # before those of today are among them
    slower = against.report(main(), committed)
    for row in slower:
        print("slower:", row["benchmark"], row["sizes"], file=sys.stderr)
    sys.exit(bool(slower))
