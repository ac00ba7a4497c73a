"""Where the GPU's time goes in a plan: the kernel of the rollout, and the rest.

Ten plans in turn are traced by JAX's profiler. `outside` is the share of the GPU's busy
time that is not the rollout's, `idle` that of the plan's whole time, measured without
the profiler, in which the GPU does nothing. The ten programs that take longest are
listed with their microseconds and launches per plan of all seeds together.
"""

import argparse
import dataclasses
import functools
import gzip
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks import plan, rows, timing, workloads

COLUMNS = (
    "seeds", "ms_per_plan", "busy_us", "rollout_us", "outside", "idle", "programs",
)  # fmt: skip
ROLLOUT = "rollout_kernel"  # what CUDA calls it
_LONGEST = 10
_PLANS = 10


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every number of seeds."""
    if jax.default_backend() != "gpu":
        raise SystemExit("there is no GPU whose programs could be traced")
    size = workloads.chosen_size(args)
    planner = workloads.planner(size, "bf16", engine="kernel")
    prepare = jax.jit(jax.vmap(workloads.plan_inputs(size, planner)))
    for seeds in args.seeds:
        inputs = prepare(jax.random.split(jax.random.key(0), seeds))
        program = jax.vmap(plan.in_turn(planner, _PLANS))
        compiled, compile_s = timing.compile_program(program, *inputs)
        call = functools.partial(compiled, *inputs)
        result = timing.repeat(call, compile_s, repeats=args.repeats)
        programs = traced(call)
        yield _row(size, seeds, result, programs)


def traced(call: Callable[[], Any]) -> dict[str, tuple[float, int]]:
    """Returns microseconds and launches of every GPU program in a call."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(call())
        (path,) = Path(folder).rglob("*.trace.json.gz")
        return programs_of(json.loads(gzip.decompress(path.read_bytes())))


def programs_of(trace: dict[str, Any]) -> dict[str, tuple[float, int]]:
    """Returns microseconds and launches by name, of what ran on a GPU's streams.

    Args:
      trace: in the format of Chrome's trace viewer, as the profiler writes it.
    """
    events = trace["traceEvents"]
    names = {
        (event["pid"], event.get("tid") if kind == "thread_name" else None): (
            event["args"]["name"]
        )
        for event in events
        if (kind := event.get("name")) in ("process_name", "thread_name")
    }
    time: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for event in events:
        device = names.get((event.get("pid"), None), "")
        stream = names.get((event.get("pid"), event.get("tid")), "")
        if event.get("ph") == "X" and "GPU" in device and "Stream" in stream:
            time[event["name"]] += event["dur"]
            count[event["name"]] += 1
    return {name: (time[name], count[name]) for name, _ in time.most_common()}


def _row(
    size: workloads.Size, seeds: int, result: timing.Timing,
    programs: dict[str, tuple[float, int]],
) -> dict[str, Any]:  # fmt: skip
    busy = sum(us for us, _ in programs.values()) / _PLANS
    own = sum(us for name, (us, _) in programs.items() if ROLLOUT in name) / _PLANS
    if not own:
        raise SystemExit(f"no {ROLLOUT} in the trace, only {', '.join(programs)}")
    whole = 1e3 * result.median_ms / _PLANS
    return rows.make_row(
        "trace",
        {**dataclasses.asdict(size), "precision": "bf16", "seeds": seeds},
        **result._asdict(),
        ms_per_plan=whole / 1e3 / seeds,
        busy_us=busy,
        rollout_us=own,
        outside=1 - own / busy,
        idle=1 - busy / whole,
        programs=sum(count for _, count in programs.values()) / _PLANS,
        longest=[
            [name, us / _PLANS, count / _PLANS]
            for name, (us, count) in [*programs.items()][:_LONGEST]
        ],
    )


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser)
    parser.add_argument("--seeds", nargs="+", type=rows.positive, default=[1, 4])
    args = rows.parse(parser, argv, size="tiny")
    done = rows.report(run(args), COLUMNS, args.json)
    for row in done:
        print(f"{row['sizes']['seeds']} seeds, us and launches per plan:")
        for name, us, count in row["longest"]:
            print(f"{us:10.1f} {count:6.1f}  {name[:80]}")
    return done


if __name__ == "__main__":
    main()
