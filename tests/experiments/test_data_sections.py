"""What the report makes of coverage.json and of model_error.json."""

import json
import shutil

import numpy as np
import pytest
from small_logs import explore_rows, report_in, write_run

from experiments.errors import UsageError
from experiments.report.report import coverage, write_report
from jaxpets import envs

EDGES = [axis.edges for axis in envs.make("pets/half_cheetah").axes]
SHAPE = tuple(len(edges) - 1 for edges in EDGES)

# Coverage.


def of_cells(**cells):
    """A histogram that is zero elsewhere; keys are such as v3_w10, in bins."""
    counts = np.zeros(SHAPE, int)
    for cell, count in cells.items():
        v, w = cell.split("_")
        counts[int(v[1:]), int(w[1:])] = count
    return counts


def write_coverage(run, counts):
    data = {
        "velocity_edges": EDGES[0],
        "pitch_rate_edges": EDGES[1],
        "counts": {seed: x.tolist() for seed, x in counts.items()},
    }
    (run / "coverage.json").write_text(json.dumps(data))


def add_run(out, arm, counts, name=None, **config):
    run = out / (name or arm)
    write_run(run, explore_rows(arm, counts), phase="explore", arm=arm, **config)
    write_coverage(run, counts)


@pytest.fixture
def out(tmp_path):
    """Two arms; one in two runs of two seeds and one."""
    out = tmp_path / "runs"
    add_run(out, "count", {0: of_cells(v16_w15=100)})
    add_run(
        out,
        "epistemic",
        # A hundred transitions each; in 3 and 1 cells, of which 2 and 1 ten times.
        {0: of_cells(v31_w0=80, v16_w15=19, v1_w29=1), 1: of_cells(v16_w15=100)},
    )
    add_run(out, "epistemic", {2: of_cells(v0_w29=60, v16_w15=40)}, name="more")
    return out


def test_coverage_is_read_by_arm_and_seed(out):
    (out / ".hidden").mkdir()
    shutil.copytree(out / "more", out / ".hidden" / "more")
    found = coverage.load(out)
    assert {arm: sorted(x) for arm, x in found["laptop"].by_arm.items()} == {
        "count-16": [0],
        "epistemic": [0, 1, 2],
    }
    np.testing.assert_array_equal(
        found["laptop"].by_arm["epistemic"][2], of_cells(v0_w29=60, v16_w15=40)
    )


def test_report_has_a_table_and_a_figure(out):
    from matplotlib import colormaps
    from PIL import Image

    written = write_report(out, out / "report")
    assert [path.name for path in written] == [
        "report.md",
        "table1.json",
        "figure4.png",
        "exploration.png",
        "coverage.png",
    ]
    assert all(path.is_file() for path in written)
    text = (out / "report" / "report.md").read_text()
    assert "![what each arm saw](coverage.png)" in text
    # Cells 3, 1, 2; ten times 2, 1, 2; forward 80, 0, 0 %; backward 1, 0, 60 %.
    row = (
        "| epistemic | 100 ± 0.0 (3 seeds) | 2.0 ± 1.0 (3 seeds) "
        "| 1.7 ± 0.6 (3 seeds) | 27 ± 46 (3 seeds) | 20 ± 34 (3 seeds) "
        "| 20 ± 34 (3 seeds) | 27 ± 46 (3 seeds) |"
    )
    assert row in text
    assert "| count-16 | 100 (1 seed) | 1.0 (1 seed) |" in text
    # Most often seen, mean over seeds: a hundred times, by count.
    pixels = np.asarray(Image.open(written[-1]).convert("RGB")).reshape(-1, 3)
    brightest = np.round(255 * np.array(colormaps["cividis"](1.0)[:3]))
    assert (abs(pixels - brightest) <= 1).all(axis=-1).sum() > 50


def test_report_without_coverage_has_no_such_section(out):
    for path in out.rglob("coverage.json"):
        path.unlink()
    written, text = report_in(out)
    assert [path.name for path in written][-1] == "exploration.png"
    assert not (out / "report" / "coverage.png").exists()
    assert "coverage" not in text


def test_presets_have_their_own_coverage(out):
    add_run(out, "oracle", {0: of_cells(v3_w3=1)}, preset="paper")
    add_run(out, "random", {0: of_cells()}, name="none", preset="smoke")
    (out / "none" / "coverage.json").unlink()
    written, text = report_in(out)
    names = [path.name for path in written]
    pictures = [name for name in names if name.startswith("coverage")]
    assert pictures == ["coverage.png", "coverage-laptop.png"]
    assert "| oracle | 1.0 (1 seed) |" in text


def test_arms_without_a_panel_beside_them(tmp_path):
    """Four panels leave two places empty; one cell is a scale too."""
    for arm in ("epistemic", "random", "oracle", "count"):
        add_run(tmp_path, arm, {0: of_cells(v16_w15=1)})
    write_report(tmp_path, tmp_path / "report")
    assert (tmp_path / "report" / "coverage.png").stat().st_size > 5000


def test_a_seed_that_is_there_twice_is_an_error(out):
    (out / "again").mkdir()
    for name in ("config.json", "coverage.json"):
        shutil.copy(out / "more" / name, out / "again" / name)
    with pytest.raises(UsageError, match="both hold the coverage of seed 2, arm epi"):
        coverage.load(out)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is no coverage of a run"),
        ('{"velocity_edges": [0], "pitch_rate_edges": [0]}', "is no coverage of a run"),
        (
            '{"velocity_edges": [0], "pitch_rate_edges": [0], "counts": {}}',
            "other bins",
        ),
    ],
)
def test_a_file_that_is_no_coverage_is_an_error(out, text, words):
    (out / "more" / "coverage.json").write_text(text)
    with pytest.raises(UsageError, match=words):
        coverage.load(out)


def test_counts_of_other_bins_are_an_error(out):
    write_coverage(out / "more", {2: of_cells(v0_w29=1)[:-1]})
    with pytest.raises(UsageError, match="other bins"):
        coverage.load(out)


# Model error.


def entry(mean, std, pairs):
    return {"mean": mean, "std": std, "pairs": pairs}


TABLE = {
    "random": {"random": None, "epistemic": entry(1.25, 0.5, 6)},
    "epistemic": {"random": entry(0.125, None, 1), "epistemic": entry(None, None, 2)},
}


@pytest.fixture
def measured(tmp_path):
    write_run(
        tmp_path / "a", explore_rows("random", [0]), phase="explore", arm="random"
    )
    return tmp_path


def report_with(measured, **changes):
    data = {
        "preset": "laptop",
        "rows": 2000,
        "trials": {"random": {"0": 60}, "epistemic": {"0": 60, "1": 26}},
        "error": TABLE,
        "nll": TABLE,
        **changes,
    }
    (measured / "model_error.json").write_text(json.dumps(data))
    return report_in(measured)[1]


def test_report_has_a_table_of_each(measured):
    text = report_with(measured)
    assert "on 2000 transitions of every seed" in text
    assert "Models are of trial 26, 60." in text
    table = [
        "| model of | data of epistemic | data of random |",
        "|---|---|---|",
        "| epistemic | not finite | 0.125 (1 pair) |",
        "| random | 1.25 ± 0.5 (6 pairs) | no pair |",
    ]
    assert text.count("\n".join(table)) == 2


def test_report_without_the_file_or_of_another_preset(measured):
    assert "Model error" not in report_with(measured, preset="paper")
    (measured / "model_error.json").unlink()
    assert "Model error" not in report_in(measured)[1]


@pytest.mark.parametrize("text", ["{", "{}", '{"preset": "laptop"}', "[]"])
def test_another_file_of_that_name_is_an_error(measured, text):
    (measured / "model_error.json").write_text(text)
    with pytest.raises(UsageError, match=r"is not of experiments\.tools\.model_error"):
        write_report(measured, measured / "report")
