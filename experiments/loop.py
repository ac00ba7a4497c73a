"""The loop of PETS over trials: act, learn, log, save; resumed where it stopped."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from experiments import acting, records
from experiments.acting import Tick, Trials
from experiments.build import Learn, State
from experiments.config import Config
from experiments.parallel import devices, distributed
from experiments.parallel.devices import Spread
from experiments.progress import Progress
from experiments.storage import checkpoint, rundir

Say = Callable[[str], None]


class Loop(NamedTuple):
    """What explore and finetune do not share."""

    what: str
    trial_length: int
    spread: Spread
    axes: tuple[str, ...]  # of the branches
    keys: Callable[[int], Array]  # trial -> keys of the branches
    act: Callable[[int, State, Array, Tick], Trials]
    learn: Learn
    labels: Callable[[int], list[dict[str, Any]]]  # of the branches


def run(
    config: Config, folder: Path, loop: Loop, init: State, first: int, last: int,
    say: Say,
) -> Trials | None:  # fmt: skip
    """Runs trials `first + 1` to `last`, or what is left of them; saves after each."""
    checkpoints, log = folder / "checkpoints", folder / "metrics.jsonl"
    spread, axes = loop.spread, loop.axes
    found = restore(checkpoints, init, say)
    done, state, meta = found or (first, init, {"log": 0})
    distributed.on_first(lambda: rundir.cut_log(log, meta["log"]))
    if done >= last:
        say(f"already complete: {last - first} of {last - first} trials.")
        return None
    state = devices.place(spread, state, *axes)
    steps = loop.trial_length
    progress = Progress((last - first) * steps, (done - first) * steps, loop.what)
    trials = None
    with progress.interruptible():
        for trial in range(done + 1, last + 1):
            begin = time.monotonic()
            act_keys, fit_keys = acting.split_keys(loop.keys(trial))
            acts = loop.act(trial, state, act_keys, progress.tick)
            trials = devices.collect(spread, acts, *axes)
            records.check_finite(trials, trial)
            acted = time.monotonic()
            fit_keys = devices.place(spread, fit_keys, *axes)
            state, fit = loop.learn(fit_keys, state, acts.transitions)
            jax.block_until_ready(state)
            seconds = {"act": acted - begin, "fit": time.monotonic() - acted}
            whole, fit = devices.collect(spread, (state, fit), *axes)
            rows = records.rows(loop.labels(trial), trials, fit, whole.params)
            timed = [{**row, "seconds": seconds} for row in rows]
            distributed.on_first(
                functools.partial(_write, folder, trial, timed, whole, config)
            )
            text = f"{loop.what} {trial}/{last}  {records.describe(rows)}"
            progress.line(f"{text}  {sum(seconds.values()):.1f} s")
    return trials


def _write(
    folder: Path, trial: int, rows: list[dict[str, Any]], state: State, config: Config
) -> None:
    """Appends the rows of a trial to the log, and saves what was learned."""
    log = folder / "metrics.jsonl"
    rundir.append_rows(log, rows)
    checkpoint.save(
        folder / "checkpoints", trial, state, {"log": rundir.log_size(log)},
        milestones=config.milestones, finite=(state.params, state.fit),
    )  # fmt: skip


def restore(
    directory: Path, template: Any, say: Say, step: int | None = None, *,
    part: bool = False,
) -> tuple[int, Any, dict[str, Any]] | None:  # fmt: skip
    """Restores on the first host, for all of them; see `checkpoint.restore`."""
    kept = []

    def read() -> tuple[int, dict[str, Any]] | None:
        found = checkpoint.restore(
            directory, template, step=step, part=part,
            warn=lambda line: say(f"warning: {line}"),
        )  # fmt: skip
        if found is None:
            return None
        number, state, meta = found
        kept.append(state)
        return number, meta

    found = distributed.on_first(read)
    if found is None:
        return None
    return found[0], distributed.share(kept[0] if kept else None, template), found[1]


def learner(spread: Spread, learn: Learn, *axes: str) -> Learn:
    """Returns a learner over `axes`, jitted, with its share of them on every device."""
    mapped = jaxpets.Learner(_never, learn, _never)
    for axis in reversed(axes):
        mapped = jaxpets.over_seeds(mapped, devices.each(spread, axis))
    every, shared = P(*axes), P()
    state = jax.tree.map(
        lambda axis: shared if axis is None else every,
        jaxpets.SEED_AXES,
        is_leaf=lambda axis: axis is None,
    )
    learn = devices.split(spread, mapped.learn, (every, state, every), (state, every))
    return jax.jit(learn, donate_argnums=1)


def _never(*_: Any) -> Any:
    raise NotImplementedError
