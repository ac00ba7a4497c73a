"""Speed of HalfCheetah over batch sizes: MJX beside C MuJoCo, both as an Env in jit.

One environment step is five steps of physics. All run random actions, from a state that
was reached by random actions. C MuJoCo has gymnasium's solver settings and all cores
(mujoco); a plain loop over one environment on one core, without JAX, is its floor
(mujoco-loop; rows older than the engine mujoco have it by that name).
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxpets
from benchmarks import rows, timing
from jaxpets.envs import half_cheetah

COLUMNS = ("engine", "batch", "compile_s", "min_ms", "median_ms", "ms_per_step",
           "env_steps_per_s")  # fmt: skip
ENGINES = {
    "mjx": half_cheetah.half_cheetah,
    "mujoco": half_cheetah.half_cheetah_native,
}
FRAME_SKIP = 5


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every engine and batch size, then one for the plain loop."""
    for engine, build in ENGINES.items():
        env = build()
        for batch in args.batch:
            result = timing.repeat(
                *env_call(env, batch, args.steps), repeats=args.repeats
            )
            yield env_row(engine, batch, args.steps, result)
    steps = 20 * args.steps  # so that a run of the fastest is not over at once
    result = timing.repeat(loop_call(steps), repeats=args.repeats)
    yield env_row("mujoco-loop", 1, steps, result)


def env_row(
    engine: str, batch: int, steps: int, result: timing.Timing
) -> dict[str, Any]:
    """Returns the row of one engine at one batch size."""
    per_step = result.median_ms / steps
    return rows.make_row(
        "env",
        {"engine": engine, "batch": batch, "steps": steps},
        **result._asdict(),
        ms_per_step=per_step,
        env_steps_per_s=1e3 * batch / per_step,
    )


def env_call(
    env: jaxpets.Env, batch: int, steps: int
) -> tuple[Callable[[], Any], float]:
    """Returns `steps` steps of a batch in one program, and its seconds of compiling."""
    keys = jax.random.split(jax.random.key(0), batch)
    shape = (steps, batch, half_cheetah.ACTION_SIZE)
    actions = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1.0, 1.0)

    def roll(state: jaxpets.EnvState, actions: jax.Array) -> jaxpets.EnvState:
        def step(
            state: jaxpets.EnvState, action: jax.Array
        ) -> tuple[jaxpets.EnvState, None]:
            return jax.vmap(env.step)(state, action), None

        return jax.lax.scan(step, state, actions)[0]

    start = jax.vmap(env.reset)(keys)
    program, compile_s = timing.compile_program(roll, start, actions)
    state = program(start, actions)
    return lambda: program(state, actions), compile_s


def loop_call(steps: int) -> Callable[[], None]:
    """Returns `steps` steps of one environment in C, on one core."""
    model = half_cheetah.load_model()
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    step = mujoco.mj_step  # pyright: ignore[reportAttributeAccessIssue]
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, model.nu))

    def roll() -> None:
        for action in actions:
            data.ctrl[:] = action
            step(model, data, nstep=FRAME_SKIP)

    return roll


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.add_argument(
        "--batch", nargs="+", type=rows.positive, default=[1, 4, 16, 64, 256, 4096]
    )
    parser.add_argument(
        "--steps", type=rows.positive, default=50, help="environment steps per run"
    )
    args = rows.parse(parser, argv, batch=[1], steps=3)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
