// The rollout's operands, and how they lie in memory, for GPU and CPU. The layout of the
// weights, gpu_layout.h or cpu_layout.h, is included before.
#pragma once

#include <cstddef>
#include <cstdint>

#include "sizes.h"

// Numbers that members share, one array after the other, each padded so that four can
// be read at once.
constexpr int INPUT_MEAN = 0;
constexpr int INPUT_SCALE = INPUT_MEAN + round_up(INPUTS, 4);  // 1 / std
constexpr int LOW = INPUT_SCALE + round_up(INPUTS, 4);
constexpr int HIGH = LOW + round_up(OBS, 4);
constexpr int MIN_VARIANCE = HIGH + round_up(OBS, 4);
constexpr int MAX_PRECISION = MIN_VARIANCE + round_up(OBS, 4);  // 1 / max variance
constexpr int SHARED_NUMBERS = MAX_PRECISION + round_up(OBS, 4);

// Numbers of a step's key: threefry's two words, the first candidate whose noise is
// drawn here, and of how many.
constexpr int KEY = 4;

// One axis that jax.vmap put in front: its size, and how many elements each operand
// moves along it (0 where the operand does not have the axis).
struct BatchAxis {
  int64_t size, weights, shared, keys, obs, actions;
};
constexpr int MAX_BATCH_AXES = 4;

struct Rollout {
  const Weight* weights;  // [E, MEMBER_WEIGHTS]
  const float* shared;    // [SHARED_NUMBERS]
  const uint32_t* keys;   // [H, KEY]
  const float* obs;       // [OBS]
  const float* actions;   // [N, H, ACTION]
  float* path;            // [N, H + 1, E, P, OBS]
  int num_members, num_candidates, horizon, particles;  // E, N, H, P
  int64_t batch;
  BatchAxis axes[MAX_BATCH_AXES];
};

// How far the steps of a particle's path lie apart.
PARTICLE_FUNCTION int64_t path_stride(const Rollout& rollout) {
  return int64_t(rollout.num_members) * rollout.particles * OBS;
}

PARTICLE_FUNCTION Rollout at_batch(Rollout rollout, int64_t index) {
  rollout.path +=
      index * rollout.num_candidates * (rollout.horizon + 1) * path_stride(rollout);
  for (int axis = MAX_BATCH_AXES - 1; axis >= 0; --axis) {
    const BatchAxis& a = rollout.axes[axis];
    const int64_t i = index % a.size;
    index /= a.size;
    rollout.weights += i * a.weights;
    rollout.shared += i * a.shared;
    rollout.keys += i * a.keys;
    rollout.obs += i * a.obs;
    rollout.actions += i * a.actions;
  }
  return rollout;
}

// Moves one particle: reads its observation and target, overwrites the observation.
PARTICLE_FUNCTION void move(float (&obs)[OBS], const float (&target)[OBS],
                            const float* shared) {
  float moved[OBS], low[OBS], high[OBS];
  UNROLLED
  for (int i = 0; i < OBS; ++i) low[i] = shared[LOW + i], high[i] = shared[HIGH + i];
  next_obs(obs, target, moved);
  bound(moved, low, high, obs);
}

PARTICLE_FUNCTION float scaled(float input, int index, const float* shared) {
  return (input - shared[INPUT_MEAN + index]) * shared[INPUT_SCALE + index];
}

// Where a particle's path begins.
PARTICLE_FUNCTION float* path_of(const Rollout& rollout, int member, int particle) {
  const int candidate = particle / rollout.particles;
  return rollout.path + candidate * (rollout.horizon + 1) * path_stride(rollout) +
         (member * rollout.particles + particle % rollout.particles) * OBS;
}

// The place of a particle's first entry in the draw of `[E, N, P, OBS]`.
PARTICLE_FUNCTION uint32_t noise_counter(const Rollout& rollout, const uint32_t* key,
                                         int member, int particle) {
  return ((member * key[3] + key[2]) * rollout.particles + particle) * OBS;
}
