"""One more fit, between exploration and phase 2, until the model has settled.

Exploration fits a few epochs at a constant rate after every trial, as PETS does. That
is enough to go on exploring; for performing a task the last steps leave noise in the
weights, and what came late was shown a few times only.
"""

import contextlib
import time

import jax
from jax import Array

from . import exploration, loop
from .build import REFIT, Parts, State, trial_keys
from .config import Config
from .entries import to_json
from .errors import CheckpointError
from .model_file import Source
from .parallel import devices
from .parallel.devices import SEED
from .storage import rundir
from .storage.folder import RunFolder

# What two variants of zero-shot must have in common for their refits to be one.
_SAME = (
    "refit", "env", "arm", "seeds", "engine", "random_trials", "trial_length",
    "num_bits", "model", "training", "planner",
)  # fmt: skip


def refitted(
    config: Config, parts: Parts, state: State, source: Source, step: int,
    run: RunFolder,
) -> State:  # fmt: skip
    """Returns what `refit` does, from another zero-shot of the run if one has it.

    Args:
      config: as of `refit`.
      parts: likewise.
      state: likewise.
      source: the run that explored.
      step: trials behind the model.
      run: the folder of this phase.
    """
    form, own = exploration.model_of(state), to_json(config)
    for other in source.below(f"zero-shot-{step:03d}*"):
        with contextlib.suppress(CheckpointError):  # damaged: it is made again
            then = other.find_json(rundir.CONFIG)
            if other.path != run.path and all(then.get(x) == own[x] for x in _SAME):
                found = other.restore(form, part=True)
                if found and found[0] == step:
                    run.say(f"refit: as in {other.path.name}")
                    return state._replace(params=found[1].params)
    return refit(config, parts, state, step, run)


def refit(
    config: Config, parts: Parts, state: State, step: int, run: RunFolder
) -> State:
    """Returns the learner `[S]` after one more fit.

    Args:
      config: reads `refit` and `seeds`.
      parts: made with these numbers, a refitter among them.
      state: learner `[S]` explored until trial `step`; consumed.
      step: the keys depend on it.
      run: says one line.
    """
    placement = devices.spread(len(config.seeds))
    fitter = parts.refitter
    assert fitter is not None

    def learn(key: Array, state: State, nothing: tuple[()]) -> tuple[State, object]:
        del nothing  # a learner's new transitions
        params, fit, metrics = fitter.step(state.params, key, state.fit, state.dataset)
        return state._replace(params=params, fit=fit), metrics

    begin = time.monotonic()
    rows, epochs = int(state.dataset.size), config.refit.num_epochs
    keys = devices.place(placement, trial_keys(config, REFIT, step), SEED)
    state = devices.place(placement, state, SEED)
    learner = parts.learner._replace(learn=learn)
    state, _ = loop.over_branches(placement, learner, SEED)(keys, state, ())
    state = devices.collect(placement, jax.block_until_ready(state), SEED)
    seconds = time.monotonic() - begin
    run.say(f"refit: {epochs} epochs of {rows:,} transitions  {seconds:.1f} s")
    return state
