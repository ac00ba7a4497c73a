"""The agent of a world that is not JAX: what it remembers, learns and refuses."""

import functools
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import jaxpets
from jaxpets._src import agent_call
from jaxpets._src.agent_steps import strongly_typed

ONE = np.ones(1)
RANDOM = jaxpets.random_planner(-ONE, ONE)
TRACES = []


def pull(params, key, state, obs):
    """A planner of one line: acts towards its goal; its state counts the steps."""
    TRACES.append(obs.shape)
    action = jnp.clip(
        params.reward - obs[:1] + 0 * params.dynamics.scaler.low[:1], -1, 1
    )
    action = action + 1e-3 * state + 0 * jax.random.normal(key, (1,), jnp.float32)
    output = jaxpets.typing.PlanOutput(action, action[None], jnp.zeros((), jnp.float32))
    return output, state + 1


def zero():
    return jnp.zeros((), jnp.float32)


PULL = jaxpets.Planner(zero, pull)
GOAL = jaxpets.RewardData(
    init=lambda key: zero(),
    refresh=lambda data, params, dataset: dataset.size.astype(jnp.float32),
)


@pytest.fixture(scope="module")
def parts():
    model = toys.small_ensemble(hidden_sizes=(4,), weight_decays=0.0)
    config = jaxpets.FitConfig(num_epochs=1, batch_size=8)
    return model, jaxpets.fitter(model, optax.adam(1e-3), config)


@pytest.fixture(scope="module")
def trained(parts):
    """What a model that has learned knows: an agent with it plans at once."""
    params = jax.jit(parts[0].init)(jax.random.key(5))
    bounds = jnp.zeros(2), jnp.ones(2)
    return params._replace(scaler=params.scaler._replace(low=bounds[0], high=bounds[1]))


@pytest.fixture(scope="module")
def make(parts):
    """Builds agents, which share the compiled steps of those that are equal."""
    return functools.partial(
        jaxpets.agent,
        PULL,
        *parts,
        random_planner=RANDOM,
        capacity=40,
        reward_data=GOAL,
    )


def rows(agent):
    """The transitions that an agent remembers, oldest first, as x of obs and next."""
    agent._remember()
    dataset = agent._state.dataset
    data = jax.tree.map(lambda x: np.asarray(x)[: int(dataset.size)], dataset.data)
    return list(zip(data.obs[:, 0].tolist(), data.next_obs[:, 0].tolist(), strict=True))


def at(x):
    return np.array([x, 0.0])


def test_it_explores_at_random_learns_plans_and_goes_on_where_it_was_saved(
    make, tmp_path
):
    TRACES.clear()
    agent, path = make(seed=3), tmp_path / "agent.safetensors"
    with pytest.raises(RuntimeError, match="learn needs what was observed"):
        agent.learn()
    with pytest.raises(RuntimeError, match="observe must follow act"):
        agent.observe(at(0))
    drawn = []
    for step in range(12):
        drawn.append(agent.act(at(step)))
        assert drawn[-1].shape == (1,) and drawn[-1].dtype == np.float32
        # Any float will do, and what is given is not kept.
        end = at(step + 1).astype(np.float32 if step % 2 else np.float64)
        agent.observe(end, step == 11)
        end[:] = 99
    assert not TRACES and len({float(a[0]) for a in drawn}) == 12
    assert agent.num_steps == 12
    metrics = agent.learn()
    assert metrics.num_updates > 0 and np.isfinite(metrics.nll)
    assert rows(agent) == [(float(t), t + 1.0) for t in range(12)]
    agent.save(path)
    # The goal is the size of the dataset: it was refreshed, and now it plans.
    assert agent.act(at(11.5)) == pytest.approx(0.5)
    assert agent.act(at(11.5)) == pytest.approx(0.501)
    agent.reset()
    assert agent.act(at(11.5)) == pytest.approx(0.5)
    # Tasks are data: neither learning nor another goal compiles again.
    agent.perform(2.25)
    assert agent.act(at(2.0)) == pytest.approx(0.251)
    agent.perform(np.float32(1.5))
    agent.observe(at(2.0))
    agent.learn()
    assert agent.act(at(2.0)) == pytest.approx(-0.498)
    agent.explore()
    assert agent.act(at(12.5)) == pytest.approx(0.503)
    assert len(TRACES) == 1

    again = make(seed=3)
    again.load(path)
    assert again.num_steps == 12
    assert rows(again) == [(float(t), t + 1.0) for t in range(12)]
    assert again.act(at(11.5)) == pytest.approx(0.5)
    again.observe(at(2.0))
    agent.load(path)
    agent.act(at(11.5))
    agent.observe(at(2.0))
    toys.assert_trees_close(again.learn(), agent.learn(), rtol=0)
    toys.assert_trees_close(again.params, agent.params, rtol=0)
    with pytest.raises(
        ValueError, match=r"agent: dataset.data.action must be \(\(3, 1"
    ):
        make(capacity=3).load(path)


def test_what_waits_to_be_learned_is_no_more_than_the_capacity(make, trained):
    """A robot that performs for days learns nothing, and needs no more room for it."""
    agent = make(params=trained, capacity=3)
    for step in range(10):
        agent.act(at(step))
        agent.observe(at(step + 1))
    assert len(agent._seen) == 3 and agent.num_steps == 10
    assert rows(agent) == [(7, 8), (8, 9), (9, 10)]
    two = make(params=trained, capacity=3, num_envs=2)
    for step in range(10):  # one of them diverges, and both do in between
        two.act([at(step), at(step)])
        two.observe([at(np.nan), at(step + 1 if step % 3 else np.nan)])
    assert sorted(rows(two)) == [(5, 6), (7, 8), (8, 9)] and two.num_steps == 6


@pytest.mark.parametrize("num_envs", [None, 2])
def test_what_is_beyond_mujocos_largest_number_is_left_out(
    make, trained, num_envs, tmp_path
):
    """Or its square, and what is divided by it, would be no number any more."""
    agent = make(params=trained, num_envs=num_envs)
    for step in range(6):
        far = 1e12 if step == 2 else step + 1
        one, other = (at(step), at(far)), (at(step), at(step + 1))
        obs, reached = one if num_envs is None else zip(one, other, strict=True)
        agent.act(obs)
        agent.observe(reached)
    assert agent.num_steps == (5 if num_envs is None else 11)
    assert np.abs([list(x) for x in rows(agent)]).max() < 10
    assert agent.learn().num_skipped == 0
    agent.save(tmp_path / "a")
    make(params=trained, num_envs=num_envs).load(tmp_path / "a")


def test_a_file_that_is_no_agent_is_refused(make, trained, tmp_path):
    path = tmp_path / "m"
    agent = make(params=trained)
    jaxpets.save_model(
        path,
        toys.small_ensemble(),
        jax.jit(toys.small_ensemble().init)(jax.random.key(0)),
    )
    with pytest.raises(ValueError, match=r"no agent .* format must be 'jaxpets agent'"):
        agent.load(path)
    agent.save(path)
    tensors = load_file(path)
    good = {"format": "jaxpets agent", "version": "1"}
    save_file(tensors, path, good | {"acts": "-1"})
    with pytest.raises(ValueError, match="counts wrong"):
        agent.load(path)
    save_file(tensors, path, good | {"version": "2"})
    with pytest.raises(ValueError, match="version must be '1', got '2'"):
        agent.load(path)


class Worlds:
    """Two worlds that count; a trial of world i ends at its i-th length."""

    def __init__(self, mode, lengths=(2, 3)):
        self.mode, self.lengths = mode, np.array(lengths)
        self.x, self.trial = np.zeros(2), np.zeros(2)
        self.over = np.zeros(2, bool)

    def obs(self, x):
        return np.stack([100 * self.trial + x, np.zeros(2)], 1)

    def start(self, which):
        self.trial, self.x = self.trial + which, np.where(which, 0, self.x)
        self.over = self.over & ~which

    def step(self):
        info = {}
        moving = ~self.over if self.mode == "NextStep" else np.ones(2, bool)
        self.start(self.over & ~moving)
        self.x = self.x + moving
        done = moving & (self.x == self.lengths)
        self.over = done
        if self.mode == "SameStep" and done.any():
            final = self.obs(self.x)
            info["final_obs"] = np.array(
                [row if d else None for row, d in zip(final, done, strict=True)], object
            )
            self.start(done)
        return self.obs(self.x), done, np.zeros(2, bool), info


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_no_transition_goes_from_an_end_to_a_start(make, trained, mode):
    agent = make(num_envs=2, params=trained, autoreset=mode)
    worlds = Worlds(mode)
    obs, planned = worlds.obs(worlds.x), []
    for _ in range(9):
        action = agent.act(obs)
        # What the planner's state adds: how many steps of this trial came before.
        planned.append(np.round((action[:, 0] - np.clip(-obs[:, 0], -1, 1)) * 1e3))
        obs, *done, info = worlds.step()
        agent.observe(obs, *done, info)
        if mode == "Disabled":
            worlds.start(done[0])
            obs = worlds.obs(worlds.x)
    found = rows(agent)
    assert all(after == before + 1 for before, after in found)
    assert agent.num_steps == len(found)
    lost = {"NextStep": 3 + 2, "SameStep": 0, "Disabled": 0}[mode]
    assert len(found) == 18 - lost
    counts = np.array(planned, int).T.tolist()
    if mode == "NextStep":  # the step that is ignored still counts in the old trial
        assert counts == [[0, 1, 2] * 3, [0, 1, 2, 3] * 2 + [0]]
    else:
        assert counts == [[0, 1] * 4 + [0], [0, 1, 2] * 3]


def test_one_world_that_resets_in_the_step_itself(make, trained):
    agent = make(params=trained, autoreset="SameStep")
    agent.act(at(1.0))
    agent.observe(at(0.0), True, info={"final_obs": at(2.0)})
    assert rows(agent) == [(1.0, 2.0)]


def test_another_planner_performs(make, trained):
    agent = make(params=trained)
    agent.perform((), jaxpets.random_planner(3 * ONE, 4 * ONE))
    assert 3 <= agent.act(at(0.0)) <= 4


@pytest.mark.parametrize("apart", [(), ("cpu", "gpu")], ids=["own", "shared memory"])
def test_after_a_plan_that_failed_it_plans_anew(make, trained, apart, monkeypatch):
    """Also where the step that failed had been given its state's memory."""
    monkeypatch.setattr(agent_call, "_APART", apart)

    def checked(obs):
        if obs[0] > 1:
            raise ValueError("too far")
        return obs[:1]

    def step(params, key, state, obs):
        shape = jax.ShapeDtypeStruct((1,), jnp.float32)
        output, state = pull(params, key, state, obs)
        there = jax.pure_callback(checked, shape, obs)
        return output._replace(action=output.action + there), state + there[0]

    agent = make(params=trained)
    assert bool(agent._places) == bool(apart)
    agent.perform(0.0, jaxpets.Planner(zero, step))
    first = agent.act(at(0.5))
    with pytest.raises(Exception, match="too far"):
        agent.act(at(2.0))
    np.testing.assert_array_equal(agent.act(at(0.5)), first)


def test_a_task_is_not_the_callers_memory(make, trained):
    agent = make(params=trained)
    # An array of NumPy that JAX could take as it lies.
    memory = np.zeros(32, np.float32)
    start = (-memory.ctypes.data % 64) // 4
    goal = memory[start : start + 1]
    agent.perform(goal)
    goal[:] = 0.75
    assert agent.act(at(0.0)) == pytest.approx(0.0)


def test_what_was_learned_outlives_a_fit_that_fails_late(make, trained, monkeypatch):
    """On a GPU a program may have failed only after its call has returned."""
    agent = make(params=trained)
    agent.act(at(0.0))
    agent.observe(at(1.0))

    def learn(key, state):
        failed = jax.tree.map(jnp.copy, state)
        jax.tree.map(lambda leaf: leaf.delete(), failed)
        return failed, zero()

    with monkeypatch.context() as patch:
        patch.setattr(agent, "_learn", learn)
        with pytest.raises(RuntimeError, match="deleted"):
            agent.learn()
    assert rows(agent) == [(0.0, 1.0)]
    assert agent.learn().num_updates > 0


def test_what_was_seen_is_learned_once_if_learning_is_broken_off(make, monkeypatch):
    agent = make(capacity=600)
    for step in range(600):
        agent.act(at(step))
        agent.observe(at(step + 1))
    append, calls = agent._append, []

    def second(*given):
        calls.append(given)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return append(*given)

    monkeypatch.setattr(agent, "_append", second)
    with pytest.raises(KeyboardInterrupt):
        agent.learn()
    assert rows(agent) == [(float(t), t + 1.0) for t in range(600)]


def test_an_agent_may_count_as_long_as_it_acts(make, trained, tmp_path):
    path, agent = tmp_path / "a", make(params=trained)
    agent._counts = agent._counts._replace(acts=2**31 - 1, fits=2**31, steps=10**12)
    agent.save(path)
    agent = make(params=trained)
    agent.load(path)
    for step in range(2):
        agent.act(at(step))
        agent.observe(at(step + 1))
    agent.learn()
    assert agent.num_steps == 10**12 + 2


@pytest.mark.parametrize("num_envs", [None, 2])
def test_it_acts_alike_through_pinned_memory_of_the_host(
    make, trained, num_envs, monkeypatch, tmp_path
):
    (device,) = jax.tree.leaves(trained)[0].devices()
    if "pinned_host" not in {memory.kind for memory in device.addressable_memories()}:
        pytest.skip("this device has no such memory")
    obs = np.full((2,) if num_envs is None else (2, 2), 0.25)
    monkeypatch.setattr(agent_call, "_APART", ())
    plain = make(num_envs=num_envs, params=trained)
    monkeypatch.setattr(agent_call, "_APART", (device.platform,))
    pinned = make(num_envs=num_envs, params=trained)
    kinds = [place.memory_kind for place in pinned._places]
    assert kinds == ["pinned_host", device.default_memory().kind]
    for planner in (PULL, RANDOM):  # the second has no state
        for agent in (plain, pinned):
            agent.perform(0.5, planner)
        for _ in range(3):
            np.testing.assert_array_equal(pinned.act(obs), plain.act(obs))
            for agent in (plain, pinned):
                agent.observe(obs)
    toys.assert_trees_close(pinned.learn(), plain.learn(), rtol=0)
    pinned.save(tmp_path / "agent")
    for agent in (plain, pinned):
        agent.load(tmp_path / "agent")
        agent.perform(0.5)
    np.testing.assert_array_equal(pinned.act(obs), plain.act(obs))
    # Its state is in one place from the first step on: the second compiles nothing.
    assert [act.program._cache_size() for act in pinned._acts.values()] == [1, 1]


def test_memory_is_left_to_jax_on_a_cpu_and_on_several_devices():
    def params(*platforms, kind="pinned_host"):
        """What is on devices that have one kind of memory."""
        memories = {"addressable_memories.return_value": [Mock(kind=kind)]}
        devices = {Mock(platform=platform, **memories) for platform in platforms}
        return Mock(devices=lambda: devices)

    for one in (params("cpu"), params("gpu", "gpu"), params("gpu", kind="device")):
        assert agent_call.places(one) is None


def test_what_a_world_may_not_say(make, trained):
    agent = make(params=trained)
    for bad, error, words in (
        ([0.0], ValueError, r"obs must be of shape \(2,\), got \(1,\)"),
        ({"x": 0}, TypeError, r"obs must be numbers of shape \(2,\), got dict"),
        (["1", "2"], TypeError, r"obs must be numbers of shape \(2,\), got list"),
        (np.ones(2) * 1j, TypeError, "obs must be numbers of shape .* got ndarray"),
        (None, TypeError, r"obs must be numbers of shape \(2,\), got NoneType"),
        ([0.0, np.nan], ValueError, r"obs must be finite, got nan in entry \[1\]"),
        ([1e300, 0.0], ValueError, r"obs must be finite, got inf in entry \[0\]"),
    ):
        with pytest.raises(error, match=words):
            agent.act(bad)
    agent.act(at(0.0))
    with pytest.raises(ValueError, match="next_obs must be finite"):
        agent.observe([np.inf, 0.0])
    with pytest.raises(TypeError, match=r"terminated must be True or False, got 1.0"):
        agent.observe(at(1.0), 1.0)
    with pytest.raises(
        ValueError, match=r"truncated must be of shape \(\), got \(2,\)"
    ):
        agent.observe(at(1.0), False, np.zeros(2, bool))
    agent.observe(at(1.0))  # none of it was kept
    assert rows(agent) == [(0.0, 1.0)]
    two = make(num_envs=2, params=trained, autoreset="SameStep")
    two.act(np.zeros((2, 2)))
    ended = np.array([True, False])
    with pytest.raises(ValueError, match="info must have final_obs"):
        two.observe(np.zeros((2, 2)), ended)
    with pytest.raises(
        TypeError, match="info must be a dict that has final_obs, got list"
    ):
        two.observe(np.zeros((2, 2)), ended, info=[{"final_obs": at(0)}, {}])
    with pytest.raises(ValueError, match="must have 2 rows, got 1"):
        two.observe(np.zeros((2, 2)), ended, info={"final_obs": [at(0)]})
    with pytest.raises(ValueError, match="must have 2 rows, got int"):
        two.observe(np.zeros((2, 2)), ended, info={"final_obs": 5})


def test_what_performs_must_be_a_planner(make, trained):
    agent = make(params=trained)
    with pytest.raises(TypeError, match="planner must be a Planner, got int"):
        agent.perform(1.0, 0)
    agent.perform(1.0)
    agent.perform(1.0, PULL)


def test_a_task_of_64_bits_is_performed_as_one_of_32(make, trained):
    with jax.enable_x64(True):
        agent = make(params=trained)
        for goal in (0.75, np.array(0.75), jnp.array(0.75)):
            agent.perform(goal)
            agent.reset()
            assert agent.act(at(0.25)) == pytest.approx(0.5)
        task = strongly_typed({"goal": np.ones(2), "entry": np.int64(3), "on": True})
    assert {name: str(x.dtype) for name, x in task.items()} == {
        "goal": "float32", "entry": "int64", "on": "bool",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "number", "words"),
    [
        ("dataset.size", 10**6, r"dataset.size in .* must be 0 to \d+, got 1000000"),
        ("dataset.size", -1, "dataset.size in .* got -1"),
        ("dataset.cursor", 10**6, "dataset.cursor in .* got 1000000"),
        ("params.scaler.std", 0, "scaler.std of params in .* must be positive"),
        ("params.scaler.mean", np.nan, "scaler.mean of params in .* no NaN"),
    ],
)
def test_a_strangers_agent_is_refused(make, trained, tmp_path, name, number, words):
    path = tmp_path / "agent.safetensors"
    make(params=trained).save(path)
    arrays = load_file(path)
    with safe_open(path, "np") as file:
        metadata = file.metadata()
    save_file({**arrays, name: np.full_like(arrays[name], number)}, path, metadata)
    agent = make(params=trained)
    with pytest.raises(ValueError, match=words):
        agent.load(path)
    agent.act(at(0.0))  # as it was


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_world_that_diverges_does_not_stop_the_others(make, trained, mode):
    """The first of two ends in NaN, and is at 5 in its new trial; the other counts."""
    agent, both = make(num_envs=2, params=trained, autoreset=mode), np.ones(2, bool)
    agent.reset()
    steps = [
        [[0, 0], [0, 0]],
        [[np.nan, 0], [1, 0]],
        [[5, 0], [2, 0]],
        [[6, 0], [3, 0]],
    ]
    path = np.array(steps)
    for step, obs in enumerate(path[:-1]):
        action = agent.act(obs)
        # Each time the world 0 plans anew, its planner has counted no step.
        assert action[1] == pytest.approx(max(-1, -step) + 1e-3 * step)
        final = {"final_obs": [[np.nan, 0], None]}
        agent.observe(path[step + 1], both * [step == 0, False], info=final)
    assert action[0] == pytest.approx(-1.0)
    assert rows(agent) == [(0, 1), (1, 2), (5, 6), (2, 3)] and agent.num_steps == 4


def test_what_an_agent_may_not_be_made_of(make, parts):
    with pytest.raises(ValueError, match=r"autoreset must be one of .*, got 'never'"):
        make(autoreset="never")
    for seed in (2**32, 2**70):  # the first would be the seed 0, without a word
        with pytest.raises(ValueError, match="seed must be at most 4294967295, got"):
            make(seed=seed)
    with pytest.raises(ValueError, match="num_envs must be at least 1"):
        make(num_envs=0)
    with pytest.raises(ValueError, match="params must"):
        make(params=jax.jit(toys.small_ensemble(obs_size=3).init)(jax.random.key(0)))
    with pytest.raises(TypeError, match="planner must be a Planner"):
        make().perform((), 3)
    days = np.zeros(1, "datetime64[D]")
    for reward in (toys.reach, "up", {"goal": object()}, jax.random.key(0), days):
        with pytest.raises(TypeError, match="reward must be a pytree of numbers, got"):
            make().perform(reward)
    with pytest.raises(TypeError, match=r"reward_data.init must be a function, got A"):
        make(reward_data=jaxpets.RewardData(jax.numpy.ones(2)))


def test_only_counted_rows_are_appended():
    data = toys.transitions(4)
    append = jax.jit(jaxpets.datasets.append)
    full = append(jaxpets.datasets.init(5, 2, 1), data)
    one, two = jnp.int32(1), jnp.int32(2)
    step = append(full, data, two)  # wraps around the end
    assert (int(step.size), int(step.cursor)) == (5, 1)
    np.testing.assert_array_equal(step.data.obs[jnp.array([4, 0])], data.obs[:2])
    np.testing.assert_array_equal(step.data.obs[1:4], full.data.obs[1:4])
    small = append(jaxpets.datasets.init(5, 2, 1), data, one)
    assert (int(small.size), int(small.cursor)) == (1, 1)
    assert not np.asarray(small.data.obs[1:]).any()
