"""The loop of PETS over trials: act, learn, record; resumed where it stopped."""

import time
from functools import partial
from typing import Any, ClassVar, Protocol

import jax
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets

from . import acting, cost, records
from .acting import Scorer, Tick, Trials
from .behind import behind
from .build import Learn, State
from .parallel import devices
from .parallel.devices import Placement
from .progress import Progress, Watch
from .storage.folder import RunFolder


class Phase(Protocol):
    """What explore and finetune do not share."""

    name: ClassVar[str]
    axes: ClassVar[tuple[str, ...]]  # of the branches

    @property
    def scorer(self) -> Scorer:
        """What trials are scored with."""
        ...

    @property
    def placement(self) -> Placement:
        """Where the branches are computed."""
        ...

    @property
    def trial_length(self) -> int:
        """Environment steps of a trial."""
        ...

    def keys(self, trial: int, /) -> Array:
        """Returns the keys of the branches."""
        ...

    def act(self, trial: int, state: State, keys: Array, tick: Tick, /) -> Trials:
        """Returns a trial of every branch."""
        ...

    def learn(self, keys: Array, state: State, new: Any, /) -> tuple[State, Any]:
        """Returns the learner after new transitions, and what is said of the fit."""
        ...

    def labels(self, trial: int, /) -> list[dict[str, Any]]:
        """Returns what the log calls the branches."""
        ...


def run(
    folder: RunFolder, phase: Phase, state: State, first: int, done: int, last: int,
    watch: Watch,
) -> bool:  # fmt: skip
    """Runs what is left of the trials `first + 1` to `last`; saves after each.

    A trial is saved while the next one acts.

    Args:
      folder: of the run.
      phase: what to do.
      state: of the learners after trial `done`.
      first: the trial before the first of this run.
      done: the last one that is saved, `first` if none is.
      last: the one that completes the run.
      watch: shows how far it is.

    Returns:
      Whether anything was left.
    """

    def place(tree: Any) -> Any:
        return devices.place(phase.placement, tree, *phase.axes)

    def collect(tree: Any) -> Any:
        return devices.collect(phase.placement, tree, *phase.axes)

    folder.update(trial=done, num_trials=last)
    if done >= last:
        folder.say(f"already complete: {last - first} of {last - first} trials.")
        return False
    state, steps = place(state), phase.trial_length
    total, before = (last - first) * steps, (done - first) * steps
    progress, compiled = Progress(total, before, phase.name, watch), set[str]()

    def calls(program: str) -> None:
        if program not in compiled:
            progress.compiling(cost.compiling(program))
        compiled.add(program)

    def save(trial: int, rows: list[dict[str, Any]], learned: Any, line: str) -> None:
        folder.record(trial, rows, learned, finite=(learned.params, learned.fit))
        progress.line(line)
        rate, left = progress.pace()
        folder.update(
            trial=trial, num_trials=last, line=line,
            steps_per_second=rate, seconds_left=left,
            device_bytes=devices.bytes_in_use(),
        )  # fmt: skip

    def tick(num_steps: int) -> None:
        saving.check()  # a full disk is said before another trial ends, or a stop
        progress.tick(num_steps)

    with progress.interruptible(), behind() as saving:
        for trial in range(done + 1, last + 1):
            act_keys, learn_keys = acting.split_keys(phase.keys(trial))
            labels = phase.labels(trial)
            calls(labels[0].get("planner", "plan"))
            begin = time.monotonic()
            acts = phase.act(trial, state, act_keys, tick)
            trials = collect(acts)
            acted = time.monotonic()
            calls("fit")
            saving.wait()  # learning gives away what is saved
            saved = time.monotonic()
            state, fit = phase.learn(place(learn_keys), state, acts.transitions)
            jax.block_until_ready(state)
            progress.did("fit", trial)
            seconds = {"act": acted - begin, "fit": time.monotonic() - saved}
            learned, fit = collect((state, fit))
            rows = records.rows(phase.scorer, labels, trials, fit, learned.params)
            if trial == 1:
                records.check_begun(rows, steps)
            timed = [{**row, "seconds": seconds} for row in rows]
            text = f"{phase.name} {trial}/{last}  {records.describe(rows)}"
            text = f"{text}  {sum(seconds.values()):.1f} s"
            saving.call(partial(save, trial, timed, learned, text))
    return True


def over_branches(
    placement: Placement, learner: jaxpets.typing.Learner, *axes: str
) -> Learn:
    """Returns `learn` over `axes`, jitted, with its share of them on every device."""
    for axis in reversed(axes):
        learner = jaxpets.over_seeds(learner, devices.each(placement, axis))
    every, shared = P(*axes), P()
    state = jax.tree.map(
        lambda axis: shared if axis is None else every,
        jaxpets.SEED_AXES,
        is_leaf=lambda axis: axis is None,
    )
    takes, gives = (every, state, every), (state, every)
    learn = devices.split(placement, learner.learn, takes, gives)
    return jax.jit(learn, donate_argnums=1)
