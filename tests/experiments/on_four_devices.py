"""What tests/test_devices.py needs several devices for; prints what it saw as JSON.

Arguments: a folder for runs, and a run of one seed on one device.
"""

import json
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import runs
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import jaxpets
from benchmarks import scale
from experiments import acting, cli
from experiments.build import EXPLORE, build, trial_keys
from experiments.parallel import devices
from experiments.run import main

COMMUNICATION = re.compile(
    r"\b(all-gather|all-reduce|all-to-all|reduce-scatter|collective-\w+|send|recv)"
    r"(?:-start)?\("
)


def communication(jitted, *args):
    """Returns the operations of a compiled program that move data between devices."""
    return COMMUNICATION.findall(jitted.lower(*args).compile().as_text())


def acting_program(flags):
    """Returns what acting and learning of an exploration run say to other devices."""
    config = cli.parse(flags)
    parts = build(config)
    spread = devices.spread(len(config.seeds))
    actors = acting.explorers(
        parts.robot.env,
        parts.explorer,
        config.planner.horizon,
        config.chunk_length,
        spread,
    )
    keys = devices.place(spread, trial_keys(config, EXPLORE, 2), devices.SEED)
    init = jax.vmap(parts.learner.init, out_axes=jaxpets.SEED_AXES)
    state = devices.place(spread, jax.jit(init)(keys), devices.SEED)
    params = jaxpets.PlanParams(state.params, state.reward)
    begin = actors.start(params.reward, keys)
    spread_over = len(begin.env.obs.sharding.device_set)
    return spread_over, communication(actors.chunk, params, keys, begin)


def one_plan():
    """Plans for a cart over four devices, and over an axis of vmap on one."""

    def cart(dt, key, obs, action):
        velocity = obs[..., 1] + dt * action[:, 0]
        noise = 0.01 * jax.random.normal(key, obs.shape, jnp.float32)
        return noise + jnp.stack([obs[..., 0] + dt * velocity, velocity], axis=-1)

    def reach(target, obs, action, next_obs):
        return -((next_obs[..., 0] - target) ** 2)

    force, obs = jnp.ones(1), jnp.zeros(2)
    search = jaxpets.optimizers.cem(
        horizon=5, action_low=-force, action_high=force, num_samples=64, num_elites=8
    )
    rollout = jaxpets.particle_rollout(cart, num_particles=4)
    planner = jaxpets.plan(rollout, reach, jaxpets.optimizers.sharded(search, "device"))
    inputs = jaxpets.PlanParams(0.1, 1.0), jax.random.key(0), planner.init(), obs
    mesh = Mesh(np.array(jax.devices()), "device")
    step = jax.jit(
        jax.shard_map(
            planner.step, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False
        )
    )
    parts = jax.vmap(lambda _: planner.step(*inputs), axis_name="device")
    got, want = step(*inputs)[0], jax.jit(parts)(jnp.arange(4))[0]
    shards = [np.asarray(part.data) for part in got.actions.addressable_shards]
    return {
        "communication": communication(step, *inputs),
        "shards": len(shards),
        "spread": float(max(np.abs(part - shards[0]).max() for part in shards)),
        "difference": float(np.abs(got.actions - want.actions).max()),
    }


def report(out, one_seed):
    explored = ["--phase", "explore", "--preset", "smoke", "--engine", "mujoco"]
    four = [*explored, "--seeds", *map(str, runs.FOUR), "--out"]
    codes = [
        main([*four, str(out / "four")]),
        main(["--phase", "zero-shot", "--from", str(one_seed), *runs.REFIT]),
        main(["--phase", "zero-shot", "--from", str(one_seed), *runs.ACTOR]),
    ]
    spread_over, said = acting_program([*four, str(out / "four")])
    flags = ["--tiny", "--precision", "f32", "--repeats", "2", "--devices", "2", "64"]
    return {
        "codes": codes,
        "devices": len(jax.devices()),
        "acting": {"devices": spread_over, "communication": said},
        "tasks": list(devices.spread(1, 4, 1).mesh.shape.values()),
        "idle": devices.idle(devices.spread(3)),
        "plan": one_plan(),
        "benchmark": scale.main([*flags, "--json", str(out / "rows.jsonl")]),
    }


if __name__ == "__main__":
    found = report(*map(Path, sys.argv[1:]))
    print(json.dumps(found))
