"""What others have published of the suite's tasks: `results/dmc20-peers.json`."""

from pathlib import Path

import msgspec

from ..storage import rundir

FILE = Path("results/dmc20-peers.json")
ENDS = (0, -1)  # of others' steps: the fewest and the most


class System(msgspec.Struct, frozen=True):
    """Somebody else's numbers: after so many steps, with the reward or without."""

    name: str
    reward: bool
    steps: list[int]
    source: str
    about: str


class Peers(msgspec.Struct, frozen=True):
    """Returns by system and task, one for each of the system's steps."""

    systems: list[System]
    returns: dict[str, dict[str, list[float]]]


def read(path: Path) -> Peers:
    """Reads a file of others' numbers.

    Raises:
      RunError: if it is not there, or is not one.
    """
    return rundir.read_as(path, Peers, "numbers of others")


def label(system: System, i: int) -> str:
    """Returns a system's name and the steps at one of its ends."""
    return f"{system.name}, {system.steps[i] / 1e6:g}M"


def labels(peers: Peers) -> dict[tuple[str, int], str]:
    """Returns what a figure says of a system after its fewest and its most steps."""
    return {
        (x.name, i): label(x, i) + ", with the reward" * x.reward
        for x in peers.systems
        for i in ENDS
    }
