// The way forward of a chunk: each hidden layer's product and activations, the outputs,
// and the loss.
#pragma once

#include "fit_block.h"

namespace {

DEVICE float activate(float z, float& slope) {
  if constexpr (ACTIVATION == SWISH) {
    const float s = fast_divide(1.0f, 1.0f + fast_exp(-z)), h = z * s;
    slope = s + h * (1.0f - s);
    return h;
  } else if constexpr (ACTIVATION == TANH) {
    const float h = tanhf(z);
    slope = 1.0f - h * h;
    return h;
  } else if constexpr (ACTIVATION == RELU) {
    slope = z > 0.0f ? 1.0f : z <= 0.0f ? 0.0f : z;  // NaN stays NaN
    return z > 0.0f ? z : z <= 0.0f ? 0.0f : z;
  } else {
    const float A = 0.7978845608028654f, B = 0.044715f;
    const float t = tanhf(A * (z + B * z * z * z));
    slope = 0.5f * (1.0f + t) + 0.5f * z * (1.0f - t * t) * A * (1.0f + 3.0f * B * z * z);
    return 0.5f * z * (1.0f + t);
  }
}
DEVICE float sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }
DEVICE float softplus(float x) {
  return (x > 0.0f ? x : 0.0f) + log1pf(expf(-fabsf(x)));
}

// The own columns of a layer for all rows. The warps share the inputs, so each has a sum
// of its own. Which input is which of an instruction's is free: with even and odd ones
// apart, loads are without conflicts.
template <int L>
DEVICE void multiply(const Block& block, const float* x) {
  constexpr int K = fan_in(L), OFFSET = w_offset(L), TILES_OF_ROWS = ROWS / 16;
  Shared& s = block.s;
  float sums[TILES_OF_ROWS][TILES_OF_COLS][4] = {};
  const int i = block.lane / 4, j = block.lane % 4;
  const float* w = s.w + OFFSET + i;
#pragma unroll 2
  for (int first = 8 * block.warp; first < K; first += 8 * WARPS) {
    const int k0 = first + 2 * j, k1 = k0 + 1;
    const bool in0 = K % 8 == 0 || k0 < K, in1 = K % 8 == 0 || k1 < K;
    uint32_t a[TILES_OF_ROWS][4], b[TILES_OF_COLS][2];
#pragma unroll
    for (int m = 0; m < TILES_OF_ROWS; ++m)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const int row = 16 * m + 8 * h + i;
        a[m][h] = tf32(in0 ? x[at(k0, row)] : 0.0f);
        a[m][2 + h] = tf32(in1 ? x[at(k1, row)] : 0.0f);
      }
#pragma unroll
    for (int t = 0; t < TILES_OF_COLS; ++t) {
      b[t][0] = tf32(in0 ? w[k0 * W_STRIDE + 8 * t] : 0.0f);
      b[t][1] = tf32(in1 ? w[k1 * W_STRIDE + 8 * t] : 0.0f);
    }
#pragma unroll
    for (int m = 0; m < TILES_OF_ROWS; ++m)
#pragma unroll
      for (int t = 0; t < TILES_OF_COLS; ++t) mma(sums[m][t], a[m], b[t]);
  }
  float* to = s.part + block.warp * PADDED_COLS * ROWS;
#pragma unroll
  for (int m = 0; m < TILES_OF_ROWS; ++m)
#pragma unroll
    for (int t = 0; t < TILES_OF_COLS; ++t)
#pragma unroll
      for (int e = 0; e < 4; ++e)
        to[at(8 * t + 2 * j + e % 2, 16 * m + e / 2 * 8 + i)] = sums[m][t][e];
}

// Adds the warps' sums; sends the activations to all blocks, or keeps the last layer's.
template <int L>
DEVICE void activations(const Block& block) {
  constexpr int ITEMS = PADDED_COLS * ROWS / 2;
  Shared& s = block.s;
  const int rank = block.rank, valid = block.own_cols<L>();
#pragma unroll
  for (int first = 0; first < ITEMS; first += THREADS) {
    const int item = first + block.tid, c = item / (ROWS / 2),
              row = item % (ROWS / 2) * 2;
    float h0 = 0.0f, h1 = 0.0f;
    if (item < ITEMS) {
      float slope0 = 0.0f, slope1 = 0.0f;
      if (c < valid) {
        float z0 = s.b[L][c], z1 = z0;
#pragma unroll
        for (int i = 0; i < WARPS; ++i) {
          const float2 z = load2(s.part + i * PADDED_COLS * ROWS + at(c, row));
          z0 += z.x; z1 += z.y;
        }
        h0 = activate(z0, slope0);
        h1 = activate(z1, slope1);
      }
      store2(s.dy[L] + at(c, row), make_float2(slope0, slope1));
    }
    if constexpr (L == LAST) {
      if (item < ITEMS) store2(s.h + at(c, row), make_float2(h0, h1));
    } else {
      const float o0 = shuffle_xor(h0, 1), o1 = shuffle_xor(h1, 1);
      if (item < ITEMS && c < valid) {
        const bool odd = block.lane & 1;
        const float4 four =
            odd ? make_float4(o0, o1, h0, h1) : make_float4(h0, h1, o0, o1);
        constexpr int OFFSET = x_offset(L + 1), OWN = cols(L);
        const float* to = s.x + OFFSET + quad(rank * OWN + c, row >> 2);
#pragma unroll
        for (int i = 0; i < ceil_div(CTAS, 2); ++i) {
          const int turn = 2 * i + odd;
          if (CTAS % 2 && turn >= CTAS) break;
          const int there = (turn + rank) % CTAS;  // not all to one at once
          send_async(peer(to, there), four, peer(&s.bars[BAR_X + L + 1], there));
        }
      }
    }
  }
}

// The own rows' part in the outputs, to the block that has the dimension.
DEVICE void outputs(const Block& block) {
  constexpr int ITEMS = OUTS * QUADS;
  Shared& s = block.s;
  const int rank = block.rank;
  for (int i = block.tid; i < ITEMS; i += THREADS) {
    // Not all to one at once.
    const int q = i % QUADS, turned = i / QUADS + rank * DIMS, n = turned % OUTS;
    float4 z = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
    for (int k = 0; k < LAST_COLS; ++k) {
      const float4 h = load4(s.h + quad(k, q));
      const float w = s.wo[k * OUT_STRIDE + n];
      z.x += w * h.x; z.y += w * h.y; z.z += w * h.z; z.w += w * h.w;
    }
    const bool raw = n >= OBS;
    const int d = raw ? n - OBS : n, there = d / DIMS, slot = d % DIMS + (raw ? DIMS : 0);
    send_async(peer(s.zin + (rank * 2 * DIMS + slot) * ROWS + 4 * q, there), z,
               peer(&s.bars[BAR_Z], there));
  }
}

// The loss of the own dimensions, and its gradient to all. `weight` is 1 / (rows * D).
DEVICE void loss(const Block& block, int buffer, int count, float weight, bool first) {
  constexpr int ITEMS = DIMS * ROWS;
  Shared& s = block.s;
  const int rank = block.rank, lane = block.lane;
  for (int start = 0; start + block.warp * 32 < ITEMS; start += THREADS) {
    const int item = start + block.tid, d = item / ROWS, row = item % ROWS;
    const bool mine = item < ITEMS && d < block.dims;
    float sums[6] = {};  // of mean, raw, low, high, nll, mse
    if (mine) {
      float mean = s.bo[d], raw = s.bo[DIMS + d];
#pragma unroll
      for (int i = 0; i < CTAS; ++i) {
        mean += s.zin[(i * 2 * DIMS + d) * ROWS + row];
        raw += s.zin[(i * 2 * DIMS + DIMS + d) * ROWS + row];
      }
      const float low = s.bound[0][d], high = s.bound[1][d];
      const float inner = high - softplus(high - raw);
      const float logvar = low + softplus(inner - low);
      const float error = mean - s.target[buffer][d * ROWS + row];
      const float square = error * error, inverse = expf(-logvar);
      const float share = row < count ? weight : 0.0f;
      const float slope = (1.0f - square * inverse) * share;  // by logvar
      const float by_inner = slope * sigmoid(inner - low);
      sums[0] = 2.0f * error * inverse * share;
      sums[1] = by_inner * sigmoid(high - raw);
      sums[2] = slope * sigmoid(low - inner);
      sums[3] = by_inner * sigmoid(raw - high);
      sums[4] = (square * inverse + logvar) * share;
      sums[5] = square * share;
    }
#pragma unroll
    for (int part = 0; part < 2; ++part) {
      float four[4];
#pragma unroll
      for (int i = 0; i < 4; ++i) four[i] = shuffle(sums[part], (lane & ~3) + i);
      if (mine) {
        const int n = part * OBS + rank * DIMS + d;
        const float* to = s.dyo + quad(n, row >> 2);
        for (int turn = lane & 3; turn < CTAS; turn += 4) {
          const int there = (turn + rank) % CTAS;
          send_async(peer(to, there), make_float4(four[0], four[1], four[2], four[3]),
                     peer(&s.bars[BAR_DYO], there));
        }
      }
    }
#pragma unroll
    for (int i = 0; i < 6; ++i)
#pragma unroll
      for (int mask = 1; mask < ROWS; mask *= 2)
        sums[i] += shuffle_xor(sums[i], mask);
    if (mine && row == 0) {
      s.gbo[d] = (first ? 0.0f : s.gbo[d]) + sums[0];
      s.gbo[DIMS + d] = (first ? 0.0f : s.gbo[DIMS + d]) + sums[1];
      s.gbound[0][d] = (first ? 0.0f : s.gbound[0][d]) + sums[2];
      s.gbound[1][d] = (first ? 0.0f : s.gbound[1][d]) + sums[3];
      s.nll[d] = (first ? 0.0f : s.nll[d]) + sums[4];
      s.mse[d] = (first ? 0.0f : s.mse[d]) + sums[5];
    }
  }
}

}  // namespace
