"""The presets: the paper's numbers, a laptop's, and seconds for tests."""

import dataclasses
from typing import Any

from .config import (
    Config,
    DistillingConfig,
    ModelConfig,
    PlannerConfig,
    Preset,
    TrainingConfig,
)

_LAPTOP_PLANNER = PlannerConfig(
    optimizer="icem",
    horizon=15,
    num_samples=64,
    num_elites=8,
    num_iterations=3,
    num_particles=5,
    noise_beta=1.0,
    precision="f32",
)
_SMOKE_PLANNER = PlannerConfig(
    horizon=3,
    num_samples=8,
    num_elites=2,
    num_iterations=2,
    num_particles=3,
    precision="f32",
)
_NO_REFIT = TrainingConfig(0)
# A policy is imagined on a GPU; on two cores the planner teaches it.
_IMAGINED = dataclasses.replace(DistillingConfig.critic, squash=10.0)
_NOT_IMAGINED = dataclasses.replace(_IMAGINED, num_updates=0)
_LAPTOP_DISTILL = DistillingConfig(
    10, num_trials=20, horizon=150, num_updates=2000, critic=_NOT_IMAGINED
)
# The laptop plans about 20,000 and not 1,500,000 model steps an action with a network a
# third as large, and trains longer on the little data there is, so that nothing is left
# for a refit. Many short trials beat few long ones.
PRESETS = {
    "paper": Config(preset="paper", distill=DistillingConfig(critic=_IMAGINED)),
    "laptop": Config(
        preset="laptop",
        num_trials=48,
        trial_length=250,
        task_length=500,
        eval_trials=3,
        finetune_trials=3,
        chunk_length=10,
        milestones=(),
        model=ModelConfig(hidden_size=128, num_layers=3),
        training=TrainingConfig(20, 64, 2e-3),
        refit=_NO_REFIT,
        tuning=TrainingConfig(20, 64, 2e-3, final_rate=0.02),
        planner=_LAPTOP_PLANNER,
        task_planner=dataclasses.replace(_LAPTOP_PLANNER, noise_beta=0.5),
        distill=_LAPTOP_DISTILL,
    ),
    "smoke": Config(
        preset="smoke",
        num_trials=3,
        trial_length=20,
        task_length=20,
        eval_trials=1,
        finetune_trials=2,
        chunk_length=10,
        milestones=(),
        model=ModelConfig(num_members=3, hidden_size=16, num_layers=2),
        training=TrainingConfig(1, 16),
        refit=_NO_REFIT,
        tuning=TrainingConfig(1, 16),
        planner=_SMOKE_PLANNER,
        task_planner=_SMOKE_PLANNER,
        distill=DistillingConfig(
            2, num_trials=6, horizon=4, num_updates=3, critic=_NOT_IMAGINED
        ),
    ),
}


# How `best` performs: a longer refit, of every member on every row, and a search from
# fewer elites in noise that keeps its direction for a while.
_BEST_REFIT = TrainingConfig(800, 256, final_rate=0.005, bootstrap=False)
_BEST_SEARCH = PlannerConfig(optimizer="icem", num_elites=25, noise_beta=0.5)


def _laptop(
    num_trials: int, trial_length: int, horizon: int, task_horizon: int,
    refit: TrainingConfig = _NO_REFIT,
) -> dict[str, Any]:  # fmt: skip
    """Returns what a robot changes of the laptop: its engine is the quicker one."""
    numbers = PRESETS["laptop"]
    return {
        "engine": "mujoco",
        "num_trials": num_trials,
        "trial_length": trial_length,
        "task_length": trial_length,
        "refit": refit,
        "planner": dataclasses.replace(numbers.planner, horizon=horizon),
        "task_planner": dataclasses.replace(numbers.task_planner, horizon=task_horizon),
    }


# What an arm or a robot changes of a preset.
_OWN: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", "best"): {"refit": _BEST_REFIT, "task_planner": _BEST_SEARCH},
    # A trial is one episode. Numbers were chosen on seeds 100 and 101.
    ("laptop", "dmc/cartpole"): _laptop(
        16, 250, 25, 25, TrainingConfig(60, 64, 2e-3, final_rate=0.02)
    ),
    ("laptop", "dmc/walker"): _laptop(24, 500, 15, 25),
    ("laptop", "gym/Hopper-v5"): _laptop(24, 500, 20, 20),
    ("laptop", "gym/Walker2d-v5"): _laptop(24, 500, 20, 20),
}


def preset_config(preset: Preset, arm: str, env: str) -> Config:
    """Returns a preset with what an arm and a robot change of it."""
    changes = _OWN.get((preset, arm), {}) | _OWN.get((preset, env), {})
    return dataclasses.replace(PRESETS[preset], **changes)


def quick_search(config: Config) -> PlannerConfig:
    """Returns a search that two cores are quick enough for, of a run at any size.

    That of the paper's size is replaced by the laptop's, at least 20 steps ahead.
    """
    if config.preset != "paper":
        return config.task_planner
    quick = preset_config("laptop", config.arm, config.env).task_planner
    return dataclasses.replace(
        quick,
        horizon=max(quick.horizon, 20),
        num_particles=config.model.num_members,
    )
