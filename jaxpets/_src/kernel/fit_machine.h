// A GPU of clusters on a CPU: a fiber for each CUDA thread. Which fiber runs next, and when a
// remote store arrives, is drawn from a seed, and what nobody wrote is NaN. So a missing
// barrier shows up as wrong numbers, and one that never completes as an error.
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
// How often each thread has waited for its cluster.
inline std::vector<uint32_t>& cluster_waits() { static std::vector<uint32_t> w; return w; }

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
