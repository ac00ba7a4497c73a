// A warp's 16 particles, for wgmma_rollout.cu.
#pragma once

#include "gpu_particles.h"

namespace {

constexpr int ROWS = 16;
constexpr int INPUT_STRIDE = INPUT_CHUNKS * DEPTH + 8;

// Behind the last activation stand two ones, for the rows that hold the biases.
__device__ __forceinline__ void append_ones(uint32_t (&activations)[4 * HIDDEN_CHUNKS],
                                            int pair) {
#pragma unroll
  for (int i = WIDTH / 4; i < 4 * HIDDEN_CHUNKS; ++i)
    activations[i] = i < WIDTH / 4 + 2 && pair == 0 ? pack(1.0f, 1.0f) : 0;
}

struct Warp : Particles<ROWS, 32, INPUT_STRIDE> {
  // Behind the inputs stand two ones and zeros, from beginning to end.
  __device__ __forceinline__ void begin(int member, int first) {
    for (int i = thread; i < ROWS * INPUT_STRIDE; i += 32) {
      const int column = i % INPUT_STRIDE;
      inputs[i] = column == INPUTS || column == INPUTS + 1 ? __half(1.0f) : __half(0.0f);
    }
    Particles::begin(member, first);
  }

  // Reads the inputs as the left operand of the first layer.
  __device__ __forceinline__ void read_inputs(uint32_t (&operand)[4 * INPUT_CHUNKS]) {
    const __half* from = inputs + thread / 4 * INPUT_STRIDE + 2 * (thread % 4);
#pragma unroll
    for (int chunk = 0; chunk < INPUT_CHUNKS; ++chunk) {
#pragma unroll
      for (int i = 0; i < 4; ++i)  // rows +0 and +8, then both 8 columns on
        operand[4 * chunk + i] = *reinterpret_cast<const uint32_t*>(
            from + i % 2 * 8 * INPUT_STRIDE + i / 2 * 8 + chunk * DEPTH);
    }
    __syncwarp();
  }

  // Moves the particles to what was drawn of the head, where the noise stands.
  __device__ __forceinline__ void move_by(const float (&head)[HEAD]) {
    draw_targets(targets + thread / 4 * STATE_STRIDE, head, shared, thread % 4, OBS);
    __syncwarp();
    move_all();
  }
};

}  // namespace
