"""Time of one trial: acting in HalfCheetah with a planner, then training.

Acting and training are separate programs, as in the experiments.
"""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax

import jaxpets
from benchmarks import rows, timing, workloads
from benchmarks.env import ENGINES

COLUMNS = ("engine", "precision", "seeds", "steps", "rows", "compile_s", "unroll_s",
           "ms_per_step", "fit_s", "trial_s")  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every number of seeds."""
    size = workloads.chosen_size(args)
    for seeds in args.seeds:
        keys = jax.random.split(jax.random.key(0), seeds)
        act = time_unroll(size, args, keys)
        learn = time_fit(size, keys, args.rows, args.repeats)
        sizes = {
            **dataclasses.asdict(size),
            "engine": args.engine,
            "precision": args.precision,
            "optimizer": args.optimizer,
            "seeds": seeds,
            "steps": args.steps,
            "rows": args.rows,
        }
        yield rows.make_row(
            "trial",
            sizes,
            compile_s=act.compile_s + learn.compile_s,
            min_ms=act.min_ms + learn.min_ms,
            median_ms=act.median_ms + learn.median_ms,
            p99_ms=act.p99_ms + learn.p99_ms,
            repeats=args.repeats,
            unroll_s=act.median_ms / 1e3,
            ms_per_step=act.median_ms / args.steps,
            fit_s=learn.median_ms / 1e3,
            trial_s=(act.median_ms + learn.median_ms) / 1e3,
        )


def time_unroll(
    size: workloads.Size, args: argparse.Namespace, keys: jax.Array
) -> timing.Timing:
    """Times reset and `--steps` steps of planning and acting."""
    env = ENGINES[args.engine]()
    planner = workloads.planner(size, args.precision, args.optimizer)
    prepare = jax.vmap(lambda key: workloads.plan_params(size, key, "epistemic"))
    params = jax.jit(prepare)(keys)

    def act(params: jaxpets.PlanParams, key: jax.Array) -> jaxpets.Transition:
        reset_key, act_key = jax.random.split(key)
        state = jaxpets.start_trial(env, planner, reset_key)
        length = args.steps
        return jaxpets.unroll(env, planner, params, act_key, state, length=length)[1]

    return timing.measure(jax.vmap(act), params, keys, repeats=args.repeats)


def time_fit(
    size: workloads.Size, keys: jax.Array, num_rows: int, repeats: int
) -> timing.Timing:
    """Times the training after a trial."""
    fitter = workloads.fitter(size)
    params, state, data = workloads.prepare_fit(size, fitter, keys, num_rows, num_rows)
    return timing.measure(
        workloads.fit_seeds(fitter), params, keys, state, data, repeats=repeats
    )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.set_defaults(repeats=1)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--precision", choices=workloads.PRECISIONS, default="bf16", help="of planning"
    )
    parser.add_argument(
        "--engine", choices=ENGINES, default="mjx", help="of the physics"
    )
    parser.add_argument("--optimizer", choices=workloads.OPTIMIZERS, default="cem")
    parser.add_argument("--seeds", nargs="+", type=rows.positive, default=[1])
    parser.add_argument("--steps", type=rows.positive, default=1000)
    parser.add_argument(
        "--rows", type=rows.positive, default=30_000, help="of data to train on"
    )
    args = rows.parse(parser, argv, size="tiny", steps=3, rows=100)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
