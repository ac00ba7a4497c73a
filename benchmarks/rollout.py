"""Time of one particle rollout: the model's share of one iteration of planning."""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import rows, timing, workloads
from jaxpets.envs import half_cheetah

COLUMNS = ("precision", "compile_s", "min_ms", "median_ms", "us_per_step",
           "tflops_per_s")  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every precision."""
    size = workloads.chosen_size(args)
    params_key, action_key, key = jax.random.split(jax.random.key(0), 3)
    params = jax.jit(lambda key: workloads.params(size, key))(params_key)
    shape = (size.num_samples, size.horizon, half_cheetah.ACTION_SIZE)
    actions = jax.random.uniform(action_key, shape, jnp.float32, -1.0, 1.0)
    obs = jnp.zeros((half_cheetah.OBS_SIZE,), jnp.float32)
    for precision in args.precision:
        rollout = workloads.rollout_fn(size, precision)
        result = timing.measure(
            rollout, params, key, obs, actions, repeats=args.repeats
        )
        flops = workloads.rollout_flops(size, size.num_samples)
        yield rows.make_row(
            "rollout",
            {**dataclasses.asdict(size), "precision": precision},
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
    args = parser.parse_args(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
