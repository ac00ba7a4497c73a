"""How plans scale over the devices of this machine.

`seeds`: one seed per device, beside one seed on one device; efficiency is the time of
the latter over that of the former. `candidates`: one plan of many candidates, shared
out over devices, beside the same plan on one; efficiency is the speed-up per device.
`difference` is the largest, of any action, to the same plans computed on one device.
With `--plans 10` a call makes ten plans one after the other, as acting does.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import jaxpets
from benchmarks import plan, rows, timing, workloads

COLUMNS = (
    "benchmark", "engine", "devices", "num_samples", "compile_s", "one_ms", "all_ms",
    "efficiency", "difference",
)  # fmt: skip
AXIS = "device"


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every kind of work and number of devices."""
    size = workloads.chosen_size(args)
    samples = args.num_samples or 16 * size.num_samples
    large = dataclasses.replace(size, num_samples=samples)
    there = len(jax.devices())
    counts = [count for count in args.devices if count <= there]
    if not counts:
        least = min(args.devices)
        raise SystemExit(
            f"--devices must be at most {there}, all there are, got {least}"
        )
    for count in counts:
        yield seeds(size, count, args)
    for count in counts:
        yield candidates(large, count, args)


def seeds(size: workloads.Size, count: int, args: argparse.Namespace) -> dict[str, Any]:
    """Compares `count` seeds on as many devices with one seed on one."""
    planner = workloads.planner(size, args.precision, engine=args.engine)
    mesh = _mesh(count)
    inputs = jax.jit(jax.vmap(workloads.plan_inputs(size, planner)))(
        jax.random.split(jax.random.key(0), count)
    )
    each = [jax.tree.map(lambda x, i=i: x[i : i + 1], inputs) for i in range(count)]
    step = jax.vmap(plan.in_turn(planner, args.plans))
    one, _ = timing.compile_program(step, *each[0])
    spread = _over(mesh, step, P(AXIS), P(AXIS))
    inputs = jax.device_put(inputs, NamedSharding(mesh, P(AXIS)))
    every, compile_s = timing.compile_program(spread, *inputs)
    alone = np.concatenate([one(*own)[0] for own in each])
    return _row(
        "scale-seeds", size, count, args, compile_s,
        one=lambda: one(*each[0]),
        every=lambda: every(*inputs),
        difference=np.abs(np.asarray(every(*inputs)[0]) - alone).max(),
    )  # fmt: skip


def candidates(
    size: workloads.Size, count: int, args: argparse.Namespace
) -> dict[str, Any]:
    """Compares one plan over `count` devices with the plan on one."""
    rollout = workloads.rollout_fn(size, args.precision, args.engine)
    search = workloads.optimizer(size, "cem", args.engine)
    whole = jaxpets.plan(rollout, jaxpets.rewards.epistemic, search)
    parted = jaxpets.plan(
        rollout, jaxpets.rewards.epistemic, jaxpets.optimizers.sharded(search, AXIS)
    )
    inputs = jax.jit(workloads.plan_inputs(size, whole))(jax.random.key(0))
    one, _ = timing.compile_program(plan.in_turn(whole, args.plans), *inputs)
    mesh = _mesh(count)
    placed = jax.device_put(inputs, NamedSharding(mesh, P()))
    part = plan.in_turn(parted, args.plans)
    spread = _over(mesh, part, P(), P())
    every, compile_s = timing.compile_program(spread, *placed)
    # The same parts, with the same draws, on one device: an axis of vmap.
    parts = jax.vmap(lambda _: part(*inputs), axis_name=AXIS)
    same = jax.jit(parts)(jnp.arange(count))[0][0]
    return _row(
        "scale-candidates", size, count, args, compile_s,
        one=lambda: one(*inputs),
        every=lambda: every(*placed),
        difference=np.abs(np.asarray(every(*placed)[0]) - same).max(),
        parts=count,
    )  # fmt: skip


def _row(
    name: str, size: workloads.Size, count: int, args: argparse.Namespace,
    compile_s: float, *, one: Callable[[], Any], every: Callable[[], Any],
    difference: Any, parts: int = 1,
) -> dict[str, Any]:  # fmt: skip
    result = timing.compare(one, every, repeats=args.repeats)
    return rows.make_row(
        name,
        {
            **dataclasses.asdict(size),
            "precision": args.precision,
            "engine": args.engine,
            "plans": args.plans,
            "devices": count,
        },
        compile_s=compile_s,
        one_ms=result.first_ms,
        all_ms=result.second_ms,
        efficiency=result.ratio / parts,
        efficiency_of_min=result.ratio_of_min / parts,
        repeats=result.repeats,
        difference=float(difference),
    )


def _mesh(count: int) -> Mesh:
    return Mesh(np.array(jax.devices()[:count]), AXIS)


def _over(
    mesh: Mesh, function: Callable[..., Any], takes: P, gives: P
) -> Callable[..., Any]:
    return jax.shard_map(
        function, mesh=mesh, in_specs=takes, out_specs=gives, check_vma=False
    )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument(
        "--devices", nargs="+", type=rows.positive, default=[1, 2, 4],
        help="how many; those that are not there are left out",
    )  # fmt: skip
    parser.add_argument("--precision", choices=workloads.PRECISIONS, default="bf16")
    parser.add_argument(
        "--engine", choices=workloads.ENGINES, default="scan", help="what imagines"
    )
    parser.add_argument("--plans", type=rows.positive, default=1, help="of one call")
    parser.add_argument(
        "--num-samples", type=rows.positive, help="of the large plan; default 16 plans"
    )
    args = rows.parse(parser, argv, size="tiny")
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
