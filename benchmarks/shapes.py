"""Time of one particle rollout by the kernel, for models of many shapes.

Each is compared, as operations a second, with the paper's model of four layers of 200.
With `--rollouts 10` a call makes ten, one after the other, as a plan does: what a call
costs the host is then shared.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from benchmarks import rows, timing, workloads
from experiments.cost import model_flops

COLUMNS = ("shape", "compile_s", "median_ms", "tflops_per_s", "share_of_paper")
_CHEETAH = (18, 6, (200,) * 4)


@dataclasses.dataclass(frozen=True)
class Shape:
    """A model; 500 candidates of 20 particles and 30 steps are imagined with it."""

    obs_size: int
    action_size: int
    hidden_sizes: tuple[int, ...]
    activation: str = "swish"
    num_members: int = 5
    num_particles: int = 20
    num_samples: int = 500
    horizon: int = 30


SHAPES = {
    "paper": Shape(*_CHEETAH),
    **{f"{n} x 200": Shape(18, 6, (200,) * n) for n in (1, 2, 8)},
    **{f"4 x {n}": Shape(18, 6, (n,) * 4) for n in (64, 128, 256, 320, 384, 512)},
    **{name: Shape(*_CHEETAH, name) for name in ("tanh", "relu", "gelu")},
    "1 member": Shape(*_CHEETAH, num_members=1),
    "16 members": Shape(*_CHEETAH, num_members=16, num_particles=32),
    "quadruped, 4 x 200": Shape(78, 12, (200,) * 4),
    "quadruped, 4 x 400": Shape(78, 12, (400,) * 4),
    "humanoid, 4 x 400": Shape(110, 21, (400,) * 4),
    "humanoid, 4 x 512": Shape(110, 21, (512,) * 4),
    "256 entries, 4 x 512": Shape(256, 32, (512,) * 4),
}
_TINY = {"num_samples": 4, "horizon": 2, "hidden_sizes": (8, 8)}


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every shape; the paper's is measured first."""
    paper = None
    for name in ("paper", *(x for x in args.shape if x != "paper")):
        shape = dataclasses.replace(SHAPES[name], **(_TINY if args.tiny else {}))
        rollout, inputs = _work(shape, args.precision, args.arch)
        call = _in_turn(rollout, args.rollouts)
        result = timing.measure(call, *inputs, repeats=args.repeats)
        rate = args.rollouts * _flops(shape) / result.median_ms / 1e9
        paper = paper or rate
        yield rows.make_row(
            "shapes",
            {
                "shape": name,
                **dataclasses.asdict(shape),
                "precision": args.precision,
                "rollouts": args.rollouts,
            },
            arch=rollout.arch,
            **result._asdict(),
            tflops_per_s=rate,
            share_of_paper=rate / paper,
        )


def _work(
    shape: Shape, precision: str, arch: str | None
) -> tuple[jaxpets.typing.FusedRollout, tuple[Any, ...]]:
    """Returns the rollout of a shape, and what it is called with.

    Raises:
      SystemExit: if there can be no kernel.
    """
    config = jaxpets.EnsembleConfig(
        num_members=shape.num_members,
        hidden_sizes=shape.hidden_sizes,
        precision=jaxpets.Precision(precision),
        activation=shape.activation,
    )
    sizes = {"obs_size": shape.obs_size, "action_size": shape.action_size}
    model = jaxpets.ensemble(config, jaxpets.delta_space(), **sizes)
    rollout = workloads.kernel_of(model, precision, shape.num_particles, arch)
    first, second, key = jax.random.split(jax.random.key(0), 3)
    actions = jax.random.uniform(
        second, (shape.num_samples, shape.horizon, shape.action_size), minval=-1.0
    )
    params = jax.jit(model.init)(first)
    return rollout, (params, key, jnp.zeros(shape.obs_size), actions)


def _in_turn(rollout: jaxpets.typing.FusedRollout, count: int) -> Callable[..., Array]:
    """Returns a number of rollouts as one call, each with a key of its own."""

    def call(params: Any, key: Array, obs: Array, actions: Array) -> Array:
        imagine = rollout.bind(params)  # once for all, as in a plan
        keys = jax.random.split(key, count)
        return jax.lax.map(lambda key: imagine(key, obs, actions)[0, 0, 0], keys)

    return call


def _flops(shape: Shape) -> float:
    """Returns the operations in matrix products, two per multiply-add."""
    widths = (shape.obs_size + shape.action_size, *shape.hidden_sizes)
    steps = shape.num_samples * shape.num_particles * shape.horizon
    return steps * model_flops((*widths, 2 * shape.obs_size))


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    parser = rows.parser(__doc__)
    parser.add_argument("--shape", nargs="+", choices=SHAPES, default=list(SHAPES))
    parser.add_argument("--precision", choices=workloads.PRECISIONS, default="bf16")
    parser.add_argument("--rollouts", type=rows.positive, default=1, help="of one call")
    parser.add_argument("--arch", help="as sm_90: Hopper without its own instructions")
    args = parser.parse_args(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
