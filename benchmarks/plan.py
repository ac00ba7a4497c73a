"""Time of one action of model-predictive control, over precision and seeds.

Each seed has its own model; the time of a row is that of all its seeds together.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp

import jaxpets
from benchmarks import rows, timing, workloads
from jaxpets.envs import half_cheetah

COLUMNS = (
    "precision", "seeds", "num_samples", "horizon", "compile_s", "min_ms", "median_ms",
    "ms_per_seed", "tflops_per_s",
)  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every combination that was asked for."""
    base = workloads.chosen_size(args)
    for num_samples, horizon in itertools.product(
        args.num_samples or [base.num_samples], args.horizon or [base.horizon]
    ):
        size = dataclasses.replace(base, num_samples=num_samples, horizon=horizon)
        for precision in args.precision:
            for seeds in args.seeds:
                yield measure(size, precision, seeds, args)


def measure(
    size: workloads.Size, precision: str, seeds: int, args: argparse.Namespace
) -> dict[str, Any]:
    """Times one planner."""
    planner = workloads.planner(size, precision, args.optimizer, args.reward)
    keys = jax.random.split(jax.random.key(0), seeds)

    @jax.jit
    @jax.vmap
    def prepare(key: jax.Array) -> tuple[jaxpets.PlanParams, Any, jax.Array]:
        obs = 0.1 * jax.random.normal(key, (half_cheetah.OBS_SIZE,), jnp.float32)
        return workloads.plan_params(size, key, args.reward), planner.init(), obs

    params, state, obs = prepare(keys)
    result = timing.measure(
        jax.vmap(planner.step), params, keys, state, obs, repeats=args.repeats
    )
    candidates = workloads.candidates_per_action(size, args.optimizer)
    flops = seeds * workloads.rollout_flops(size, candidates)
    sizes = {
        **dataclasses.asdict(size),
        "precision": precision,
        "seeds": seeds,
        "optimizer": args.optimizer,
        "reward": args.reward,
    }
    return rows.make_row(
        "plan",
        sizes,
        **result._asdict(),
        ms_per_seed=result.median_ms / seeds,
        gflop=flops / 1e9,
        tflops_per_s=flops / result.median_ms / 1e9,
    )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--precision", nargs="+", choices=workloads.PRECISIONS, default=["bf16"]
    )
    parser.add_argument("--seeds", nargs="+", type=rows.positive, default=[1, 4, 16])
    parser.add_argument("--num-samples", nargs="+", type=rows.positive)
    parser.add_argument("--horizon", nargs="+", type=rows.positive)
    parser.add_argument("--optimizer", choices=workloads.OPTIMIZERS, default="cem")
    parser.add_argument("--reward", choices=workloads.REWARDS, default="epistemic")
    args = parser.parse_args(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
