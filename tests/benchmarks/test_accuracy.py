"""The accuracy of a rollout: what is compared, and the program on a performed run."""

import argparse
import dataclasses
import functools
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from benchmarks import accuracy, workloads
from experiments import exploration
from experiments.build import build
from experiments.entries import to_json
from experiments.presets import PRESETS
from experiments.storage import checkpoint, rundir
from jaxpets.envs import half_cheetah

SIZE = dataclasses.replace(workloads.named_size("tiny"), num_samples=10, num_elites=4)
REWARDS = {"epistemic", *half_cheetah.TASK_NAMES}


def imagines(scale, values):
    """An Imagine whose path is the start times scale."""

    def imagine(key, obs, actions):
        del key
        assert actions.shape == (10, 3, half_cheetah.ACTION_SIZE)
        assert jnp.max(jnp.abs(actions)) <= 1.0
        return scale * obs, {"reward": jnp.asarray(values, jnp.float32)}

    return imagine


def test_error_and_overlap_are_those_of_the_paths_and_of_the_best():
    exact = imagines(1.0, np.arange(10))  # the best are 6, 7, 8, 9
    other = imagines(1.5, [0, 0, 0, 0, 9, 9, 9, 9, 0, 0])  # 4, 5, 6, 7
    starts = jnp.ones((2, half_cheetah.OBS_SIZE))
    error, overlap = accuracy.compare(exact, other, starts, jnp.zeros(18), SIZE)
    np.testing.assert_allclose(error, [0.5, 0.5], rtol=1e-6)
    assert overlap == {"reward": [0.5, 0.5]}


def test_a_moved_start_moves_by_its_distance():
    exact = imagines(1.0, np.arange(10))
    starts = jnp.ones((30, half_cheetah.OBS_SIZE))
    error, overlap = accuracy.compare(exact, exact, starts, jnp.full(18, 1e-2), SIZE)
    assert overlap == {"reward": [1.0] * 30}
    # The root mean square of 540 normal draws, 4 sigma.
    assert abs(np.sqrt(np.mean(np.square(error))) - 1e-2) < 2e-3


@pytest.fixture(scope="module")
def performed(tmp_path_factory):
    """What a zero-shot leaves behind: config, model and trajectories."""
    folder = tmp_path_factory.mktemp("zero-shot-060")
    smoke = PRESETS["smoke"]
    search = dataclasses.replace(smoke.planner, num_particles=5)
    config = dataclasses.replace(
        smoke,
        phase="zero-shot",
        seeds=(0, 1),
        model=dataclasses.replace(smoke.model, num_members=5),
        planner=search,
        task_planner=search,
    )
    rundir.write_json(folder / "config.json", to_json(config))
    keys = jax.random.split(jax.random.key(0), 2)
    size = dataclasses.replace(SIZE, hidden_sizes=(16, 16))
    params = jax.jit(jax.vmap(functools.partial(workloads.params, size)))(keys)
    model = exploration.model_of(exploration.template(config, build(config)))
    model = model._replace(params=params)
    checkpoint.save(folder / "checkpoints", 60, model, {}, finite=model)
    obs = np.random.default_rng(0).normal(size=(2, 4, 2, 50, half_cheetah.OBS_SIZE))
    obs[:, :, 1] *= 5  # other trials spread wider
    np.savez(folder / "trajectories.npz", obs=obs.astype(np.float32))
    return folder


def test_states_are_of_the_first_seed_and_all_tasks(performed):
    starts, scale = accuracy.states(performed / "trajectories.npz", 4)
    with np.load(performed / "trajectories.npz") as file:
        obs = file["obs"]
    assert starts.shape == (4, half_cheetah.OBS_SIZE)
    for task, start in enumerate(starts):
        assert any(np.array_equal(start, state) for state in obs[0, task, 0])
    np.testing.assert_allclose(scale, obs[0].std((0, 1, 2)), rtol=1e-5)
    with pytest.raises(SystemExit, match="--states 50: the trials have 50 steps"):
        accuracy.states(performed / "trajectories.npz", 50)
    with pytest.raises(SystemExit, match="there is no"):
        accuracy.states(performed / "nothing.npz", 4)


def test_values_are_those_that_a_planner_sees(performed):
    """Of the first seed's model: the same candidates, noise and rewards."""
    params, size = accuracy.explored(performed, SIZE)
    keys = jax.random.split(jax.random.key(0), 2)
    of_seed = jax.jit(functools.partial(workloads.params, size))(keys[0])
    # Mapped over seeds the fixture rounds otherwise; another seed is off by 0.1.
    close = functools.partial(np.testing.assert_allclose, atol=1e-5)
    jax.tree.map(close, params, of_seed)
    obs = jnp.full(half_cheetah.OBS_SIZE, 0.1)
    actions = jax.random.uniform(keys[1], (10, 3, half_cheetah.ACTION_SIZE))
    path, values = accuracy.imagine(params, size, "f32")(keys[1], obs, actions)
    assert path.shape == (10, 4, 5, 1, half_cheetah.OBS_SIZE)
    seen = {
        "epistemic": (jaxpets.rewards.epistemic, jaxpets.rewards.max_variance(params)),
        "forward": (half_cheetah.task_reward, half_cheetah.task("forward")),
        "back-flip": (half_cheetah.task_reward, half_cheetah.task("back-flip")),
    }
    for reward, (reward_fn, weights) in seen.items():
        rollout = workloads.rollout_fn(size, "f32")
        planner = jaxpets.plan(rollout, reward_fn, toys.probe(actions))
        dynamics = jaxpets.PlanParams(params, weights)
        _, wanted = jax.jit(planner.step)(dynamics, keys[1], planner.init(), obs)
        np.testing.assert_allclose(values[reward], wanted, rtol=1e-5, atol=1e-5)
        assert np.ptp(wanted) > 1e-3


def test_what_is_not_finite_is_worst_and_no_number():
    nan = imagines(jnp.nan, np.arange(10))
    starts = jnp.ones((3, half_cheetah.OBS_SIZE))
    error, _ = accuracy.compare(
        imagines(1.0, np.arange(10)), nan, starts, jnp.zeros(18), SIZE
    )
    assert accuracy._number(np.max([0.0, *error, 0.0])) is None


def test_program_compares_an_explored_model(performed, tmp_path):
    """On a CPU tf32 is float32; bfloat16 is further off than a moved start."""
    path = tmp_path / "rows.jsonl"
    rollouts = ["moved", "tf32", "bf16"]
    rollouts += ["kernel"] if jax.default_backend() == "cpu" else []
    flags = ["--tiny", "--states", "2", "--rollout", *rollouts]
    found = accuracy.main([str(performed), *flags, "--json", str(path)])
    written = [json.loads(line) for line in path.read_text().splitlines()]
    assert json.loads(json.dumps(found)) == written
    assert {row["reward"] for row in found} == REWARDS
    error = {row["rollout"]: row["error"] for row in found}
    assert error["tf32"] == 0 < error["moved"] < error["bf16"] < 0.1
    # A CPU's is in float32: it is one rounding of many off, and bfloat16's are 2^16.
    assert error.get("kernel", 0) < error["bf16"] / 1000
    for row in found:
        assert row["states"] == 2 and row["error"] <= row["most_error"]
        assert 0 <= row["least_overlap"] <= row["overlap"] <= 1
        assert row["rollout"] != "tf32" or row["least_overlap"] == 1


def test_a_folder_without_a_model_is_refused(performed, tmp_path):
    (tmp_path / "config.json").write_text((performed / "config.json").read_text())
    with pytest.raises(SystemExit, match="there is no checkpoint in"):
        accuracy.explored(tmp_path, SIZE)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"state_margin": None}, "has its own --model"),
        ({"num_members": 1}, "has 1 members; they must be 2 or more"),
        ({"num_members": 4}, "divide the 5 particles"),
    ],
)
def test_models_that_cannot_be_compared_are_refused(performed, tmp_path, changes, text):
    config = json.loads((performed / "config.json").read_text())
    config["model"] |= changes
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(SystemExit, match=text):
        accuracy.explored(tmp_path, SIZE)


@pytest.mark.parametrize("env", ["pets/pusher", "own.py:robot"])
def test_another_robot_is_refused_first(performed, tmp_path, env):
    config = json.loads((performed / "config.json").read_text()) | {"env": env}
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(SystemExit) as caught:
        accuracy.main([str(tmp_path), "--tiny"])
    assert str(caught.value) == (
        f"cannot read {tmp_path}: its robot is {env}, and only pets/half_cheetah is "
        "compared"
    )


def test_files_of_tasks_and_objectives_are_not_needed(performed, tmp_path):
    config = json.loads((performed / "config.json").read_text())
    config |= {"tasks": "mine.py", "arm": "mine.py:seek"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "checkpoints").symlink_to(performed / "checkpoints")
    params, size = accuracy.explored(tmp_path, SIZE)
    assert size == accuracy.explored(performed, SIZE)[1] and params is not None


def test_more_elites_than_candidates_are_refused(performed, capsys):
    with pytest.raises(SystemExit, match="2"):
        accuracy.main([str(performed), "--tiny", "--num-elites", "17"])
    assert "num_samples must be at least num_elites" in capsys.readouterr().err


def test_no_folder_is_refused(tmp_path):
    with pytest.raises(SystemExit, match="cannot read"):
        accuracy.explored(tmp_path / "nothing", SIZE)


def test_no_kernel_is_compared_where_none_runs(monkeypatch, performed):
    restored = accuracy.explored(performed, SIZE)
    monkeypatch.setattr(accuracy, "explored", lambda *_: restored)
    device = SimpleNamespace(platform="tpu")
    monkeypatch.setattr(jax, "devices", lambda: [device])
    args = argparse.Namespace(
        run=performed, states=1, rollout=["kernel"], tiny=True, size="paper"
    )
    with pytest.raises(SystemExit, match="no kernel to time"):
        next(accuracy.run(args))
