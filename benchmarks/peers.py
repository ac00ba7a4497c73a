"""Plans of TD-MPC2 and hydrax, each at its own setting, beside jaxpets' plan.

These are other amounts of work on other models: `steps` counts those of one plan, of
all candidates, through a latent model, a simulator or an ensemble's particles.
Everything runs in turn in one process. An observation, or a simulator's state, goes in
from the host, and a run ends when the action is there. Of TD-MPC2 `compile_s` is its
first call, in which torch compiles.
"""

import argparse
import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import costs, rows, timing, workloads
from jaxpets.envs import half_cheetah

COLUMNS = ("program", "engine", "precision", "num_samples", "horizon", "steps",
           "compile_s", "min_ms", "median_ms", "p99_ms")  # fmt: skip
NEEDED = {
    "tdmpc2": "--tdmpc2 needs TD-MPC2: git clone "
    "https://github.com/nicklashansen/tdmpc2 and "
    "pip install torch tensordict pyyaml ({error})",
    "hydrax": "--hydrax needs hydrax: git clone "
    "https://github.com/vincekurtz/hydrax and "
    "pip install mujoco-mjx evosax interpax ({error})",
}
WARM_UPS = 3  # torch compiles in the first, and records a CUDA graph in the second


class Program(NamedTuple):
    """Something that plans."""

    sizes: dict[str, Any]
    steps: int  # of all candidates, in one plan
    compile_s: float
    plan: Callable[[], np.ndarray]  # returns an action on the host
    peer: dict[str, Any] | None = None  # its commit, and what rows do not name


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row per program, when all have run in turn."""
    programs = [
        ours(size, engine, precision)
        for size in args.size
        for engine in args.engine
        for precision in args.precision
    ]
    # After ours: the import of hydrax replaces XLA_FLAGS, which XLA reads but once.
    for name, build in (("tdmpc2", tdmpc2), ("hydrax", hydrax)):
        if (checkout := getattr(args, name)) is not None:
            programs.append(peer(name, build, checkout))
    plans = [program.plan for program in programs]
    turns = timing.in_turn(*plans, repeats=args.repeats, warm_ups=WARM_UPS)
    for program, seconds in zip(programs, zip(*turns, strict=True), strict=True):
        result = timing.summary(seconds, program.compile_s)
        yield rows.make_row(
            "peers",
            program.sizes,
            steps=program.steps,
            peer=program.peer,
            **result._asdict(),
        )


def peer(name: str, build: Callable[[Path], Program], checkout: Path) -> Program:
    """Builds a peer, or ends with one line that says what is missing."""
    try:
        program = build(checkout)
    except ImportError as error:
        raise SystemExit(NEEDED[name].format(error=error)) from None
    return program._replace(peer={"commit": commit(checkout), **(program.peer or {})})


def commit(checkout: Path) -> str | None:
    """Returns the commit of a checkout, and not that of a repository around it."""
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "rev-parse", "HEAD"]
    try:
        return subprocess.check_output(command, text=True).strip()
    except (OSError, subprocess.CalledProcessError):  # no git, or not its folder
        return None


def ours(name: str, engine: str, precision: str) -> Program:
    """Returns jaxpets' plan on HalfCheetah, of one seed, by CEM."""
    size = workloads.named_size(name)
    planner = workloads.planner(size, precision, engine=engine)
    prepare = jax.jit(workloads.plan_inputs(size, planner))
    *inputs, obs = prepare(jax.random.key(0))
    inputs.append(np.asarray(obs))
    step, compile_s = timing.compile_program(planner.step, *inputs)
    return Program(
        {"program": f"jaxpets {name}", "engine": engine, "precision": precision,
         **dataclasses.asdict(size)},
        costs.candidates_per_action(size, "cem") * size.horizon
        * size.num_particles,
        compile_s,
        lambda: np.asarray(step(*inputs)[0].action),
    )  # fmt: skip


def tdmpc2(checkout: Path) -> Program:
    """Returns TD-MPC2's `act` with its defaults and untrained weights.

    Those are the 5M-parameter model, `torch.compile`, and on a GPU TF32. The sizes of
    observation and action are HalfCheetah's.

    Raises:
      ImportError: where it, or what it needs, is not there.
    """
    source = checkout / "tdmpc2"
    sys.path.insert(0, str(source))
    import tensordict  # pyright: ignore[reportMissingImports]
    import torch  # pyright: ignore[reportMissingImports]
    import yaml  # pyright: ignore[reportMissingModuleSource]
    from common import MODEL_SIZE  # pyright: ignore[reportMissingImports]
    from common.world_model import WorldModel  # pyright: ignore[reportMissingImports]
    from tdmpc2 import TDMPC2  # pyright: ignore[reportMissingImports]

    torch.manual_seed(0)
    torch.set_float32_matmul_precision("high")  # as in train.py
    on_gpu = jax.default_backend() == "gpu"
    device = torch.device("cuda:0" if on_gpu else "cpu")
    values = yaml.safe_load((source / "config.yaml").read_text()) | MODEL_SIZE[5]
    values |= {
        "multitask": False,
        "task_dim": 0,
        "obs_shape": {"state": (half_cheetah.OBS_SIZE,)},
        "action_dim": half_cheetah.ACTION_SIZE,
        "episode_length": 1000,
        "bin_size": (values["vmax"] - values["vmin"]) / (values["num_bins"] - 1),
    }
    config: Any = dataclasses.make_dataclass("Config", values)(**values)
    # Its constructor wants cuda:0, and makes optimizers, which no plan reads.
    agent = TDMPC2.__new__(TDMPC2)
    torch.nn.Module.__init__(agent)
    agent.cfg, agent.device = config, device
    agent.discount = agent._get_discount(config.episode_length)
    with device:
        agent.model = WorldModel(config).eval()
        mean = torch.zeros(config.horizon, config.action_dim)
    agent._prev_mean = torch.nn.Buffer(mean)
    obs = torch.zeros(half_cheetah.OBS_SIZE)

    def plan() -> np.ndarray:
        return agent.act(obs, eval_mode=True).numpy()

    names = ("num_samples", "num_elites", "num_pi_trajs", "horizon")
    return Program(
        {"program": "TD-MPC2",
         "engine": "torch.compile" if config.compile else "eager",
         "precision": "tf32" if on_gpu else "f32",
         "num_iterations": config.iterations,
         "torch_threads": torch.get_num_threads(),
         **{name: values[name] for name in names}},
        config.num_samples * config.iterations * config.horizon,
        timing.seconds(plan),
        plan,
        {"tensordict": tensordict.__version__},
    )  # fmt: skip


def hydrax(checkout: Path) -> Program:
    """Returns hydrax' planner of its example of a walker, on MJX.

    The walker has nine joints and six motors, as HalfCheetah has.

    Raises:
      ImportError: where it, or what it needs, is not there.
    """
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    sys.path.insert(0, str(checkout))
    from hydrax.algs import PredictiveSampling  # pyright: ignore[reportMissingImports]
    from hydrax.tasks.walker import Walker  # pyright: ignore[reportMissingImports]

    jax.config.update("jax_compilation_cache_dir", cache)  # its import sets one
    controller = PredictiveSampling(  # as in examples/walker.py
        Walker(),
        num_samples=128,
        noise_level=0.5,
        plan_horizon=0.6,
        spline_type="zero",
        num_knots=5,
    )
    params, state = controller.init_params(), controller.task.make_data()
    state = state.replace(qpos=np.asarray(state.qpos), qvel=np.asarray(state.qvel))

    def optimize(state: Any, params: Any) -> tuple[jax.Array, Any]:
        params, _ = controller.optimize(state, params)
        return controller.get_action(params, state.time), params

    step, compile_s = timing.compile_program(optimize, state, params)
    return Program(
        {"program": "hydrax", "engine": "mjx", "precision": "f32",
         "num_samples": controller.num_samples, "horizon": controller.ctrl_steps,
         "num_iterations": controller.iterations, "num_knots": controller.num_knots},
        controller.num_samples * controller.iterations * controller.ctrl_steps,
        compile_s,
        lambda: np.asarray(step(state, params)[0]),
    )  # fmt: skip


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.set_defaults(repeats=30)
    parser.add_argument("--tdmpc2", type=Path, metavar="CHECKOUT", help="of TD-MPC2")
    parser.add_argument("--hydrax", type=Path, metavar="CHECKOUT", help="of hydrax")
    parser.add_argument("--size", nargs="+", choices=("paper", "laptop"),
                        default=["paper"], help="of jaxpets' plans")  # fmt: skip
    parser.add_argument("--engine", nargs="+", choices=workloads.ENGINES,
                        default=["scan"], help="of jaxpets' plans")  # fmt: skip
    parser.add_argument("--precision", nargs="+", choices=workloads.PRECISIONS,
                        default=["f32"], help="of jaxpets' plans")  # fmt: skip
    args = rows.parse(parser, argv, size=["tiny"])
    if args.tdmpc2 is None and args.hydrax is None:
        parser.error("ask for --tdmpc2, --hydrax or both")
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
