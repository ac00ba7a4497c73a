"""Speed of HalfCheetah: MJX over batch sizes, and C MuJoCo on one core beside it.

One environment step is five steps of physics. C MuJoCo runs gymnasium's solver
settings; both run random actions, from a state that was reached by random actions.
"""

import argparse
from collections.abc import Iterator, Sequence
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
FRAME_SKIP = 5


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every batch size, then one for C MuJoCo."""
    steps = 3 if args.tiny else args.steps
    for batch in [1] if args.tiny else args.batch:
        result = time_mjx(batch, steps, args.repeats)
        yield env_row("mjx", batch, steps, result)
    yield env_row("mujoco", 1, 20 * steps, time_mujoco(20 * steps, args.repeats))


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


def time_mjx(batch: int, steps: int, repeats: int) -> timing.Timing:
    """Times `steps` steps of a batch of environments, in one program."""
    env = half_cheetah.half_cheetah()
    keys = jax.random.split(jax.random.key(0), batch)
    shape = (steps, batch, half_cheetah.ACTION_SIZE)
    actions = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1.0, 1.0)

    def roll(state: jaxpets.EnvState, actions: jax.Array) -> jaxpets.EnvState:
        def step(
            state: jaxpets.EnvState, action: jax.Array
        ) -> tuple[jaxpets.EnvState, None]:
            return jax.vmap(env.step)(state, action), None

        return jax.lax.scan(step, state, actions)[0]

    program, compile_s = timing.compile_program(
        roll, jax.vmap(env.reset)(keys), actions
    )
    state = program(jax.vmap(env.reset)(keys), actions)
    timing.seconds(lambda: program(state, actions))
    times = [timing.seconds(lambda: program(state, actions)) for _ in range(repeats)]
    return timing.summarize(times, compile_s)


def time_mujoco(steps: int, repeats: int) -> timing.Timing:
    """Times `steps` steps of one environment in C."""
    model = half_cheetah.load_model()
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, model.nu))

    def roll() -> None:
        for action in actions:
            data.ctrl[:] = action
            mujoco.mj_step(  # pyright: ignore[reportAttributeAccessIssue]
                model, data, nstep=FRAME_SKIP
            )

    timing.seconds(roll)
    return timing.summarize([timing.seconds(roll) for _ in range(repeats)])


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.add_argument(
        "--batch", nargs="+", type=rows.positive, default=[1, 4, 16, 64, 256, 4096]
    )
    parser.add_argument(
        "--steps", type=rows.positive, default=50, help="environment steps per run"
    )
    args = parser.parse_args(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
