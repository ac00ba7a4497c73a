// What a block of wgmma_rollout.cu has in shared memory, and how its warps hand it on.
#pragma once

#include "hopper.h"
#include "wgmma_warp.h"

namespace {

constexpr int TILE = 64;  // particles of one warpgroup, the height of a wgmma
constexpr int SLICE = ROWS;  // particles of one that multiplies them by mma
constexpr int WARPGROUP = 128;
constexpr int CONSUMERS = 2;
constexpr int THREADS = (CONSUMERS + 1) * WARPGROUP;
constexpr int NOISE_WARPS = 3;
// Numbers that stream of a layer: each half has a place of its own for them.
constexpr int STREAMED_LEFT = LEFT_STREAMED * DEPTH * LEFT;
constexpr int STREAMED_RIGHT = RIGHT_STREAMED * DEPTH * RIGHT;
// Numbers of a layer that stay in shared memory.
constexpr int RESIDENT_INPUT = INPUT_WEIGHTS;
constexpr int RESIDENT_HIDDEN = HIDDEN_WEIGHTS - STREAMED_LEFT - STREAMED_RIGHT;
constexpr int RESIDENT_OUTPUT = OUTPUT_WEIGHTS;
constexpr int RESIDENT_WEIGHTS =
    RESIDENT_INPUT + (LAYERS - 1) * RESIDENT_HIDDEN + RESIDENT_OUTPUT;

enum Half { LEFT_HALF, RIGHT_HALF };  // of a hidden layer's columns

// The particles of one consumer.
template <int COUNT>
struct Rows {
  float state[COUNT * STATE_STRIDE];
  float target[COUNT * STATE_STRIDE];  // noise, then what the model predicts
  __half inputs[COUNT * INPUT_STRIDE];
  int path_offset[COUNT], action_offset[COUNT];  // of each row
};

// Of a block: those of two tiles, or of one and a slice.
union BlockRows {
  Rows<TILE> tiles[CONSUMERS];
  struct {
    Rows<TILE> tile;
    Rows<SLICE> slice;
    __half activations[SLICE * ACTIVATION_STRIDE];
  } sliced;
};

struct alignas(128) Shared {
  __half resident[RESIDENT_WEIGHTS > 0 ? RESIDENT_WEIGHTS : 8];
  __half streamed_left[STREAMED_LEFT > 0 ? STREAMED_LEFT : 8];
  __half streamed_right[STREAMED_RIGHT > 0 ? STREAMED_RIGHT : 8];
  alignas(16) float shared[SHARED_NUMBERS];
  alignas(16) BlockRows rows;
  alignas(8) uint64_t resident_full, streamed_full[2], streamed_empty[2];  // of a Half
  uint64_t noise_full[CONSUMERS], noise_empty[CONSUMERS];
};

// What a block owns: of a member the rows from the first on.
struct Block {
  int batch, member, first_row, tiles;
  bool has_slice;

  __device__ __forceinline__ int consumers() const { return tiles + has_slice; }
};

__device__ __forceinline__ void sync_warpgroup(int warpgroup) {
  asm volatile("bar.sync %0, 128;" ::"r"(warpgroup + 1) : "memory");
}

// The consumers take turns at the tensor cores. Those that shared them would also finish
// together, and leave them idle together.
__device__ __forceinline__ void begin_turn(int consumer) {
  asm volatile("bar.sync %0, 256;" ::"r"(CONSUMERS + 1 + consumer) : "memory");
}

__device__ __forceinline__ void pass_turn(int consumer) {
  asm volatile("bar.arrive %0, 256;" ::"r"(2 * CONSUMERS - consumer) : "memory");
}

// A warp is done with what a barrier tells of. No branch, for use between products.
__device__ __forceinline__ void release(uint64_t* barrier) {
  asm volatile(
      "{\n.reg .pred first;\nsetp.eq.u32 first, %1, 0;\n"
      "@first mbarrier.arrive.shared::cta.b64 _, [%0];\n}" ::"r"(address(barrier)),
      "r"(threadIdx.x % 32)
      : "memory");
}

}  // namespace
