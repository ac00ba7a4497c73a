"""Pairs of programs run in turn in one process: what holds on a busy machine too.

A ratio above 1 says that the second is faster. It is the median over pairs of runs;
ratio_of_min compares the fastest run of each.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from benchmarks import env, rows, timing, workloads
from jaxpets.envs import half_cheetah

COLUMNS = ("first_ms", "second_ms", "ratio", "ratio_of_min", "first", "second")
Call = Callable[[], Any]


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row per pair."""
    size = workloads.chosen_size(args)
    steps = 3 if args.tiny else 20
    f32 = plan_call(size, "f32", "cem")
    pairs: list[tuple[str, str, Callable[[], tuple[Call, Call]]]] = [
        (
            "plan f32",
            "plan bf16",
            lambda: (f32, plan_call(size, "bf16", "cem")),
        ),
        (
            "plan cem f32",
            "plan icem f32",
            lambda: (f32, plan_call(size, "f32", "icem")),
        ),
        (
            "plan cem f32",
            "its rollouts alone",
            lambda: (f32, rollouts_call(size, "f32")),
        ),
        (
            "fit of 4 seeds, in turn",
            "fit of 4 seeds, vmap",
            lambda: fit_calls(args.tiny),
        ),
        (
            f"{steps} env steps, MJX",
            f"{steps} env steps, C",
            lambda: (mjx_call(1, steps), env.loop_call(steps)),
        ),
        (
            f"{steps} env steps, 16 x C",
            f"{steps} env steps, MJX batch 16",
            lambda: (env.loop_call(16 * steps), mjx_call(16, steps)),
        ),
        # Last: it ends where no kernel runs.
        (
            "plan f32, scan",
            "plan f32, kernel",
            lambda: (f32, plan_call(size, "f32", "cem", "kernel")),
        ),
    ]
    # Two pairs that compile fast show that it works.
    for first, second, build in pairs[:4:3] if args.tiny else pairs:
        result = timing.compare(*build(), repeats=args.repeats)
        sizes = {"first": first, "second": second, "size": args.size}
        yield rows.make_row("ratios", sizes, **result._asdict())


def mjx_call(batch: int, steps: int) -> Call:
    """Returns `steps` steps of a batch on MJX, compiled."""
    return env.env_call(half_cheetah.half_cheetah(), batch, steps)[0]


def plan_call(
    size: workloads.Size, precision: str, search: str, engine: str = "scan"
) -> Call:
    """Returns one action of planning, compiled."""
    planner = workloads.planner(size, precision, search, engine=engine)
    key = jax.random.key(0)
    params = jax.jit(lambda: workloads.plan_params(size, key, "epistemic"))()
    state, obs = planner.init(), workloads.transitions(key, 1).obs[0]
    step, _ = timing.compile_program(planner.step, params, key, state, obs)
    return lambda: step(params, key, state, obs)


def rollouts_call(size: workloads.Size, precision: str) -> Call:
    """Returns the rollouts of one action with `cem`, compiled."""
    rollout, inputs = workloads.rollout_work(size, precision)
    program, _ = timing.compile_program(rollout, *inputs)
    return lambda: [program(*inputs) for _ in range(size.num_iterations)]


def fit_calls(tiny: bool) -> tuple[Call, Call]:
    """Returns the training of 4 seeds, one after the other and side by side."""
    size = workloads.named_size("tiny" if tiny else "paper")
    fitter = workloads.fitter(size, num_epochs=1)
    keys = jax.random.split(jax.random.key(0), 4)
    params, state, data = workloads.prepare_fit(size, fitter, keys, 640, 640)
    inputs = (params, keys, state, data)
    # The size of the data has no axis: it is the same for all seeds.
    pick = lambda x, i: x[i] if x.ndim else x  # noqa: E731
    single = [jax.tree.map(lambda x, i=i: pick(x, i), inputs) for i in range(4)]
    one, _ = timing.compile_program(fitter.step, *single[0])
    many, _ = timing.compile_program(workloads.fit_seeds(fitter), *inputs)
    return lambda: [one(*each) for each in single], lambda: many(*inputs)


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.set_defaults(size="laptop")
    args = rows.parse(parser, argv, size="tiny")
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
