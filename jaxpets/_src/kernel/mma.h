// A warp's matrix instructions, which all GPUs from Ampere on have.
#pragma once

#include <cstdint>

namespace {

// Reads 16 rows of 16 halves as a left operand; every lane has the address of 8 of them.
__device__ __forceinline__ void load_operand(uint32_t (&a)[4], uint32_t from) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(a[0]), "=r"(a[1]), "=r"(a[2]), "=r"(a[3])
               : "r"(from)
               : "memory");
}

// Adds 16 rows x 16 deep times 16 deep x 8 columns to the sums of these columns.
__device__ __forceinline__ void add_product(float* sums, const uint32_t (&a)[4],
                                            const uint32_t* weights) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
      "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(weights[0]), "r"(weights[1]));
}

}  // namespace
