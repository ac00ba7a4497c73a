"""What an actor and a critic learn of tasks whose answers are known."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import PlanParams
from jaxpets._src.actor_critic_update import lambda_returns
from jaxpets._src.guards import guarded_step
from jaxpets._src.imagined_trials import imagine
from jaxpets.policies import (
    ActorCriticConfig,
    Goals,
    Guided,
    actor_critic,
)

pytestmark = pytest.mark.slow

NUM_UPDATES = 500
DIVIDED = 6  # calls for a task that needs more


class Task(NamedTuple):
    """Data of one reward that is several."""

    same: float = 0.0  # everywhere
    near: float = 0.0  # within 0.1 of `place`
    close: float = 0.0  # the closer to `place`
    place: float = 0.0
    spread: float = 0.0  # of places, between trials
    end: float = float("inf")  # where trials end


TASKS = {
    "two": Task(same=2.0),
    "minus one": Task(same=-1.0),
    "nothing": Task(),
    "short": Task(same=1.0, end=-9.0),
    "far": Task(near=1.0, place=1.0),
    "anywhere": Task(close=1.0, spread=1.0),
    "broken world": Task(near=1.0, place=0.5),
    "broken state": Task(same=1.0),
}
# What the cart gains by a force, and where the world blows up.
WORLD = (jnp.float32(3.0), jnp.float32(jnp.inf))


def dynamics(params, key, obs, action):
    gain, limit = params
    moved = toys.cart(gain, key, obs, action)
    return jnp.where(obs[..., :1] > limit, jnp.inf, moved)


def earn(task, obs, action, next_obs):
    off = jnp.abs(next_obs[..., 0] - task.place)
    within = task.near * (off < 0.1).astype(jnp.float32)
    return task.same + within + task.close * jnp.exp(-4.0 * off**2)


def draw(task, key):
    shift = task.spread * jax.random.uniform(key, (), jnp.float32, -1.0, 1.0)
    return task._replace(place=task.place + shift)


def build(**changes):
    numbers = dict(hidden_size=32, batch_size=16, horizon=3, num_updates=NUM_UPDATES)
    numbers |= dict(discount=0.9, target_rate=0.1)
    numbers |= {k: changes.pop(k) for k in list(changes) if k in NUMBERS}
    settings = dict(
        dynamics_fn=dynamics,
        reward_fn=earn,
        optimizer=optax.adam(2e-3),
        config=ActorCriticConfig(**numbers),
        space=jaxpets.delta_space(),
        obs_size=2,
        action_low=-toys.LIMIT,
        action_high=toys.LIMIT,
        goals=Goals(draw, lambda task: task.place[None]),
        terminal_fn=lambda task, obs: obs[0] > task.end,
    )
    return actor_critic(**(settings | changes))


NUMBERS = ActorCriticConfig.__dataclass_fields__


def states(count=500, reach=1.5):
    """States all over the place, as exploration leaves them."""
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.uniform(-reach, reach, (count, 2)), jnp.float32)
    data = jaxpets.Transition(rows, rows[:, :1], rows)
    return jaxpets.datasets.append(jaxpets.datasets.init(count + 20, 2, 1), data)


class Learned(NamedTuple):
    """What was learned of one task."""

    guided: Guided
    before: Any  # a state
    after: Any
    metrics: Any

    def value(self):
        return VALUE(self.guided, states().data.obs[:50])


LEARNER = build()
INIT, STEP = jax.jit(LEARNER.init), jax.jit(LEARNER.step)
VALUE = jax.jit(LEARNER.value_fn)


@functools.cache
def learn(name, num_calls=1, squash=0.0):
    """Every task is learned by the same compiled program."""
    data, task = states(), Task(*map(jnp.float32, TASKS[name]))
    limit = 1.0 if name == "broken world" else jnp.inf
    params = PlanParams((WORLD[0], jnp.float32(limit)), task)
    keys = jax.random.split(jax.random.key(0), num_calls + 1)
    before = INIT(params, keys[0], data)
    squashed = before.params._replace(squash=jnp.float32(squash))
    before = before._replace(params=squashed)
    if name == "broken state":
        bad = before.params._replace(scale=jnp.float32(jnp.nan))
        before = before._replace(params=bad)
    after = before
    for key in keys[1:]:
        after, metrics = STEP(params, key, after, data)
    return Learned(Guided(task, after.params), before, after, metrics)


def driven(planner, reward, start, length=40):
    """Positions `[T]` of the cart."""
    params = PlanParams(WORLD, reward)
    env = toys.cart_env(float(WORLD[0]))
    env = env._replace(reset=lambda key: jaxpets.EnvState(start, jnp.int32(0)))

    def run(key):
        state = jaxpets.start_trial(env, planner, key)
        return jaxpets.unroll(env, planner, params, key, state, length=length)[1]

    return np.asarray(jax.jit(run)(jax.random.key(1)).next_obs[:, 0])


def test_returns_equal_the_recursion_by_hand():
    rng = np.random.default_rng(1)
    reward, after = rng.normal(size=(2, 4, 3)).astype(np.float32)
    goes_on = rng.uniform(size=(4, 3)) < 0.7
    counts = rng.uniform(size=(4, 3)) < 0.7
    got = lambda_returns(reward, after, goes_on, counts, discount=0.9, trace=0.3)
    later = after[-1]
    for t in reversed(range(4)):
        later = reward[t] + 0.9 * goes_on[t] * (0.7 * after[t] + 0.3 * later)
        np.testing.assert_allclose(got[t], later, rtol=1e-5)
        later = np.where(counts[t], later, after[t])


def test_imagined_trials_end_and_stay():
    """The second member blows up in its second step, the first ends at 0.5."""

    def dynamics(params, key, obs, action):
        bad = (obs[..., 1] > 0.15) & (jnp.arange(2)[:, None] == 1)
        moved = obs + params * action
        return jnp.where(bad[..., None], jnp.nan, moved)

    run = imagine(
        dynamics,
        lambda data, obs, action, next_obs: data * next_obs[..., 0],
        lambda data, obs: obs[0] > 0.5,
        lambda policy, key, data, obs: jnp.full((2, 1, 2), policy),
        4,
    )
    data = jnp.array([[1.0], [10.0]])
    steps = run(jnp.float32(1.0), 0.2, jax.random.key(0), data, jnp.zeros((2, 1, 2)))
    counts = np.asarray(steps.counts[..., 0]).T
    np.testing.assert_array_equal(counts, [[1, 1, 1, 0], [1, 0, 0, 0]])
    np.testing.assert_array_equal(steps.goes_on[:, 0, 0], [1, 1, 0, 0])
    # Sums of 0.2, and ten times the first.
    rewards = np.asarray(steps.reward[..., 0]).T
    np.testing.assert_allclose(rewards, [[0.2, 0.4, 0.6, 0], [2, 0, 0, 0]], rtol=1e-6)
    assert np.isfinite(steps.next_obs).all()
    np.testing.assert_allclose(steps.next_obs[-1, :, 0, 0], [0.6, 0.2], rtol=1e-6)


@pytest.mark.parametrize("squash", [0.0, 10.0])
@pytest.mark.parametrize(
    ("name", "reward"), [("two", 2.0), ("minus one", -1.0), ("nothing", 0.0)]
)
def test_a_constant_reward_is_worth_its_sum_for_ever(name, reward, squash):
    learned = learn(name, squash=squash)
    # What is left of the weights' first values; squashed the largest is the flattest.
    atol = 1.5 if squash else 0.5
    np.testing.assert_allclose(learned.value(), 10.0 * reward, atol=atol)
    np.testing.assert_allclose(learned.metrics.reward, reward, rtol=1e-5)
    assert learned.metrics.num_skipped == 0


def test_nothing_is_to_come_where_trials_end():
    np.testing.assert_allclose(learn("short").value(), 1.0, atol=0.1)


def test_a_reward_behind_the_horizon_is_found():
    guided, start = learn("far", DIVIDED).guided, jnp.array([-1.0, 0.0])
    search = toys.optimizer("icem", horizon=3)
    rollout = jaxpets.particle_rollout(dynamics)
    blind = jaxpets.plan(rollout, earn, search)
    assert np.abs(driven(blind, guided.reward, start) - 1.0).min() > 0.5
    seeing = jaxpets.plan(
        rollout,
        LEARNER.reward_fn,
        search,
        discount=0.9,
        value_fn=LEARNER.value_fn,
    )
    for planner in (seeing, LEARNER.policy):
        path = driven(planner, guided, start)
        assert np.abs(path[-10:] - 1.0).max() < 0.2


def test_a_policy_goes_where_its_trial_wants_it():
    task, networks = learn("anywhere", DIVIDED).guided
    for place in (-0.8, 0.8):
        guided = Guided(task._replace(place=jnp.float32(place)), networks)
        path = driven(LEARNER.policy, guided, jnp.zeros(2))
        assert np.abs(path[-10:] - place).max() < 0.3


def test_rows_that_blow_up_teach_nothing():
    learned = learn("broken world")
    assert learned.metrics.num_skipped == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(learned.after.params))


PLAIN = dict(num_updates=1, target_rate=0.0, num_members=2, optimizer=optax.sgd(0.1))


def one_update(task, state=None, targets=1.0, pessimism=0.0, restart=0.0):
    """One gradient step of a learner with two members; also what it began with."""
    known = PlanParams(WORLD, Task(*map(jnp.float32, task)))
    if state is None:
        state = INIT_PLAIN(known, jax.random.key(0), states())
    large = jax.tree.map(lambda x: targets * x, state.targets)
    begun = state._replace(targets=large)
    key, numbers = jax.random.key(1), jnp.array([pessimism, restart], jnp.float32)
    return begun, STEP_PLAIN(numbers, known, key, begun, states())[0]


def step_plain(numbers, *arguments):
    return build(pessimism=numbers[0], restart=numbers[1], **PLAIN).step(*arguments)


INIT_PLAIN = jax.jit(build(**PLAIN).init)
STEP_PLAIN = jax.jit(step_plain)


def biases(state):
    """The last biases of the critics, which go where their targets are on average."""
    leaves = jax.tree.leaves_with_path(state.params.critics)
    (found,) = [x for path, x in leaves if x.shape[1:] == (1,)]
    return np.asarray(found)


def test_no_value_is_beyond_the_rewards():
    """Once it is, it does not matter how far."""
    ends = [one_update(TASKS["two"], targets=scale)[1] for scale in (1e4, 1e6)]
    assert (biases(ends[0]) == biases(ends[1])).all()
    _, near = one_update(TASKS["two"], targets=1.0)
    assert (biases(near) != biases(ends[0])).all()


@pytest.mark.parametrize("squash", [0.0, 10.0])
def test_a_step_is_that_by_hand(squash):
    """Of critics that say the same everywhere, of a reward that is the same, too."""
    known = PlanParams(WORLD, Task(*map(jnp.float32, TASKS["two"])))
    said, squash = 0.3, np.float32(squash)

    def constant(path, leaf):  # the last layer
        if leaf.shape[1:] == (32, 1):
            return jnp.zeros_like(leaf)
        return jnp.full_like(leaf, said) if leaf.shape[1:] == (1,) else leaf

    def squashed(value):
        return np.log1p(squash * value) / np.log1p(squash) if squash else value

    init = jax.jit(build(**PLAIN, squash=squash).init)
    state = init(known, jax.random.key(0), states())
    critics = jax.tree.map_with_path(constant, state.params.critics)
    params = state.params._replace(critics=critics)
    assert params.squash == squash
    begun = state._replace(params=params, targets=critics)
    key, numbers = jax.random.key(1), jnp.zeros(2)
    after, metrics = STEP_PLAIN(numbers, known, key, begun, states())

    value = np.expm1(said * np.log1p(squash)) / squash if squash else said
    reward, targets = 2.0 * params.scale, []  # the largest value is 1
    later = value
    for _ in range(3):
        later = reward + 0.9 * (0.5 * value + 0.5 * later)
        targets.append(squashed(later))
    wanted = said - 0.1 * 2.0 * (said - np.mean(targets))
    np.testing.assert_allclose(biases(after), wanted, rtol=1e-5)
    np.testing.assert_allclose(metrics.value, value / params.scale, rtol=1e-5)
    guided = Guided(known.reward, begun.params)
    found = VALUE(guided, states().data.obs[:3])
    np.testing.assert_allclose(found, value / params.scale, rtol=1e-5)


def test_pessimism_takes_the_lesser_of_the_critics():
    least, mean, between = (
        biases(one_update(TASKS["far"], pessimism=x)[1]) for x in (1.0, 0.0, 0.5)
    )
    assert (least < between).all() and (between < mean).all()


def test_half_of_the_trials_go_on():
    """The others begin in states of the data, with a reward of their own."""
    before, after = one_update(TASKS["anywhere"])
    rows = {tuple(row) for row in np.asarray(states().data.obs)}
    known = np.array([[tuple(x) in rows for x in xs] for xs in np.asarray(after.obs)])
    half = known.shape[1] // 2
    assert known.shape == (2, 8) and known[:, :half].all() and not known[:, half:].any()
    same = np.asarray(after.rewards.place == before.rewards.place)
    assert same[:, half:].all() and not same[:, :half].any()
    for task, restart in ((TASKS["anywhere"], 1.0), (TASKS["short"], 0.0)):
        _, renewed = one_update(task, restart=restart)
        assert all(tuple(x) in rows for x in np.asarray(renewed.obs).reshape(-1, 2))


def test_tasks_at_once_are_those_alone():
    tasks = [Task(*map(jnp.float32, TASKS[name])) for name in ("far", "anywhere")]
    alone = [one_update(task) for task in tasks]
    stack = functools.partial(jax.tree.map, lambda *x: jnp.stack(x))
    params = PlanParams(WORLD, stack(*tasks))
    takes = (None, PlanParams(None, 0), None, 0, None)
    together, _ = jax.jit(jax.vmap(step_plain, takes))(
        jnp.zeros(2), params, jax.random.key(1), stack(*(x for x, _ in alone)), states()
    )
    wanted = stack(*(x for _, x in alone))
    for got, want in zip(*map(jax.tree.leaves, (together, wanted)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_states_of_numpy_are_begun_at_outside_jit():
    """As those of a file: rows are picked by what is traced, which NumPy cannot."""
    learner = build(num_updates=1)
    params = PlanParams(WORLD, Task(*map(jnp.float32, TASKS["two"])))
    key = jax.random.key(0)
    data = jax.device_get(states(20))
    state = learner.init(params, key, data)
    _, metrics = learner.step(params, key, state, data)
    assert metrics.reward == 2.0 and metrics.num_skipped == 0


def test_a_state_made_outside_of_jit_can_be_donated():
    learner = build(num_updates=1)
    params = PlanParams(WORLD, Task(*map(jnp.float32, TASKS["two"])))
    state = learner.init(params, jax.random.key(0), states(20))
    step = jax.jit(learner.step, donate_argnums=2)
    _, metrics = step(params, jax.random.key(1), state, states(20))
    assert metrics.num_skipped == 0 and state.targets["params"]


def test_an_observation_of_another_size_is_refused():
    row = jaxpets.coordinates.Coordinate
    rows = jaxpets.coordinates.space([row("x"), row("v")])
    learner = build(num_updates=1, space=rows)
    params = PlanParams(WORLD, Task(*map(jnp.float32, TASKS["two"])))
    networks = learner.init(params, jax.random.key(0), states(20)).params
    known = PlanParams((), Guided(params.reward, networks))
    for size in (1, 3, 4):
        with pytest.raises(
            ValueError, match=rf"obs must be float32\[2\], got .*\[{size}\]"
        ):
            learner.policy.step(known, jax.random.key(0), (), jnp.zeros(size))


def test_steps_that_are_not_finite_are_dropped():
    learned = learn("broken state")
    assert learned.metrics.num_skipped == NUM_UPDATES
    actors = (learned.before.params.actor, learned.after.params.actor)
    jax.tree.map(np.testing.assert_array_equal, *actors)


def test_a_gradient_too_large_to_square_is_dropped():
    """Adam's step of it is 0, but its moment would stay infinite, and the weight."""
    adam, weights = optax.adam(1e-3), {"w": jnp.ones(3)}
    state = adam.init(weights)
    large = {"w": jnp.asarray([0.0, 1e25, 1.0], jnp.float32)}
    *kept, good = guarded_step(adam.update, large, weights, state)
    assert not good
    toys.assert_trees_close(kept, [weights, state], rtol=0)
    *_, good = guarded_step(adam.update, weights, weights, state)
    assert good


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        (dict(discount=1.0), ValueError, "discount must be below 1, got 1.0"),
        (dict(discount=jnp.float32(1)), ValueError, "discount must be below 1, got 1"),
        (dict(trace=1.5), ValueError, r"trace must be in \[0, 1\], got 1.5"),
        (dict(squash=-1.0), ValueError, "squash must be finite and at least 0, got -1"),
        (dict(horizon=0), ValueError, "horizon must be at least 1, got 0"),
        (dict(goals=3), TypeError, "goals must be a Goals, got"),
        (dict(goals=Goals(3)), TypeError, r"goals.draw must be a function, got 3"),
        (dict(num_members=0), ValueError, "num_members must be at least 1, got 0"),
        (dict(dynamics_fn=None), TypeError, "dynamics_fn must be a function, got None"),
        (dict(terminal_fn=1), TypeError, "terminal_fn must be a function, got 1"),
    ],
)
def test_bad_settings_fail_when_built(changes, error, text):
    with pytest.raises(error, match=text):
        build(**changes)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            dict(terminal_fn=lambda task, obs: obs[..., 0]),
            r"terminal_fn must return bool of shape \(\), got float32\[\]",
        ),
        (
            dict(terminal_fn=lambda task, obs: jnp.int32(1)),
            r"terminal_fn must return bool of shape \(\), got int32\[\]",
        ),
        (
            dict(goals=Goals(features=lambda task: jnp.float32(1))),
            r"goals.features's result must be float32\[G\], got float32\[\]",
        ),
    ],
)
def test_functions_that_return_something_else_are_named(changes, text):
    learner, params = build(**changes), PlanParams(WORLD, Task())

    def both(key, data):
        return learner.step(params, key, learner.init(params, key, data), data)

    with pytest.raises(ValueError, match=text):
        jax.eval_shape(both, jax.random.key(0), states())


def test_wrong_arguments_fail_when_traced():
    learner = build()
    data = jaxpets.datasets.init(5, 3, 1)
    params = PlanParams(WORLD, Task())
    with pytest.raises(ValueError, match=r"dataset.data.obs must be float32\[C, 2\]"):
        learner.init(params, jax.random.key(0), data)
    data = jaxpets.datasets.init(5, 2, 2)
    message = r"dataset.data.action must be float32\[C, 1\], got float32\[5, 2\]"
    with pytest.raises(ValueError, match=message):
        learner.init(params, jax.random.key(0), data)
    with pytest.raises(TypeError, match="params must be a PlanParams"):
        learner.init(WORLD, jax.random.key(0), states())
    with pytest.raises(TypeError, match=r"params.reward must be a Guided"):
        learner.policy.step(params, jax.random.key(0), (), jnp.zeros(2))
    swapped = params._replace(reward=Guided((), params.reward))
    with pytest.raises(
        TypeError, match=r"reward.networks must be an ActorCriticParams"
    ):
        learner.policy.step(swapped, jax.random.key(0), (), jnp.zeros(2))
