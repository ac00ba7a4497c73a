"""State coverage: its bins, and its file beside a run."""

import json

import jax
import numpy as np
import pytest
import runs

from experiments.report import coverage
from experiments.run import main
from experiments.storage.folder import RunFolder
from jaxpets import envs
from jaxpets.envs import half_cheetah

AXES = envs.make("pets/half_cheetah").axes
SCALES = tuple(coverage.Scale(axis.name, axis.unit, axis.edges) for axis in AXES)
SHAPE = tuple(len(axis.edges) - 1 for axis in AXES)
SEEDS = (0, 7)


def observations(velocity, pitch_rate):
    """Observations `[N, D]` whose other entries would be in other cells."""
    obs = np.full((len(velocity), half_cheetah.OBS_SIZE), 5.3, np.float32)
    obs[:, half_cheetah.FORWARD_VELOCITY] = velocity
    obs[:, half_cheetah.PITCH_RATE] = pitch_rate
    return obs


# The histogram.


def test_bins_are_those_asked_for():
    np.testing.assert_allclose(AXES[0].edges, np.linspace(-8, 8, 33))
    np.testing.assert_allclose(AXES[1].edges, np.linspace(-15, 15, 31))


def test_histogram_is_numpys_with_open_ends():
    generator = np.random.default_rng(0)
    velocity = generator.normal(0.0, 5.0, 3000).astype(np.float32)
    pitch_rate = generator.normal(0.0, 9.0, 3000).astype(np.float32)
    assert abs(velocity).max() > 8 and abs(pitch_rate).max() > 15
    counts = coverage.histogram(AXES, observations(velocity, pitch_rate))
    edges = np.linspace(-8, 8, 33), np.linspace(-15, 15, 31)
    # Within the edges all is as NumPy has it; what is beyond goes to the next bin.
    inside = np.clip(velocity, -8, 8), np.clip(pitch_rate, -15, 15)
    want, *_ = np.histogram2d(*inside, edges)
    np.testing.assert_array_equal(counts, want)
    assert counts.shape == SHAPE and counts.sum() == 3000
    assert np.issubdtype(counts.dtype, np.integer)


@pytest.mark.parametrize(
    ("velocity", "pitch_rate", "cell"),
    [
        (0.0, 0.0, (16, 15)),  # an edge belongs to the bin above it
        (-0.01, -0.01, (15, 14)),
        (-8.0, -15.0, (0, 0)),
        (-1e6, -1e6, (0, 0)),
        (8.0, 15.0, (31, 29)),
        (1e6, 1e6, (31, 29)),
        (3.0, -6.0, (22, 9)),
    ],
)
def test_the_cell_of_one_observation(velocity, pitch_rate, cell):
    counts = coverage.histogram(AXES, observations([velocity], [pitch_rate]))
    assert np.argwhere(counts).tolist() == [list(cell)]


def test_histograms_add_up():
    generator = np.random.default_rng(1)
    obs = observations(*generator.normal(0.0, 4.0, (2, 100)))
    parts = coverage.histogram(AXES, obs[:30]) + coverage.histogram(AXES, obs[30:])
    np.testing.assert_array_equal(coverage.histogram(AXES, obs), parts)
    assert not coverage.histogram(AXES, obs[:0]).any()


def test_measures_are_shares_of_what_was_seen():
    generator = np.random.default_rng(2)
    velocity, pitch_rate = generator.normal(0.0, [[3.0], [6.0]], (2, 5000))
    # Numbers on an edge: those on a limit count above it.
    velocity[:2], pitch_rate[:2] = (3.0, -3.0), (6.0, -6.0)
    counts = coverage.histogram(AXES, observations(velocity, pitch_rate))
    found = list(coverage.measures(SCALES, counts).values())
    want = [velocity >= 3, velocity < -3, pitch_rate >= 6, pitch_rate < -6]
    np.testing.assert_allclose(found[3:], [100 * x.mean() for x in want])
    assert found[0] == 5000
    cells = np.unique(
        np.stack(
            [
                np.clip(np.floor(velocity * 2), -16, 15),
                np.clip(np.floor(pitch_rate), -15, 14),
            ]
        ),
        axis=1,
        return_counts=True,
    )[1]
    assert found[1] == len(cells)
    assert found[2] == np.sum(cells >= 10)


# The file of a run.


@pytest.fixture(scope="module")
def explored(explored_once):
    return explored_once(*SEEDS).folder


@pytest.fixture
def again(explored, tmp_path):
    """A copy of that run."""
    return runs.copied(explored, tmp_path)


def go_on(folder):
    seeds = ("--seeds", *map(str, SEEDS))
    return main([*runs.EXPLORED, *seeds, "--out", str(folder.parent)])


@pytest.mark.slow
def test_a_complete_run_has_the_coverage_of_its_data(explored):
    data = json.loads((explored / "coverage.json").read_text())
    edges = ["velocity_edges", "pitch_rate_edges"]
    assert [*data] == [*edges, "units", "trial", "counts"]
    assert data["trial"] == runs.LAST
    assert [tuple(data[name]) for name in edges] == [axis.edges for axis in AXES]
    assert list(data["counts"]) == [str(seed) for seed in SEEDS]
    dataset = runs.learner(explored).dataset
    total = runs.LAST * runs.STEPS
    assert int(dataset.size) == total
    for next_obs, counts in zip(
        np.asarray(dataset.data.next_obs), data["counts"].values(), strict=True
    ):
        np.testing.assert_array_equal(counts, coverage.histogram(AXES, next_obs))
        assert np.sum(counts) == total
    first, second = data["counts"].values()
    assert first != second
    found = coverage.load(explored.parent)
    assert found["smoke"].scales == SCALES
    assert {arm: list(seeds) for arm, seeds in found["smoke"].by_arm.items()} == {
        "epistemic": list(SEEDS)
    }


@pytest.mark.slow
def test_only_rows_that_are_filled_count(explored, tmp_path):
    """After two of three trials a third of the rows holds zeros."""
    (tmp_path / "checkpoints").symlink_to(explored / "checkpoints")
    whole = runs.learner(explored, step=runs.LAST - 1)
    template = jax.tree.map(lambda _: None, whole)._replace(dataset=whole.dataset)
    coverage.write(
        RunFolder(tmp_path), AXES, SEEDS, template, runs.LAST - 1, anew=False
    )
    counts = json.loads((tmp_path / "coverage.json").read_text())["counts"]
    assert [np.sum(x) for x in counts.values()] == [(runs.LAST - 1) * runs.STEPS] * 2


@pytest.mark.slow
def test_a_complete_run_gets_what_is_missing_and_keeps_what_is_there(again, capsys):
    path = again / "coverage.json"
    written = path.read_bytes()
    path.unlink()
    assert go_on(again) == 0
    assert path.read_bytes() == written
    path.write_text('{"mine": 1}')
    assert go_on(again) == 0
    assert path.read_text() == '{"mine": 1}'
    path.write_text('{"trial": 2}')  # from before the run was given a third
    assert go_on(again) == 0
    assert path.read_bytes() == written
    errors = capsys.readouterr().err
    assert errors.count("already complete: 3 of 3 trials") == 3


@pytest.mark.slow
def test_a_trial_that_is_run_again_counts_anew(explored, tmp_path):
    folder = runs.unfinished(explored, tmp_path)
    (folder / "coverage.json").write_text("of a trial that was lost")
    assert go_on(folder) == 0
    assert (folder / "coverage.json").read_bytes() == (
        explored / "coverage.json"
    ).read_bytes()
