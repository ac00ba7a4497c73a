"""Steps a robot once, which each extra must be able to do.

On MJX too where there is only `jaxpets[envs]`, which the others bring as well; and one
of the DeepMind Control Suite where its extra is installed.
"""

import importlib.util

import jax

from jaxpets import envs
from jaxpets.envs import half_cheetah

has_dmc = importlib.util.find_spec("dm_control") is not None
builds = [half_cheetah.half_cheetah_native]
if not has_dmc:
    builds.append(half_cheetah.half_cheetah)
for build in builds:
    env = build()
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), env.action_high)
    assert jax.numpy.isfinite(state.obs).all()
    print(f"{build.__name__}: {state.obs[half_cheetah.FORWARD_VELOCITY]:.3f} m/s")

if has_dmc:
    env = envs.make("dmc/walker").env
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), env.action_high)
    assert jax.numpy.isfinite(state.obs).all()
    print("dmc/walker")
