"""The pages of the project: their links lead somewhere, their numbers are the logs'."""

import re
from pathlib import Path

import numpy as np
import pytest

from experiments.report import logs, stats, tables

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "results/README.md",
    "experiments/README.md",
    "benchmarks/README.md",
    "benchmarks/kernel.md",
    "docs/own_robot.md",
)
# The columns of the main table after the paper's.
COLUMNS = (
    "epistemic, no-refit",
    "epistemic",
    "epistemic, best-pipeline",
    "best",
)


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    path = ROOT / page
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text())
    for link in links:
        if "://" in link:
            continue
        name, _, heading = link.partition("#")
        target = (path.parent / name) if name else path
        assert target.exists(), f"{page} links to {link}"
        if heading:
            assert heading in anchors(target.read_text()), f"{page} links to {link}"


def anchors(text):
    """Headings as GitHub names them."""
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", t).strip().lower().replace(" ", "-") for t in titles}


def test_the_front_page_is_read_in_five_minutes():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1200


@pytest.fixture(scope="module")
def main_table():
    """The rows of the main table as the logs have them."""
    rows = logs.load(ROOT / "results" / "paper")
    found = logs.scores(logs.named_by_tag(rows), explored=60)
    lines = []
    for task, paper in zip(tables.TASKS, tables.PAPER_TABLE_1["SU-PETS"], strict=True):
        cells = [task.replace("-", " "), str(paper)]
        for column in COLUMNS:
            scores = np.array(list(found[column][task].values()))
            low, high = stats.t_interval(scores)
            cells.append(f"{scores.mean():.0f} [{low:.0f}, {high:.0f}]")
        lines.append("| " + " | ".join(cells) + " |")
    counts = [str(len(found[column]["forward"])) for column in COLUMNS]
    return [*lines, "| n | 3 | " + " | ".join(counts) + " |"]


def test_the_main_table_is_what_the_logs_say(main_table):
    lines = (ROOT / "results" / "README.md").read_text().splitlines()
    for row in main_table:
        assert row in lines


def test_the_front_page_has_the_first_and_the_last_column(main_table):
    lines = (ROOT / "README.md").read_text().splitlines()
    *tasks, counts = [row.strip("| ").split(" | ") for row in main_table]
    named = {"paper's SU-PETS": 1, "the same, run here": 2, "`best`": -1}
    for words, i in named.items():
        row = [words, *(task[i] for task in tasks)]
        assert f"| {' | '.join(row)} |" in lines
    assert counts[2] == counts[-1] == "13"
    assert any("13 seeds, the paper had three" in line for line in lines)
