// Hopper's instructions on a CPU, as fit_device.h has them.
#pragma once

#include "fit_machine.h"

namespace {

using Remote = unsigned char*;
struct Watchdog {
  void turn() { emulator::wait(emulator::always, nullptr); }
};

inline void forget(int&) {}
inline int thread_index() { return emulator::machine().self->thread; }
inline int block_index() { return emulator::machine().self->block->index; }
inline bool block_sync_or(bool x) {
  auto* b = emulator::machine().self->block;
  b->any |= x;
  emulator::Phase p{&b->phase, b->phase};
  if (++b->arrived == b->threads) {
    b->arrived = 0;
    b->result = b->any;
    b->any = false;
    ++b->phase;
  } else {
    emulator::wait(emulator::phase_over, &p);
  }
  return b->result;
}
inline void block_sync() { block_sync_or(false); }
inline float shuffle_any(float x, int from) {
  auto* f = emulator::machine().self;
  auto& w = f->block->warps[f->thread / 32];
  const uint32_t slot = w.phase & 1;
  w.value[slot][f->thread % 32] = x;
  emulator::Phase p{&w.phase, w.phase};
  if (++w.arrived == 32) { w.arrived = 0; ++w.phase; }
  else emulator::wait(emulator::phase_over, &p);
  return w.value[slot][from & 31];
}
// Without rounding, so that products are those of float32.
inline uint32_t tf32(float x) { uint32_t y; memcpy(&y, &x, 4); return y; }
inline void mma(float (&c)[4], const uint32_t (&a)[4], const uint32_t (&b)[2]) {
  auto* f = emulator::machine().self;
  auto& w = f->block->warps[f->thread / 32];
  const uint32_t slot = w.phase & 1;
  const int lane = f->thread % 32;
  for (int i = 0; i < 4; ++i) w.factors[slot][lane][i] = a[i];
  for (int i = 0; i < 2; ++i) w.factors[slot][lane][4 + i] = b[i];
  emulator::Phase p{&w.phase, w.phase};
  if (++w.arrived == 32) { w.arrived = 0; ++w.phase; }
  else emulator::wait(emulator::phase_over, &p);
  const auto number = [&](int lane, int i) {
    float x;
    memcpy(&x, &w.factors[slot][lane][i], 4);
    return x;
  };
  for (int e = 0; e < 4; ++e) {
    const int row = lane / 4 + e / 2 * 8, n = lane % 4 * 2 + e % 2;
    for (int k = 0; k < 8; ++k)
      c[e] += number(row % 8 * 4 + k % 4, row / 8 + k / 4 * 2) * number(n * 4 + k % 4, 4 + k / 4);
  }
}
inline float shuffle_xor(float x, int mask) { return shuffle_any(x, (thread_index() % 32) ^ mask); }
inline float shuffle(float x, int lane) { return shuffle_any(x, lane); }
template <typename T>
inline T& shared_memory() { return *reinterpret_cast<T*>(emulator::machine().self->block->memory); }
inline Remote peer(const void* p, int rank) {
  auto* b = emulator::machine().self->block;
  return b->cluster->blocks[rank]->memory + (static_cast<const unsigned char*>(p) - b->memory);
}
// A thread may arrive at most once before it waits, as on the device.
inline void cluster_arrive() {
  auto* c = emulator::machine().self->block->cluster;
  if (++c->arrived == c->size) {
    c->arrived = 0;
    ++c->phase;
  }
}
inline void cluster_wait_for(uint32_t old) {
  auto* c = emulator::machine().self->block->cluster;
  emulator::Phase p{&c->phase, old};
  if (c->phase == old) emulator::wait(emulator::phase_over, &p);
}
// The number of the wait is the number of the phase: each thread waits for every phase.
inline void cluster_wait() {
  auto* f = emulator::machine().self;
  auto& waits = emulator::cluster_waits();
  const size_t me = size_t(f->block->index) * f->block->threads + f->thread;
  if (waits.size() <= me) waits.resize(me + 1, 0);
  cluster_wait_for(waits[me]++);
}
inline void send_async(Remote to, float4 x, Remote bar) {
  emulator::Store s{reinterpret_cast<float*>(to), x, reinterpret_cast<emulator::Bar*>(bar)};
  if (emulator::machine().order == 0) emulator::deliver(s);
  else emulator::machine().flying.push_back(s);
}
inline void bar_init(uint64_t* bar) {
  auto* b = reinterpret_cast<emulator::Bar*>(bar);
  b->tx = 0; b->pending = 1; b->phase = 0;
}
inline void bar_init_fence() {}
inline void bar_expect(uint64_t* bar, int bytes) {
  auto* b = reinterpret_cast<emulator::Bar*>(bar);
  if (b->pending != 1) { fprintf(stderr, "an mbarrier was armed twice\n"); abort(); }
  b->tx = b->tx + bytes;
  b->pending = 0;
  emulator::check_bar(b);
}
struct BarWait { emulator::Bar* bar; int parity; };
inline bool bar_done(void* p) {
  auto* w = static_cast<BarWait*>(p);
  return (w->bar->phase & 1) != w->parity;
}
inline void bar_wait(uint64_t* bar, int parity) {
  BarWait w{reinterpret_cast<emulator::Bar*>(bar), parity};
  if (!bar_done(&w)) emulator::wait(bar_done, &w);
}
template <typename T>
inline void copy_async(T* to, const T* from) {
  static_assert(sizeof(T) == 4, "");
  emulator::machine().self->copies.push_back({to, from});
}
inline void copy_async_wait() {
  auto& copies = emulator::machine().self->copies;
  for (auto& c : copies) memcpy(c.first, c.second, 4);
  copies.clear();
}
inline void global_arrive(uint32_t* counter) { ++*counter; }
inline uint32_t load_acquire(const uint32_t* p) { return *const_cast<const volatile uint32_t*>(p); }
inline uint32_t load_global(const uint32_t* p) { return *p; }
inline float load_global(const float* p) { return *p; }
inline void store_global(uint32_t* p, uint32_t x) { *p = x; }
inline void store_global(float* p, float x) { *p = x; }
inline float fast_exp(float x) { return expf(x); }
inline float fast_divide(float x, float y) { return x / y; }
inline float fast_sqrt(float x) { return sqrtf(x); }
inline bool finite(float x) { return fabsf(x) <= 3.402823466e38f; }

}  // namespace
