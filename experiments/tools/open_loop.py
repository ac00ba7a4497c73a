"""`python -m experiments.tools.open_loop RUN [RUN ...] --out FILE`.

How far ahead the models are right, and whether they know how far. The models of all
runs imagine windows of consecutive transitions that the runs saw, from the first
observation on and with the actions that were done there: the windows and the noise are
the same for every model. As in `model_error`, a model is never asked about the data of
its own run and seed, nor about the random trials at the start, and a window is of one
trial.

Imagination is that of a planner: particles which keep their member, drawn from its
Gaussian at every step. There are 20, or a few more so that members have equally many.

error: of the particles' mean, root mean square over dimensions, each by the std of the
  observation in all that was drawn: 1 is what the mean of all states would err by.
  Of the windows the median, since of a mean the few that explode would be the most.
spread: of the particles' std, in the same way. A model that knows how far it errs has
  about as much of it as of error; of error a bit less where dimensions are few, since
  the median of what is skewed is below its mean.
coverage: share of windows and dimensions in which the truth is between the quantiles
  of the particles at 5 and 95 %; 0.9 for a model that is right about itself.
What is not finite is an infinite error, and covers nothing; in the file it is null.

Under `arms`, by the arm of the model and the step, are means over the data of all arms,
which weigh equally; under `own` are those over the data of other seeds of that arm,
null without any. std is that of pairs of a model and a data set within an arm of data,
root mean square over these arms.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets

from ..errors import UsageError
from ..report import tables
from . import compared, model_error, windows

STEPS = (1, 3, 10, 30)
NUM_PARTICLES = 20
# Numbers in the paths imagined at once; it takes about three times their memory.
_CHUNK_SIZE = 2**26


class Scores(NamedTuple):
    """What imagination was worth, all of one shape with the steps last."""

    error: Array
    spread: Array
    coverage: Array


def measure(
    runs: Sequence[Path],
    num_rows: int,
    num_steps: int,
    at_trial: int | None,
    env: str | None = None,
) -> dict:
    """Returns error, spread and coverage by the arm of the model and the step.

    Args:
      runs: folders of exploration runs of one preset, no seed of an arm twice.
      num_rows: B, windows drawn of every seed.
      num_steps: K, transitions of a window.
      at_trial: whose checkpoints to read; None for the last of each run.
      env: the robot, which must be said if it is of a file.

    Returns:
      `preset`, `rows`, `steps`, `trials` by arm and seed, and `arms` and `own`, which
      have mean, std and number of pairs by arm, step and measure.

    Raises:
      RunError: if the runs cannot be compared or read, or have too few windows.
    """
    compared.check_positive("--rows", num_rows)
    compared.check_positive("--steps", num_steps)

    def drawn(saved: compared.Saved) -> jaxpets.Transition:
        config, dataset = saved.config, saved.dataset
        if num_steps > config.trial_length:
            raise UsageError(
                f"--steps {num_steps} is not valid; a trial of {saved.run} has "
                f"{config.trial_length} transitions."
            )
        rows = saved.first, int(dataset.size)
        starts = windows.starts_of(dataset.data, *rows, config.trial_length, num_steps)
        count = int(jnp.min(jnp.sum(starts, axis=1)))
        what = f"windows of {num_steps} transitions"
        compared.check_enough(saved, num_rows, count, what)
        return windows.draw(dataset.data, config.seeds, starts, num_steps, num_rows)

    found = compared.read(runs, at_trial, env, drawn)
    steps = [step for step in STEPS if step <= num_steps]

    def score_of(model: jaxpets.Ensemble, params: Any, data: Any, scale: Any) -> Scores:
        return score(model.sample, model.num_members, steps, params, data, scale)

    data = compared.joined(found)
    scores = compared.score_all(found, score_of, data, compared.scale_of(data.obs))
    arms = compared.arms_of(found)
    every: dict[str, Any] = {}
    own: dict[str, Any] = {}
    for i, step in enumerate(steps):
        for name, values in scores._asdict().items():
            for part, by_model in zip(
                (every, own), pooled(values[..., i], arms), strict=True
            ):
                for arm, entry in by_model.items():
                    at_step = part.setdefault(arm, {}).setdefault(step, {})
                    at_step[name] = entry
    heading = {**compared.heading(found, num_rows), "steps": num_steps}
    return heading | {"arms": every, "own": own}


def score(
    sample: jaxpets.typing.DynamicsFn,
    num_members: int,
    steps: Sequence[int],
    params: Any,
    data: jaxpets.Transition,
    scale: Array,
) -> Scores:
    """Returns scores `[M, N, len(steps)]` of M models on N data sets.

    Args:
      sample: of an Ensemble.
      num_members: E.
      steps: after which to look, from 1 to K.
      params: of M models.
      data: windows `[N, B, K, *]`.
      scale: `[D]`, in which errors are measured, in units of obs.
    """
    num_particles = num_members * -(-NUM_PARTICLES // num_members)
    rollout = jaxpets.particle_rollout(
        sample, num_members=num_members, num_particles=num_particles
    )
    num_sets, num_rows, num_steps, obs_size = data.next_obs.shape
    at = jnp.array(steps)
    # Quantiles outside of which are 5 % of what is drawn like the particles: those of
    # Weibull. The usual ones are too close for so few, and would hold 82 %.
    place = (0.05 * (num_particles + 1) - 1) / (num_particles - 1)
    places = jnp.array([place, 1 - place])

    def imagine(params: Any, key: Array, window: jaxpets.Transition) -> Scores:
        path = rollout(params, key, window.obs[0], window.action[None])
        particles = path[0, at].reshape(len(steps), num_particles, obs_size)
        truth = window.next_obs[at - 1]
        low, high = jnp.quantile(particles, places, axis=1)
        is_covered = (low <= truth) & (truth <= high)
        is_covered &= jnp.all(jnp.isfinite(particles), axis=1)
        return Scores(
            _size((jnp.mean(particles, axis=1) - truth) / scale),
            _size(jnp.std(particles, axis=1, ddof=1) / scale),
            jnp.mean(is_covered.astype(jnp.float32), axis=-1),
        )

    def pair(params: Any, data: jaxpets.Transition) -> Scores:
        # The same noise for all models: none of them is lucky.
        keys = jax.random.split(jax.random.key(1), num_rows)
        found = jax.vmap(imagine, (None, 0, 0))(params, keys, data)
        error, spread = _median(found.error), _median(found.spread)
        return Scores(error, spread, jnp.mean(found.coverage, axis=0))

    one = num_rows * (num_steps + 1) * num_particles * obs_size
    num_chunks = -(-num_sets // max(1, _CHUNK_SIZE // one))
    chunk = -(-num_sets // num_chunks)

    def of_model(params: Any) -> Scores:
        return jax.lax.map(lambda x: pair(params, x), data, batch_size=chunk)

    return jax.lax.map(of_model, params)


def _size(miss: Array) -> Array:
    """Returns the root mean square over the last axis; infinite if it is not finite."""
    size = jnp.sqrt(jnp.mean(miss**2, axis=-1))
    return jnp.where(jnp.isfinite(size), size, jnp.inf)


def _median(values: Array) -> Array:
    """Returns the median over the first axis, of which some may be infinite."""
    values, count = jnp.sort(values, axis=0), len(values)
    # jnp.median weighs an infinite neighbour by 0.
    return (values[(count - 1) // 2] + values[count // 2]) / 2


def pooled(
    values: np.ndarray, arms: Sequence[str]
) -> tuple[dict[str, dict[str, Any] | None], dict[str, dict[str, Any] | None]]:
    """Returns summaries by the arm of the model, over all data and over its own arm's.

    Args:
      values: `[M, M]`, of model m on the data of model n; m = n is left out.
      arms: M, of each model.
    """
    with np.errstate(invalid="ignore"):  # the std of what is infinite
        table = model_error.by_arm(values, arms)
        every = {arm: _together(row.values()) for arm, row in table.items()}
    return every, {arm: row[arm] for arm, row in table.items()}


def _together(entries: Any) -> dict[str, Any] | None:
    """Returns the summary of summaries that weigh equally; None is no summary."""
    known = [entry for entry in entries if entry is not None]
    if not known:
        return None
    stds = [entry["std"] for entry in known if entry["std"] is not None]
    return {
        "mean": np.mean([entry["mean"] for entry in known]),
        "std": np.sqrt(np.mean(np.square(stds))) if stds else None,
        "pairs": sum(entry["pairs"] for entry in known),
    }


def table(arms: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> list[str]:
    """Returns error and coverage as a table: arms by steps.

    Args:
      arms: as `measure` has them.
    """
    steps = list(next(iter(arms.values())))
    header = [f"{name} at {i}" for name in ("error", "coverage") for i in steps]
    rows = [
        [arm, *(_cell(row[i][name]) for name in ("error", "coverage") for i in steps)]
        for arm, row in arms.items()
    ]
    return tables.table(["model of", *header], rows)


def _cell(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return "no pair"
    if not np.isfinite(entry["mean"]):
        return "not finite"
    return f"{entry['mean']:.3g}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measures, writes a JSON file and prints a table; returns the exit code."""
    parser = compared.parser("open_loop", __doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON")
    parser.add_argument(
        "--rows", type=int, default=200, help="windows of every seed (200)"
    )
    parser.add_argument(
        "--steps", type=int, default=30, help="transitions of a window (30)"
    )
    args = parser.parse_args(argv)

    def measured() -> dict:
        found = measure(args.runs, args.rows, args.steps, args.at_trial, args.env)
        print("\n".join(table(found["arms"])))
        return found

    return compared.write(args.out, measured)


if __name__ == "__main__":
    sys.exit(main())
