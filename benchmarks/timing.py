"""Compile time apart from run time, and one callable against another."""

import math
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax


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
    jax.block_until_ready(call())
    return time.perf_counter() - start


def repeat(call: Callable[[], Any], compile_s: float = 0.0, *, repeats: int) -> Timing:
    """Runs something compiled once unmeasured and then `repeats` times."""
    seconds(call)
    times = sorted(1e3 * seconds(call) for _ in range(repeats))
    p99 = times[math.ceil(0.99 * repeats) - 1]
    return Timing(compile_s, times[0], statistics.median(times), p99, repeats)


def measure(function: Callable[..., Any], *args: Any, repeats: int) -> Timing:
    """Compiles `function` for `args`, then runs it as `repeat` does."""
    compiled, compile_s = compile_program(function, *args)
    return repeat(lambda: compiled(*args), compile_s, repeats=repeats)


def in_turn(
    first: Callable[[], Any], second: Callable[[], Any], *, repeats: int
) -> list[tuple[float, float]]:
    """Runs two callables in turn, so that both see the same state of the machine.

    Returns:
      The seconds of both, `repeats` times, after one run of each that does not count.
    """
    seconds(first)
    seconds(second)
    return [(seconds(first), seconds(second)) for _ in range(repeats)]


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
