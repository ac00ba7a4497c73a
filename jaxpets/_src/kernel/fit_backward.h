// The way back of a chunk: gradients of activations, which blocks send one another, and
// of weights.
#pragma once

#include "fit_block.h"

namespace {

// The gradient of the own columns of the last hidden layer.
DEVICE void last_gradient(const Block& block) {
  constexpr int ITEMS = PADDED_COLS * ROWS / 2;
  Shared& s = block.s;
  for (int item = block.tid; item < ITEMS; item += THREADS) {
    const int c = item / (ROWS / 2), row = item % (ROWS / 2) * 2;
    float a = 0.0f, b = 0.0f;
#pragma unroll 6
    for (int n = 0; n < OUTS; ++n) {
      const float2 y = load2(s.dyo + at(n, row));
      const float w = s.wo[c * OUT_STRIDE + n];
      a += w * y.x; b += w * y.y;
    }
    float* to = s.dy[LAST] + at(c, row);
    const float2 slope = load2(to);
    store2(to, make_float2(a * slope.x, b * slope.y));
  }
}

DEVICE void output_weight_gradient(const Block& block, bool first) {
  constexpr int ITEMS = ceil_div(LAST_COLS, 2) * OUTS;
  Shared& s = block.s;
  for (int item = block.tid; item < ITEMS; item += THREADS) {
    const int k = item / OUTS * 2, n = item % OUTS;
    float a = 0.0f, b = 0.0f;
#pragma unroll
    for (int q = 0; q < QUADS; ++q) {
      const float4 y = load4(s.dyo + quad(n, q));
      const float4 u = load4(s.h + quad(k, q)), v = load4(s.h + quad(k + 1, q));
      a += u.x * y.x + u.y * y.y + u.z * y.z + u.w * y.w;
      b += v.x * y.x + v.y * y.y + v.z * y.z + v.w * y.w;
    }
    float &ga = s.go[k * OUT_STRIDE + n], &gb = s.go[(k + 1) * OUT_STRIDE + n];
    ga = first ? a : ga + a;
    gb = first ? b : gb + b;
  }
}

// The own columns' part in the gradient of the inputs of layer L, to whom they belong.
// Which row is which of an instruction's is free: a lane gets four that follow one
// another from two instructions.
template <int L>
DEVICE void send_gradient(const Block& block) {
  constexpr int OWN = cols(L - 1), OFFSET = w_offset(L), K = fan_in(L);
  constexpr int TILES = ceil_div(K, 16), EIGHTS = ROWS / 8;
  Shared& s = block.s;
  const int rank = block.rank, i = block.lane / 4, j = block.lane % 4;
  uint32_t b[TILES_OF_COLS][EIGHTS][2];
#pragma unroll
  for (int n = 0; n < TILES_OF_COLS; ++n)
#pragma unroll
    for (int q = 0; q < EIGHTS; ++q) {
      const int row = q / 2 * 16 + i / 2 * 4 + q % 2 * 2 + i % 2;
      b[n][q][0] = tf32(s.dy[L][at(8 * n + j, row)]);
      b[n][q][1] = tf32(s.dy[L][at(8 * n + j + 4, row)]);
    }
  const float* w = s.w + OFFSET + j;
  const float* to = s.part + (L % 2 * CTAS + rank) * COLS * ROWS + 4 * j;
  for (int tile = block.warp; tile < TILES; tile += WARPS) {
    const int turned = (tile + rank) % TILES;  // not all to one at once
    const int k0 = 16 * turned + i, k1 = k0 + 8;
    const float *w0 = w + least(k0, K - 1) * W_STRIDE,
                *w1 = w + least(k1, K - 1) * W_STRIDE;
    float sums[EIGHTS][4] = {};
#pragma unroll
    for (int n = 0; n < TILES_OF_COLS; ++n) {
      const uint32_t a[4] = {tf32(w0[8 * n]), tf32(w1[8 * n]), tf32(w0[8 * n + 4]),
                             tf32(w1[8 * n + 4])};
#pragma unroll
      for (int q = 0; q < EIGHTS; ++q) mma(sums[q], a, b[n][q]);
    }
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const int k = h ? k1 : k0;
      if (k >= K) continue;
      const int owner = k / OWN, c = k % OWN;
      const Remote there = peer(to + c * ROWS, owner);
      const Remote bar = peer(&s.bars[BAR_PART + L], owner);
#pragma unroll
      for (int q = 0; q < EIGHTS; q += 2)
        send_async(there + q / 2 * 16 * sizeof(float),
                   make_float4(sums[q][2 * h], sums[q][2 * h + 1], sums[q + 1][2 * h],
                               sums[q + 1][2 * h + 1]), bar);
    }
  }
}

// Adds what came for layer L - 1.
template <int L>
DEVICE void add_gradient(const Block& block) {
  constexpr int ITEMS = PADDED_COLS * ROWS / 2;
  Shared& s = block.s;
  const int valid = block.own_cols<L - 1>();
  for (int item = block.tid; item < ITEMS; item += THREADS) {
    const int c = item / (ROWS / 2), row = item % (ROWS / 2) * 2;
    float* to = s.dy[L - 1] + at(c, row);
    float a = 0.0f, b = 0.0f;
    if (c < valid) {
      const float* from = s.part + (L % 2 * CTAS * COLS + c) * ROWS + row;
#pragma unroll
      for (int i = 0; i < CTAS; ++i) {
        const float2 two = load2(from + i * COLS * ROWS);
        a += two.x; b += two.y;
      }
      const float2 slope = load2(to);
      a *= slope.x; b *= slope.y;
    }
    store2(to, make_float2(a, b));
  }
}

// Adds this chunk's part to a slot's gradient of weights.
DEVICE void weight_gradient(const Block& block, int slot, int buffer,
                            float (&g)[RUNS * RUN]) {
  Shared& s = block.s;
  const Unit unit = block.unit_of(slot);
  if (unit.layer < 0) return;
  const float* x = unit.layer ? s.x + unit.x : s.x0[buffer];
  const float* dy = s.dy[unit.layer];
  const int k0 = least(unit.input(0), unit.fan_in - 1),
            k1 = least(unit.input(1), unit.fan_in - 1);
  const int i = block.lane / 4, j = block.lane % 4;
#pragma unroll 2
  for (int row = 0; row < ROWS; row += 8) {
    const uint32_t a[4] = {tf32(x[at(k0, row + j)]), tf32(x[at(k1, row + j)]),
                           tf32(x[at(k0, row + j + 4)]), tf32(x[at(k1, row + j + 4)])};
#pragma unroll
    for (int t = 0; t < TILES_OF_COLS; ++t) {
      const uint32_t b[2] = {tf32(dy[at(8 * t + i, row + j)]),
                             tf32(dy[at(8 * t + i, row + j + 4)])};
      mma(*reinterpret_cast<float(*)[4]>(g + 4 * t), a, b);
    }
  }
}

DEVICE void bias_gradients(const Block& block, bool first) {
  constexpr int ITEMS = LAYERS * PADDED_COLS * 4;
  Shared& s = block.s;
  for (int start = 0; start < ITEMS; start += THREADS) {
    const int item = start + block.tid, part = item % 4, c = item / 4 % PADDED_COLS,
              l = item / 4 / PADDED_COLS;
    float sum = 0.0f;
    if (item < ITEMS) {
#pragma unroll
      for (int q = 0; q < QUADS; q += 4) {
        const float4 y = load4(s.dy[l] + quad(c, q + part));
        sum += y.x + y.y + y.z + y.w;
      }
    }
    sum += shuffle_xor(sum, 1);
    sum += shuffle_xor(sum, 2);
    if (item < ITEMS && part == 0) s.gb[l][c] = first ? sum : s.gb[l][c] + sum;
  }
}

}  // namespace
