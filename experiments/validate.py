"""What must hold between the numbers of a config."""

import re
from typing import Any

from .config import UNDIVIDED, Config, PlannerConfig
from .entries import Mark, entries, flag, is_read
from .errors import UsageError
from .storage import rundir, trackers


def require(holds: bool, flag: str, value: Any, valid: str) -> None:
    """Raises UsageError with the flag, its value and what would be valid."""
    if not holds:
        raise UsageError(f"{flag} {value} is not valid; it must be {valid}.")


def validate(config: Config) -> None:
    """Checks what more than one number decides; each alone is valid already.

    Raises:
      UsageError: naming the flag, the value and what would be valid.
    """
    trackers.check(config.track)
    unique = 0 < len(config.seeds) == len(set(config.seeds))
    require(unique, "--seeds", config.seeds, "one or more different seeds")
    _check_members(config)
    for name in ("planner", "task_planner"):
        check_planner(flag(name), getattr(config, name), config.model.num_members)
    for name in ("training", "tuning"):
        epochs = getattr(config, name).num_epochs
        require(epochs > 0, f"--{name}.num-epochs", epochs, "1 to 10,000")
    random, trials = config.random_trials, config.num_trials
    valid = f"1 to --num-trials ({trials})"
    require(random <= trials, "--random-trials", random, valid)
    for length in (config.trial_length, config.task_length):
        divides = length % config.chunk_length == 0
        valid = f"a divisor of the length of a trial ({length})"
        require(divides, "--chunk-length", config.chunk_length, valid)
    _check_critic(config)
    if config.video is not None:
        good = config.video.suffix == ".mp4"
        require(good, "--video", config.video, "a .mp4 file")


def _check_members(config: Config) -> None:
    members = config.model.num_members
    require(
        members >= 2 or config.arm in UNDIVIDED,
        "--model.num-members",
        members,
        f"2 or more for --arm {config.arm}; one member never disagrees",
    )
    require(
        members >= 2 or not config.pessimism,
        "--pessimism",
        config.pessimism,
        "0 with one member; it never disagrees",
    )


def _check_critic(config: Config) -> None:
    updates = config.critic.num_updates
    if not updates:
        alone = "False without --critic.num-updates"
        require(not config.critic.acts, "--critic.acts", True, alone)
    if config.phase == "distill":
        rounds, updates = config.distill.num_rounds, config.distill.critic.num_updates
        valid = "1 or more without --distill.critic.num-updates"
        require(rounds + updates > 0, "--distill.num-rounds", rounds, valid)
    elif not is_read("critic", config.phase):
        return
    if updates:
        alone = "0 with a critic, which is asked about one member at a time"
        require(not config.pessimism, "--pessimism", config.pessimism, alone)
        has_policy = bool(config.policy) and is_read("policy", config.phase)
        require(not has_policy, "--policy", config.policy, "None with a critic")


def check_planner(flag: str, planner: PlannerConfig, num_members: int) -> None:
    """Refuses more elites than candidates, and particles that members cannot share."""
    require(
        planner.num_elites <= planner.num_samples or planner.optimizer == "mppi",
        f"{flag}.num-elites",
        planner.num_elites,
        f"2 to {flag}.num-samples ({planner.num_samples})",
    )
    require(
        planner.num_particles % num_members == 0,
        f"{flag}.num-particles",
        planner.num_particles,
        f"a multiple of --model.num-members ({num_members})",
    )


def check_names(config: Config) -> None:
    """Refuses what is no name of a folder."""
    for which, name in (("name", config.name), ("tag", config.tag)):
        if name is not None:
            try:
                rundir.check_name(name)
            except UsageError as error:
                raise UsageError(f"--{which}: {error}") from None


def check_explored(config: Config, explored: Config) -> None:
    """Refuses to call a model what it is not, and what the phase would ignore."""
    phase, names = config.phase, {entry.name for entry in entries(Config)}
    for entry in entries(Config):
        given, found = entry.of(config), entry.of(explored)
        if not is_read(entry.name, phase):
            valid = f"left out in {phase}, which does not read it"
            if (own := f"{phase}.{entry.name}") in names:
                valid = f"{valid}; {flag(own)} is meant here"
        elif Mark.EXPLORED in entry.marks:
            valid = f"{found}, which goes with what --from names"
        else:
            continue
        require(given == found, flag(entry.name), given, valid)


def check_process(config: Config) -> None:
    """Refuses half a place among several processes."""
    address = config.coordinator_address
    count, own = config.num_processes, config.process_id
    if address in (None, "auto"):
        alone = "left out, unless --coordinator-address is HOST:PORT"
        require(count is None, "--num-processes", count, alone)
        require(own is None, "--process-id", own, alone)
    else:
        named = re.fullmatch(r"\S+:[0-9]{1,5}", str(address)) is not None
        require(named, "--coordinator-address", address, "HOST:PORT or auto")
        given = "1 or more, with --coordinator-address"
        require(count is not None, "--num-processes", count, given)
        below = count is not None and own is not None and own < count
        valid = f"0 to one less than --num-processes ({count})"
        require(below, "--process-id", own, valid)
    one = config.phase != "report" or address is None
    require(one, "--coordinator-address", address, "left out in report")
