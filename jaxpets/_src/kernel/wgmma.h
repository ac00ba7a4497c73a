// Hopper's warpgroup matrix instructions: left operand in registers, right operand in
// shared memory, sums in registers. Wgmma<COLUMNS>::multiply is generated in model.h.
#pragma once

#include <cstdint>

// Sees every write to registers that the next product reads.
__device__ __forceinline__ void wgmma_fence() {
  asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
}

__device__ __forceinline__ void wgmma_commit() {
  asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
}

template <int IN_FLIGHT>
__device__ __forceinline__ void wgmma_wait() {
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(IN_FLIGHT) : "memory");
}

// Describes a chunk of weights: blocks of 8 columns x 8 deep, 128 bytes each, the two
// halves of the depth next to each other, then the next 8 columns; no swizzle.
__device__ __forceinline__ uint64_t weight_descriptor(uint32_t address) {
  constexpr uint64_t DEPTH_STRIDE = 128 / 16, COLUMN_STRIDE = 256 / 16;
  return (address & 0x3FFFF) >> 4 | DEPTH_STRIDE << 16 | COLUMN_STRIDE << 32;
}
