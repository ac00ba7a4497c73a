"""Time of one gradient step of the ensemble, over seeds that train side by side.

What is timed is a call of `Fitter.step`: scaler, bootstraps, shuffles and all updates.
"""

import argparse
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax

from benchmarks import rows, timing, workloads

COLUMNS = ("engine", "seeds", "rows", "capacity", "updates", "compile_s", "min_ms",
           "median_ms", "us_per_update")  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every engine and number of seeds."""
    size = workloads.named_size("tiny" if args.tiny else "paper")
    capacity = max(args.rows, args.capacity or 0)
    updates = args.epochs * -(-args.rows // args.batch_size)
    fitters = {
        engine: workloads.fitter(size, args.epochs, args.batch_size, engine)
        for engine in args.engine
    }
    for engine, seeds in itertools.product(args.engine, args.seeds):
        fitter = fitters[engine]
        keys = jax.random.split(jax.random.key(0), seeds)
        params, state, data = workloads.prepare_fit(
            size, fitter, keys, args.rows, capacity
        )
        result = timing.measure(
            workloads.fit_seeds(fitter), params, keys, state, data, repeats=args.repeats
        )
        sizes = {
            "engine": engine,
            "seeds": seeds,
            "rows": args.rows,
            "capacity": capacity,
            "updates": updates,
            "batch_size": args.batch_size,
            "num_members": size.num_members,
            "hidden_sizes": size.hidden_sizes,
        }
        yield rows.make_row(
            "fit",
            sizes,
            **result._asdict(),
            us_per_update=1e3 * result.median_ms / updates,
        )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.add_argument("--engine", nargs="+", choices=("scan", "kernel"),
                        default=["scan"], help="what trains")  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=rows.positive, default=[1, 4, 16])
    parser.add_argument("--rows", type=rows.positive, default=10_000, help="of data")
    parser.add_argument(
        "--capacity", type=rows.positive, help="of the dataset; as many as rows if less"
    )
    parser.add_argument("--epochs", type=rows.positive, default=5)
    parser.add_argument("--batch-size", type=rows.positive, default=32)
    args = rows.parse(parser, argv, rows=100)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
