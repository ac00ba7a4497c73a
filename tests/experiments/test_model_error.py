"""Models on the data of others: the numbers, the pairs and the program."""

import json
import operator
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import runs

import jaxpets
from benchmarks import model_quality
from experiments import cli
from experiments.build import build
from experiments.config import Config
from experiments.errors import UsageError
from experiments.run import main
from experiments.tools import compared, model_error
from jaxpets.envs import half_cheetah

D, A = half_cheetah.OBS_SIZE, half_cheetah.ACTION_SIZE
AFTER = (runs.LAST - 1) * runs.STEPS  # transitions that are planned

# The numbers.


def normal(*shape, seed=0):
    generator = np.random.default_rng(seed)
    return jnp.asarray(generator.normal(size=shape), jnp.float32)


def transitions(num_sets, num_rows):
    return jaxpets.Transition(
        normal(num_sets, num_rows, D, seed=1),
        normal(num_sets, num_rows, A, seed=2),
        normal(num_sets, num_rows, D, seed=3),
    )


def world(obs, action):
    return obs + jnp.sum(action, axis=-1)[:, None]


def test_a_perfect_model_has_no_error():
    """And the likelihood of Gaussians at their mean."""
    data = transitions(2, 50)
    data = data._replace(next_obs=jax.vmap(world)(data.obs, data.action))
    variance = jnp.full((1, 3, D), 0.25, jnp.float32)

    def predict(params, obs, action):
        return world(obs, action), jnp.broadcast_to(params[:, None], obs.shape)

    error, nll = model_error.score(predict, 3, variance, data, jnp.ones(D))
    np.testing.assert_array_equal(error, np.zeros((1, 2)))
    # 0.5 ln(2 pi 0.25); sums of 18 terms in float32.
    np.testing.assert_allclose(nll, 0.5 * np.log(np.pi / 2), rtol=1e-5)


def test_members_that_err_to_both_sides_cancel():
    data = transitions(1, 20)
    data = data._replace(next_obs=jax.vmap(world)(data.obs, data.action))
    scale = jnp.arange(1.0, D + 1)

    def predict(params, obs, action):
        return world(obs, action) + params[:, None, None] * scale, jnp.ones_like(obs)

    shifts = jnp.array([[-2.0, 2.0], [1.0, 3.0], [0.0, -6.0]])
    error, _ = model_error.score(predict, 2, shifts, data, scale)
    # The mean of the shifts, in units of the scale; sums of floats of order 20.
    np.testing.assert_allclose(error[:, 0], [0.0, 2.0, 3.0], atol=1e-5)


def test_score_is_that_of_model_quality():
    """The same two definitions, there in NumPy for one model and data set."""
    data = transitions(4, 30)
    params = normal(3, 2, 5, D, seed=4)

    def predict(params, obs, action):
        shift, spread = params
        mean = obs + shift[:, None] * jnp.sum(action, axis=-1)[:, None]
        return mean, jnp.exp(spread)[:, None] + 0 * obs

    scale = jnp.std(data.next_obs[0], axis=0)
    error, nll = model_error.score(predict, 5, params, data, scale)
    assert error.shape == nll.shape == (3, 4)
    for m in range(3):
        for n in range(4):
            obs = jnp.broadcast_to(data.obs[n], (5, 30, D))
            mean, variance = predict(params[m], obs, data.action[n])
            want = model_quality.scores(mean, variance, data.next_obs[n])
            # float32 against float64.
            np.testing.assert_allclose(nll[m, n], want["nll_mixture"], rtol=1e-4)
            if n == 0:  # whose std the scale is
                np.testing.assert_allclose(error[m, n], want["nrmse"], rtol=1e-4)


def test_score_is_the_same_jitted():
    data, params = transitions(2, 10), normal(2, 3, D)

    def predict(params, obs, action):
        return obs + params[:, None], jnp.ones_like(obs)

    scale = jnp.ones(D)
    plain = model_error.score(predict, 3, params, data, scale)
    jitted = jax.jit(lambda *x: model_error.score(predict, 3, *x))
    # XLA sums in another order.
    for one, other in zip(plain, jitted(params, data, scale), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)


def test_what_never_changes_divides_nothing(monkeypatch):
    """As a goal that is seen and the same in all trials."""
    data = transitions(2, 20)
    still = [x.at[..., 0].set(3.0) for x in (data.obs, data.next_obs)]
    data = data._replace(obs=still[0], next_obs=still[1])

    def predict(params, obs, action):
        return obs + params[:, None], jnp.ones_like(obs)

    model = SimpleNamespace(predict=predict, num_members=3)
    config = Config(seeds=(0, 1))
    run = compared.Explored(config, "best", model, normal(2, 3, D), data, 4)
    monkeypatch.setattr(compared, "read", lambda *_: [run])
    found = model_error.measure([], 20, None)
    assert np.isfinite(found["error"]["best"]["best"]["mean"])


# The pairs.


def test_no_model_meets_its_own_data():
    arms = ["random", "epistemic", "epistemic", "random", "count-32"]
    values = np.arange(25.0).reshape(5, 5)
    np.fill_diagonal(values, np.nan)  # would spoil what it is part of
    found = model_error.by_arm(values, arms)
    assert list(found) == ["epistemic", "count-32", "random"]
    assert all(list(row) == list(found) for row in found.values())
    own = found["epistemic"]["epistemic"]
    assert own == {"mean": 9.0, "std": pytest.approx(np.sqrt(8.0)), "pairs": 2}
    assert found["count-32"]["count-32"] is None
    # Models 0 and 3 on data 1 and 2: 1, 2, 16, 17.
    other = found["random"]["epistemic"]
    assert other["mean"] == 9.0 and other["pairs"] == 4
    assert other["std"] == pytest.approx(np.std([1, 2, 16, 17], ddof=1))
    assert found["count-32"]["random"]["pairs"] == 2


def test_one_pair_has_no_spread():
    found = model_error.by_arm(np.array([[0.0, 1.0], [2.0, 0.0]]), ["a", "b"])
    assert found["a"]["b"] == {"mean": 1.0, "std": None, "pairs": 1}
    assert found["b"]["b"] is None


def test_a_draw_is_of_filled_rows_and_always_the_same():
    rows = jnp.broadcast_to(jnp.arange(100.0)[:, None], (3, 100, 1))
    data = jaxpets.Transition(rows, rows + 0.5, rows + 1)
    drawn = model_error.draw(data, (0, 5, 2**32 - 1), 20, 80, 40)
    again = model_error.draw(data, (0, 5, 2**32 - 1), 20, 80, 40)
    jax.tree.map(np.testing.assert_array_equal, drawn, again)
    assert drawn.obs.shape == (3, 40, 1)
    assert drawn.obs.min() >= 20 and drawn.obs.max() < 80
    for own in drawn.obs:
        assert len(np.unique(own)) == 40
    np.testing.assert_array_equal(drawn.next_obs, drawn.obs + 1)
    assert (drawn.obs[0] != drawn.obs[1]).any()
    # A seed's draw does not depend on the seeds beside it.
    one = jax.tree.map(lambda x: x[1:2], data)
    alone = model_error.draw(one, (5,), 20, 80, 40)
    np.testing.assert_array_equal(alone.obs[0], drawn.obs[1])


# The program, on real runs: seeds 0 and 7 of epistemic, seed 0 of random.


@pytest.fixture(scope="module")
def explored(explored_once, tmp_path_factory):
    out = tmp_path_factory.mktemp("explored")
    random = ("--arm", "random", "--out", str(out))
    assert main([*runs.EXPLORED, *random]) == 0
    return explored_once(0, 7).folder, out / "smoke-random"


@pytest.fixture(scope="module")
def found(explored, tmp_path_factory):
    """All that is planned, so that a mean does not depend on the draw."""
    path = tmp_path_factory.mktemp("found") / "model_error.json"
    flags = ("--out", str(path), "--rows", str(AFTER))
    assert model_error.main([*map(str, explored), *flags]) == 0
    return json.loads(path.read_text())


def pooled(explored):
    """Model functions, parameters and data after the random trial, by arm and seed."""
    every = {}
    for folder, arm in zip(explored, ("epistemic", "random"), strict=True):
        state = jax.tree.map(np.asarray, runs.learner(folder))
        config = cli.parse(["--phase", "zero-shot", "--from", str(folder)])
        predict = build(config).model.predict
        for i, seed in enumerate(config.seeds):
            rows = (i, slice(runs.STEPS, None))
            every[arm, seed] = SimpleNamespace(
                predict=predict,
                params=jax.tree.map(operator.itemgetter(i), state.params),
                data=jax.tree.map(operator.itemgetter(rows), state.dataset.data),
            )
    return every


@pytest.mark.slow
def test_error_is_that_of_a_loop(explored, found):
    every = pooled(explored)
    space = half_cheetah.model_space()
    target = {k: space.target(x.data.obs, x.data.next_obs) for k, x in every.items()}
    scale = np.concatenate([*target.values()]).std(axis=0)
    errors, nlls = {}, {}
    for own, model in every.items():
        for other in (other for other in every if other != own):
            data = every[other].data
            obs = jnp.broadcast_to(data.obs, (3, *data.obs.shape))
            mean, variance = model.predict(model.params, obs, data.action)
            miss = (np.asarray(space.target(obs, mean)).mean(0) - target[other]) / scale
            pair = own[0], other[0]
            errors.setdefault(pair, []).append(np.sqrt(np.mean(miss**2)))
            nll = model_quality.scores(mean, variance, data.next_obs)["nll_mixture"]
            nlls.setdefault(pair, []).append(nll)
    assert {k: len(x) for k, x in errors.items()} == {
        ("epistemic", "epistemic"): 2,
        ("epistemic", "random"): 2,
        ("random", "epistemic"): 2,
    }
    for name, want in (("error", errors), ("nll", nlls)):
        assert found[name]["random"]["random"] is None
        for (model, data), values in want.items():
            entry = found[name][model][data]
            assert entry["pairs"] == len(values)
            # float32 against float64, and matrix products in another order.
            assert entry["mean"] == pytest.approx(np.mean(values), rel=1e-3)
            spread = pytest.approx(np.std(values, ddof=1), rel=1e-2, abs=1e-3)
            assert entry["std"] == spread


@pytest.mark.slow
def test_the_file_says_what_was_measured(found):
    assert set(found) == {"preset", "rows", "trials", "error", "nll"}
    assert (found["preset"], found["rows"]) == ("smoke", AFTER)
    assert found["trials"] == {"epistemic": {"0": 3, "7": 3}, "random": {"0": 3}}


@pytest.mark.slow
def test_what_all_arms_share_is_not_drawn(explored):
    """A seed acts alike in its random trials: each model would know another's data."""
    first, second = (runs.learner(x).dataset.data.action[0] for x in explored)
    np.testing.assert_array_equal(first[: runs.STEPS], second[: runs.STEPS])
    assert (first[runs.STEPS :] != second[runs.STEPS :]).any(axis=-1).all()
    with pytest.raises(UsageError, match=r"has 40 transitions a seed after the random"):
        model_error.measure(explored, AFTER + 1, None)


@pytest.mark.slow
def test_an_earlier_trial(explored):
    found = model_error.measure(explored, runs.STEPS, runs.LAST - 1)
    assert found["trials"]["random"] == {0: runs.LAST - 1}
    with pytest.raises(UsageError, match="has 20 transitions"):
        model_error.measure(explored, runs.STEPS + 1, runs.LAST - 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        (("--rows", "2000"), 2, "error: --rows 2000 is not valid; "),
        (("--rows", "0"), 2, "error: --rows 0 is not valid; it must be 1 or more."),
        (("--at-trial", "1"), 3, "error: no checkpoint 1 in "),
        (("--out", "none/a.json"), 2, "error: --out none/a.json is not valid; "),
        (("--out", "."), 2, "error: --out . is not valid; it is a folder."),
    ],
)
def test_flags_that_cannot_work(explored, tmp_path, capsys, flags, code, words):
    path = tmp_path / "model_error.json"
    command = [*map(str, explored), "--out", str(path), *flags]
    assert model_error.main(command) == code
    errors = capsys.readouterr().err
    assert errors.startswith(words) and errors.count("\n") == 1
    assert not path.exists()


@pytest.mark.slow
def test_runs_that_cannot_be_compared(explored, tmp_path):
    epistemic, random = explored
    with pytest.raises(UsageError, match="both hold seed 0 of arm epistemic"):
        model_error.measure([epistemic, random, epistemic], AFTER, None)
    other = tmp_path / "other"
    other.mkdir()
    config = json.loads((random / "config.json").read_text())
    (other / "config.json").write_text(json.dumps({**config, "preset": "paper"}))
    with pytest.raises(UsageError, match="of presets paper, smoke; give one"):
        model_error.measure([epistemic, other], AFTER, None)
    shutil.copy(random / "config.json", other / "config.json")
    with pytest.raises(UsageError, match="there is no checkpoint in"):
        model_error.measure([epistemic, other], AFTER, None)
