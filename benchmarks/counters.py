r"""What a GPU's counters say of a kernel, by Nsight Compute, which runs beside it.

It profiles this program, which runs the kernel three times, and its pages of numbers
become rows:

    export XLA_FLAGS=--xla_gpu_enable_command_buffer=
    ncu --set full --clock-control none --target-processes application-only \
        --launch-skip 2 -c 1 -k "regex:(rollout|epoch)_kernel" -o seen \
        python -m benchmarks.counters
    ncu --import seen.ncu-rep --page raw --csv > seen.csv
    ncu --import seen.ncu-rep --page source --csv > source.csv
    python -m benchmarks.counters --read seen.csv --source source.csv

The last of its runs is profiled. Pages are read where they were measured: a row names
the machine and the versions of the program that makes it, and of the page its GPU.

`used` is the share of all multiprocessors' time in which they had work. Of that time
`tensor` is the share of tensor cores, `special` of the units for tanh and logarithms,
and `issued` of schedulers that had an instruction to issue, with `warps` each. `waits`
are shares of a warp's time, by what it waited for, and `code` of all warps' samples, by
the instruction where they were taken.
"""

import argparse
import csv
import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import rows, workloads

COLUMNS = (
    "kernel", "engine", "seeds", "us", "blocks", "used", "tensor", "special", "issued",
    "warps", "registers", "spills",
)  # fmt: skip
_RUNS = 3  # as many launches as ncu is told to skip, and one more
_ROWS = 1000  # of the data of a fit
_LARGEST = 20
_US = {"ns": 1e-3, "us": 1.0, "ms": 1e3, "s": 1e6}
_WAIT = "smsp__average_warps_issue_stalled_"
_PER_ISSUE = "_per_issue_active.ratio"
_SAMPLES = "Warp Stall Sampling (All Samples)"


def run(kernel: str, size: workloads.Size, engine: str, seeds: int) -> None:
    """Runs a kernel as often as the profiler wants."""
    keys = jax.random.split(jax.random.key(0), seeds)
    if kernel == "fit":
        fitter = workloads.fitter(size, 1, 32, "kernel")
        params, state, data = workloads.prepare_fit(size, fitter, keys, _ROWS, _ROWS)
        inputs: Any = (params, keys, state, data)
        step = jax.jit(workloads.fit_seeds(fitter))
    else:
        rollout, (params, _, obs, actions) = workloads.rollout_work(
            size, "bf16", engine
        )
        # Each seed has a model of its own, as where seeds explore.
        params, obs, actions = jax.tree.map(
            lambda x: jnp.stack([x] * seeds), (params, obs, actions)
        )
        inputs, step = (params, keys, obs, actions), jax.jit(jax.vmap(rollout))
    for _ in range(_RUNS):
        jax.block_until_ready(step(*inputs))


def counters(page: Iterable[str]) -> dict[str, Any]:
    """Returns what a row says of one kernel.

    Args:
      page: lines of `--page raw --csv`, of one launch.

    Raises:
      SystemExit: if they are none.
    """
    table = [*csv.reader(line for line in page if line.startswith('"'))]
    if len(table) != 3:
        raise SystemExit(f"not a page of one launch: {len(table)} lines of a table")
    names, units, values = table
    found, unit = (dict(zip(names, x, strict=True)) for x in (values, units))

    def number(name: str) -> float:
        return float(found[name].replace(",", ""))

    waits = Counter(
        {
            name[len(_WAIT) : -len(_PER_ISSUE)]: number(name)
            for name in names
            if name.startswith(_WAIT)
            and name.endswith(_PER_ISSUE)
            and "not_issued" not in name
        }
    )
    of_active = ".avg.pct_of_peak_sustained_active"
    duration = "gpu__time_duration.sum"
    return {
        "device": found["device__attribute_display_name"],
        "us": number(duration) * _US[unit[duration]],
        "blocks": int(number("launch__grid_size")),
        "threads": int(number("launch__block_size")),
        "registers": int(number("launch__registers_per_thread")),
        "spills": int(number("sass__inst_executed_register_spilling")),
        "used": number("sm__cycles_active.avg") / number("sm__cycles_elapsed.avg"),
        "tensor": number("sm__pipe_tensor_cycles_active" + of_active) / 100,
        "special": number("sm__inst_executed_pipe_xu" + of_active) / 100,
        "issued": number("smsp__issue_active" + of_active) / 100,
        "warps": number("smsp__warps_active.avg.per_cycle_active"),
        "waits": _shares(waits, but="selected"),  # it issues then
    }


def code(page: Iterable[str]) -> dict[str, float]:
    """Returns the share of all samples that instructions of each kind have.

    Args:
      page: lines of `--page source --csv`.
    """
    lines = [line for line in page if line.startswith('"')]
    samples: Counter[str] = Counter()
    for row in csv.DictReader(lines[1:]):  # the first has the kernel's name
        words = row["Source"].split()
        word = words[1] if words[0].startswith("@") else words[0]
        samples[word.partition(".")[0]] += int(row[_SAMPLES].replace(",", "") or 0)
    return _shares(samples)


def _shares(parts: Counter[str], but: str = "") -> dict[str, float]:
    """Returns the largest parts as shares of all."""
    total = sum(parts.values()) or 1
    largest = [(x, y) for x, y in parts.most_common() if x != but][:_LARGEST]
    return {x: round(y / total, 4) for x, y in largest}


@rows.refused(OSError, ValueError)
def _lines(page: Path) -> list[str]:
    return page.read_text().splitlines()


def _row(args: argparse.Namespace, size: workloads.Size) -> Iterator[dict[str, Any]]:
    own: dict[str, Any] = {"seeds": args.seeds, "engine": args.engine}
    if args.kernel == "fit":
        network = {"num_members": size.num_members, "hidden_sizes": size.hidden_sizes}
        own |= {**network, "num_rows": _ROWS, "num_epochs": 1, "batch_size": 32}
    else:
        own |= {**dataclasses.asdict(size), "precision": "bf16"}
    row = rows.make_row("counters", own, kernel=args.kernel)
    row |= counters(_lines(args.read))
    if args.source:
        row["code"] = code(_lines(args.source))
    yield row


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, runs the kernel or reads what was seen of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--json", type=rows.appendable, help="append the row to this file"
    )
    parser.add_argument("--tiny", action="store_true", help="a toy size")
    workloads.add_size_flag(parser)
    parser.add_argument("--kernel", choices=["rollout", "fit"], default="rollout")
    parser.add_argument("--engine", choices=["kernel", "sm_90"], default="kernel")
    parser.add_argument("--seeds", type=rows.positive, default=1)
    parser.add_argument("--read", type=Path, help="a page of raw numbers of one launch")
    parser.add_argument("--source", type=Path, help="its page of instructions")
    args = rows.parse(parser, argv, size="tiny")
    if args.kernel == "fit" and args.engine != "kernel":
        parser.error("--engine is of rollouts: one kernel trains")
    if not args.read and (args.json or args.source):
        parser.error("--json and --source go with --read")
    size = workloads.chosen_size(args)
    if args.read:
        return rows.report(_row(args, size), COLUMNS, args.json)
    if jax.default_backend() != "gpu":
        raise SystemExit("there is no GPU whose counters could be read")
    run(args.kernel, size, args.engine, args.seeds)
    return []


if __name__ == "__main__":
    main()
