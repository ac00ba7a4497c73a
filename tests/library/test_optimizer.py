"""What optimizer is an Adam, and with which numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxpets._src.optimizer import Adam, adam_of

few = functools.partial(settings, deadline=None, derandomize=True)


def written(low, high, digits):
    """Numbers of few digits from 10^low to 10^high, as one writes them."""
    exponents = st.integers(low, high - 1)
    digits_of = st.integers(10 ** (digits - 1), 10**digits - 1)
    return st.builds(lambda n, e: float(f"{n}e{e - digits + 1}"), digits_of, exponents)


def decay(least):
    """1 minus a number of two digits, from 10^least to a half."""
    less = written(least, 0, 2).filter(lambda x: x <= 0.5)
    return less.map(lambda x: round(1.0 - x, 6))


@few(max_examples=40)
@given(written(-6, 0, 3), decay(-2), decay(-4), written(-10, -2, 2))
@example(1e-3, 0.9, 0.999, 1e-8)
@example(1e-3, 0.0, 0.999, 1e-3)
def test_the_numbers_of_an_adam_are_found(rate, b1, b2, eps):
    """The very ones, where they are of a few digits."""
    assert adam_of(optax.adam(rate, b1, b2, eps)) == Adam(rate, b1, b2, eps)


@pytest.mark.parametrize("eps", [0.0, 1e-20])
def test_an_eps_of_nothing_is_none(eps):
    """A weight without a gradient would become 0 / 0 in a kernel."""
    assert adam_of(optax.adam(1e-3, eps=eps)) is None


@few(max_examples=25)
@given(st.floats(1e-6, 1.0))
@example(1e-3 / 3)
def test_any_rate_is_found(rate):
    """To what float32 tells, from which it is computed: twice 6e-8, and a bit."""
    found = adam_of(optax.adam(rate))
    assert found is not None and found[1:] == (0.9, 0.999, 1e-8)
    np.testing.assert_allclose(found.rate, rate, rtol=5e-7)


@few(max_examples=15)
@given(written(-16, -6, 1), written(-10, -4, 1))
def test_an_adam_with_a_root_of_eps_is_another(eps_root, eps):
    assert adam_of(optax.adam(1e-3, eps=eps, eps_root=eps_root)) is None


def with_decay(rate, decay):
    """Two parts, as Adam has, of which the second is not only a rate."""

    def update(updates, params):
        return jax.tree.map(lambda u, p: -rate * (u + decay * p), updates, params)

    return optax.chain(optax.scale_by_adam(), optax.stateless(update))


def all_but_a_bound(network):
    """A mask for the parameters of a network, and nothing else."""
    return jax.tree.map(lambda _: True, network)._replace(min_logvar=False)


# Nothing of what is no Adam with a constant rate may be taken for one.
OTHERS = {
    "adamw": optax.adamw(1e-3),
    "adamw without decay": optax.adamw(1e-3, weight_decay=0.0),
    "sgd": optax.sgd(1e-3),
    "a schedule": optax.adam(optax.cosine_decay_schedule(1e-3, 100)),
    "a schedule that is constant": optax.adam(optax.constant_schedule(1e-3)),
    "a rate in the state": optax.inject_hyperparams(optax.adam)(1e-3),
    "a chain": optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3)),
    "a chain of one": optax.chain(optax.adam(1e-3)),
    "nesterov": optax.adam(1e-3, nesterov=True),
    "nadam": optax.nadam(1e-3),
    "amsgrad": optax.amsgrad(1e-3),
    "eps_root": optax.adam(1e-3, eps_root=1e-8),
    "a small eps_root": optax.adam(1e-3, eps_root=1e-15),
    "moments of bfloat16": optax.adam(1e-3, mu_dtype=jnp.bfloat16),
    "radam": optax.radam(1e-3),
    "adamax": optax.adamax(1e-3),
    "adabelief": optax.adabelief(1e-3),
    "lion": optax.lion(1e-3),
    "decay in the second part": with_decay(1e-3, 0.1),
    "for some parameters": optax.masked(optax.adam(1e-3), all_but_a_bound),
    "NaN": optax.adam(float("nan")),
    "a rate of zero": optax.adam(0.0),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_optimizers_are_none(name):
    optimizer = OTHERS[name]
    assert adam_of(optimizer) is None
    found = []
    jax.make_jaxpr(lambda x: (found.append(adam_of(optimizer)), x)[1])(1.0)
    assert found == [None]


@pytest.mark.parametrize(
    "build",
    [
        lambda: optax.chain(optax.scale_by_adam(), optax.scale(-1e-3)),
        lambda: optax.adam(np.float32(1e-3)),
        lambda: optax.adam(jnp.float32(1e-3)),
    ],
)
def test_what_it_was_built_of_does_not_matter(build):
    assert adam_of(build()) == Adam(1e-3, 0.9, 0.999, 1e-8)


def test_inside_other_programs_it_is_found_too():
    """Jitted, mapped, differentiated; nothing of it is in their program."""
    found = []

    def program(x):
        found.append(adam_of(optax.adam(1e-3)))
        return 2.0 * x

    plain = jax.make_jaxpr(lambda x: 2.0 * x)(1.0)
    assert str(jax.make_jaxpr(program)(1.0)) == str(plain)
    jax.jit(jax.vmap(jax.grad(program)))(jnp.ones(3))
    assert found == [Adam(1e-3, 0.9, 0.999, 1e-8)] * 2


def test_a_rate_that_is_traced_is_not_found():
    found = []

    def program(rate):
        found.append(adam_of(optax.adam(rate)))
        return rate

    jax.jit(program)(1e-3)
    jax.jit(jax.vmap(program))(jnp.ones(3))
    assert found == [None, None]


@pytest.mark.parametrize("promotion", ["standard", "strict"])
def test_promotion_is_as_the_caller_set_it(promotion):
    with jax.numpy_dtype_promotion(promotion):
        assert adam_of(optax.adam(1e-3)) == Adam(1e-3, 0.9, 0.999, 1e-8)
