// The operands of a fit, and how XLA hands them over.
#pragma once

#include <type_traits>

#include "fit_sizes.h"
#include "xla_call.h"

namespace {

// Words of the scratch of a seed: how many blocks have come, which of three steps were
// bad, and the gradients of the bounds by all members in two steps.
constexpr int SCRATCH_BAD = 32, SCRATCH_BOUNDS = 64;
constexpr int SCRATCH = SCRATCH_BOUNDS + 2 * MEMBERS * OUTS;

constexpr int NUM_HYPER = DECAYS + LAYERS + 1;

// All operands have the seeds first.
struct Fit {
  const float *params, *m, *v;    // [MEMBERS, PARAMS]: parameters, Adam's moments
  const float* bounds;            // [6, OBS]: low, high, their moments
  const int32_t *count, *size;    // []
  const float *inputs, *targets;  // [capacity, INPUTS], [capacity, OBS]
  const int32_t* rows;            // [MEMBERS, capacity]
  const float* hyper;             // [NUM_HYPER]
  float *params_out, *m_out, *v_out, *bounds_out;
  int32_t* count_out;
  float* totals;      // [MEMBERS, CTAS, 2]: sums over rows of nll and mse
  float* num_rows;    // []
  int32_t* skipped;   // []
  uint32_t* scratch;  // [SCRATCH], zeros
  int64_t capacity;
  int num_seeds, first_seed;
};

// Reads the operands. Returns what is wrong with them, or nothing.
const char* read(const Call& call, Fit& fit) {
  if (call.args.size != 10 || call.rets.size != 9) return "there are other operands";
  const auto operand = [&](int i) -> const Operand& {
    return *static_cast<const Operand*>(call.args.args[i]);
  };
  const auto result = [&](int i) -> const Operand& {
    return *static_cast<const Operand*>(call.rets.rets[i]);
  };
  const Operand &params = operand(0), &rows = operand(8);
  const int64_t axes = params.rank - 2;  // what jax.vmap put in front
  if (axes < 0 || rows.rank != axes + 2 || operand(6).rank != axes + 2 ||
      operand(7).rank != axes + 2 || operand(9).rank != axes + 1 ||
      params.dims[axes] != MEMBERS || params.dims[axes + 1] != PARAMS ||
      operand(6).dims[axes + 1] != INPUTS || operand(7).dims[axes + 1] != OBS ||
      rows.dims[axes] != MEMBERS || operand(9).dims[axes] != NUM_HYPER ||
      result(8).dims[axes] != SCRATCH)
    return "the operands are those of another model";
  fit.num_seeds = 1;
  for (int64_t i = 0; i < axes; ++i) fit.num_seeds *= int(params.dims[i]);
  fit.capacity = rows.dims[axes + 1];
  const auto find = [](const Operand& there, auto& data) {
    data = static_cast<std::decay_t<decltype(data)>>(there.data);
  };
  find(operand(0), fit.params);
  find(operand(1), fit.m);
  find(operand(2), fit.v);
  find(operand(3), fit.bounds);
  find(operand(4), fit.count);
  find(operand(5), fit.size);
  find(operand(6), fit.inputs);
  find(operand(7), fit.targets);
  find(operand(8), fit.rows);
  find(operand(9), fit.hyper);
  find(result(0), fit.params_out);
  find(result(1), fit.m_out);
  find(result(2), fit.v_out);
  find(result(3), fit.bounds_out);
  find(result(4), fit.count_out);
  find(result(5), fit.totals);
  find(result(6), fit.num_rows);
  find(result(7), fit.skipped);
  find(result(8), fit.scratch);
  return nullptr;
}

}  // namespace
