"""The tables of searches in results/README.md are those of the committed logs."""

import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks import costs, workloads

RESULTS = Path(__file__).parents[2] / "results"
TASKS = ("forward", "backward", "front-flip", "back-flip")


def steps_of_a_plan(search):
    """What the code imagines."""
    names = ("horizon", "num_samples", "num_iterations", "num_elites", "num_particles")
    size = workloads.Size(**{x: search[x] for x in names})
    candidates = costs.candidates_per_action(size, search["optimizer"])
    return candidates * size.horizon * size.num_particles


@pytest.fixture(scope="module")
def searches():
    """Thousands of steps, and shares of the full search `[4]`, of each search."""
    steps, returns = {}, {}
    with tarfile.open(RESULTS / "search.tar.xz") as logs:
        for member in logs:
            found = re.fullmatch(r"best/zero-shot-060-(.*)/(.*)\..*", member.name)
            if found is None or found[2] not in ("config", "metrics"):
                continue
            file = logs.extractfile(member)
            assert file is not None
            if found[2] == "config":
                search = json.load(file)["task_planner"]
                steps[found[1]] = steps_of_a_plan(search) / 1000
                continue
            rows = [json.loads(line) for line in file]
            assert len({(x["task"], x["seed"], x["trial"]) for x in rows}) == 40
            returns[found[1]] = np.array(
                [np.mean([x["return"] for x in rows if x["task"] == y]) for y in TASKS]
            )
    full = returns["500-icem-5-20"]
    assert np.array_equal(full.round(), [6787, 5478, 11283, 9038])
    return {x: (steps[x], 100 * returns[x] / full) for x in returns}


def cell(steps, shares):
    text = " ".join(f"{x:.0f}" for x in shares)
    return f"{steps:,.0f}: {text}, **{shares.mean():.0f}**"


def test_every_search_is_in_the_table(searches):
    page = (RESULTS / "README.md").read_text()
    lines = re.findall(r"^\| (\d+) x (\d) x (\d+) \| (.*) \|$", page, re.MULTILINE)
    shown = {}
    for size, iterations, particles, cells in lines:
        rest = f"{iterations}-{particles}"
        names = [f"{size}-{x}-{rest}" for x in ("icem", "cem", "mppi")]
        names.insert(1, f"means-{size}-{iterations}")
        texts = zip(names, cells.split("|"), strict=True)
        shown |= {name: text for name, text in texts if text.strip()}
    assert shown.keys() == searches.keys() - {"500-cem-5-20-legacy"}
    for name, text in shown.items():
        assert text.strip() == cell(*searches[name]), name
    legacy = searches["500-cem-5-20-legacy"][1]
    assert np.array_equal(legacy.round(), [93, 86, 79, 87])


def test_the_smallest_search_that_is_good_enough(searches):
    page = (RESULTS / "README.md").read_text()
    for share in (90, 95, 99):
        (line,) = re.findall(rf"^\| {share} % \| (.*) \|$", page, re.MULTILINE)
        expected = []
        for kind in ("icem", "means"):
            for least in (np.min, np.mean):
                enough = [
                    (steps, name)
                    for name, (steps, shares) in searches.items()
                    if kind in name and least(shares) >= share
                ]
                expected.append(f"{min(enough)[0]:.0f}" if enough else "none")
        assert not any(
            shares.mean() >= share
            for name, (_, shares) in searches.items()
            if "-cem-" in name or "mppi" in name
        )
        assert [x.split(" (")[0] for x in line.split(" | ")] == [*expected, "none"]
