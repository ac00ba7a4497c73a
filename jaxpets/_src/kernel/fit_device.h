// What training needs of Hopper: clusters, mbarriers, remote stores. fit_emulator.h has the
// same functions for a CPU.
#pragma once

#ifndef __CUDACC__
#include "fit_emulator.h"
#else

#include <cuda_runtime.h>
#include <stdint.h>

#define DEVICE __device__ __forceinline__

namespace {

using Remote = uint32_t;  // an address in the shared memory of a block of the cluster

DEVICE int thread_index() { return threadIdx.x; }
DEVICE int block_index() { return blockIdx.x; }
DEVICE void block_sync() { __syncthreads(); }
DEVICE bool block_sync_or(bool x) { return __syncthreads_or(x); }
DEVICE float shuffle_xor(float x, int mask) { return __shfl_xor_sync(~0u, x, mask); }
DEVICE float shuffle(float x, int lane) { return __shfl_sync(~0u, x, lane); }

template <typename T>
DEVICE T& shared_memory() {
  extern __shared__ __align__(128) unsigned char memory[];
  return *reinterpret_cast<T*>(memory);
}

DEVICE uint32_t shared_address(const void* p) {
  return static_cast<uint32_t>(__cvta_generic_to_shared(p));
}
DEVICE Remote peer(const void* p, int rank) {
  uint32_t address;
  asm volatile("mapa.shared::cluster.u32 %0, %1, %2;"
               : "=r"(address) : "r"(shared_address(p)), "r"(rank));
  return address;
}
DEVICE void cluster_arrive() {
  __syncwarp();
  asm volatile("barrier.cluster.arrive.release.aligned;" ::: "memory");
}
DEVICE void cluster_wait() {
  __syncwarp();
  asm volatile("barrier.cluster.wait.acquire.aligned;" ::: "memory");
}
// Stores to a block of the cluster and tells its mbarrier of 16 bytes.
DEVICE void send_async(Remote to, float4 x, Remote bar) {
  asm volatile(
      "st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v4.f32 "
      "[%0], {%1, %2, %3, %4}, [%5];"
      :: "r"(to), "f"(x.x), "f"(x.y), "f"(x.z), "f"(x.w), "r"(bar) : "memory");
}
DEVICE void bar_init(uint64_t* bar) {
  asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(shared_address(bar)) : "memory");
}
DEVICE void bar_init_fence() {
  asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
}
DEVICE void bar_expect(uint64_t* bar, int bytes) {
  asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;"
               :: "r"(shared_address(bar)), "r"(bytes) : "memory");
}
// What takes over four seconds is a fault: rather an error than a hang.
struct Watchdog {
  uint32_t turns = 0;
  uint64_t start = 0;
  static DEVICE uint64_t time() {
    uint64_t now;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(now));
    return now;
  }
  DEVICE void turn() {
    if (++turns % 4096) return;
    const uint64_t now = time();
    if (!start) start = now;
    if (now - start > 4000000000ull) __trap();
  }
};
DEVICE bool bar_try(uint32_t bar, int parity) {
  uint32_t done;
  asm volatile(
      "{\n .reg .pred p;\n"
      " mbarrier.try_wait.parity.acquire.cluster.shared::cta.b64 p, [%1], %2;\n"
      " selp.u32 %0, 1, 0, p;\n}"
      : "=r"(done) : "r"(bar), "r"(parity) : "memory");
  return done;
}
DEVICE void bar_wait(uint64_t* bar, int parity) {
  const uint32_t address = shared_address(bar);
  if (bar_try(address, parity)) return;
  Watchdog dog;
  while (!bar_try(address, parity)) dog.turn();
}
template <typename T>
DEVICE void copy_async(T* to, const T* from) {
  asm volatile("cp.async.ca.shared.global [%0], [%1], 4;"
               :: "r"(shared_address(to)), "l"(from) : "memory");
}
DEVICE void copy_async_wait() { asm volatile("cp.async.wait_all;" ::: "memory"); }

DEVICE void global_arrive(uint32_t* counter) {
  __threadfence();
  asm volatile("red.release.gpu.global.add.u32 [%0], 1;" :: "l"(counter) : "memory");
}
DEVICE uint32_t load_acquire(const uint32_t* p) {
  uint32_t x;
  asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(x) : "l"(p) : "memory");
  return x;
}
DEVICE uint32_t load_global(const uint32_t* p) { return __ldcg(p); }
DEVICE float load_global(const float* p) { return __ldcg(p); }
DEVICE void store_global(uint32_t* p, uint32_t x) { __stcg(p, x); }
DEVICE void store_global(float* p, float x) { __stcg(p, x); }

DEVICE float fast_exp(float x) { return __expf(x); }
DEVICE float fast_divide(float x, float y) { return __fdividef(x, y); }
DEVICE float fast_sqrt(float x) {
  float y;
  asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
DEVICE bool finite(float x) { return fabsf(x) <= 3.402823466e38f; }

// A factor of a product on tensor cores: rounded to TF32, as a word.
DEVICE uint32_t tf32(float x) {
  uint32_t y;
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(y) : "f"(x));
  return y;
}
DEVICE void mma(float (&c)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 "
      "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}

// The compiler then knows nothing of a number.
DEVICE void forget(int& number) { asm volatile("" : "+r"(number)); }

}  // namespace

#endif
