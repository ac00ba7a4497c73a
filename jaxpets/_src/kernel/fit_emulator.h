// Hopper's instructions on a CPU, a fiber for each CUDA thread: see fit_device.h. Which
// fiber runs next, and when a remote store arrives, is drawn from a seed, and what nobody
// wrote is NaN. So a missing barrier shows up as wrong numbers, and one that never
// completes as an error.
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <ucontext.h>

#include <algorithm>
#include <memory>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __grid_constant__
#define DEVICE inline

namespace {

struct float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline float2 make_float2(float x, float y) { return {x, y}; }

namespace emulator {

struct Block;
struct Fiber {
  ucontext_t context;
  Block* block;
  int thread;
  bool done = false;
  // What it waits for: true when it may go on.
  bool (*ready)(void*) = nullptr;
  void* what = nullptr;
  std::vector<std::pair<void*, const void*>> copies;  // until it waits for them
};
struct Cluster {
  int size, arrived = 0;
  uint32_t phase = 0;
  std::vector<Block*> blocks;
};
struct Warp {
  int arrived = 0;
  uint32_t phase = 0;
  float value[2][32];
  uint32_t factors[2][32][6];
};
struct Block {
  Cluster* cluster;
  int index, rank, threads;
  int arrived = 0;
  uint32_t phase = 0;
  bool any = false, result = false;
  std::vector<Warp> warps;
  unsigned char* memory;
  int priority;
};
struct Bar {  // 8 bytes, in the place of an mbarrier
  int32_t tx : 24;
  int32_t pending : 4;
  int32_t phase : 4;
  uint32_t unused;
};
struct Store {
  float* to;
  float4 value;
  Bar* bar;
};

struct Machine {
  std::vector<std::unique_ptr<Fiber>> fibers;
  std::vector<Store> flying;
  ucontext_t home;
  Fiber* self = nullptr;
  uint64_t random = 88172645463325252ull;
  int order = 0;
  uint32_t draw() {
    random ^= random << 13; random ^= random >> 7; random ^= random << 17;
    return uint32_t(random >> 16);
  }
};
inline Machine& machine() { static Machine m; return m; }

inline void check_bar(Bar* bar) {
  if (bar->pending == 0 && bar->tx == 0) {
    bar->phase = (bar->phase & 1) ? 0 : 1;
    bar->pending = 1;
  }
}
inline void deliver(const Store& s) {
  memcpy(s.to, &s.value, 16);
  s.bar->tx = s.bar->tx - 16;
  check_bar(s.bar);
}
inline void wait(bool (*ready)(void*), void* what) {
  Machine& m = machine();
  Fiber* f = m.self;
  f->ready = ready;
  f->what = what;
  swapcontext(&f->context, &m.home);
}
struct Phase { uint32_t* phase; uint32_t old; };
inline bool phase_over(void* p) {
  auto* q = static_cast<Phase*>(p);
  return *q->phase != q->old;
}
inline bool always(void*) { return true; }

}  // namespace emulator

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
inline std::vector<uint32_t>& cluster_waits() { static std::vector<uint32_t> w; return w; }
inline void cluster_wait_for(uint32_t old) {
  auto* c = emulator::machine().self->block->cluster;
  emulator::Phase p{&c->phase, old};
  if (c->phase == old) emulator::wait(emulator::phase_over, &p);
}
// The number of the wait is the number of the phase: each thread waits for every phase.
inline void cluster_wait() {
  auto* f = emulator::machine().self;
  auto& waits = cluster_waits();
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

namespace emulator {

template <typename Job>
struct Launch { void (*kernel)(const Job); const Job* job; };
template <typename Job>
inline Launch<Job>& current() { static Launch<Job> l; return l; }
template <typename Job>
inline void entry() {
  current<Job>().kernel(*current<Job>().job);
  Machine& m = machine();
  m.self->done = true;
  swapcontext(&m.self->context, &m.home);
}

// Runs a grid. Calls take turns: in order, and stores arrive at once; at random; one block
// as far ahead of the others as it can get. Returns what is wrong, or nothing.
template <typename Job>
const char* launch(void (*kernel)(const Job), const Job& job, int blocks, int cluster,
                   int threads, size_t shared, int number) {
  const int order = number % 3;
  Machine& m = machine();
  m.fibers.clear();
  m.flying.clear();
  cluster_waits().assign(size_t(blocks) * threads, 0);
  m.order = order;
  m.random = 88172645463325252ull + 7919 * uint64_t(number + 1);
  current<Job>() = {kernel, &job};
  const size_t STACK = 128 << 10;
  std::vector<std::unique_ptr<Cluster>> clusters;
  std::vector<std::unique_ptr<Block>> all;
  std::vector<unsigned char*> memories;
  const size_t total = size_t(blocks) * threads * STACK;
  auto* stacks = static_cast<char*>(mmap(nullptr, total, PROT_READ | PROT_WRITE,
                                         MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0));
  if (stacks == MAP_FAILED) return "no memory for stacks";
  for (int i = 0; i < blocks; ++i) {
    if (i % cluster == 0) {
      clusters.emplace_back(new Cluster);
      clusters.back()->size = cluster * threads;
    }
    auto* b = new Block;
    all.emplace_back(b);
    b->cluster = clusters.back().get();
    b->cluster->blocks.push_back(b);
    b->index = i; b->rank = i % cluster; b->threads = threads;
    b->warps.resize(threads / 32);
    b->memory = static_cast<unsigned char*>(aligned_alloc(128, (shared + 127) / 128 * 128));
    // What is read before it is written is NaN.
    memset(b->memory, 0xff, shared);
    memories.push_back(b->memory);
    b->priority = int(m.draw() & 0xffff);
    for (int t = 0; t < threads; ++t) {
      auto* f = new Fiber;
      m.fibers.emplace_back(f);
      f->block = b; f->thread = t;
      getcontext(&f->context);
      f->context.uc_stack.ss_sp = stacks + (size_t(i) * threads + t) * STACK;
      f->context.uc_stack.ss_size = STACK;
      f->context.uc_link = &m.home;
      makecontext(&f->context, reinterpret_cast<void (*)()>(entry<Job>), 0);
    }
  }
  const char* problem = nullptr;
  std::vector<Fiber*> live;
  for (auto& f : m.fibers) live.push_back(f.get());
  size_t idle = 0;
  while (!live.empty()) {
    bool ran = false;
    if (order) {  // the order of a round, and what arrives before it
      for (size_t i = live.size() - 1; i > 0; --i) std::swap(live[i], live[m.draw() % (i + 1)]);
      if (order == 2)
        std::stable_sort(live.begin(), live.end(), [](Fiber* a, Fiber* b) {
          return a->block->priority < b->block->priority;
        });
      std::vector<Store> left;
      for (auto& s : m.flying) {
        if (m.draw() % 2) deliver(s); else left.push_back(s);
      }
      m.flying.swap(left);
    }
    size_t kept = 0;
    int first = -1;
    for (size_t i = 0; i < live.size(); ++i) {
      Fiber* f = live[i];
      // In order 2 a round is one block's that can run.
      const bool turn = order != 2 || first < 0 || f->block->index == first;
      if (turn && (!f->ready || f->ready(f->what))) {
        if (order == 2 && f->ready != always) first = f->block->index;
        if (f->ready != always) ran = true;
        f->ready = nullptr;
        m.self = f;
        swapcontext(&m.home, &f->context);
      }
      if (!f->done) live[kept++] = f;
    }
    live.resize(kept);
    idle = ran || !m.flying.empty() ? 0 : idle + 1;
    if (idle > 1000) { problem = "the kernel hangs"; break; }
  }
  if (!problem && !m.flying.empty()) problem = "stores still under way at the end";
  m.fibers.clear();
  munmap(stacks, total);
  for (auto* p : memories) free(p);
  return problem;
}

}  // namespace emulator

}  // namespace
