// The rollout's operands, and how they lie in memory; GPU kernel and CPU reference share
// this file. Sizes come from model.h, which is generated for one kind of model.
#pragma once

#include <cstddef>
#include <cstdint>

#include "model.h"
#include "row.h"

constexpr int round_up(int x, int multiple) {
  return (x + multiple - 1) / multiple * multiple;
}

// Products are cut along the inner dimension into chunks of 16, the depth of one tensor
// core instruction. A chunk holds 16 x columns weights as blocks of 8 x 8. Two rows hold
// the bias, rounded, and what rounding left; activations end in two ones for them.
constexpr int DEPTH = 16;
constexpr int INPUTS = FEATURES + ACTION;
constexpr int INPUT_CHUNKS = round_up(INPUTS + 2, DEPTH) / DEPTH;
constexpr int HIDDEN_CHUNKS = round_up(WIDTH + 2, DEPTH) / DEPTH;
constexpr int HEAD = round_up(OBS, 8);  // columns for means, then as many for variances
// A hidden layer is computed in two halves; all chunks of the first come first.
constexpr int LEFT = round_up(round_up(WIDTH, 16) / 2, 16);
constexpr int RIGHT = WIDTH - LEFT;
constexpr int INPUT_WEIGHTS = INPUT_CHUNKS * DEPTH * WIDTH;
constexpr int HIDDEN_WEIGHTS = HIDDEN_CHUNKS * DEPTH * WIDTH;
constexpr int OUTPUT_WEIGHTS = HIDDEN_CHUNKS * DEPTH * 2 * HEAD;
constexpr int MEMBER_WEIGHTS =
    INPUT_WEIGHTS + (LAYERS - 1) * HIDDEN_WEIGHTS + OUTPUT_WEIGHTS;

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
  const uint16_t* weights;  // [E, MEMBER_WEIGHTS] float16
  const float* shared;      // [SHARED_NUMBERS]
  const uint32_t* keys;     // [H, KEY]
  const float* obs;         // [OBS]
  const float* actions;     // [N, H, ACTION]
  float* path;              // [N, H + 1, E, P, OBS]
  int num_members, num_candidates, horizon, particles;  // E, N, H, P
  int64_t batch;
  BatchAxis axes[MAX_BATCH_AXES];
};

ROW_FUNCTION Rollout at_batch(Rollout rollout, int64_t index) {
  rollout.path += index * rollout.num_candidates * (rollout.horizon + 1) *
                  rollout.num_members * rollout.particles * OBS;
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
ROW_FUNCTION void move(float (&obs)[OBS], const float (&target)[OBS],
                       const float* shared) {
  float moved[OBS], low[OBS], high[OBS];
  UNROLLED
  for (int i = 0; i < OBS; ++i) low[i] = shared[LOW + i], high[i] = shared[HIGH + i];
  next_obs(obs, target, moved);
  bound(moved, low, high, obs);
}

ROW_FUNCTION float scaled(float input, int index, const float* shared) {
  return (input - shared[INPUT_MEAN + index]) * shared[INPUT_SCALE + index];
}

// The place of a particle's first entry in the draw of `[E, N, P, OBS]`.
ROW_FUNCTION uint32_t noise_counter(const Rollout& rollout, const uint32_t* key,
                                    int member, int particle) {
  return ((member * key[3] + key[2]) * rollout.particles + particle) * OBS;
}
