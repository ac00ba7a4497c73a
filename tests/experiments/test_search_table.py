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
    shown = 0
    for run, full_returns, columns in (
        (
            "real-time/100-101-102-103-104",
            [6326, 6046, 9594, 9055],
            {(500, 30): 1, (1000, 30): 2, (1600, 30): 3},
        ),
        (
            "real-time-again/110-111-112-113-114",
            [6531, 5888, 10977, 8989],
            {(1000, 30): 1, (1600, 30): 2, (1600, 27): 3},
        ),
    ):
        found, returns = logged(run)
        full = returns.pop("full")
        assert np.array_equal(full.round(), full_returns)
        shown += len(returns)
        for name in returns:
            search, share = found[name], shown_as(100 * returns[name] / full)
            if not search["means"]:
                assert share in text
                continue
            size, horizon = search["num_samples"], search["horizon"]
            column = columns[size, horizon if (size, horizon) in columns else 30]
            rows = [x.split("|") for x in text.splitlines() if x.count("|") == 5]
            assert share in [row[column + 1].strip() for row in rows], name
    assert shown == len(re.findall(r", \*\*\d+\*\*", text)) == 22 + 12


@pytest.mark.parametrize(
    ("before", "again", "seeds", "shares"),
    [
        ("means-1000-3-12", None, 110, "94 ± 3, 97 ± 2, 98 ± 4 and 99 ± 2"),
        ("means-1600-3-12", None, 110, "97 ± 9, 100 ± 3, 98 ± 5 and 99 ± 4"),
        (None, "1000-12-0.5", 120, "97 ± 5, 101 ± 4, 97 ± 2 and 100 ± 4"),
        (None, "1600-27-12-0.5", 120, "97 ± 6, 106 ± 4, 97 ± 3 and 104 ± 3"),
        ("means-1000-3-12", "1000-12-0.5", 120, "95 ± 3, 99 ± 2, 98 ± 2 and 100 ± 2"),
        (
            "means-1600-3-12",
            "1600-30-12-0.5",
            115,
            "96 ± 6, 102 ± 3, 98 ± 3 and 99 ± 3",
        ),
    ],
)
def test_the_shares_of_what_was_chosen_for_a_millisecond(before, again, seeds, shares):
    """Of the models of two sweeps, up to a seed."""
    page = (RESULTS / "README.md").read_text()
    assert shares in " ".join(page.split())
    of_full, searched = np.zeros(4), np.zeros(4)
    for first in range(100, seeds, 5):
        sweep, name = (
            ("real-time", before) if first < 110 else ("real-time-again", again)
        )
        if name is not None:
            five = "-".join(str(x) for x in range(first, first + 5))
            _, returns = logged(f"{sweep}/{five}")
            of_full, searched = of_full + returns["full"], searched + returns[name]
    expected = [int(x) for x in re.findall(r"(\d+) ±", shares)]
    assert np.array_equal((100 * searched / of_full).round(), expected)
