"""Held-out likelihood and error of our ensemble and mbrl-lib's, on the same data.

10,000 HalfCheetah transitions to train on and 2,000 of other trials to test on, the
network of PETS (5 members, 4 x 200, swish), Adam, the same number of updates.

nll_members: negative log-likelihood in nats per dimension, mean over members.
nll_mixture: that of the equal mixture of the members, over dimensions jointly, / 18.
nrmse: error of the members' mean prediction, each dimension by its target's std.
Targets are those of PETS: the velocity itself, changes of all else, raw units.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import mbrl_model, real_data, rows

COLUMNS = ("model", "seed", "updates", "nll_members", "nll_mixture", "nrmse",
           "us_per_update", "ratio")  # fmt: skip


def scores(mean: np.ndarray, variance: np.ndarray, target: np.ndarray) -> dict:
    """Scores Gaussian members.

    Args:
      mean: `[E, B, D]`, of the target.
      variance: `[E, B, D]`.
      target: `[B, D]`.

    Returns:
      nll_members, nll_mixture and nrmse, as the module's docstring has them.
    """
    mean, variance, target = (np.asarray(x, float) for x in (mean, variance, target))
    square = (target - mean) ** 2 / variance
    log_prob = -0.5 * (square + np.log(2 * np.pi * variance))
    mixture = np.logaddexp.reduce(log_prob.sum(-1), axis=0) - np.log(len(mean))
    error = (mean.mean(0) - target) / target.std(0)
    return {
        "nll_members": float(-log_prob.mean()),
        "nll_mixture": float(-mixture.mean() / target.shape[-1]),
        "nrmse": float(np.sqrt(np.mean(error**2))),
    }


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row per model and seed, then one for the speed of both if both ran."""
    data = get_data(args)
    updates = args.epochs * -(-len(data.train["obs"]) // args.batch_size)
    target = real_data.targets(data.test)

    def row(name: str, seed: int, mean: np.ndarray, variance: np.ndarray) -> dict:
        return rows.make_row(
            "model_quality",
            {**sizes(args, data), "model": name, "seed": seed, "updates": updates},
            **scores(mean, variance, target),
        )

    for seed in args.seeds:
        if args.ours:
            yield row("jaxpets", seed, *train_ours(args, data, seed))
        for name in args.mbrl or ():
            model = build_mbrl(args, data, name, seed)
            mbrl_model.train(model, args.epochs)
            prediction = mbrl_model.predict(model, data.test)
            yield row(f"mbrl-lib {name}", seed, *prediction)
    if args.ours and args.mbrl:
        yield compare_speed(args, data)


def sizes(args: argparse.Namespace, data: real_data.Split) -> dict[str, Any]:
    """Returns the sizes that all rows share."""
    return {
        "train_rows": len(data.train["obs"]),
        "test_rows": len(data.test["obs"]),
        "batch_size": args.batch_size,
        "epochs": args.epochs,
        "num_members": 5,
        "hidden_sizes": [args.hidden] * 4,
    }


def get_data(args: argparse.Namespace) -> real_data.Split:
    """Reads the data, or collects it and writes it for the next time."""
    if args.data is not None:
        with rows.refused(OSError, ValueError, argparse.ArgumentTypeError):
            if args.data.exists():
                return real_data.load(args.data)
            rows.appendable(str(args.data))  # before it is collected, for minutes
    data = real_data.collect(*((300, 100) if args.tiny else (10_000, 2_000)))
    if args.data is not None:
        real_data.save(data, args.data)
    return data


def build_ours(args: argparse.Namespace, num_epochs: int) -> tuple[Any, Any]:
    """Returns our ensemble and its fitter."""
    import optax

    import jaxpets
    from jaxpets.envs import half_cheetah

    model = jaxpets.ensemble(
        jaxpets.EnsembleConfig(hidden_sizes=(args.hidden,) * 4),
        half_cheetah.model_space(),
        obs_size=half_cheetah.OBS_SIZE,
        action_size=half_cheetah.ACTION_SIZE,
    )
    config = jaxpets.FitConfig(num_epochs=num_epochs, batch_size=args.batch_size)
    return model, jaxpets.fitter(model, optax.adam(1e-3), config)


def as_dataset(arrays: real_data.Arrays) -> Any:
    """Returns the arrays as a full Dataset of jaxpets."""
    import jax.numpy as jnp

    import jaxpets

    data = jaxpets.Transition(**{k: jnp.asarray(v) for k, v in arrays.items()})
    capacity, obs_size = data.obs.shape
    empty = jaxpets.datasets.init(capacity, obs_size, data.action.shape[1])
    return jaxpets.datasets.append(empty, data)


def train_ours(
    args: argparse.Namespace, data: real_data.Split, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Trains our ensemble; returns mean and variance `[E, B, D]` of the targets."""
    import jax
    import jax.numpy as jnp

    from jaxpets.envs import half_cheetah

    model, fitter = build_ours(args, args.epochs)
    init_key, fit_key = jax.random.split(jax.random.key(seed))
    params = model.init(init_key)
    step = jax.jit(fitter.step)
    params, _, _ = step(params, fit_key, fitter.init(params), as_dataset(data.train))
    obs = jnp.asarray(data.test["obs"])
    members = jnp.broadcast_to(obs, (5, *obs.shape))
    mean, variance = model.predict(params, members, jnp.asarray(data.test["action"]))
    target = half_cheetah.model_space().target(obs, mean)
    return np.asarray(target), np.asarray(variance)


def build_mbrl(
    args: argparse.Namespace, data: real_data.Split, name: str, seed: int
) -> mbrl_model.Model:
    """Builds mbrl-lib's model, or ends with one line that says what is missing."""
    variant = mbrl_model.VARIANTS[name]
    try:
        return mbrl_model.build(data.train, variant, seed, args.batch_size, args.hidden)
    except ModuleNotFoundError as error:
        raise SystemExit(mbrl_model.NEEDED.format(error=error)) from None


def compare_speed(args: argparse.Namespace, data: real_data.Split) -> dict[str, Any]:
    """Times an epoch of each in turn, in this process; ratio is mbrl-lib / ours."""
    import jax

    from benchmarks import timing

    model, fitter = build_ours(args, num_epochs=1)
    params = model.init(jax.random.key(0))
    dataset = as_dataset(data.train)
    inputs = (params, jax.random.key(1), fitter.init(params), dataset)
    step, _ = timing.compile_program(fitter.step, *inputs)
    theirs = build_mbrl(args, data, args.mbrl[0], 0)
    result = timing.compare(
        lambda: mbrl_model.train(theirs, 1), lambda: step(*inputs), repeats=args.repeats
    )
    updates = -(-len(data.train["obs"]) // args.batch_size)
    return rows.make_row(
        "model_quality",
        {**sizes(args, data), "model": "mbrl-lib / jaxpets", "updates": updates},
        us_per_update=1e3 * result.second_ms / updates,
        us_per_update_mbrl=1e3 * result.first_ms / updates,
        ratio=result.ratio,
        ratio_of_min=result.ratio_of_min,
        repeats=result.repeats,
    )


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Returns the flags; at least one model must be asked for."""
    parser = rows.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.set_defaults(repeats=5)
    parser.add_argument("--ours", action="store_true", help="train our ensemble")
    parser.add_argument(
        "--mbrl",
        nargs="*",
        choices=list(mbrl_model.VARIANTS),
        help="train mbrl-lib's: our optimizer and bounds (matched, the default), "
        "fixed log-variance bounds, or the settings it ships for HalfCheetah",
    )
    parser.add_argument("--data", type=Path, help=".npz to read; made if not there")
    parser.add_argument(
        "--seeds", nargs="*", type=int, default=[0, 1, 2], help="none: only speed"
    )
    parser.add_argument("--epochs", type=rows.positive, default=20)
    parser.add_argument("--batch-size", type=rows.positive, default=32)
    args = parser.parse_args(argv)
    if args.mbrl is not None:
        args.mbrl = args.mbrl or ["matched"]
    if not args.ours and not args.mbrl:
        parser.error("ask for --ours, --mbrl or both")
    args.hidden = 16 if args.tiny else 200
    return args


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the flags, measures and reports."""
    args = parse(argv)
    return rows.report(run(args), COLUMNS, args.json)


if __name__ == "__main__":
    main()
