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


def logged(run):
    """The searches and the returns `[4]` of each search with the models of a run."""
    searches, returns = {}, {}
    with tarfile.open(RESULTS / "search.tar.xz") as logs:
        for member in logs:
            found = re.fullmatch(rf"{run}/zero-shot-060-(.*)/(.*)\..*", member.name)
            if found is None or found[2] not in ("config", "metrics"):
                continue
            file = logs.extractfile(member)
            assert file is not None
            if found[2] == "config":
                searches[found[1]] = json.load(file)["task_planner"]
                continue
            rows = [json.loads(line) for line in file]
            assert len({(x["task"], x["seed"], x["trial"]) for x in rows}) == 40
            returns[found[1]] = np.array(
                [np.mean([x["return"] for x in rows if x["task"] == y]) for y in TASKS]
            )
    return searches, returns


@pytest.fixture(scope="module")
def searches():
    """Thousands of steps, and shares of the full search `[4]`, of each search."""
    found, returns = logged("best")
    steps = {x: steps_of_a_plan(search) / 1000 for x, search in found.items()}
    full = returns["500-icem-5-20"]
    assert np.array_equal(full.round(), [6787, 5478, 11283, 9038])
    return {x: (steps[x], 100 * returns[x] / full) for x in returns}


def shown_as(shares):
    text = " ".join(f"{x:.0f}" for x in shares)
    return f"{text}, **{shares.mean():.0f}**"


def cell(steps, shares):
    return f"{steps:,.0f}: {shown_as(shares)}"


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


def test_every_search_of_a_millisecond_is_in_the_text():
    page = (RESULTS / "README.md").read_text()
    (text,) = re.findall(r"### Searches of a millisecond\n(.*?)\n#", page, re.DOTALL)
    found, returns = logged("real-time/100-101-102-103-104")
    full = returns.pop("full")
    assert np.array_equal(full.round(), [6326, 6046, 9594, 9055])
    assert len(returns) == len(re.findall(r"\*\*\d+\*\*", text)) == 22
    columns = {500: 1, 1000: 2, 1600: 3}
    for name, search in found.items():
        if name == "full":
            continue
        share = shown_as(100 * returns[name] / full)
        if not search["means"]:
            assert share in text
            continue
        column = columns[search["num_samples"]]
        rows = [x.split("|") for x in text.splitlines() if x.count("|") == 5]
        assert share in [row[column + 1].strip() for row in rows], name


def test_the_searches_that_were_chosen_for_a_millisecond():
    page = (RESULTS / "README.md").read_text()
    assert "94 ± 3, 97 ± 2, 98 ± 4 and 99 ± 2" in page
    assert "97 ±\n  9, 100 ± 3, 98 ± 5 and 99 ± 4" in page
    for name, expected in (
        ("means-1000-3-12", [94, 97, 98, 99]),
        ("means-1600-3-12", [97, 100, 98, 99]),
    ):
        total = {"full": 0.0, name: 0.0}
        for seeds in ("100-101-102-103-104", "105-106-107-108-109"):
            _, returns = logged(f"real-time/{seeds}")
            total = {x: total[x] + returns[x] for x in total}
        shares = 100 * total[name] / total["full"]
        assert np.array_equal(shares.round(), expected)
