"""Rollouts to compare: models of every kind, what they are given, and the engines."""

import dataclasses
import functools
import warnings
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

import jaxpets
from jaxpets import Precision, coordinates
from jaxpets._src.fused_rollout import rollout_of_kind
from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import Kernel, Kind
from jaxpets.envs import half_cheetah as hc
from jaxpets.envs.observations import readings

SOURCES = Path(build.__file__).parent
_real = build._compiler


def _plain_compiler(kind, arch=""):
    """Optimises little, as these kernels run once: it saves half of the time.

    Runs of the experiments, in processes of their own, have kernels as a user has.
    """
    command = _real(kind, arch)
    return command if kind.is_for_gpu else [*command, "-O1"]


# In every process that imports this: all of them are to build the same kernels.
build._compiler = _plain_compiler


def _features(obs):
    angle, rate = obs[..., :1], obs[..., 1]
    parts = [
        jnp.sin(angle),
        jnp.cos(angle),
        jnp.tanh(obs[..., jnp.array([2, 0])]),
        jnp.exp(-(obs[..., -1:] ** 2)),
        jnp.where(rate > 0.0, rate, 0.1 * rate)[..., None] / 2.0,
        jnp.mean(obs, axis=-1, keepdims=True),
        jnp.max(obs, axis=-1, keepdims=True) - jnp.min(obs, axis=-1, keepdims=True),
        jnp.clip(obs[..., ::-1], -1.0, 1.0),
        jnp.linalg.norm(obs, axis=-1, keepdims=True),
        jax.nn.softplus(obs[..., 1:3]),
    ]
    return jnp.concatenate(parts, axis=-1)


WEIGHT = np.array([1.0, 0.5, 1.0, 2.0], np.float32)
# Everything a kernel's coordinates may do; features are 15.
RICH = jaxpets.ModelSpace(
    features=_features,
    target=lambda obs, next_obs: (next_obs - WEIGHT * obs) / 0.5,
    next_obs=lambda obs, target: WEIGHT * obs + target * 0.5,
    bound=lambda obs, low, high: jnp.where(WEIGHT > 0.7, jnp.clip(obs, low, high), obs),
)


def _observed(*names):
    """The space of what is observed of a body that is free, has joints and sensors."""
    model = robots.compiled(robots.FREE, robots.SENSORS + robots.HIP)
    return coordinates.space([row.coordinate for row in readings(model, names)])


@dataclasses.dataclass(frozen=True)
class Case:
    """A model, and how much of it to imagine."""

    obs_size: int = 3
    action_size: int = 2
    hidden_sizes: tuple = (16, 24)
    num_members: int = 3
    particles: int = 2  # of one member
    num_samples: int = 4
    horizon: int = 5
    state_margin: float | None = 0.5
    activation: str = "swish"
    space: jaxpets.ModelSpace = dataclasses.field(default_factory=jaxpets.delta_space)

    def config(self, precision=Precision.BF16):
        return jaxpets.EnsembleConfig(
            num_members=self.num_members,
            hidden_sizes=self.hidden_sizes,
            precision=precision,
            state_margin=self.state_margin,
            activation=self.activation,
        )

    def model(self, precision=Precision.F32):
        return jaxpets.ensemble(
            self.config(precision),
            self.space,
            obs_size=self.obs_size,
            action_size=self.action_size,
        )

    def scan(self, precision=Precision.F32):
        return jaxpets.particle_rollout(
            self.model(precision).sample,
            num_members=self.num_members,
            num_particles=self.num_members * self.particles,
        )

    def fused(self, precision=Precision.BF16):
        """With the kernel of the first device, as a user has it."""
        return jaxpets.fused_rollout(
            self.model(precision), num_particles=self.num_members * self.particles
        )

    def of_kind(self, kind, precision=Precision.BF16):
        """With this kind of kernel."""
        num_particles = self.num_members * self.particles
        return rollout_of_kind(self.model(precision), num_particles, kind)

    @functools.cache  # noqa: B019
    def args(self):
        """Params, a key, a start and actions; of NumPy, for nothing to compile."""
        rng = np.random.default_rng(0)

        def drawn(shape):
            # As wide as `init` has it; but biases too, since zeros hide where they go.
            std = 0.5 * shape[-2] ** -0.5
            return rng.normal(size=shape, scale=std).astype(np.float32)

        params = jax.eval_shape(self.model().init, jax.random.key(0))
        members = jax.tree.map(lambda x: drawn(x.shape), params.network.members)
        lowest, highest = drawn((1, self.obs_size))[0] - 6, drawn((1, self.obs_size))[0]
        mean = drawn((1, params.scaler.mean.size))[0]
        low, high = (sign + drawn((4, self.obs_size))[0] for sign in (-3, 3))
        scaler = type(params.scaler)(mean, 1 + abs(mean), low, high)
        params = type(params)(type(params.network)(members, lowest, highest), scaler)
        shape = (self.num_samples, self.horizon, self.action_size)
        actions = rng.uniform(-1, 1, shape).astype(np.float32)
        obs = drawn((1, self.obs_size))[0]
        return params, jax.random.key(1), obs, actions

    def avals(self):
        """Shapes and types of the arguments, which may be too large to draw."""
        return jax.eval_shape(lambda: type(self).args.__wrapped__(self))


SMALL = Case()
CHEETAH = Case(18, 6, (40, 36, 64), num_members=5, particles=4, space=hc.model_space())
CASES = {
    "small": SMALL,
    "least": Case(obs_size=1, action_size=1, hidden_sizes=(1,)),
    "one of all": dataclasses.replace(
        SMALL, num_members=1, particles=1, num_samples=1, horizon=1
    ),
    # One for each kind of space, and each with another width of the head.
    "half_cheetah": CHEETAH,  # planar: slides and hinges
    "free joint": Case(  # without a bound
        obs_size=13,
        hidden_sizes=(33, 16),
        state_margin=None,
        space=_observed("qpos/root", "qvel/root"),
    ),
    "ball joint": Case(
        obs_size=7,
        action_size=1,
        hidden_sizes=(16, 16, 16),
        space=_observed("qpos/shoulder", "qvel/shoulder"),
    ),
    "sensors": Case(  # of all kinds, and where sites are
        obs_size=16,
        action_size=3,
        hidden_sizes=(64,),
        space=_observed("sensordata", "site_xpos", "qvel/hip"),
    ),
    "rich": Case(obs_size=4, space=RICH),
    "tanh": dataclasses.replace(SMALL, activation="tanh"),
    "relu": dataclasses.replace(SMALL, activation="relu"),
    "gelu": dataclasses.replace(SMALL, activation="gelu"),
}


def put(array, index, value):
    """A copy with other entries."""
    array = np.array(array)
    array[index] = value
    return array


def unbounded(params):
    """Parameters before there are data: the range of what is imagined is infinite."""
    scaler = params.scaler
    free = scaler._replace(low=scaler.low - np.inf, high=scaler.high + np.inf)
    return params._replace(scaler=free)


def relative_error(got, want):
    """Of all moves, relative to all moves: the start is the same."""
    assert got.shape == want.shape and got.dtype == want.dtype == jnp.float32
    got, want = np.float64(got), np.float64(want)
    return np.linalg.norm(got - want) / np.linalg.norm(want - want[..., :1, :, :, :])


@dataclasses.dataclass(frozen=True)
class Engine:
    """A way to compute the kernel's rollout on this machine.

    Attributes:
      kind: of kernel.
      rounding: the most relative error, against the scan in float32.
    """

    kind: Kind
    rounding: float

    @functools.cache  # noqa: B019
    def fused(self, case):
        fused = case.of_kind(self.kind)
        assert fused.uses_kernel, fused.reason
        return fused

    @functools.cache  # noqa: B019
    def run(self, case):
        return jax.jit(self.fused(case))


# The GPU's kernel multiplies float16 numbers, the scan float32 ones: every layer
# rounds its inputs and weights by up to 2^-12 of themselves. Errors of many terms
# cancel; those of H steps add up, but so do the moves they are compared with.
REFERENCE = Engine(Kind.WGMMA_REFERENCE, 2e-4)
# The CPU's kernel differs from the scan by the order of its sums, and by functions that
# are right to two units in the last place, 1e-7: measured 5e-8 to 2e-7 in all.
CPU = Engine(Kind.CPU, 1e-6)
needs_cpu = pytest.mark.skipif(
    jax.devices()[0].platform != "cpu", reason="the kernel is that of the first device"
)
ENGINES = [
    pytest.param(REFERENCE, id="reference"),
    pytest.param(CPU, id="cpu", marks=needs_cpu),
]


@functools.cache
def scan(case):
    return jax.jit(case.scan())


def pretend(monkeypatch, platform="gpu", **attributes):
    """Makes JAX's only device one of another kind."""
    device = SimpleNamespace(platform=platform, **attributes)
    monkeypatch.setattr(jax, "devices", lambda: [device])


def kernels_of(monkeypatch, module):
    """Builds no kernels; returns those asked for: model, kind, and for which GPU."""
    seen = []

    def load_kernel(model, kind, arch):
        seen.append((model, kind, arch))
        return Kernel("target", "nvcc 13.0")

    monkeypatch.setattr(module, "load_kernel", load_kernel)
    return seen


def recorded(call):
    """What is returned, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return call(), caught


# Mapped: p is for params, k for the key, o for obs, a for actions.

LETTERS = "pkoa"
SIZES = (2, 3, 2, 3)  # of the mapped axes, from outside


def stacked(case, levels):
    """Arguments with an axis in front for every level that maps them, and `in_axes`."""
    args = []
    for letter, arg in zip(LETTERS, case.args(), strict=True):
        shape = tuple(
            size for size, level in zip(SIZES, levels, strict=False) if letter in level
        )
        if letter == "k":
            args.append(jax.random.split(arg, shape) if shape else arg)
            continue
        factors = 1 - 0.1 * np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
        args.append(jax.tree.map(functools.partial(np.multiply.outer, factors), arg))
    axes = [
        tuple(0 if letter in level else None for letter in LETTERS) for level in levels
    ]
    return args, axes
