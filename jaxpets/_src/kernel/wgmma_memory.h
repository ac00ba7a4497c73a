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
// All that streams of a layer fits into the ring. If not, a slot is needed again before
// the other consumer has read it, and they cannot take turns.
constexpr bool FITS = LEFT_STREAMED + RIGHT_STREAMED <= SLOTS * UNIT;

constexpr int SLOT = UNIT * DEPTH * LEFT;  // LEFT >= RIGHT

// Numbers of a layer that stay in shared memory.
constexpr int RESIDENT_INPUT = INPUT_WEIGHTS;
constexpr int RESIDENT_HIDDEN = (HIDDEN_CHUNKS - LEFT_STREAMED) * DEPTH * LEFT +
                                (HIDDEN_CHUNKS - RIGHT_STREAMED) * DEPTH * RIGHT;
constexpr int RESIDENT_OUTPUT = OUTPUT_WEIGHTS;
constexpr int RESIDENT_WEIGHTS =
    RESIDENT_INPUT + (LAYERS - 1) * RESIDENT_HIDDEN + RESIDENT_OUTPUT;

// The particles of one consumer.
template <int COUNT>
struct Rows {
  float state[COUNT * STATE_STRIDE];
  float target[COUNT * STATE_STRIDE];  // noise, then what the model predicts
  __half inputs[COUNT * INPUT_STRIDE];
  int path_offset[COUNT], action_offset[COUNT];  // of each row
};

// Of a row of activations in shared memory: an odd number of 16 byte words, for 8 rows to
// be read at once.
constexpr int ACTIVATION_STRIDE = HIDDEN_CHUNKS * DEPTH + 8;

// Of a block: those of two tiles, or of one and, where the second would be, of a slice.
union BlockRows {
  Rows<TILE> tiles[CONSUMERS];
  struct {
    Rows<TILE> tile;
    Rows<SLICE> slice;
    __half activations[SLICE * ACTIVATION_STRIDE];
  } sliced;
};

struct alignas(128) Shared {
  __half resident[RESIDENT_WEIGHTS];
  __half ring[SLOTS][SLOT];
  alignas(16) float shared[SHARED_NUMBERS];
  alignas(16) BlockRows rows;
  uint64_t resident_full, ring_full[SLOTS], ring_empty[SLOTS];
  uint64_t noise_full[CONSUMERS], noise_empty[CONSUMERS];
};

// A warp that has a consumer's rows from `first` on.
template <int COUNT>
__device__ __forceinline__ Warp warp_of(Rows<COUNT>& rows, int first, Shared& smem,
                                        const Rollout& rollout, int lane) {
  return {rollout,
          smem.shared,
          rows.inputs + first * INPUT_STRIDE,
          rows.state + first * STATE_STRIDE,
          rows.target + first * STATE_STRIDE,
          rows.path_offset + first,
          rows.action_offset + first,
          lane,
          rollout.num_members * rollout.particles * OBS};
}

// What a block owns: of a member the rows from the first on.
struct Block {
  int batch, member, first_row, tiles;
  bool has_slice;

  __device__ __forceinline__ int consumers() const { return tiles + has_slice; }
};

__device__ __forceinline__ void sync_warpgroup(int warpgroup) {
  asm volatile("bar.sync %0, 128;" ::"r"(warpgroup + 1) : "memory");
}

// A position in the ring: which slot, and how often the ring has been around.
struct Cursor {
  int slot = 0;
  uint32_t round = 0;
  __device__ __forceinline__ void advance() {
    if (++slot == SLOTS) slot = 0, round ^= 1;
  }
};

// No branch, for use between products.
__device__ __forceinline__ void release(Shared& smem, int slot) {
  asm volatile(
      "{\n.reg .pred first;\nsetp.eq.u32 first, %1, 0;\n"
      "@first mbarrier.arrive.shared::cta.b64 _, [%0];\n}" ::"r"(
          address(&smem.ring_empty[slot])),
      "r"(threadIdx.x % 32)
      : "memory");
}

}  // namespace
