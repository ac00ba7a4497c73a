# %% [markdown]
# # A world of your own, explored without a reward, then told what to do
#
# A pendulum whose motor is too weak to lift it at once. Five networks learn how it
# moves, while a planner seeks states about which they disagree. Then rewards are typed
# as text. It takes two minutes on two cores; as a script it is `python
# examples/tour.py`. `jupytext --to ipynb` makes the notebook, which wants a wheel of
# jaxpets beside it:

# %%
# %pip install --quiet jaxpets-*.whl matplotlib

# %%
import functools
import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import optax
from matplotlib.animation import FuncAnimation

import jaxpets
from jaxpets import coordinates, datasets, formulas, rewards

num_trials, num_steps = (2, 10) if "--tiny" in sys.argv else (10, 100)
plt.rcParams |= {"animation.html": "jshtml", "figure.constrained_layout.use": True}

# %% [markdown]
# ## The world
# Two functions, and a name for each entry of what is observed. Of an angle the model
# reads sine and cosine, and predicts the change.

# %%
ANGLE = coordinates.Coordinate("angle", kind="angle", is_bounded=False)  # rad
ROWS = (ANGLE, coordinates.Coordinate("speed"))  # rad/s
TORQUE, DT = jnp.full(1, 2.0), 0.1  # N m, s


def reset(key):
    """Starts a trial at rest, within a hundredth of a radian of hanging."""
    return jaxpets.EnvState(0.01 * jax.random.normal(key, (2,)), physics=())


def step(state, torque):
    """Turns a pendulum of 1 kg and 1 m by one step."""
    angle, speed = state.obs
    speed = jnp.clip(speed + DT * (torque[0] - 9.81 * jnp.sin(angle)), -8.0, 8.0)
    return jaxpets.EnvState(jnp.stack([angle + DT * speed, speed]), physics=())


env = jaxpets.Env(reset, step, -TORQUE, TORQUE, ROWS)

# %% [markdown]
# ## The model, and how it explores

# %%
config = jaxpets.EnsembleConfig(hidden_sizes=(64, 64))
model = jaxpets.ensemble(config, coordinates.space(ROWS), obs_size=2, action_size=1)
fitter = jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig(num_epochs=20))
rollout = jaxpets.particle_rollout(model.sample, num_members=5, num_particles=10)
search = jaxpets.optimizers.icem(horizon=20, action_low=-TORQUE, action_high=TORQUE)
explorer = jaxpets.plan(rollout, rewards.epistemic, search)
unit = jaxpets.RewardData(refresh=lambda _, __, data: datasets.obs_variance(data))
size = {"trial_length": num_steps, "capacity": num_trials * num_steps}
learner = jaxpets.learner(env, model, fitter, unit, **size)

# %%
trial, state = jax.jit(learner.step, static_argnums=0), learner.init(jax.random.key(0))
planner, history = jaxpets.random_planner(-TORQUE, TORQUE), []
for number in range(num_trials):
    state, out = trial(planner, jax.random.key(number), state)
    history.append(state)
    print(f"trial {number + 1:2}: model's error {out.fit.mse:.5f}")
    planner = explorer

# %% [markdown]
# ## What the networks do not know
# Their disagreement about an idle step from every state, and the states seen so far.

# %%
angle, speed = jnp.meshgrid(jnp.linspace(-jnp.pi, jnp.pi, 61), jnp.linspace(-8, 8, 41))
grid = jnp.stack([angle.ravel(), speed.ravel()], axis=-1)


@jax.jit
def disagreement(state):
    """Returns the reward that explores, of an idle step from each state of `grid`."""
    shown, idle = jnp.stack([grid] * 5), jnp.zeros((len(grid), 1))
    mean, _ = model.predict(state.params, shown, idle)  # [E, B, D]
    reward = functools.partial(rewards.epistemic, state.reward, grid, idle)
    return jax.vmap(reward, in_axes=1)(mean[:, :, None])  # of [E, P, D] each


figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), sharey=True)
for axis, then, name in zip(axes, (history[0], state), ("first", "last"), strict=True):
    values = jnp.log10(disagreement(then)).reshape(angle.shape)
    image = axis.pcolormesh(angle, speed, values, vmin=-3, vmax=0)
    turned, fast = then.dataset.data.next_obs[: int(then.dataset.size)].T
    axis.plot((turned + jnp.pi) % (2 * jnp.pi) - jnp.pi, fast, "w.", markersize=1)
    axis.set(title=f"after the {name} trial", xlabel="angle [rad]", ylabel="[rad/s]")
figure.colorbar(image, label="log10 of disagreement")
figure.savefig("disagreement.png")

# %% [markdown]
# ## Type a reward
# A line of text over the names of the entries: stand, spin, swing up to the horizontal.
# It is data, so the planner is compiled once for all. Type lines of your own.

# %%
LINES = ("-cos(angle)", "abs(speed)", "-abs(speed**2 / 2 - 9.81 * cos(angle))")
actor = jaxpets.plan(rollout, formulas.reward, search)
perform = jax.jit(functools.partial(jaxpets.unroll, env, actor, length=num_steps))
paths = []
for line in LINES:
    formula = formulas.parse(line, formulas.names(ROWS), action_size=1)
    start = jaxpets.start_trial(env, actor, jax.random.key(0))
    known = jaxpets.PlanParams(state.params, formula)
    _, done, _ = perform(known, jax.random.key(1), start)
    print(f"{rewards.score(formulas.reward, formula, done).mean():6.2f} for {line}")
    paths.append(done.next_obs[:, 0])

# %%
figure, axes = plt.subplots(1, len(LINES), figsize=(9, 3.2))
rods = [axis.plot([], [], "o-", linewidth=4)[0] for axis in axes]
for axis, line in zip(axes, LINES, strict=True):
    axis.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", xticks=(), yticks=())
    axis.set_title(line, fontsize="small")


def draw(number):
    """Draws the pendulums at a step."""
    for rod, path in zip(rods, paths, strict=True):
        rod.set_data([0, jnp.sin(path[number])], [0, -jnp.cos(path[number])])


film = FuncAnimation(figure, draw, frames=num_steps, interval=1000 * DT)
film.save("pendulum.gif", writer="pillow")
plt.close(figure)
film  # pyright: ignore[reportUnusedExpression]
