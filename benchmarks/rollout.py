"""Time of one particle rollout: the model's share of one iteration of planning."""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks import costs, rows, timing, workloads

COLUMNS = ("engine", "precision", "compile_s", "min_ms", "median_ms", "us_per_step",
           "tflops_per_s")  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every precision."""
    size = workloads.chosen_size(args)
    for engine, precision in itertools.product(args.engine, args.precision):
        rollout, inputs = workloads.rollout_work(size, precision, engine)
        result = timing.measure(rollout, *inputs, repeats=args.repeats)
        flops = costs.rollout_flops(size, size.num_samples)
        yield rows.make_row(
            "rollout",
            {**dataclasses.asdict(size), "precision": precision, "engine": engine},
            arch=workloads.arch(size, precision, engine),
            **result._asdict(),
            us_per_step=1e3 * result.median_ms / size.horizon,
            tflops_per_s=flops / result.median_ms / 1e9,
        )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--precision", nargs="+", choices=workloads.PRECISIONS, default=["bf16"]
    )
    parser.add_argument("--engine", nargs="+", choices=workloads.ENGINES,
                        default=["scan"], help="what imagines")  # fmt: skip
    args = rows.parse(parser, argv, size="tiny")
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
