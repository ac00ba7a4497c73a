"""Fits to compare: models of every shape, what they are shown, and how far apart."""

import dataclasses
import functools
import importlib

import jax
import numpy as np
import optax
import rollouts  # has the kernels of this folder compiled with few optimisations
import toys

import jaxpets
from jaxpets._src.fused_fitter import fitter_of_kind
from jaxpets._src.kernel.build import Kind

SOURCES, recorded = rollouts.SOURCES, rollouts.recorded
# Of which the package's own name is that of a function.
module = importlib.import_module("jaxpets._src.fused_fitter")
CAPACITY = 80


@dataclasses.dataclass(frozen=True)
class Fit:
    """A model, how it is trained, and on how many blocks."""

    hidden_sizes: tuple = (12, 10)
    obs_size: int = 3
    action_size: int = 2
    num_members: int = 2
    activation: str = "swish"
    space: jaxpets.ModelSpace = dataclasses.field(default_factory=jaxpets.delta_space)
    precision: jaxpets.Precision = jaxpets.Precision.TF32
    weight_decays: float | tuple | None = None
    bound_decay: float = 0.01
    num_epochs: int = 3  # the reference runs each in another order of blocks
    batch_size: int = 32
    final_rate: float = 1.0
    bootstrap: bool = True
    rate: float = 1e-3
    ctas: int = 4
    threads: int = 32

    def but(self, **changes):
        return dataclasses.replace(self, **changes)

    def ensemble(self):
        return jaxpets.ensemble(
            jaxpets.EnsembleConfig(
                num_members=self.num_members,
                hidden_sizes=self.hidden_sizes,
                weight_decays=self.weight_decays,
                bound_decay=self.bound_decay,
                precision=self.precision,
                activation=self.activation,
            ),
            self.space,
            obs_size=self.obs_size,
            action_size=self.action_size,
        )

    def arguments(self):
        config = jaxpets.FitConfig(
            self.num_epochs, self.batch_size, self.final_rate, self.bootstrap
        )
        return self.ensemble(), optax.adam(self.rate), config

    def plain(self):
        return jaxpets.fitter(*self.arguments())

    def fused(self):
        """As a user asks for it: with the kernel of the first device, if it has one."""
        return jaxpets.fused_fitter(*self.arguments())

    @functools.cache  # noqa: B019
    def reference(self):
        """With the kernel's source, run by fibers."""
        sizes = dict(ctas=self.ctas, threads=self.threads)
        made = fitter_of_kind(*self.arguments(), Kind.FIT_REFERENCE, **sizes)
        assert made.uses_kernel and not made.reason, made.reason
        return made

    @functools.cache  # noqa: B019
    def steps(self):
        """Of the reference and of the fitter, jitted."""
        return jax.jit(self.reference().step), jax.jit(self.plain().step)

    def layout(self):
        return module._layout(self.ensemble(), ctas=self.ctas, threads=self.threads)

    def params(self, seed=0):
        """With biases too: zeros hide where they go."""
        params = jax.jit(self.ensemble().init)(jax.random.key(seed))
        rng = np.random.default_rng(seed)

        def with_biases(x):
            x = np.asarray(x)
            noise = rng.normal(size=x.shape, scale=0.1).astype(np.float32)
            return np.where(x == 0.0, noise, x)

        members = jax.tree.map(with_biases, params.network.members)
        return params._replace(network=params.network._replace(members=members))

    def transitions(self, size, seed=0, capacity=CAPACITY):
        """What lies behind the data is NaN."""
        data = toys.transitions(capacity, self.obs_size, self.action_size, seed)

        def filled(x):
            x = np.array(x)
            x[size:] = np.nan
            return x

        return jax.tree.map(filled, data)

    def dataset(self, size, **options):
        return dataset_of(self.transitions(size, **options), size)


SMALL = Fit()


def dataset_of(data, size):
    size = np.int32(size)
    return jaxpets.typing.Dataset(data, size, size % np.int32(data.obs.shape[-2]))


def start(case, seed=0):
    """Parameters, a key, and the state of training."""
    params = case.params(seed)
    return params, jax.random.key(seed), case.plain().init(params)


def both(case, dataset, calls=1, begin=None):
    """What the reference and the fitter return, of calls in a row."""
    results = []
    for step in case.steps():
        params, key, state = begin or start(case)
        for call in range(calls):
            now = jax.random.fold_in(key, call)
            params, state, metrics = step(params, now, state, dataset)
        results.append((params, state, metrics))
    return results


# Both add up the same products of float32, in other orders, and divide and take roots
# otherwise by a unit in the last place. Adam divides by what is left, so it makes more
# of that where a gradient is small: found were 4e-6 of a leaf's largest number.
CLOSE = 1e-5
# The fitter's gradient of min_logvar is 1 - x with x near 1, and off by up to 1e-3 of
# itself: 8e-4 if compared with float64, where the kernel's is off by 2e-9.
ILL_CONDITIONED = 2e-3


def assert_same_fit(got, want, close=CLOSE):
    """Parameters, Adam's moments, counts and metrics."""
    jax.tree.map(_assert_same_aval, got, want)
    got, got_low = _without_low(got)
    want, want_low = _without_low(want)
    assert_near(got, want, close)
    assert_near(got_low, want_low, ILL_CONDITIONED)


def assert_near(got, want, close):
    """Relative to the largest number of each leaf; integers are equal."""

    def check(path, x, y):
        x, y = np.asarray(x), np.asarray(y)
        if y.dtype.kind != "f":
            np.testing.assert_array_equal(x, y, jax.tree_util.keystr(path))
            return
        scale = np.max(np.abs(y), where=np.isfinite(y), initial=0.0)
        np.testing.assert_allclose(
            x, y, rtol=0.0, atol=close * scale, err_msg=jax.tree_util.keystr(path)
        )

    jax.tree_util.tree_map_with_path(check, got, want)


def _assert_same_aval(x, y):
    assert (x.shape, x.dtype, x.weak_type) == (y.shape, y.dtype, y.weak_type)


def _without_low(result):
    """Takes Adam's moments of min_logvar out of what a fitter returns."""
    params, state, metrics = result
    adam, *rest = state.opt_state
    low = adam.mu.min_logvar, adam.nu.min_logvar
    mu, nu = (x._replace(min_logvar=()) for x in (adam.mu, adam.nu))
    return (params, (adam.count, mu, nu, *rest), metrics), low


def distance(a, b):
    """Between two networks."""
    pairs = zip(jax.tree.leaves(a.network), jax.tree.leaves(b.network), strict=True)
    squares = [np.sum((np.float64(x) - np.float64(y)) ** 2) for x, y in pairs]
    return np.sqrt(sum(squares))
