// What a block of a fit works with: its shared memory, its place, its part of the rows.
#pragma once

#include <stddef.h>

#include <utility>

#include "fit_operands.h"

namespace {

struct Adam {
  float b1, b2, one_b1, one_b2, eps;
  float c1, c2, rate;  // of a step: 1 / corrections, step size

  DEVICE float step(float w, float g, float& m, float& v) const {
    m = b1 * m + one_b1 * g;
    v = b2 * v + one_b2 * (g * g);
    return w - rate * fast_divide(m * c1, fast_sqrt(v * c2) + eps);
  }
};

struct alignas(128) Shared {
  float w[w_offset(LAYERS)];
  float x0[2][INPUTS * ROWS];                   // of this chunk and the next
  float x[LAYERS > 1 ? x_offset(LAYERS) : 32];  // inputs of layers 1, ...
  float h[PADDED_COLS * ROWS];                  // own outputs of the last hidden layer
  float dy[LAYERS][PADDED_COLS * ROWS];         // derivatives, then gradients
  // Sums of the warps in a product, and gradients of inputs as they come from blocks.
  float part[most(2 * CTAS * COLS * ROWS, WARPS * PADDED_COLS * ROWS)];
  float zin[CTAS * 2 * DIMS * ROWS];
  float dyo[OUTS * ROWS];
  float target[2][DIMS * ROWS];
  float wo[PADDED_COLS * OUT_STRIDE], mo[PADDED_COLS * OUT_STRIDE],
      vo[PADDED_COLS * OUT_STRIDE], go[PADDED_COLS * OUT_STRIDE];
  float b[LAYERS][PADDED_COLS], mb[LAYERS][PADDED_COLS], vb[LAYERS][PADDED_COLS],
      gb[LAYERS][PADDED_COLS];
  float bo[2 * DIMS], mbo[2 * DIMS], vbo[2 * DIMS], gbo[2 * DIMS];
  // Low and high: values, moments, gradients of this member.
  float bound[2][DIMS], mbound[2][DIMS], vbound[2][DIMS], gbound[2][DIMS];
  float nll[DIMS], mse[DIMS], total_nll[DIMS], total_mse[DIMS];
  float decay[LAYERS + 1];
  Adam adam;
  int good;
  int index[3][ROWS];
  alignas(8) uint64_t bars[2 * LAYERS + 2];
};
// What a barrier is armed for: partial outputs, gradients of outputs, the inputs of each
// layer, and parts in their gradients.
enum { BAR_Z = 0, BAR_DYO = 1, BAR_X = 2, BAR_PART = 2 + LAYERS };

static_assert(offsetof(Shared, x) % 16 == 0 && offsetof(Shared, h) % 16 == 0 &&
                  offsetof(Shared, dy) % 16 == 0 && offsetof(Shared, part) % 16 == 0 &&
                  offsetof(Shared, zin) % 16 == 0 && offsetof(Shared, dyo) % 16 == 0, "");
static_assert(sizeof(Shared) == SHARED_BYTES, "fit_layout.py counts otherwise");

// Whole numbers that templates can be made with: each<3>(f) calls f for 0, 1, 2.
template <int I>
struct Number {
  __host__ __device__ constexpr operator int() const { return I; }
};
template <int... I, typename F>
DEVICE void each(std::integer_sequence<int, I...>, F&& f) {
  (f(Number<I>{}), ...);
}
template <int N, typename F>
DEVICE void each(F&& f) {
  each(std::make_integer_sequence<int, N>{}, f);
}

DEVICE float4 load4(const float* p) { return *reinterpret_cast<const float4*>(p); }
DEVICE float2 load2(const float* p) { return *reinterpret_cast<const float2*>(p); }
DEVICE void store2(float* p, float2 x) { *reinterpret_cast<float2*>(p) = x; }

// A lane's weights in a slot: of which layer, and its first input there.
struct Unit {
  int layer, k;
  int fan_in, w, x, params, width, cols;

  DEVICE int input(int run) const { return k + 8 * (run % 2); }
};

struct Block {
  Shared& s;
  const int tid, warp, lane, rank, member;
  const int dims;  // own

  template <int L>
  DEVICE int own_cols() const {
    constexpr int WIDTH = width(L), OWN = cols(L);
    const int left = WIDTH - rank * OWN;
    return left < 0 ? 0 : least(left, OWN);
  }

  // The same. What follows from a thread's place is then computed where it is needed: kept
  // from phase to phase, it would take the registers of moments.
  DEVICE Block fresh() const {
    int t = tid, r = rank;
    forget(t);
    forget(r);
    return Block{s, t, t / 32, t % 32, r, member, dims};
  }

  // Inputs of a layer.
  template <int L>
  DEVICE const float* x_of(int buffer) const {
    constexpr int OFFSET = x_offset(L);
    return L == 0 ? s.x0[buffer] : s.x + OFFSET;
  }

  // The first column of a run, and where its weights are.
  DEVICE int column(int run) const { return run / 2 * 8 + lane % 4 * 2; }
  DEVICE float* place(const Unit& unit, int run) const {
    return s.w + unit.w + unit.input(run) * W_STRIDE + column(run);
  }
  DEVICE Unit unit_of(int slot) const {
    const int u = slot * WARPS + warp;
    Unit unit = {-1, 0, 0, 0, 0, 0, 0, 0};
    each<LAYERS>([&](auto layer) {
      constexpr int L = layer;
      constexpr int FIRST = first_unit(L), END = FIRST + units(L), K = ::fan_in(L),
                    W = w_offset(L), X = x_offset(L), P = p_offset(L), N = ::width(L),
                    OWN = ::cols(L);
      if (u >= FIRST && u < END)
        unit = {L, (u - FIRST) * UNIT + lane / 4, K, W, X, P, N, OWN};
    });
    return unit;
  }
};

// Up to ROWS rows of a minibatch. The gradients of its chunks add up.
struct Chunk {
  int step, start, count, batch_rows;
  bool first, last;
};
DEVICE Chunk chunk_of(int q, int size, int batch) {
  const int per_batch = (batch + ROWS - 1) / ROWS;
  Chunk c;
  c.step = q / per_batch;
  const int j = q - c.step * per_batch, batch_start = c.step * batch;
  c.batch_rows = least(batch, size - batch_start);
  c.start = batch_start + j * ROWS;
  c.count = least(ROWS, c.batch_rows - j * ROWS);
  c.first = j == 0;
  c.last = (j + 1) * ROWS >= c.batch_rows;
  return c;
}

}  // namespace
