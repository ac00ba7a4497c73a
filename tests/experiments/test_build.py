from types import SimpleNamespace
from typing import get_args

import chex
import jax
import jax.numpy as jnp
import pytest

import jaxpets
from experiments import cli, engines, robots
from experiments.build import build
from experiments.config import ArmName, Config
from jaxpets import envs
from jaxpets.envs import half_cheetah


def value(*flags):
    """What the first plan of a task is worth to a smoke run's untrained ensemble."""
    config = cli.parse(["--phase", "explore", "--preset", "smoke", *flags])
    parts = build(config)
    keys = jax.random.split(jax.random.key(0))
    params = jax.jit(parts.model.init)(keys[0])
    weights = half_cheetah.task("forward")
    actor = parts.actor
    step = jax.jit(lambda p: actor.step(p, keys[1], actor.init(), jnp.zeros(18)))
    return step(jaxpets.PlanParams(params, weights))[0].value


@pytest.mark.parametrize(
    ("rollout", "flags", "wanted"),
    [
        (("", "g++ 12.2"), (), "kernel of g++ 12.2"),
        (("no compiler", ""), (), "scan (no compiler)"),
        (("", "g++ 12.2"), ("--task-planner.no-fused",), "scan"),
    ],
    ids=["kernel", "fallback", "scan"],
)
def test_what_plans_is_named(monkeypatch, rollout, flags, wanted):
    fused = jaxpets.typing.FusedRollout(lambda params: None, *rollout)
    monkeypatch.setattr(jaxpets, "fused_rollout", lambda *_, **__: fused)
    phase = ["--phase", "explore", "--preset", "smoke", "--arm", "random"]
    parts = build(cli.parse([*phase, *flags]))
    assert (parts.explored_by, parts.performed_by) == ("none", wanted)


@pytest.mark.parametrize("arm", get_args(ArmName))
def test_an_arm_plans_with_its_data(arm):
    parts = build(cli.parse(["--phase", "explore", "--preset", "smoke", "--arm", arm]))
    key, explorer = jax.random.key(0), parts.explorer
    state = jax.eval_shape(parts.learner.init, key)
    refresh = parts.reward_data.refresh
    after = jax.eval_shape(refresh, state.reward, state.params, state.dataset)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state.reward)
    params = jaxpets.PlanParams(state.params, state.reward)
    plan, _ = jax.eval_shape(explorer.step, params, key, explorer.init(), jnp.zeros(18))
    assert plan.action.shape == (6,) and plan.value.shape == ()


def test_imagined_trials_end_where_real_ones_do(monkeypatch):
    robot = envs.make("pets/half_cheetah")
    env = robot.env._replace(terminal_fn=lambda obs: obs[..., 0] > 1)
    given = []

    def plan(*parts, terminal_fn):
        given.append(terminal_fn)

    scan = ("--planner.no-fused", "--task-planner.no-fused")
    config = cli.parse(["--phase", "explore", "--preset", "smoke", *scan])
    monkeypatch.setattr(robots, "of", lambda config: robot._replace(env=env))
    monkeypatch.setattr(jaxpets, "plan", plan)
    build(config)
    explores, performs = (end(None, jnp.array([0.0, 2.0])[:, None]) for end in given)
    assert explores.tolist() == performs.tolist() == [False, True]


@pytest.mark.parametrize(
    ("kernel", "named", "said"),
    [
        (dict(compiler="nvcc 13.0"), "kernel of nvcc 13.0", []),
        (dict(reason="no nvcc"), "scan", ["warning: no kernel trains: no nvcc"]),
    ],
    ids=["kernel", "fallback"],
)
def test_what_trains_is_named(monkeypatch, kernel, named, said):
    def build_fused(*parts):
        return jaxpets.fitter(*parts)._replace(**kernel)

    monkeypatch.setattr(jaxpets, "fused_fitter", build_fused)
    phase = ["--phase", "explore", "--preset", "smoke", "--arm", "random"]
    parts = build(cli.parse([*phase, "--training.fused"]))
    assert not parts.tuner.uses_kernel and not parts.tuner.reason
    found, lines = {}, []
    run = SimpleNamespace(
        computes=lambda **now: found.update(now) or [], say=lines.append
    )
    engines.say_engines(run, "scan", fitter=parts.fitter, refitter=None)
    assert found == {"rollout": "scan", "fitter": named} and lines == said


def test_pessimism_lowers_what_a_plan_is_worth():
    plain, doubtful = value(), value("--pessimism", "2")
    assert doubtful < plain
    assert value("--pessimism", "0") == pytest.approx(plain)


def a_rollout(reason):
    """What `fused_rollout` returns, which imagines nothing."""
    return jaxpets.typing.FusedRollout(lambda params: None, reason)


@pytest.mark.parametrize("fallback", [False, True])
@pytest.mark.parametrize(
    ("backend", "flags", "wanted"),
    [
        ("gpu", ("bf16", "--planner.fused"), True),
        ("gpu", ("bf16", "--planner.no-fused"), False),
        ("gpu", ("f32", "--planner.fused"), False),
        ("cpu", ("bf16", "--planner.fused"), False),
        ("cpu", ("f32", "--planner.fused"), False),
    ],
)
def test_a_search_is_unrolled_beside_a_kernel_of_a_gpu_only(
    monkeypatch, backend, flags, wanted, fallback
):
    """Where fused_rollout gives the scan instead, the search stays a loop."""
    searches = []

    def cem(*, unroll, **size):
        searches.append(unroll)
        return search(**size)

    search, fused = jaxpets.optimizers.cem, a_rollout("none" if fallback else "")
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jaxpets, "fused_rollout", lambda *_, **__: fused)
    monkeypatch.setattr(jaxpets.optimizers, "cem", cem)
    precision, flag = flags
    phase = ["--phase", "explore", "--preset", "smoke", "--allow-cpu"]
    build(cli.parse([*phase, "--planner.precision", precision, flag]))
    assert searches[0] is (wanted and not fallback)


@pytest.mark.parametrize(
    ("backend", "precision", "wanted"),
    [
        ("cpu", "f32", True),
        ("cpu", "tf32", True),
        ("cpu", "bf16", True),
        ("gpu", "tf32", False),
        ("gpu", "bf16", True),
        ("tpu", "bf16", False),
    ],
)
def test_a_kernel_is_asked_for_where_there_may_be_one(
    monkeypatch, backend, precision, wanted
):
    """Elsewhere it would warn that there is none."""
    asked = []

    def fused(model, **_):
        asked.append(model.config.precision)
        return a_rollout("none")

    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jaxpets, "fused_rollout", fused)
    phase = ["--phase", "explore", "--preset", "smoke", "--allow-cpu"]
    flags = [*phase, "--planner.precision", precision]
    build(cli.parse(flags))
    assert (jaxpets.Precision(precision) in asked) is wanted
    asked.clear()
    build(cli.parse([*flags, "--planner.no-fused", "--task-planner.no-fused"]))
    assert not asked


def test_on_a_cpu_a_plan_is_that_of_the_scan():
    """What the kernel and the scan in float32 imagine differs by 1e-6."""
    if jax.default_backend() != "cpu":
        pytest.skip("the kernel of a GPU is less exact")
    flags = ["--task-planner.precision", "f32"]
    got, want = value(*flags), value(*flags, "--task-planner.no-fused")
    assert float(got) == pytest.approx(float(want), rel=1e-4)


def test_some_of_a_robots_tasks():
    robot = robots.of(Config())
    tasks = robots.chosen(Config(task="back-flip,backward"), robot)
    assert tasks.names == ("back-flip", "backward")
    for i, name in enumerate(tasks.names):
        found = jax.tree.map(lambda x, i=i: x[i], tasks.params)
        chex.assert_trees_all_equal(found, half_cheetah.task(name))
