"""A step through memory that host and device share: of an agent, in test_agent.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from jax.sharding import SingleDeviceSharding

import jaxpets
from jaxpets._src.agent_call import _UNSEEN, Mailbox, Places, compiled, first_state
from jaxpets._src.agent_steps import Given, act_fn

DEVICE = jax.devices()[0]
KINDS = {memory.kind for memory in DEVICE.addressable_memories()}
pytestmark = pytest.mark.skipif(
    "pinned_host" not in KINDS, reason="this device has no such memory"
)
HERE = SingleDeviceSharding(DEVICE)
KEY = jax.random.key(0)


def places():
    return Places(HERE.with_memory_kind("pinned_host"), HERE)


def given(number, obs=(0.5, 2.0), is_new=False):
    return Given(np.int32(number), np.asarray(is_new), np.asarray(obs, np.float32))


def act(params, key, state, given):
    state = jnp.where(given.is_new, 0.0, state) + params
    return jnp.stack([given.number.astype(float) + given.obs.sum(), state]), state


def start():
    return jax.device_put(jnp.zeros(()), HERE)


def test_it_is_the_step():
    step, plain = compiled(act, places()), compiled(act, None)
    assert isinstance(step, Mailbox) and not isinstance(plain, Mailbox)
    states = [start(), start()]
    for number in range(5):
        told = given(number, (number, 1.0), number == 3)
        actions = []
        for i, one in enumerate((step, plain)):
            action, states[i] = one(2.0, KEY, states[i], told)
            actions.append(action)
        np.testing.assert_array_equal(*actions)
        np.testing.assert_array_equal(actions[0], [2 * number + 1, states[0]])
    assert states[0] == 2 * 2.0
    assert step.program._cache_size() == 1


def test_an_action_is_the_callers_own():
    step = compiled(act, places())
    first, state = step(1.0, KEY, start(), given(1))
    kept = first.copy()
    step(1.0, KEY, state, given(2))
    np.testing.assert_array_equal(first, kept)
    first[:] = 7.0  # may be written to
    assert step(1.0, KEY, start(), given(1))[0][0] == kept[0]


def test_a_step_that_fails_says_so_and_the_next_one_acts():
    def checked(number):
        if number == 1:
            raise ValueError("the world has ended")
        return np.float32(number)

    def failing(params, key, state, given):
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        return jax.pure_callback(checked, shape, given.number)[None], state

    step = compiled(failing, places())
    for number in (0, 1, 2):
        if number == 1:
            with pytest.raises(Exception, match="the world has ended"):
                step(0.0, KEY, start(), given(number))
        else:
            assert step(0.0, KEY, start(), given(number))[0] == number


def test_any_number_comes_in_the_end():
    """Also the one that means that none has come."""

    def act(params, key, state, given):
        words = jnp.where(given.number == 1, jnp.uint32(_UNSEEN), 0)
        return jax.lax.bitcast_convert_type(words, jnp.float32)[None], state

    step = compiled(act, places())
    for number in (0, 1, 2):
        (action,), _ = step(0.0, KEY, start(), given(number))
        assert np.isnan(action) == (number == 1)


def test_a_slow_action_is_awaited():
    def slow(params, key, state, given):
        matrix = jnp.full((400, 400), given.number.astype(float) / 400)
        product = jax.lax.fori_loop(0, 60, lambda _, x: (matrix @ x) / params, matrix)
        return jnp.stack([given.number.astype(float) + 0 * product.sum(), 1.0]), state

    step = compiled(slow, places())
    for number in range(1, 5):
        action, _ = step(float(number), KEY, start(), given(number))
        np.testing.assert_array_equal(action, [number, 1.0])


def test_a_step_takes_its_states_memory_and_never_a_planners():
    kept = jnp.ones(3)

    def step(params, key, state, obs):
        return jaxpets.typing.PlanOutput(params * state[:1], (), ()), state + 1

    planner = jaxpets.Planner(lambda: kept, step)
    for lead in ((), (1,)):  # for which alone the state would be that very array
        act = compiled(act_fn(planner, 1, 1 if lead else None), places())
        first = state = first_state(planner, lead, places())
        for number in range(3):
            told = given(number, np.zeros((*lead, 2)), np.zeros(lead, bool))
            action, state = act(2.0, KEY, state, told)
            np.testing.assert_array_equal(action, np.full((*lead, 1), 2.0 + 2 * number))
        assert first.is_deleted()
        np.testing.assert_array_equal(kept, 1.0)


def test_nothing_of_a_step_goes_before_what_is_given():
    """Or XLA makes two CUDA graphs of it, which take longer to start than one."""
    step = compiled(act, places())
    slot, told = np.zeros(2, np.float32), np.zeros(4, np.int32)
    program = jax.make_jaxpr(step.program)(slot, start(), 2.0, KEY, told).jaxpr
    (call,) = program.eqns
    names = [eqn.primitive.name for eqn in call.params["jaxpr"].eqns]
    assert names[:2] == ["device_put", "optimization_barrier"] and len(names) > 4
    waiting = call.params["jaxpr"].eqns[1].invars
    assert len(waiting) == 4  # params, key, state and what is given
    late = {id(x) for eqn in call.params["jaxpr"].eqns[2:] for x in eqn.invars}
    early = [*call.params["jaxpr"].jaxpr.invars, *call.params["jaxpr"].eqns[0].outvars]
    assert not late & {id(x) for x in early}


@pytest.mark.skipif(DEVICE.platform != "cpu", reason="the runtime refuses there")
def test_what_xla_puts_elsewhere_is_found_there():
    step, places_seen, held = compiled(act, places()), [], None
    for number in range(4):
        action, _ = step(1.0, KEY, start(), given(number))
        assert action[0] == number + 2.5
        slot = step._boxes[0][0]
        places_seen.append(slot.unsafe_buffer_pointer())
        if number == 1:  # whoever looks at an array keeps it from being given away
            held = np.asarray(slot)
    assert places_seen[1] != places_seen[2] == places_seen[3]
    del held


@pytest.mark.gpu
@pytest.mark.parametrize("num_envs", [None, 3])
def test_no_action_of_a_gpu_is_seen_before_it_is_known(num_envs):
    """Plans by the kernel, one after the other."""
    model = toys.small_ensemble(precision=jaxpets.Precision.BF16)
    rollout = jaxpets.fused_rollout(model, num_particles=2 * model.num_members)
    assert rollout.uses_kernel
    planner = jaxpets.plan(
        rollout, jaxpets.rewards.epistemic, toys.optimizer("icem", horizon=9)
    )
    act, lead = act_fn(planner, 1, num_envs), () if num_envs is None else (num_envs,)
    with jax.default_device(DEVICE):
        params = jaxpets.PlanParams(jax.jit(model.init)(KEY), jnp.ones(2))
        calls = [compiled(act, place) for place in (places(), None)]
        states = [first_state(planner, lead, places()) for _ in calls]
        rng = np.random.default_rng(0)
        for number in range(300):
            is_new = np.full(lead, number % 100 == 0)
            told = given(number, rng.normal(size=(*lead, 2)), is_new)
            actions = []
            for i, call in enumerate(calls):
                action, states[i] = call(params, KEY, states[i], told)
                actions.append(action)
            np.testing.assert_array_equal(*actions)
