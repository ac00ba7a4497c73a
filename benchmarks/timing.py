"""Compile time apart from run time, and one callable against another."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """How long one program takes."""

    compile_s: float  # tracing, lowering and compiling
    min_ms: float  # of `repeats` runs
    median_ms: float
    p99_ms: float  # of fewer than 100 runs the slowest
    repeats: int


class Ratio(NamedTuple):
    """How long two callables take that were run in turn."""

    first_ms: float  # medians
    second_ms: float
    ratio: float  # median of first / second, pair by pair
    ratio_of_min: float  # of the fastest runs: what an undisturbed machine would show
    repeats: int


def compile_program(
    function: Callable[..., Any], *args: Any
) -> tuple[Callable[..., Any], float]:
    """Returns `function` compiled for `args`, and the seconds that this took."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    return compiled, time.perf_counter() - start


def seconds(call: Callable[[], Any]) -> float:
    """Returns how long a call takes until all its results have arrived."""
    start = time.perf_counter()
    result = call()
    if not isinstance(result, np.ndarray):  # which is there; to ask takes microseconds
        jax.block_until_ready(result)
    return time.perf_counter() - start


def summary(times: Sequence[float], compile_s: float) -> Timing:
    """Returns what the seconds of several runs come to."""
    ms = sorted(1e3 * time for time in times)
    p99 = ms[math.ceil(0.99 * len(ms)) - 1]
    return Timing(compile_s, ms[0], statistics.median(ms), p99, len(ms))


def repeat(call: Callable[[], Any], compile_s: float = 0.0, *, repeats: int) -> Timing:
    """Runs something compiled once unmeasured and then `repeats` times."""
    seconds(call)
    return summary([seconds(call) for _ in range(repeats)], compile_s)


def measure(function: Callable[..., Any], *args: Any, repeats: int) -> Timing:
    """Compiles `function` for `args`, then runs it as `repeat` does."""
    compiled, compile_s = compile_program(function, *args)
    return repeat(lambda: compiled(*args), compile_s, repeats=repeats)


def in_turn(
    *calls: Callable[[], Any],
    repeats: int,
    warm_ups: int = 1,
    between: Callable[[], Any] = lambda: None,
) -> list[tuple[float, ...]]:
    """Runs callables in turn, so that all see the same state of the machine.

    Args:
      calls: what is timed.
      repeats: how often each is.
      warm_ups: runs of each before, which do not count.
      between: is called before each run and not timed.

    Returns:
      The seconds of each, `repeats` times.
    """

    def timed(call: Callable[[], Any]) -> float:
        between()
        return seconds(call)

    for call in calls:
        for _ in range(warm_ups):
            timed(call)
    return [tuple(timed(call) for call in calls) for _ in range(repeats)]


def compare(
    first: Callable[[], Any], second: Callable[[], Any], *, repeats: int
) -> Ratio:
    """Returns how long two callables take that run in turn."""
    pairs = in_turn(first, second, repeats=repeats)
    return Ratio(
        first_ms=1e3 * statistics.median(pair[0] for pair in pairs),
        second_ms=1e3 * statistics.median(pair[1] for pair in pairs),
        ratio=statistics.median(first / second for first, second in pairs),
        ratio_of_min=min(pair[0] for pair in pairs) / min(pair[1] for pair in pairs),
        repeats=repeats,
    )
