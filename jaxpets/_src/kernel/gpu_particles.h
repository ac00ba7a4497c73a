// What threads do with their particles in every step, but for the products of layers:
// inputs, activations, noise and moves. For Hopper's kernel and the one of other GPUs.
#pragma once

#include <cuda_fp16.h>

#include "gpu_activation.h"
#include "handler.h"

namespace {

// An odd number of 16 byte words: a thread a row, four numbers at once, and no conflicts.
constexpr int STATE_STRIDE = 4 * (round_up(OBS, 4) / 4 | 1);

__device__ __forceinline__ uint32_t address(const void* pointer) {
  return static_cast<uint32_t>(__cvta_generic_to_shared(pointer));
}

__device__ __forceinline__ uint32_t pack(float low, float high) {
  const __half2 pair = __floats2half2_rn(low, high);
  return *reinterpret_cast<const uint32_t*>(&pair);
}

__device__ __forceinline__ float fast_tanh(float x) {
  float tanh;
  asm("tanh.approx.f32 %0, %1;" : "=f"(tanh) : "f"(x));
  return tanh;
}

template <int REGISTERS>
__device__ __forceinline__ void activate(float (&sums)[REGISTERS]) {
#pragma unroll
  for (int i = 0; i < REGISTERS; ++i) sums[i] = activated(sums[i], fast_tanh);
}

// Writes the features of one particle into the input tile.
__device__ __forceinline__ void write_features(__half* inputs, const float (&obs)[OBS],
                                               const float* shared) {
  float values[FEATURES];
  features(obs, values);
#pragma unroll
  for (int i = 0; i < FEATURES; ++i) values[i] = scaled(values[i], i, shared);
  uint32_t words[FEATURES / 2 + 1];
#pragma unroll
  for (int i = 0; i < FEATURES / 2; ++i)
    words[i] = pack(values[2 * i], values[2 * i + 1]);
#pragma unroll
  for (int i = 0; i < FEATURES / 8; ++i)
    reinterpret_cast<uint4*>(inputs)[i] = make_uint4(words[4 * i], words[4 * i + 1],
                                                     words[4 * i + 2], words[4 * i + 3]);
#pragma unroll
  for (int i = FEATURES / 8 * 4; i < FEATURES / 2; ++i)
    reinterpret_cast<uint32_t*>(inputs)[i] = words[i];
  if (FEATURES % 2) inputs[FEATURES - 1] = __float2half_rn(values[FEATURES - 1]);
}

// Copies VECTOR numbers out of shared memory; no branch, for use between products.
constexpr int VECTOR = OBS % 4 == 0 ? 4 : OBS % 2 == 0 ? 2 : 1;
__device__ __forceinline__ void store(float* to, const float* from, bool wanted) {
  if constexpr (VECTOR == 4) {
    const float4 v = *reinterpret_cast<const float4*>(from);
    asm volatile(
        "{\n.reg .pred wanted;\nsetp.ne.b32 wanted, %5, 0;\n"
        "@wanted st.global.v4.f32 [%0], {%1, %2, %3, %4};\n}" ::"l"(to),
        "f"(v.x), "f"(v.y), "f"(v.z), "f"(v.w), "r"(int(wanted))
        : "memory");
  } else if constexpr (VECTOR == 2) {
    const float2 v = *reinterpret_cast<const float2*>(from);
    asm volatile(
        "{\n.reg .pred wanted;\nsetp.ne.b32 wanted, %3, 0;\n"
        "@wanted st.global.v2.f32 [%0], {%1, %2};\n}" ::"l"(to),
        "f"(v.x), "f"(v.y), "r"(int(wanted))
        : "memory");
  } else {
    asm volatile(
        "{\n.reg .pred wanted;\nsetp.ne.b32 wanted, %2, 0;\n"
        "@wanted st.global.f32 [%0], %1;\n}" ::"l"(to),
        "f"(*from), "r"(int(wanted))
        : "memory");
  }
}

// Turns means and raw log-variances into draws; the noise stands where they go. Mean and
// log-variance of one entry lie in the same thread, entries two by two. There are
// `entries` in all.
template <int COLUMNS>
__device__ __forceinline__ void draw_targets(float* target, const float (&head)[COLUMNS],
                                             const float* shared, int pair, int entries) {
#pragma unroll
  for (int i = 0; i < COLUMNS / 2; i += 2) {
    // Wait for no branch: what stands behind the last entry is computed, not stored.
    const int column = i / 4 * 8 + 2 * pair;
    const int at = i / 4 * 8 + 6 < entries ? column : min(column, (entries - 1) / 2 * 2);
    float2* const place =
        reinterpret_cast<float2*>(target + i % 4 / 2 * 8 * STATE_STRIDE + at);
    const float2 low = *reinterpret_cast<const float2*>(shared + MIN_VARIANCE + at);
    const float2 high = *reinterpret_cast<const float2*>(shared + MAX_PRECISION + at);
    float2 value = *place;
    value.x = head[i] + value.x * deviation(head[COLUMNS / 2 + i], low.x, high.x);
    value.y = head[i + 1] + value.y * deviation(head[COLUMNS / 2 + i + 1], low.y, high.y);
    if (column == at) *place = value;
  }
}

// Draws numbers `first + i * stride` of a step's normal(key, [E, N, P, OBS]) into rows of
// OBS: those of this thread, so many at once.
template <int COUNT, int STRIDE, int AT_ONCE>
__device__ __forceinline__ void draw_noise(float* rows, const uint32_t* key,
                                           uint32_t counter, int thread) {
  constexpr bool EXACT = COUNT % (STRIDE * AT_ONCE) == 0;
  const uint32_t key0 = key[0], key1 = key[1];
  for (int i = thread; i < COUNT; i += STRIDE * AT_ONCE) {
    uint32_t bits[AT_ONCE];
    float drawn[AT_ONCE];
    threefry(key0, key1, counter + i, STRIDE, bits);
    normal(bits, drawn);
    const int column = i % OBS;
    float* const place = rows + i / OBS * STATE_STRIDE + column;
#pragma unroll
    for (int k = 0; k < AT_ONCE; ++k) {
      const int moved = k * STRIDE / OBS, columns = k * STRIDE % OBS;
      const int carry = column + columns >= OBS ? STATE_STRIDE - OBS : 0;
      if (EXACT || i + k * STRIDE < COUNT)
        place[moved * STATE_STRIDE + columns + carry] = drawn[k];
    }
  }
}

// ROWS particles of THREADS threads, a warp or a block, which have them from beginning to
// end. The pointers are to their own rows in shared memory.
template <int ROWS, int THREADS, int INPUT_STRIDE>
struct Particles {
  static_assert(ROWS <= THREADS, "a thread moves one particle");
  static constexpr int ACTIONS = (ROWS * ACTION + THREADS - 1) / THREADS;  // of a thread
  static constexpr int VECTORS = (ROWS * OBS / VECTOR + THREADS - 1) / THREADS;

  const Rollout& rollout;
  const float* shared;
  __half* inputs;
  float *states, *targets;
  int *path_offsets, *action_offsets;  // of each row
  int thread, step_stride;
  float action[ACTIONS];

  __device__ __forceinline__ void sync() const {
    if constexpr (THREADS == 32)
      __syncwarp();
    else
      __syncthreads();
  }

  __device__ __forceinline__ void load_actions(int step) {
#pragma unroll
    for (int k = 0; k < ACTIONS; ++k) {
      const int i = min(thread + THREADS * k, ROWS * ACTION - 1);
      action[k] =
          rollout.actions[action_offsets[i / ACTION] + step * ACTION + i % ACTION];
    }
  }

  __device__ __forceinline__ void write_actions() {
#pragma unroll
    for (int k = 0; k < ACTIONS; ++k) {
      const int i = min(thread + THREADS * k, ROWS * ACTION - 1);
      const int column = FEATURES + i % ACTION;
      inputs[i / ACTION * INPUT_STRIDE + column] =
          __float2half_rn(scaled(action[k], column, shared));
    }
  }

  __device__ __forceinline__ void store_states(int step) {
#pragma unroll
    for (int k = 0; k < VECTORS; ++k) {
      const int i = min(thread + THREADS * k, ROWS * OBS / VECTOR - 1) * VECTOR;
      const int in_row = i % OBS, offset = path_offsets[i / OBS];
      store(rollout.path + offset + step * step_stride + in_row,
            states + i / OBS * STATE_STRIDE + in_row, offset >= 0);
    }
  }

  // Puts the particles from `first` on where they start, with their first inputs. What
  // stands behind these is the caller's.
  __device__ __forceinline__ void begin(int member, int first) {
    if (thread < ROWS) {
      const int rows = rollout.num_candidates * rollout.particles;
      const int wanted = first + thread;
      const int particle = min(wanted, rows - 1);
      const int candidate = particle / rollout.particles;
      const int in_step = (member * rollout.particles + particle % rollout.particles) * OBS;
      path_offsets[thread] =
          wanted < rows ? candidate * (rollout.horizon + 1) * step_stride + in_step : -1;
      action_offsets[thread] = candidate * rollout.horizon * ACTION;
    }
    sync();
    if (thread < ROWS) {
      float obs[OBS];
#pragma unroll
      for (int i = 0; i < OBS; ++i)
        states[thread * STATE_STRIDE + i] = obs[i] = rollout.obs[i];
      write_features(inputs + thread * INPUT_STRIDE, obs, shared);
    }
    load_actions(0);
    write_actions();
  }

  // Moves the particles to their targets.
  __device__ __forceinline__ void move_all() {
    if (thread < ROWS) {
      float obs[OBS], drawn[OBS];
#pragma unroll
      for (int i = 0; i < OBS; ++i) {
        obs[i] = states[thread * STATE_STRIDE + i];
        drawn[i] = targets[thread * STATE_STRIDE + i];
      }
      move(obs, drawn, shared);
#pragma unroll
      for (int i = 0; i < OBS; ++i) states[thread * STATE_STRIDE + i] = obs[i];
      write_features(inputs + thread * INPUT_STRIDE, obs, shared);
    }
  }
};

}  // namespace
