"""What a benchmark reports: a table on the screen, and rows of JSON in a file."""

import argparse
import contextlib
import datetime
import functools
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "torch", "mbrl",
             "onnxruntime")  # fmt: skip


def environment() -> dict[str, Any]:
    """Returns where and when a row was measured; loads no package itself."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    if "jaxpets" in sys.modules:
        versions["jaxpets"] = sys.modules["jaxpets"].__version__
    device = "cpu"
    if "jax" in sys.modules:
        device = sys.modules["jax"].devices()[0].device_kind
    now = datetime.datetime.now(datetime.UTC)
    return {
        "date": now.isoformat(timespec="seconds"),
        "device": device,
        "cpus": os.cpu_count(),
        "git": _commit(),
        "versions": versions,
    }


def make_row(benchmark: str, sizes: dict[str, Any], **results: Any) -> dict[str, Any]:
    """Returns one row: what was run, where, at which sizes, and what came out."""
    return {"benchmark": benchmark, **environment(), "sizes": sizes, **results}


def report(
    rows: Iterable[dict[str, Any]], columns: tuple[str, ...], path: Path | None
) -> list[dict[str, Any]]:
    """Prints each row, and appends it to `path`, as soon as it is there."""
    done = []
    for row in rows:
        if not done:
            print(f"{row['benchmark']} on {row['device']}", flush=True)
            print("  ".join(f"{column:>12}" for column in columns), flush=True)
        cells = (row.get(column, row["sizes"].get(column)) for column in columns)
        print("  ".join(f"{_text(cell):>12}" for cell in cells), flush=True)
        if path is not None:
            with path.open("a") as file:
                file.write(json.dumps(row) + "\n")
        done.append(row)
    return done


def parser(description: str | None) -> argparse.ArgumentParser:
    """Returns a parser with the flags that all benchmarks share."""
    flags = argparse.ArgumentParser(
        description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    flags.add_argument(
        "--json", type=appendable, help="append rows to this file, as JSONL"
    )
    flags.add_argument("--repeats", type=positive, default=10, help="measured runs")
    flags.add_argument(
        "--tiny", action="store_true", help="toy sizes, but for those that are said"
    )
    return flags


def parse(
    flags: argparse.ArgumentParser, argv: Sequence[str] | None, **toys: Any
) -> argparse.Namespace:
    """Returns what was said; with `--tiny` toys stand in for what was not."""
    args = flags.parse_args(argv)
    if args.tiny:
        flags.set_defaults(**toys)
        args = flags.parse_args(argv)
    return args


@contextlib.contextmanager
def refused(*errors: type[Exception]) -> Iterator[None]:
    """Ends with one line and code 2, as argparse does, for values that cannot be.

    It is for what is built or read of flags, and not for what is timed: an error of
    that is a bug, whose trace is wanted.
    """
    try:
        yield
    except errors as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


def positive(text: str) -> int:
    """Parses a positive integer, for argparse."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {number}")
    return number


def appendable(text: str) -> Path:
    """Parses the name of a file that can be appended to, and does not make it."""
    path = os.path.realpath(text)
    folder = os.path.dirname(path)
    if os.path.isdir(path):
        raise argparse.ArgumentTypeError(f"{path} is a folder")
    if not os.path.isdir(folder):
        raise argparse.ArgumentTypeError(f"there is no folder {folder}")
    if not os.access(path if os.path.exists(path) else folder, os.W_OK):
        raise argparse.ArgumentTypeError(f"{path} cannot be written to")
    return Path(text)


@functools.cache
def _commit() -> str | None:
    """Returns which code this is, where it is a checkout.

    It is asked once: rows that are appended to a committed file change the checkout,
    and those of one process must name one commit.
    """
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    folder = Path(__file__).parent
    try:
        return subprocess.check_output(
            command, cwd=folder, stderr=subprocess.DEVNULL, text=True
        ).strip()
    except (OSError, subprocess.CalledProcessError):  # no git, or no checkout
        return None


def _text(cell: Any) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
