"""Models that imagine windows: the numbers, the pairs, and the program."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import runs

import jaxpets
from experiments.errors import UsageError
from experiments.run import main
from experiments.tools import compared, open_loop

K = 10  # transitions of a window
STEPS = [1, 3, K]

# The numbers. A world of two dimensions: a random walk with a drift, whose std of a
# step is NOISE, so that after h steps a path is NOISE sqrt(h) wide.

NOISE = 0.3


def world(num_sets, num_rows, noise):
    """Windows of the walk, whose action is the drift."""
    obs_key, action_key, noise_key = jax.random.split(jax.random.key(7), 3)
    shape = (num_sets, num_rows, K, 2)
    action = jax.random.normal(action_key, (*shape[:-1], 1))
    change = action + noise * jax.random.normal(noise_key, shape)
    start = jax.random.normal(obs_key, (num_sets, num_rows, 1, 2))
    path = start + jnp.cumsum(change, axis=2)
    obs = jnp.concatenate([start, path[:, :, :-1]], axis=2)
    return jaxpets.Transition(obs, action, path)


def walk(params, key, obs, action):
    """A model that is right but for a bias, with some noise; both `[E]`."""
    bias, noise = (x[:, None, None] for x in params)
    return obs + action + bias + noise * jax.random.normal(key, obs.shape)


def models(bias, noise):
    """Parameters of M models of E = 2 members each, from M numbers or `[M, 2]`."""
    bias, noise = (
        jnp.broadcast_to(jnp.asarray(x, jnp.float32).reshape(len(bias), -1), shape)
        for x, shape in ((bias, (len(bias), 2)), (noise, (len(bias), 2)))
    )
    return bias, noise


def test_a_model_that_is_right_has_no_error_and_a_bias_adds_up():
    data = world(2, 30, 0.0)
    params = models([0.0, 0.1, 0.2], np.full(3, 1e-6))
    scale = jnp.array([1.0, 2.0])
    found = open_loop.score(walk, 2, STEPS, params, data, scale)
    assert found.error.shape == found.spread.shape == (3, 2, 3)
    # Per dimension bias / scale; float32 paths of order 10.
    rms = np.sqrt((1 + 1 / 4) / 2)
    want = np.outer([0.0, 0.1, 0.2], STEPS) * rms
    want = np.broadcast_to(want[:, None], (3, 2, 3))
    np.testing.assert_allclose(found.error, want, atol=1e-4)
    assert (found.spread < 1e-4).all()
    assert (found.coverage[1:] == 0).all()


def test_members_that_err_to_both_sides_cancel_and_spread():
    """Particles keep their member: the two halves go apart, and the truth is between.

    A particle that changed its member would be off by the root of the steps instead.
    """
    data = world(1, 10, 0.0)
    params = models([[-1.0, 1.0]], np.full(1, 1e-6))
    found = open_loop.score(walk, 2, STEPS, params, data, jnp.ones(2))
    np.testing.assert_allclose(found.error[0, 0], 0.0, atol=1e-4)
    # Of 20 particles at both ends, with one degree of freedom less.
    np.testing.assert_allclose(
        found.spread[0, 0], np.sqrt(20 / 19) * np.array(STEPS), rtol=1e-3
    )
    assert (found.coverage == 1).all()


def test_a_model_that_knows_the_noise_covers_nine_of_ten():
    """And one that is surer, or less sure, covers fewer and more."""
    data = world(4, 400, NOISE)
    params = models(np.zeros(3), [NOISE, NOISE / 3, NOISE * 3])
    found = open_loop.score(walk, 2, STEPS, params, data, jnp.ones(2))
    # 3200 draws of a share of 0.9: a std of 0.005. The particles' noise is that of 400
    # windows only, once for all data sets, which doubles it at most: 0.03 is three of
    # these. Interpolation of quantiles, instead of order statistics, is 0.002.
    covered = np.mean(found.coverage, axis=1)
    np.testing.assert_allclose(covered[0], 0.9, atol=0.03)
    assert (covered[1] < 0.6).all() and (covered[2] > 0.99).all()
    # The error has the noise of the particles' mean, too: a 20th of the variance. The
    # median of the size of two normal numbers is sqrt(ln 2) of its root mean square.
    # A median of 400 windows has a std of about 3 %, and four of them share particles.
    ratio = np.mean(found.spread[0] / found.error[0], axis=0)
    np.testing.assert_allclose(ratio, 1 / np.sqrt(np.log(2) * 1.05), rtol=0.1)


def test_what_explodes_is_infinite_if_it_is_most_and_covers_nothing():
    data = world(1, 11, 0.0)

    def explode(params, key, obs, action):
        return jnp.where(obs + action > params, jnp.nan, obs + action)

    always, never = -jnp.inf, jnp.inf
    # Between the two: windows whose greatest observation is of the lesser half.
    peaks = jnp.sort(jnp.max(data.next_obs[0], axis=(1, 2)))
    params = jnp.array([always, never, peaks[6] + 1e-2])
    found = open_loop.score(explode, 1, STEPS, params, data, jnp.ones(2))
    assert np.isinf(found.error[0]).all() and (found.coverage[0] == 0).all()
    np.testing.assert_allclose(found.error[1:, 0, -1], 0.0, atol=1e-4)
    assert found.coverage[2, 0, -1] <= 7 / 11 + 1e-6


def test_a_median_that_is_infinite_or_has_infinite_neighbours():
    inf = jnp.inf
    for values, want in (
        ([1.0, inf, 2.0], 2.0),
        ([inf, 3.0, inf], inf),
        ([inf, 1.0], inf),
        ([4.0, 1.0, 2.0, inf], 3.0),
    ):
        assert open_loop._median(jnp.array(values)) == want


def test_score_is_the_same_for_all_sizes_of_chunks_and_jitted(monkeypatch):
    data = world(5, 10, NOISE)
    params = models([0.0, 0.1], [NOISE, NOISE])
    scale = compared.scale_of(data.obs)
    plain = open_loop.score(walk, 2, STEPS, params, data, scale)

    def score(*inputs):
        return open_loop.score(walk, 2, STEPS, *inputs)

    one = 10 * (K + 1) * 20 * 2  # of a data set
    for size in (1, 2 * one, 3 * one):
        monkeypatch.setattr(open_loop, "_CHUNK_SIZE", size)
        found = jax.jit(score)(params, data, scale)
        for a, b in zip(plain, found, strict=True):
            # XLA sums in another order.
            np.testing.assert_allclose(a, b, rtol=1e-4)


def test_a_dimension_that_stays_as_it_is_has_scale_one():
    obs = jnp.stack([jnp.arange(6.0), jnp.full(6, 3.0)], axis=-1).reshape(2, 3, 2)
    # A sum of six numbers in float32.
    np.testing.assert_allclose(compared.scale_of(obs), [np.std(np.arange(6)), 1], 1e-6)


# The pairs.


def test_no_model_meets_its_own_data_and_arms_of_data_weigh_equally():
    arms = ["random", "epistemic", "epistemic", "random", "epistemic"]
    of_data = np.array([10.0, 1.0, 1.0, 10.0, 1.0])
    values = np.tile(of_data, (5, 1))
    np.fill_diagonal(values, np.nan)  # would spoil what it is part of
    every, own = open_loop.pooled(values, arms)
    assert list(every) == list(own) == ["epistemic", "random"]
    # Of random, 2 x 1 pairs of its own and 2 x 3 of the other's data.
    assert every["random"] == {"mean": 5.5, "std": 0.0, "pairs": 8}
    assert every["epistemic"]["mean"] == 5.5 and every["epistemic"]["pairs"] == 12
    assert own["random"] == {"mean": 10.0, "std": 0.0, "pairs": 2}
    assert own["epistemic"]["pairs"] == 6


def test_spread_of_pairs_is_within_an_arm_of_data():
    values = np.array([[0.0, 1.0, 5.0], [3.0, 0.0, 7.0], [9.0, 9.0, 0.0]])
    every, own = open_loop.pooled(values, ["random", "random", "count-32"])
    assert own["random"] == {"mean": 2.0, "std": np.sqrt(2.0), "pairs": 2}
    assert own["count-32"] is None
    assert every["random"] == {
        "mean": 4.0, "std": pytest.approx(np.sqrt(2.0)), "pairs": 4
    }  # fmt: skip
    alone, _ = open_loop.pooled(np.zeros((1, 1)), ["random"])
    assert alone == {"random": None}


def test_the_table_shows_what_is_there_and_what_is_not():
    def entry(mean):
        return {"mean": mean, "std": None, "pairs": 1}

    row = {1: {"error": entry(0.12345), "spread": None, "coverage": entry(np.inf)}}
    missing = {1: {"error": None, "spread": None, "coverage": None}}
    lines = open_loop.table({"epistemic": row, "best": missing})
    assert lines[0] == "| model of | error at 1 | coverage at 1 |"
    assert lines[2] == "| epistemic | 0.123 | not finite |"
    assert lines[3] == "| best | no pair | no pair |"


# The program, on real runs: seeds 0 and 7 of epistemic, seed 0 of random.


@pytest.fixture(scope="module")
def explored(explored_once, tmp_path_factory):
    out = tmp_path_factory.mktemp("explored")
    random = ("--arm", "random", "--out", str(out))
    assert main([*runs.EXPLORED, *random]) == 0
    return explored_once(0, 7).folder, out / "smoke-random"


@pytest.mark.slow
def test_the_file_says_what_was_measured(explored, tmp_path, capsys):
    path = tmp_path / "open_loop.json"
    flags = ("--out", str(path), "--rows", "12", "--steps", str(K))
    assert open_loop.main([*map(str, explored), *flags]) == 0
    found = json.loads(path.read_text())
    assert set(found) == {"preset", "rows", "steps", "trials", "arms", "own"}
    assert (found["preset"], found["rows"], found["steps"]) == ("smoke", 12, K)
    assert found["trials"] == {"epistemic": {"0": 3, "7": 3}, "random": {"0": 3}}
    assert list(found["arms"]) == list(found["own"]) == ["epistemic", "random"]
    for arm, pairs in (("epistemic", 4), ("random", 2)):
        assert list(found["arms"][arm]) == ["1", "3", "10"]
        for entry in found["arms"][arm].values():
            assert set(entry) == {"error", "spread", "coverage"}
            assert all(x["pairs"] == pairs for x in entry.values())
            assert 0 <= entry["coverage"]["mean"] <= 1
            assert entry["error"]["mean"] > 0
    assert found["own"]["random"]["1"]["error"] is None
    assert found["own"]["epistemic"]["1"]["error"]["pairs"] == 2
    output = capsys.readouterr().out
    assert "| model of | error at 1 | error at 3 | error at 10 | coverage" in output


@pytest.mark.slow
def test_all_transitions_of_real_trials_follow_one_another(explored):
    """Two planned trials of 20 have 2 x 11 windows of 10; and 2 of a whole trial."""
    with pytest.raises(UsageError, match="has 22 windows of 10 transitions a seed"):
        open_loop.measure(explored, 23, K, None)
    with pytest.raises(UsageError, match="has 2 windows of 20 transitions a seed"):
        open_loop.measure(explored, 3, runs.STEPS, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        (("--rows", "200"), 2, "error: --rows 200 is not valid; "),
        (("--rows", "0"), 2, "error: --rows 0 is not valid; it must be 1 or more."),
        (("--steps", "0"), 2, "error: --steps 0 is not valid; it must be 1 or more."),
        (("--steps", "21"), 2, "error: --steps 21 is not valid; a trial of "),
        (("--at-trial", "1"), 3, "error: no checkpoint 1 in "),
        (("--out", "none/a.json"), 2, "error: --out none/a.json is not valid; "),
    ],
)
def test_flags_that_cannot_work(explored, tmp_path, capsys, flags, code, words):
    path = tmp_path / "open_loop.json"
    command = [*map(str, explored), "--out", str(path), "--steps", "5", *flags]
    assert open_loop.main(command) == code
    errors = capsys.readouterr().err
    assert errors.startswith(words) and errors.count("\n") == 1
    assert not path.exists()
