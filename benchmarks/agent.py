"""`act` of `jaxpets.agent`, and the plan alone in one's own loop, awaited, in turn.

The plan alone is one compiled call whose action comes to the host, through `memory`: on
a GPU the program writes it to the host's pinned memory. `act` checks the observation
besides, and keeps what it did for `observe`; on a GPU it does not wait for XLA to say
that an action has come. The loop gives the memory of the planner's state away for the
next one, and so does `act` on a GPU. `added_ms` is the median of the differences, pair
by pair. `copied_ms` is that of the plan alone whose action is copied from the device,
which is how rows without `memory` have `plan_ms`. Rows without `reward` explored, and
kept the state. With `--means` no noise is drawn, as by `--task-planner.means` of the
experiments.

With `--policy` it is a step of a distilled policy instead, which needs no plan: by
onnxruntime on one thread, whose arrays come with every call or are `bound` once and
then read and written where they are, in turn, and then by JAX.
"""

import argparse
import dataclasses
import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
import optax
from jax.sharding import SingleDeviceSharding

import jaxpets
from benchmarks import rows, timing, workloads
from jaxpets import models, policies
from jaxpets.envs import half_cheetah

COLUMNS = ("added_ms", "act_ms", "act_p99_ms", "plan_ms", "plan_p99_ms", "copied_ms",
           "copied_p99_ms", "memory", "size", "engine")  # fmt: skip
OF_POLICY = ("bound_us", "bound_min_us", "bound_p99_us", "onnx_us", "onnx_min_us",
             "onnx_p99_us", "jax_us", "jax_min_us", "jax_p99_us",
             "hidden_size")  # fmt: skip
OF_SIZE = ("num_samples", "horizon")  # that may be chosen, too
Call = Callable[[], np.ndarray]


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields one row."""
    size = workloads.chosen_size(args, *OF_SIZE)
    planner = workloads.planner(
        size, args.precision, args.optimizer, args.reward, engine=args.engine
    )
    if args.means:
        planner = models.by_means(planner)
    # `act` returns before its program has ended, whose rest is not the next call's.
    nothing = jax.jit(lambda: jax.numpy.zeros(()))
    turns = timing.in_turn(
        *calls(size, planner, args.reward),
        repeats=args.repeats,
        between=lambda: nothing().block_until_ready(),
    )
    acts, plans, copied = 1e3 * np.asarray(turns).T
    yield rows.make_row(
        "agent",
        {
            **dataclasses.asdict(size),
            "size": args.size,
            "precision": args.precision,
            "engine": args.engine,
            "optimizer": args.optimizer,
            "reward": args.reward,
            "means": args.means,
        },
        arch=workloads.arch(size, args.precision, args.engine),
        awaited=True,
        memory=memory(),
        added_ms=float(np.median(acts - plans)),
        act_ms=float(np.median(acts)),
        act_p99_ms=float(np.percentile(acts, 99)),
        plan_ms=float(np.median(plans)),
        plan_p99_ms=float(np.percentile(plans, 99)),
        copied_ms=float(np.median(copied)),
        copied_p99_ms=float(np.percentile(copied, 99)),
        repeats=args.repeats,
    )


def memory() -> str:
    """Returns the kind of memory through which an action comes soonest."""
    device = jax.devices()[0]
    kinds = {one.kind for one in device.addressable_memories()}
    is_alone = jax.local_device_count() == 1
    if device.platform == "gpu" and is_alone and "pinned_host" in kinds:
        return "pinned_host"
    return device.default_memory().kind


def calls(
    size: workloads.Size, planner: jaxpets.Planner, reward: str
) -> tuple[Call, Call, Call]:
    """Returns `act` of an agent, its plan alone, and that with a copied action."""
    key = jax.random.key(0)
    params = jax.jit(lambda: workloads.plan_params(size, key, reward))()
    one = np.ones(half_cheetah.ACTION_SIZE, np.float32)
    agent = jaxpets.agent(
        planner,
        workloads.model(size, "f32"),
        workloads.fitter(size),
        random_planner=jaxpets.random_planner(-one, one),
        capacity=1000,
        params=params.dynamics,
    )
    agent.perform(params.reward)
    obs = np.asarray(workloads.transitions(key, 1).obs[0])
    here, copied = SingleDeviceSharding(jax.devices()[0]), jax.jit(planner.step)
    first = planner.init()
    state = jax.device_put(jax.tree.map(jax.numpy.copy, first), here)

    def act(*given: Any) -> tuple[jax.Array, Any]:
        output, state = planner.step(*given)
        return output.action, state

    places = here.with_memory_kind(memory()), here
    step = jax.jit(act, donate_argnums=2, out_shardings=places)

    def loop() -> np.ndarray:
        nonlocal state
        action, state = step(params, key, state, obs)
        return np.asarray(action)

    return (
        lambda: agent.act(obs),
        loop,
        lambda: np.asarray(copied(params, key, first, obs)[0].action),
    )


def policy(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields one row of a policy of HalfCheetah's tasks, at the width of its config."""
    size = 8 if args.tiny else policies.DistillConfig().hidden_size
    found: dict[str, float] = {}
    steps = policy_calls(size)
    for names in (("onnx", "bound"), ("jax",)):
        turns = timing.in_turn(*(steps[x] for x in names), repeats=args.repeats)
        for name, seconds in zip(names, zip(*turns, strict=True), strict=True):
            times = timing.summary(seconds, 0.0)
            found |= {
                f"{name}_us": 1e3 * times.median_ms,
                f"{name}_min_us": 1e3 * times.min_ms,
                f"{name}_p99_us": 1e3 * times.p99_ms,
            }
    yield rows.make_row(
        "agent policy", {"hidden_size": size}, **found, repeats=args.repeats
    )


def policy_calls(hidden_size: int) -> dict[str, Call]:
    """Returns a step of a policy: by onnxruntime, by that with bound arrays, by JAX."""
    onnxruntime = importlib.import_module("onnxruntime")
    one = np.ones(half_cheetah.ACTION_SIZE, np.float32)
    box: Any = {"action_low": -one, "action_high": one}
    task, key = half_cheetah.task("forward"), jax.random.key(0)
    space = half_cheetah.model_space()
    learner = policies.actor_critic(
        lambda params, key, obs, action: obs,
        half_cheetah.task_reward,
        optax.adam(1e-3),
        policies.ActorCriticConfig(hidden_size=hidden_size),
        space,
        obs_size=half_cheetah.OBS_SIZE,
        goals=policies.Goals(features=jax.numpy.stack),
        **box,
    )
    dataset = workloads.dataset(key, 100, 100)
    params = learner.init(jaxpets.PlanParams((), task), key, dataset).params
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        policies.to_onnx(params, space, obs_size=half_cheetah.OBS_SIZE, **box), options
    )
    obs = np.asarray(dataset.data.obs[0])
    given = {"obs": obs[None].copy(), "task": np.stack(task)[None]}
    binding, action = session.io_binding(), one[None].copy()
    for name, array in given.items():
        binding.bind_cpu_input(name, array)
    place = action.shape, action.ctypes.data
    binding.bind_output("action", "cpu", 0, np.float32, *place)

    def bound() -> np.ndarray:
        given["obs"][0] = obs
        session.run_with_iobinding(binding)
        return action

    step = jax.jit(learner.policy.step)
    known = jaxpets.PlanParams((), policies.Guided(task, params))
    return {
        "onnx": lambda: session.run(["action"], given)[0],
        "bound": bound,
        "jax": lambda: np.asarray(step(known, key, (), obs)[0].action),
    }


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    workloads.add_size_flag(parser, *OF_SIZE)
    parser.add_argument(
        "--optimizer", choices=workloads.OPTIMIZERS, default="icem", help="search"
    )
    parser.add_argument(
        "--engine", choices=workloads.ENGINES, default="kernel", help="what imagines"
    )
    parser.add_argument(
        "--precision", choices=workloads.PRECISIONS, default="f32", help="of the model"
    )
    parser.set_defaults(size="laptop", repeats=1000)
    parser.add_argument("--reward", choices=workloads.REWARDS, default="task")
    parser.add_argument("--means", action="store_true", help="draw no noise")
    parser.add_argument("--policy", action="store_true", help="a policy, not a plan")
    args = rows.parse(parser, argv, size="tiny")
    if args.policy:
        plans = vars(args).keys() - {"policy", "json", "repeats", "tiny"}
        if others := [x for x in plans if getattr(args, x) != parser.get_default(x)]:
            flags = ", ".join(f"--{x.replace('_', '-')}" for x in sorted(others))
            parser.error(f"--policy has no plan that could have {flags}")
        return rows.report(policy(args), OF_POLICY, args.json)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
