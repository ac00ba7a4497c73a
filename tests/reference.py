"""Independent NumPy transcriptions (float64) of what the library computes.

Written from the papers and the published hyper-parameters, not from the JAX code:
PETS (Chua et al. 2018), iCEM (Pinneri et al. 2020), #Exploration (Tang et al. 2017) and
"Unsupervised Exploration with Deep Model-Based RL". Loops are explicit on purpose.
"""

import math

import numpy as np

# -- Cross-entropy method ------------------------------------------------------------


def constrained_variance(mean, variance, low, high):
    """Variance whose two standard deviations stay inside the box."""
    to_low = ((mean - low) / 2.0) ** 2
    to_high = ((high - mean) / 2.0) ** 2
    return np.minimum(variance, np.minimum(to_low, to_high))


def initial_variance(low, high):
    """(ub - lb)^2 / 16: two standard deviations reach the bounds from the middle."""
    return (high - low) ** 2 / 16.0


def cem_update(mean, variance, samples, values, num_elites, momentum, *, legacy=False):
    """One refit of the search distribution on the elites."""
    order = sorted(range(len(values)), key=lambda i: -values[i])
    elites = np.stack([np.float64(samples[i]) for i in order[:num_elites]])
    elite_mean = elites.sum(axis=0) / num_elites
    elite_variance = ((elites - elite_mean) ** 2).sum(axis=0) / num_elites
    new_mean = momentum * mean + (1.0 - momentum) * elite_mean
    # The code of 2018 mixed the new variance with itself.
    old = elite_variance if legacy else variance
    new_variance = momentum * old + (1.0 - momentum) * elite_variance
    return new_mean, new_variance


def shift(mean, fill):
    """Warm start: the plan moved by one step, its last step filled."""
    return np.concatenate([mean[1:], np.broadcast_to(fill, mean[:1].shape)])


def mppi_update(samples, values, temperature):
    """Mean under exponential weights of the values."""
    weights = np.exp((np.float64(values) - np.max(values)) / temperature)
    weights /= weights.sum()
    return np.einsum("n,n...->...", weights, np.float64(samples))


# -- Coloured noise ------------------------------------------------------------------


def spectrum_slope(noise):
    """Slope of log power against log frequency along the last axis, 0 left out.

    Noise of colour beta has power spectral density f^-beta, so the slope is -beta.
    """
    length = noise.shape[-1]
    spectrum = np.abs(np.fft.rfft(np.float64(noise), axis=-1)) ** 2
    power = spectrum.reshape(-1, spectrum.shape[-1]).mean(axis=0)
    frequency = np.fft.rfftfreq(length)
    inner = slice(1, (length - 1) // 2 + 1)  # neither the mean nor Nyquist
    return np.polyfit(np.log(frequency[inner]), np.log(power[inner]), 1)[0]


# -- Ensemble ------------------------------------------------------------------------


def softplus(x):
    return np.logaddexp(0.0, x)


def bound_logvar(raw, min_logvar, max_logvar):
    """Soft clip of predicted log variances: first from above, then from below."""
    logvar = max_logvar - softplus(max_logvar - raw)
    return min_logvar + softplus(logvar - min_logvar)


def input_scaler(inputs, floor=1e-12):
    """Mean and standard deviation of every column; constant columns keep scale 1."""
    mean = inputs.mean(axis=0)
    std = np.sqrt(((inputs - mean) ** 2).mean(axis=0))
    return mean, np.where(std < floor, 1.0, std)


def swish(x):
    return x / (1.0 + np.exp(-x))


def forward(kernels, biases, inputs, activate=swish):
    """One member: kernels `[in, out]`, inputs `[B, in]` -> mean, raw log variance."""
    hidden = np.float64(inputs)
    for layer, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
        hidden = hidden @ np.float64(kernel) + np.float64(bias)
        if layer < len(kernels) - 1:
            hidden = activate(hidden)
    half = hidden.shape[-1] // 2
    return hidden[..., :half], hidden[..., half:]


def negative_log_likelihood(mean, logvar, target):
    """Gaussian negative log likelihood of one member, without constants."""
    return float(((mean - target) ** 2 * np.exp(-logvar) + logvar).mean())


def pets_loss(
    kernels, biases, min_logvar, max_logvar, scaler, inputs, targets, *, decays
):
    """Loss of the whole ensemble on its bootstrapped batch, and its share of errors.

    Args:
      kernels, biases: per layer, `[E, in, out]` and `[E, out]`.
      min_logvar, max_logvar: `[D]`.
      scaler: mean and std of the inputs.
      inputs, targets: `[E, B, in]` and `[E, B, D]`, one batch a member.
      decays: one a layer; times sum(w^2) / 2 over all members, no biases.
    """
    mean_in, std_in = scaler
    total = 0.0
    for e in range(len(inputs)):
        mean, raw = forward(
            [k[e] for k in kernels],
            [b[e] for b in biases],
            (np.float64(inputs[e]) - mean_in) / std_in,
        )
        logvar = bound_logvar(raw, np.float64(min_logvar), np.float64(max_logvar))
        total += negative_log_likelihood(mean, logvar, np.float64(targets[e]))
    nll = total
    for decay, kernel in zip(decays, kernels, strict=True):
        total += decay * float((np.float64(kernel) ** 2).sum()) / 2.0
    total += 0.01 * float(np.float64(max_logvar).sum())
    return total - 0.01 * float(np.float64(min_logvar).sum()), nll


def cheetah_inputs(obs, action):
    """What the network of HalfCheetah sees: no obs[0]; sine and cosine of the pitch."""
    pitch = obs[..., 2:3]
    parts = [obs[..., 1:2], np.sin(pitch), np.cos(pitch), obs[..., 3:], action]
    return np.concatenate(parts, axis=-1)


def cheetah_targets(obs, next_obs):
    """The velocity of obs[0] itself, changes of everything else."""
    return np.concatenate(
        [next_obs[..., :1], next_obs[..., 1:] - obs[..., 1:]], axis=-1
    )


# -- Rewards -------------------------------------------------------------------------


def epistemic(next_obs, baseline_variance):
    """r_t of the paper on one particle set `[E, P, D]`."""
    members, _, dims = next_obs.shape
    total = 0.0
    for k in range(dims):
        means = [float(np.float64(next_obs[e, :, k]).mean()) for e in range(members)]
        centre = sum(means) / members
        variance = sum((m - centre) ** 2 for m in means) / members
        total += math.sqrt(variance / float(baseline_variance[k]))
    return total / dims


def simhash(projection, mean, std, obs):
    """The signs of A g(s) as a tuple of booleans, with g standardising s."""
    g = (np.float64(obs) - mean) / std
    return tuple(bool(x > 0) for x in np.float64(projection) @ g)


class DictCounts:
    """Pseudo-counts in a Python dictionary."""

    def __init__(self, projection, states):
        """Counts every row of `states` `[n, D]`."""
        self.projection = projection
        self.mean, self.std = input_scaler(np.float64(states))
        self.table = {}
        for state in states:
            code = simhash(projection, self.mean, self.std, state)
            self.table[code] = self.table.get(code, 0) + 1

    def count(self, obs):
        """How many counted states share the code of `obs`."""
        return self.table.get(simhash(self.projection, self.mean, self.std, obs), 0)

    def bonus(self, obs):
        """1 / sqrt(1 + n)."""
        return 1.0 / math.sqrt(1.0 + self.count(obs))


TASKS = {  # name: (index in the observation, sign)
    "forward": (0, 1.0),
    "backward": (0, -1.0),
    "front_flip": (11, 1.0),
    "back_flip": (11, -1.0),
}


def task_reward(task, action, next_obs):
    """Velocity or pitch rate of the next observation less 0.1 ||a||^2."""
    index, sign = TASKS[task]
    cost = 0.1 * (np.float64(action) ** 2).sum(axis=-1)
    return sign * np.float64(next_obs)[..., index] - cost


# -- Propagation ---------------------------------------------------------------------


def ts_infinity(members, noise, obs, actions):
    """Trajectory sampling with the member of every particle fixed for the horizon.

    Args:
      members: per member `(A, B, std)` of x' = A x + B a + std * eps.
      noise: `[H, N, E, P, D]`, standard normal.
      obs: `[D]`.
      actions: `[N, H, A]`.

    Returns:
      `[N, H + 1, E, P, D]`.
    """
    horizon, num_samples, num_members, num_particles, size = noise.shape
    shape = (num_samples, horizon + 1, num_members, num_particles, size)
    states = np.zeros(shape)
    for n in range(num_samples):
        for e, (a, b, std) in enumerate(members):
            for p in range(num_particles):
                x = np.float64(obs)
                states[n, 0, e, p] = x
                for t in range(horizon):
                    x = a @ x + b @ actions[n, t] + std * noise[t, n, e, p]
                    states[n, t + 1, e, p] = x
    return states
