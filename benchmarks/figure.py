"""Draws what a plan takes over seeds and over candidates, with floor and peers.

Reads rows of `python -m benchmarks.plan`: bf16, paper size, of one device.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from benchmarks import costs, workloads
from benchmarks.rows import appendable
from experiments.report import style

PEERS = Path(__file__).parent / "results" / "peers.jsonl"
# Of the tensor cores, bf16, dense, from the data sheet; other devices have no floor.
PEAK_FLOPS = {"NVIDIA H200": 989e12}
FLOOR = "tensor cores at their peak"
ENGINES = {"scan": "jaxpets, scan", "kernel": "jaxpets, kernel"}
_COLORS = {"scan": style.BLUE, "kernel": style.VERMILLION}
_MARKERS = ("s", "^", "D", "v", "P", "X")
_PAPER = workloads.named_size("paper")
Row = dict[str, Any]


def read(paths: Iterable[Path]) -> list[Row]:
    """Returns the rows of JSONL files, in their order."""
    return [json.loads(line) for path in paths for line in path.open() if line.strip()]


def plans(rows: Iterable[Row]) -> list[Row]:
    """Returns the rows that are drawn: plans in bf16 that differ in N and seeds only.

    Raises:
      ValueError: if there is none, or they are of several devices.
    """
    rest = dataclasses.asdict(_PAPER) | {"precision": "bf16", "optimizer": "cem"}
    rest["hidden_sizes"] = list(_PAPER.hidden_sizes)
    del rest["num_samples"]
    # Elites do not matter to the time, and are best a share of the candidates.
    del rest["num_elites"]
    found = [
        row
        for row in rows
        if row["benchmark"] == "plan"
        and row["sizes"].items() >= rest.items()
        and not row["sizes"].get("chunk_size")
        and row["sizes"].get("plans", 1) == 1
    ]
    if not found:
        raise ValueError(
            "there are no rows of plans by CEM in bf16 at the paper's size, of which "
            "those of one device are drawn."
        )
    devices = sorted({row["device"] for row in found})
    if len(devices) != 1:
        raise ValueError(f"rows of plans must be of one device, got {devices}.")
    return found


def floor_ms(num_samples: int, device: str) -> float:
    """Returns what the matrix products of a plan take at the device's peak."""
    size = dataclasses.replace(_PAPER, num_samples=num_samples)
    candidates = costs.candidates_per_action(size, "cem")
    return 1e3 * costs.rollout_flops(size, candidates) / PEAK_FLOPS[device]


def points(rows: Iterable[Row], over: str, engine: str) -> list[tuple[int, float]]:
    """Returns ms per plan of `engine` over `seeds` or `num_samples`, the other fixed.

    Fixed are the paper's candidates, and one seed. Where a size was measured more than
    once, the last row counts.
    """
    fixed = {"seeds": ("num_samples", _PAPER.num_samples), "num_samples": ("seeds", 1)}
    name, value = fixed[over]
    found = {
        row["sizes"][over]: row["median_ms"] / row["sizes"]["seeds"]
        for row in rows
        if row["sizes"][name] == value
        and row["sizes"].get("engine", "scan") == engine  # once there was no other
    }
    return sorted(found.items())


def draw(rows: Iterable[Row], peers: Iterable[Row]) -> Figure:
    """Returns the figure: over seeds (left), over candidates (right).

    Peers are drawn where they ran on the device of the rows; of several times of one
    for as many seeds, the best.

    Raises:
      ValueError: as `plans`.
    """
    rows = plans(rows)
    best: dict[tuple[str, int], Row] = {}
    for peer in sorted(peers, key=lambda peer: -peer["ms_per_plan"]):
        if peer["device"] == rows[0]["device"]:
            best[peer["name"], peer["seeds"]] = peer
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(9.0, 3.8)
        left, right = figure.subplots(1, 2, sharey=True)
        _panel(left, rows, "seeds", best.values())
        one = [peer for peer in best.values() if peer["seeds"] == 1]
        _panel(right, rows, "num_samples", one)
        left.set_title(f"{_PAPER.num_samples} candidates")
        left.set_xlabel("seeds, each with its own model")
        left.set_ylabel("ms per plan")
        right.set_title("one seed")
        right.set_xlabel("candidates")
        known = {}
        for axes in (left, right):
            known |= {line.get_label(): line for line in axes.get_lines()}
        figure.legend(known.values(), known.keys(), loc="outside right upper")
        title = f"{rows[0]['device']}: jaxpets in bf16, peers at their fastest"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure


def _panel(axes: Any, rows: list[Row], over: str, peers: Iterable[Row]) -> None:
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    ticks = set()
    for engine, label in ENGINES.items():
        if pairs := points(rows, over, engine):
            across, ms = zip(*pairs, strict=True)
            ticks |= set(across)
            axes.plot(across, ms, "o-", color=_COLORS[engine], label=label,
                      markersize=4, linewidth=2.0)  # fmt: skip
    names = []
    for peer in sorted(peers, key=lambda peer: peer["name"]):
        if peer["name"] not in names:
            names.append(peer["name"])
        place = peer["seeds"] if over == "seeds" else _PAPER.num_samples
        ticks.add(place)
        axes.plot(
            [place], [peer["ms_per_plan"]], _MARKERS[names.index(peer["name"])],
            color=style.GREY, label=peer["name"], markersize=5, linestyle="none",
        )  # fmt: skip
    if ticks and (device := rows[0]["device"]) in PEAK_FLOPS:
        ends = [min(ticks), max(ticks)]
        samples = ends if over == "num_samples" else [_PAPER.num_samples] * 2
        axes.plot(ends, [floor_ms(n, device) for n in samples], "--",
                  color=style.BLACK, label=FLOOR, linewidth=1.0)  # fmt: skip
    axes.set_xticks(sorted(ticks))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(ScalarFormatter())


def main(argv: Sequence[str] | None = None) -> Figure:
    """Parses the flags, draws and saves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILES.jsonl")
    parser.add_argument("--out", type=appendable, default=Path("plan.svg"))
    parser.add_argument("--peers", type=Path, default=PEERS, help="rows of peers")
    args = parser.parse_args(argv)
    try:
        figure = draw(read(args.files), read([args.peers]))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    style.save(figure, args.out)
    return figure


if __name__ == "__main__":
    main()
