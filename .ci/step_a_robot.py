"""Steps HalfCheetah once on both engines, which each extra must be able to do.

And a robot of the DeepMind Control Suite, where its extra is installed.
"""

import importlib.util

import jax

from jaxpets import envs
from jaxpets.envs import half_cheetah

for build in (half_cheetah.half_cheetah_native, half_cheetah.half_cheetah):
    env = build()
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), env.action_high)
    assert jax.numpy.isfinite(state.obs).all()
    print(f"{build.__name__}: {state.obs[half_cheetah.FORWARD_VELOCITY]:.3f} m/s")

if importlib.util.find_spec("dm_control"):
    env = envs.make("dmc/walker").env
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), env.action_high)
    assert jax.numpy.isfinite(state.obs).all()
    print("dmc/walker")
