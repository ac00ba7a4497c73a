// What stays in a block for a whole launch: it is read, updated by Adam, and written.
#pragma once

#include "fit_block.h"

namespace {

// A thread's gradients and moments of hidden layers' weights, in registers.
struct Moments {
  float g[SLOTS][RUNS * RUN], m[SLOTS][RUNS * RUN], v[SLOTS][RUNS * RUN];
};

// Of a run of weights in a slot: where it is in a member's parameters.
DEVICE int parameter(const Block& block, const Unit& unit, int run, int column) {
  return unit.params + unit.input(run) * unit.width + block.rank * unit.cols + column;
}

DEVICE void read_state(const Block& block, const Fit& fit, int64_t seed,
                       const float* hyper, Moments& moments) {
  Shared& s = block.s;
  const int tid = block.tid, rank = block.rank;
  const int64_t first = (seed * MEMBERS + block.member) * PARAMS;
  const float *p = fit.params + first, *pm = fit.m + first, *pv = fit.v + first;
  each<SLOTS>([&](auto slot) {
    constexpr int SLOT = slot;
    const auto unit = block.unit_of(SLOT);
    const int valid = unit.layer < 0 ? 0 : least(unit.cols, unit.width - rank * unit.cols);
#pragma unroll
    for (int run = 0; run < RUNS; ++run) {
      float w[RUN] = {};
      const bool there = unit.layer >= 0 && unit.input(run) < unit.fan_in;
#pragma unroll
      for (int j = 0; j < RUN; ++j) {
        const int c = block.column(run) + j, i = run * RUN + j;
        const bool own = there && c < valid;
        const int from = own ? parameter(block, unit, run, c) : 0;
        w[j] = own ? p[from] : 0.0f;
        moments.m[SLOT][i] = own ? pm[from] : 0.0f;
        moments.v[SLOT][i] = own ? pv[from] : 0.0f;
        moments.g[SLOT][i] = 0.0f;
      }
      if (there) store2(block.place(unit, run), make_float2(w[0], w[1]));
    }
  });
  each<LAYERS>([&](auto layer) {
    constexpr int L = layer;
    for (int c = tid; c < PADDED_COLS; c += THREADS) {
      const bool own = c < block.template own_cols<L>();
      constexpr int FIRST = p_offset(L) + fan_in(L) * width(L), OWN = cols(L);
      const int from = own ? FIRST + rank * OWN + c : 0;
      s.b[L][c] = own ? p[from] : 0.0f;
      s.mb[L][c] = own ? pm[from] : 0.0f;
      s.vb[L][c] = own ? pv[from] : 0.0f;
      s.gb[L][c] = 0.0f;
    }
  });
  for (int i = tid; i <= LAYERS; i += THREADS) s.decay[i] = hyper[DECAYS + i];
  for (int i = tid; i < PADDED_COLS * OUT_STRIDE; i += THREADS) {
    const int k = i / OUT_STRIDE, n = i % OUT_STRIDE;
    const bool own = k < block.own_cols<LAST>() && n < OUTS;
    const int from = own ? P_OUT + (rank * LAST_COLS + k) * OUTS + n : 0;
    s.wo[i] = own ? p[from] : 0.0f;
    s.mo[i] = own ? pm[from] : 0.0f;
    s.vo[i] = own ? pv[from] : 0.0f;
    s.go[i] = 0.0f;
  }
  const float* bounds = fit.bounds + seed * 6 * OBS;
  for (int i = tid; i < 2 * DIMS; i += THREADS) {
    const int d = i % DIMS, which = i / DIMS, n = which * OBS + rank * DIMS + d;
    const bool own = d < block.dims;
    s.bo[i] = own ? p[P_OUT_BIAS + n] : 0.0f;
    s.mbo[i] = own ? pm[P_OUT_BIAS + n] : 0.0f;
    s.vbo[i] = own ? pv[P_OUT_BIAS + n] : 0.0f;
    s.gbo[i] = 0.0f;
    s.bound[which][d] = own ? bounds[n] : 0.0f;
    s.mbound[which][d] = own ? bounds[2 * OBS + n] : 0.0f;
    s.vbound[which][d] = own ? bounds[4 * OBS + n] : 0.0f;
    s.gbound[which][d] = 0.0f;
  }
  for (int d = tid; d < DIMS; d += THREADS)
    s.nll[d] = s.mse[d] = s.total_nll[d] = s.total_mse[d] = 0.0f;
}

// The corrections and the step size of an update, as optax has them, in float32.
DEVICE void prepare(Adam& adam, const float* hyper, int count, float epoch_done) {
  const float next = float(count + 1);
  const float c1 = 1.0f - powf(adam.b1, next), c2 = 1.0f - powf(adam.b2, next);
  const float done = (hyper[EPOCH] + epoch_done) / hyper[EPOCHS];
  const float final = hyper[FINAL];
  const float cosine = 0.5f * (1.0f + cosf(3.14159265358979f * (done < 1.0f ? done : 1.0f)));
  const float share = final < 1.0f ? (1.0f - final) * cosine + final : 1.0f;
  adam.c1 = 1.0f / c1;
  adam.c2 = 1.0f / c2;
  adam.rate = hyper[RATE] * share;
}

// What the members share: variance bounds, whose gradients are those of all members.
DEVICE void update_bounds(const Block& block, const Adam& adam, const float* gradients,
                          float decay, float rows) {
  Shared& s = block.s;
  // The last warp has the least to do.
  for (int d = block.tid - (WARPS - 1) * 32; d < block.dims; d += 32) {
    if (d < 0) break;
    float sums[2] = {-decay, decay};
#pragma unroll
    for (int e = 0; e < MEMBERS; ++e)
#pragma unroll
      for (int which = 0; which < 2; ++which)
        sums[which] += load_global(gradients + (e * 2 + which) * OBS + d);
#pragma unroll
    for (int which = 0; which < 2; ++which)
      s.bound[which][d] = adam.step(s.bound[which][d], sums[which], s.mbound[which][d],
                                    s.vbound[which][d]);
    const float floor = s.bound[0][d] + 0.1f;
    if (s.bound[1][d] < floor) s.bound[1][d] = floor;
    s.total_nll[d] += rows * s.nll[d];
    s.total_mse[d] += rows * s.mse[d];
  }
}

DEVICE void update_outputs(const Block& block, const Adam& adam) {
  Shared& s = block.s;
  const float decay = s.decay[LAYERS];
  for (int i = block.tid; i < LAST_COLS * OUT_STRIDE; i += THREADS)
    if (i % OUT_STRIDE < OUTS)
      s.wo[i] = adam.step(s.wo[i], s.go[i] + decay * s.wo[i], s.mo[i], s.vo[i]);
  for (int i = block.tid; i < 2 * DIMS; i += THREADS)
    s.bo[i] = adam.step(s.bo[i], s.gbo[i], s.mbo[i], s.vbo[i]);
}

DEVICE void update_biases(const Block& block, const Adam& adam) {
  Shared& s = block.s;
  float *b = &s.b[0][0], *gb = &s.gb[0][0], *mb = &s.mb[0][0], *vb = &s.vb[0][0];
  for (int i = block.tid; i < LAYERS * PADDED_COLS; i += THREADS)
    b[i] = adam.step(b[i], gb[i], mb[i], vb[i]);
}

// The weights of the slots that wait for layer L alone.
template <int L>
DEVICE void update_weights(const Block& block, const Adam& adam, Moments& moments) {
  each<SLOTS>([&](auto slot) {
    constexpr int SLOT = slot;
    if constexpr (needs(SLOT) == L) {
      const Block here = block.fresh();
      const auto unit = here.unit_of(SLOT);
      if (unit.layer < 0) return;
      const float decay = here.s.decay[unit.layer];
#pragma unroll
      for (int run = 0; run < RUNS; ++run) {
        if (unit.input(run) >= unit.fan_in) continue;
        float* place = here.place(unit, run);
        const float2 old = load2(place);
        float w[RUN] = {old.x, old.y};
#pragma unroll
        for (int j = 0; j < RUN; ++j) {
          const int i = run * RUN + j;
          w[j] = adam.step(w[j], moments.g[SLOT][i] + decay * w[j], moments.m[SLOT][i],
                           moments.v[SLOT][i]);
        }
        store2(place, make_float2(w[0], w[1]));
      }
    }
  });
}

DEVICE void write_state(const Block& block, const Fit& fit, int64_t seed,
                        const Moments& moments) {
  Shared& s = block.s;
  const int tid = block.tid, rank = block.rank;
  const int64_t member = seed * MEMBERS + block.member;
  float *p = fit.params_out + member * PARAMS, *pm = fit.m_out + member * PARAMS,
        *pv = fit.v_out + member * PARAMS;
  each<SLOTS>([&](auto slot) {
    constexpr int SLOT = slot;
    const auto unit = block.unit_of(SLOT);
    if (unit.layer < 0) return;
    const int valid = least(unit.cols, unit.width - rank * unit.cols);
#pragma unroll
    for (int run = 0; run < RUNS; ++run) {
      if (unit.input(run) >= unit.fan_in) continue;
      const float* w = block.place(unit, run);
#pragma unroll
      for (int j = 0; j < RUN; ++j) {
        const int c = block.column(run) + j, i = run * RUN + j;
        const int to = parameter(block, unit, run, c);
        if (c < valid) {
          p[to] = w[j]; pm[to] = moments.m[SLOT][i]; pv[to] = moments.v[SLOT][i];
        }
      }
    }
  });
  each<LAYERS>([&](auto layer) {
    constexpr int L = layer;
    for (int c = tid; c < block.template own_cols<L>(); c += THREADS) {
      constexpr int FIRST = p_offset(L) + fan_in(L) * width(L), OWN = cols(L);
      const int to = FIRST + rank * OWN + c;
      p[to] = s.b[L][c]; pm[to] = s.mb[L][c]; pv[to] = s.vb[L][c];
    }
  });
  for (int i = tid; i < PADDED_COLS * OUT_STRIDE; i += THREADS) {
    const int k = i / OUT_STRIDE, n = i % OUT_STRIDE;
    const int to = P_OUT + (rank * LAST_COLS + k) * OUTS + n;
    if (k < block.own_cols<LAST>() && n < OUTS) {
      p[to] = s.wo[i]; pm[to] = s.mo[i]; pv[to] = s.vo[i];
    }
  }
  float* bounds = fit.bounds_out + seed * 6 * OBS;
  for (int i = tid; i < 2 * DIMS; i += THREADS) {
    const int d = i % DIMS, which = i / DIMS, n = which * OBS + rank * DIMS + d;
    if (d >= block.dims) continue;
    const int to = P_OUT_BIAS + n;
    p[to] = s.bo[i]; pm[to] = s.mbo[i]; pv[to] = s.vbo[i];
    if (block.member == 0) {
      bounds[n] = s.bound[which][d];
      bounds[2 * OBS + n] = s.mbound[which][d];
      bounds[4 * OBS + n] = s.vbound[which][d];
    }
  }
  if (tid == 0) {
    float nll = 0.0f, mse = 0.0f;
    for (int d = 0; d < block.dims; ++d) { nll += s.total_nll[d]; mse += s.total_mse[d]; }
    float* totals = fit.totals + (member * CTAS + rank) * 2;
    totals[0] = nll;
    totals[1] = mse;
  }
}

}  // namespace
