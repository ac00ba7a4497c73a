"""What `jaxpets.agent` adds to a plan: `act` and the plan alone, awaited, in turn.

The plan alone is one compiled call whose action comes to the host. `act` checks and
copies the observation besides, and keeps what it did for `observe`. `added_ms` is the
median of the differences, pair by pair.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

import jaxpets
from benchmarks import rows, timing, workloads
from jaxpets.envs import half_cheetah

COLUMNS = ("added_ms", "act_ms", "act_p99_ms", "plan_ms", "plan_p99_ms", "size",
           "engine")  # fmt: skip
Call = Callable[[], np.ndarray]


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields one row."""
    size = workloads.chosen_size(args)
    planner = workloads.planner(size, "f32", args.optimizer, engine=args.engine)
    pairs = timing.in_turn(*calls(size, planner), repeats=args.repeats)
    acts, plans = 1e3 * np.asarray(pairs).T
    yield rows.make_row(
        "agent",
        {"size": args.size, "engine": args.engine, "optimizer": args.optimizer},
        added_ms=float(np.median(acts - plans)),
        act_ms=float(np.median(acts)),
        act_p99_ms=float(np.percentile(acts, 99)),
        plan_ms=float(np.median(plans)),
        plan_p99_ms=float(np.percentile(plans, 99)),
        repeats=args.repeats,
    )


def calls(size: workloads.Size, planner: jaxpets.Planner) -> tuple[Call, Call]:
    """Returns `act` of an agent, and its plan alone."""
    key = jax.random.key(0)
    params = jax.jit(lambda: workloads.plan_params(size, key, "epistemic"))()
    one = np.ones(half_cheetah.ACTION_SIZE, np.float32)
    agent = jaxpets.agent(
        planner,
        workloads.model(size, "f32"),
        workloads.fitter(size),
        random_planner=jaxpets.random_planner(-one, one),
        capacity=1000,
        params=params.dynamics,
    )
    agent.perform(params.reward)
    obs = np.asarray(workloads.transitions(key, 1).obs[0])
    step, state = jax.jit(planner.step), planner.init()
    return (
        lambda: agent.act(obs),
        lambda: np.asarray(step(params, key, state, obs)[0].action),
    )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--optimizer", choices=workloads.OPTIMIZERS, default="icem", help="search"
    )
    parser.add_argument(
        "--engine", choices=workloads.ENGINES, default="kernel", help="what imagines"
    )
    parser.set_defaults(size="laptop", repeats=1000)
    args = parser.parse_args(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
