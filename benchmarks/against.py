"""Today's rows beside the committed ones, both in units of a plain program.

Machines of one kind differ by some per cent, and so do days. What is compared is how
often a program runs while the plan by the scan, in bf16 and of one seed, runs once: the
last before it on such a device and at the same commit, in `benchmarks.all` one of the
same process. C MuJoCo runs on the host, and hosts of one kind of GPU differ by a factor
of two: its unit is the plain loop in C, which is timed after it. Rows that were timed
without their unit are not compared. Of both the fastest run counts, as a call that is
waited for wakes late on some days.
"""

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import workloads

RESULTS = Path(__file__).parent / "results"
SLOWER = 0.9  # of the committed speed: no longer chance
# What a plan is of that does not say so, as rows from before there was a choice.
_DEFAULT = {
    **dataclasses.asdict(workloads.named_size("paper")),
    "optimizer": "cem",
    "reward": "epistemic",
    "chunk_size": None,
}
_PLAN = _DEFAULT | {"engine": "scan", "precision": "bf16", "seeds": 1, "plans": 1}
Row = dict[str, Any]


class Pair(NamedTuple):
    """A row of today, and the last committed one of the same program and sizes."""

    row: Row
    committed: Row | None
    speed: float | None  # over the committed one, both in units of the plain program


def pairs(today: Sequence[Row], committed: Iterable[Row]) -> Iterator[Pair]:
    """Yields a pair per row of today that has a time; rows of other devices are new."""
    before: dict[str, tuple[Row, float | None]] = {}
    for row, unit in _with_unit(committed):
        replaces = unit is not None or key(row) not in before
        if row["device"] == today[0]["device"] and replaces:
            before[key(row)] = row, unit
    for row, unit in _with_unit(today):
        then, unit_then = before.get(key(row), (None, None))
        speed = None
        if then and unit and unit_then:
            speed = unit / row["min_ms"] / (unit_then / then["min_ms"])
        yield Pair(row, then, speed)


def key(row: Row) -> str:
    """Returns what a row is of: a program and its sizes."""
    sizes = {"engine": "scan", **row["sizes"]}  # fits before there was a kernel
    return json.dumps([row["benchmark"], sizes], sort_keys=True)


def committed_rows(folder: Path = RESULTS) -> list[Row]:
    """Returns the rows of all files of a folder, the oldest first."""
    lines = [
        json.loads(line)
        for path in sorted(folder.glob("*.jsonl"))
        for line in path.read_text().splitlines()
    ]
    return sorted(lines, key=lambda row: row.get("date", ""))


def report(today: Sequence[Row], committed: Sequence[Row]) -> list[Row]:
    """Prints today's rows beside the committed ones.

    Returns:
      The rows whose speed is below nine tenths of the committed one.
    """
    if not today:
        return []
    found = list(pairs(today, committed))
    print(f"{'median ms':>10}  {'committed':>10}  {'speed':>6}")
    for row, then, speed in found:
        cells = [f"{row['median_ms']:>10.4g}"]
        cells.append(f"{then['median_ms']:>10.4g}" if then else f"{'-':>10}")
        cells.append(f"{speed:>6.2f}" if speed else f"{'-':>6}")
        print(*cells, row["benchmark"], _text(row), sep="  ")
    return [pair.row for pair in found if pair.speed and pair.speed < SLOWER]


def peers(committed: Sequence[Row], device: str) -> None:
    """Prints the plans of other systems on such a device."""
    for row in committed:
        if "source" in row and row["device"] == device:
            print(f"{row['ms_per_plan']:>10.4g}  {row['name']}, {row['engine']}, "
                  f"{row['dtype']}, {row['seeds']} seeds: {row['source']}")  # fmt: skip


def _with_unit(rows: Iterable[Row]) -> Iterator[tuple[Row, float | None]]:
    """Yields each row that has a time, with its plain program's if it is known."""
    timed = [row for row in rows if "min_ms" in row]
    loops = [*_seen_last(reversed(timed), _is_loop)][::-1]
    plans = _seen_last(timed, _is_plan)
    for row, plan, loop in zip(timed, plans, loops, strict=True):
        yield row, loop if _engine(row).startswith("mujoco") else plan


def _seen_last(
    rows: Iterable[Row], is_plain: Callable[[Row], bool]
) -> Iterator[float | None]:
    """Yields for each row the last plain program's time, of its device and commit."""
    last: dict[tuple[str, str | None], float] = {}
    for row in rows:
        where = row["device"], row.get("git")
        if is_plain(row):
            last[where] = row["min_ms"]
        yield last.get(where)


def _is_plan(row: Row) -> bool:
    sizes = _DEFAULT | row["sizes"]
    found = {name: sizes.get(name) for name in _PLAN}
    # As text, since tuples are lists in a file.
    return row["benchmark"] == "plan" and json.dumps(found) == json.dumps(_PLAN)


def _is_loop(row: Row) -> bool:
    return _engine(row) == "mujoco-loop"


def _engine(row: Row) -> str:
    return row["sizes"].get("engine", "")


def _text(row: Row) -> str:
    """Returns the sizes that are numbers or words."""
    return " ".join(
        f"{name}={value}"
        for name, value in row["sizes"].items()
        if isinstance(value, int | str)
    )
