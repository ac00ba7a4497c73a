"""The card of a model: what it is, what it saw and what it returns.

`experiments.tools.share` writes it beside the file, in the form of the Hugging Face
Hub. Every number in it is of the file, of a run's config and log, or of the logs of
zero-shots.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxpets
from jaxpets import models

from .. import exploration
from ..config import Config, PlannerConfig
from ..errors import UsageError
from ..report import stats
from ..storage import metrics, rundir
from ..storage.folder import RunFolder
from ..storage.metrics import Row, number

_SAID = ("environment", "licence", "training", "search")
_HEAD = """---
license: {licence}
library_name: jaxpets
pipeline_tag: reinforcement-learning
tags: [world-model, model-based-rl, unsupervised-exploration, jax, mujoco]
model-index:
- name: {name}
  results:"""
_RESULT = """  - task:
      type: reinforcement-learning
      name: {task}
    dataset:
      name: {robot}
      type: {robot}
    metrics:
    - type: mean_reward
      value: {value:.1f}
      name: {how}"""
_USAGE = """```python
model, params = jaxpets.{load}
rollout = jaxpets.fused_rollout(model, num_particles={particles})
box = {{"action_low": env.action_low, "action_high": env.action_high}}
search = jaxpets.optimizers.{optimizer}(
    **box,
    {settings},
)
planner = jaxpets.plan(rollout, your_reward, search)
plan, state = jax.jit(planner.step)(jaxpets.PlanParams(params), key, state, obs)
```"""


class _Performed(NamedTuple):
    """A zero-shot with the model: its config, its device, and returns by task."""

    config: Config
    device: str
    returns: Mapping[str, np.ndarray]


class _Facts(NamedTuple):
    """What a card is made of."""

    file: Path  # as it is called, which may be somewhere else as yet
    about: Mapping[str, Any]  # what the file says
    model: jaxpets.Ensemble
    config: Config  # of the run
    explored: Sequence[Row]  # of the seed that the model is of
    performed: Sequence[_Performed]


def text(
    file: Path, run: Path, returns: Sequence[Path] | None, name: Path | None = None
) -> str:
    """Returns the card of a model.

    Args:
      file: from `experiments.tools.share`.
      run: the exploration that the model is of, or a zero-shot in it.
      returns: folders of zero-shots with it; None for those in the run's folder that
        have a log.
      name: of the file, where it is not there yet; None for what it is called now.

    Raises:
      RunError: if the file says nothing of a training, or a log or config is missing.
    """
    facts = _facts(file, run, returns)._replace(file=name or file)
    robot, arm = facts.about["environment"], facts.about["training"]["arm"]
    parts = (
        _front_matter(facts),
        f"# {facts.file.stem}: a model of {robot}",
        f"It predicts what {robot} does next, and was learned by the arm `{arm}` of "
        "jaxpets. It is no policy: a search plans with it, for any reward over what "
        "the robot observes.",
        "## How to use it",
        _usage(facts),
        "## What it is",
        _bullets(_model(facts)),
        "## What it saw",
        _bullets(_seen(facts)),
        "## How it was trained",
        _bullets(_trained(facts)),
        "## What it returns",
        *_returned(facts),
        "## Limits",
        _bullets(_limits(facts.model)),
        f"## Licence\n\n{facts.about['licence']}.\n",
    )
    return "\n\n".join(parts)


def _facts(file: Path, run: Path, returns: Sequence[Path] | None) -> _Facts:
    about = models.about(file)
    if missing := [word for word in _SAID if not about.get(word)]:
        raise UsageError(f"{file} does not say its {', '.join(missing)}.")
    seed, trials = (about["training"][word] for word in ("seed", "num_trials"))
    config = exploration.config_of(RunFolder(run))
    if config.phase != "explore":
        returns, run = returns or [run], run.parent
        config = exploration.config_of(RunFolder(run))
    logged = (log.parent for log in run.glob(f"zero-shot-*/{rundir.METRICS}"))
    performed = []
    for folder in sorted(filter(_as_shared, logged)) if returns is None else returns:
        rows = [r for r in _rows(folder) if (r.seed, r.explored) == (seed, trials)]
        if rows:
            device = _device(rundir.find_json(folder / rundir.ENVIRONMENT))
            own = exploration.config_of(RunFolder(folder))
            performed.append(_Performed(own, device, _by_task(rows)))
        elif returns is not None:
            raise UsageError(f"{folder} has no trial of seed {seed} after {trials}.")
    explored = [row for row in _rows(run) if row.seed == seed and row.trial <= trials]
    model, _ = jaxpets.load_model(file)
    return _Facts(file, about, model, config, explored, performed)


def _as_shared(folder: Path) -> bool:
    """Tells if what performed in a folder is what explored, and no more."""
    config = exploration.config_of(RunFolder(folder))
    return config.refit.num_epochs == 0 and config.policy is None


def _rows(folder: Path) -> list[Row]:
    log = folder / rundir.METRICS
    if not log.is_file():
        raise UsageError(f"there is no {log}.")
    return list(metrics.read(log, rundir.read_json(folder / rundir.CONFIG)))


def _by_task(rows: Iterable[Row]) -> dict[str, np.ndarray]:
    found: dict[str, list[float]] = {}
    for row in rows:
        if np.isfinite(value := number(row.data["return"])):
            found.setdefault(row.task, []).append(value)
    return {task: np.array(values) for task, values in found.items()}


def _front_matter(facts: _Facts) -> str:
    """Returns what the Hub reads; a text in JSON is one in YAML."""
    licence = str(facts.about["licence"]).lower()
    lines = [_HEAD.format(licence=licence, name=json.dumps(facts.file.stem))]
    for found in facts.performed:
        how = f"mean return; {_performing(found.config)}; {found.device}"
        robot = json.dumps(facts.about["environment"])
        for task, values in found.returns.items():
            words = {"task": json.dumps(task), "robot": robot, "how": json.dumps(how)}
            lines.append(_RESULT.format(**words, value=values.mean()))
    return "\n".join([*lines, "---"]) if facts.performed else f"{lines[0]} []\n---"


def _usage(facts: _Facts) -> str:
    search = facts.about["search"]
    own = facts.file.resolve()
    shipped = [x for x in models.names() if models.path(x).resolve() == own]
    settings = (f"{key}={value!r}" for key, value in search["settings"].items())
    return _USAGE.format(
        load=f'pretrained("{shipped[0]}")'
        if shipped
        else f'load_model("{facts.file.name}")',
        particles=search["num_particles"],
        optimizer=search["optimizer"],
        settings=",\n    ".join(settings),
    )


def _model(facts: _Facts) -> Iterator[str]:
    model = facts.model
    config, space = model.config, model.space
    assert config is not None and space is not None
    widths = " x ".join(map(str, config.hidden_sizes))
    sizes = f"{model.obs_size} numbers of an observation and {model.action_size}"
    units = f"{widths} {config.activation} units"
    yield f"{config.num_members} networks of {units}, each a Gaussian."
    yield f"Read are {sizes} of an action; predicted is the next observation."
    names = ", ".join(f"`{row.name}`" for row in space.coordinates) or "without names"
    yield f"Entries: {names}."
    if rounded := facts.about.get("weights"):
        yield f"Its weights are rounded to {rounded}."


def _seen(facts: _Facts) -> Iterator[str]:
    training, rows = facts.about["training"], facts.explored
    trials, length = training["num_trials"], training["trial_length"]
    random = sum(row.data.get("planner") == "random" for row in rows)
    yield f"{trials} trials of {length:,} steps: {trials * length:,} transitions."
    sought = f"; the others sought `{training['arm']}`" if random < trials else ""
    yield f"{random} of them with random actions{sought}."
    if lost := sum(row.data.get("lost_steps", 0) for row in rows):
        yield f"Lost where physics diverged: {lost} steps."
    if fit := rows[-1].data.get("fit") if rows else None:
        yield (
            f"Mean squared error after the last trial: {fit['mse']:.3g}, in the units "
            "of what is predicted."
        )


def _trained(facts: _Facts) -> Iterator[str]:
    training = facts.about["training"]
    yield f"After every trial: {_fit(vars(facts.config.training))}."
    refit = training.get("refit") or {"num_epochs": 0}
    yield f"Before it performed: {_fit(refit) if refit['num_epochs'] else 'no more'}."
    skipped = [row.data.get("fit", {}).get("num_skipped", 0) for row in facts.explored]
    yield f"Updates refused for being not finite: {sum(skipped):.0f}."
    yield f"Exploring was planned by {_search(facts.config.planner)}."
    software = training.get("software") or {}
    names = ("jaxpets", "jax", "flax", "optax", "mujoco")
    versions = [f"{name} {software[name]}" for name in names if name in software]
    known = ", ".join([_device(software), *versions])
    yield f"Seed {training['seed']}; {known}; commit {software.get('git', 'unknown')}."


def _fit(fit: Mapping[str, Any]) -> str:
    rows = "a bootstrap of all rows" if fit["bootstrap"] else "all rows"
    rate, last = fit["learning_rate"], fit["learning_rate"] * fit["final_rate"]
    falling = f", falling to {last:g}" if last < rate else ""
    return (
        f"{fit['num_epochs']} epochs of each network over {rows}, batches of "
        f"{fit['batch_size']}, Adam at {rate:g}{falling}"
    )


def _performing(config: Config) -> str:
    said, updates = _search(config.task_planner), config.critic.num_updates
    said = "an actor, no search" if config.critic.acts else said
    return f"{said}, critic of {updates:,} imagined steps" if updates else said


def _search(search: PlannerConfig) -> str:
    found = f"{search.optimizer} with {search.num_samples} candidates, "
    found += f"{search.num_iterations} iterations, {search.num_particles} particles"
    return f"{found} and horizon {search.horizon}"


def _device(environment: Mapping[str, Any]) -> str:
    kind = str(environment.get("device_kind", "unknown device"))
    return "CPU" if kind == "cpu" else kind


def _returned(facts: _Facts) -> Iterator[str]:
    if not facts.performed:
        yield "It has not performed a task yet."
        return
    yield (
        "At the first attempt, without learning. Brackets are Student's 95 % interval "
        "of the mean over trials of this one model; other seeds return something else."
    )
    for found in facts.performed:
        how, length = _performing(found.config), found.config.task_length
        yield f"{found.device}; {how}; trials of {length:,} steps:"
        lines = ["| task | mean return | trials |", "|---|---|---|"]
        for task, values in found.returns.items():
            mean, interval = f"{values.mean():.0f}", stats.t_interval(values)
            if interval is not None:
                mean += f" [{interval[0]:.0f}, {interval[1]:.0f}]"
            lines.append(f"| {task} | {mean} | {len(values)} |")
        yield "\n".join(lines)


def _limits(model: jaxpets.Ensemble) -> Iterator[str]:
    yield "One robot in one simulator: it knows no other, and no machine."
    yield "Where it has seen little its networks disagree, and err."
    yield "A search finds where it errs in the search's favour: plans promise too much."
    if model.config is not None and (margin := model.config.state_margin) is not None:
        yield (
            "Imagined states stay within the range of the data and "
            f"{100 * margin:g} % of it on each side, but for entries without limits."
        )
    yield "Nothing about safety was trained or tested."


def _bullets(lines: Iterator[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)
