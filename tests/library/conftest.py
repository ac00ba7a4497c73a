"""One small model and its trainer, compiled once for a file."""

import jax
import optax
import pytest
import toys

import jaxpets
from jaxpets import FitConfig


@pytest.fixture(scope="module")
def model():
    return toys.small_ensemble()


@pytest.fixture(scope="module")
def params(model):
    return jax.jit(model.init)(jax.random.key(0))


@pytest.fixture(scope="module")
def fitter(model):
    return jaxpets.fitter(
        model, optax.adam(1e-3), FitConfig(num_epochs=3, batch_size=8)
    )


@pytest.fixture(scope="module")
def step(fitter):
    return jax.jit(fitter.step)
