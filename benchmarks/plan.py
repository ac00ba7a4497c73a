"""Time of one action of model-predictive control, over precision and seeds.

Each seed has its own model; the time of a row is that of all its seeds together. With
`--plans 10` a call makes ten plans one after the other, as acting does: what a call
costs the host is then shared.

With `--gemm`, `gemm_fraction` is the rate of the plan's matrix products over that of
bare ones in the same precision, `f32_gemm_fraction` over that of bare ones in float32:
a large square or one hidden layer, whichever is faster, run in turn with the plan. Of
each the fastest run counts.
"""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from benchmarks import costs, rows, timing, workloads

COLUMNS = (
    "engine", "precision", "seeds", "plans", "num_samples", "horizon", "compile_s",
    "min_ms", "median_ms", "ms_per_plan", "tflops_per_s", "gemm_fraction",
)  # fmt: skip


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every combination that was asked for."""
    base = workloads.chosen_size(args)
    for num_samples, horizon in itertools.product(
        args.num_samples or [base.num_samples], args.horizon or [base.horizon]
    ):
        size = dataclasses.replace(base, num_samples=num_samples, horizon=horizon)
        for engine, precision in itertools.product(args.engine, args.precision):
            for seeds in args.seeds:
                yield measure(size, engine, precision, seeds, args)


def measure(
    size: workloads.Size, engine: str, precision: str, seeds: int,
    args: argparse.Namespace,
) -> dict[str, Any]:  # fmt: skip
    """Times one planner."""
    planner = workloads.planner(
        size, precision, args.optimizer, args.reward, args.chunk_size, engine
    )
    prepare = jax.jit(jax.vmap(workloads.plan_inputs(size, planner, args.reward)))
    inputs = prepare(jax.random.split(jax.random.key(0), seeds))
    program = in_turn(planner, args.plans) if args.plans > 1 else planner.step
    step, compile_s = timing.compile_program(jax.vmap(program), *inputs)
    call = functools.partial(step, *inputs)
    result = timing.repeat(call, compile_s, repeats=args.repeats)
    candidates = costs.candidates_per_action(size, args.optimizer)
    plans = seeds * args.plans
    flops = plans * costs.rollout_flops(size, candidates)
    sizes = {
        **dataclasses.asdict(size),
        "precision": precision,
        "seeds": seeds,
        "plans": args.plans,
        "optimizer": args.optimizer,
        "reward": args.reward,
        "chunk_size": args.chunk_size,
        "engine": engine,
    }
    beside = beside_gemm(call, flops, size, precision, args) if args.gemm else {}
    return rows.make_row(
        "plan",
        sizes,
        name="jaxpets",
        dtype=precision,
        seeds=seeds,
        engine=engine,
        arch=workloads.arch(size, precision, engine),
        awaited=args.plans == 1,
        ms_per_plan=result.median_ms / plans,
        **result._asdict(),
        gflop=flops / 1e9,
        tflops_per_s=flops / result.median_ms / 1e9,
        **beside,
    )


def in_turn(planner: jaxpets.Planner, plans: int) -> Callable[..., Any]:
    """Returns a program of so many plans in turn; it returns their actions first."""

    def run(params: Any, key: jax.Array, state: Any, obs: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            out, state = planner.step(params, key, state, obs)
            return state, out.action

        state, actions = jax.lax.scan(step, state, jax.random.split(key, plans))
        return actions, state

    return run


def beside_gemm(
    call: Callable[[], Any],
    flops: float,
    size: workloads.Size,
    precision: str,
    args: argparse.Namespace,
) -> dict[str, float]:
    """Compares a compiled plan with bare matrix products, run in turn with it."""
    side = 8192 if jax.default_backend() == "gpu" else 2048
    side = 64 if args.tiny else side
    bare = {name: bare_products(size, name, side) for name in ("f32", precision)}
    rate, best = 0.0, dict.fromkeys(bare, 0.0)
    for _ in range(args.repeats):
        rate = max(rate, flops / timing.seconds(call))
        for name, products in bare.items():
            for work, product in products:
                seconds = min(timing.seconds(product) for _ in range(20))
                best[name] = max(best[name], work / seconds)
    return {
        "gemm_tflops_per_s": best[precision] / 1e12,
        "gemm_fraction": rate / best[precision],
        "f32_gemm_fraction": rate / best["f32"],
    }


def bare_products(
    size: workloads.Size, precision: str, side: int
) -> list[tuple[float, Callable]]:
    """Returns bare matrix products, each with its operations and its compiled call.

    They are a square of `side`, and the batch of a hidden layer of one model step,
    `[E, N * P, W] x [E, W, W]`, both in the precision of the network's products.
    """
    inputs = size.num_samples * size.num_particles // size.num_members
    width = size.hidden_sizes[0]
    dtype = jnp.bfloat16 if precision == "bf16" else jnp.float32
    exact = jax.lax.Precision.HIGHEST if precision == "f32" else None

    def product(x: Array, y: Array) -> Array:
        return jnp.matmul(x, y, precision=exact, preferred_element_type=jnp.float32)

    done = []
    for batch, many, inner in [(1, side, side), (size.num_members, inputs, width)]:
        x = jnp.full((batch, many, inner), 0.5, dtype)
        y = jnp.full((batch, inner, inner), 0.5, dtype)
        compiled = jax.jit(product).lower(x, y).compile()
        call = functools.partial(compiled, x, y)
        done.append((2.0 * batch * many * inner**2, call))
    return done


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--precision", nargs="+", choices=workloads.PRECISIONS, default=["bf16"]
    )
    parser.add_argument("--engine", nargs="+", choices=workloads.ENGINES,
                        default=["scan"], help="what imagines")  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=rows.positive, default=[1, 4, 16])
    parser.add_argument("--plans", type=rows.positive, default=1, help="of one call")
    parser.add_argument("--num-samples", nargs="+", type=rows.positive)
    parser.add_argument("--horizon", nargs="+", type=rows.positive)
    parser.add_argument("--optimizer", choices=workloads.OPTIMIZERS, default="cem")
    parser.add_argument("--reward", choices=workloads.REWARDS, default="epistemic")
    parser.add_argument(
        "--chunk-size", type=rows.positive, help="candidates at a time; default all"
    )
    parser.add_argument(
        "--gemm", action="store_true", help="compare with bare matrix products"
    )
    args = rows.parse(parser, argv, size="tiny")
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
