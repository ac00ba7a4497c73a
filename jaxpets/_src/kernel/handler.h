// The rollout as an XLA custom call. Included after the layout of the weights.
#pragma once

#include "rollout.h"
#include "xla_call.h"

namespace {

// Reads the operands. Returns what is wrong with them, or nothing.
const char* read(const Call& call, Rollout& rollout) {
  if (call.args.size != 5 || call.rets.size != 1) return "there are other operands";
  const auto operand = [&call](int i) -> const Operand& {
    return *static_cast<const Operand*>(call.args.args[i]);
  };
  const Operand &weights = operand(0), &shared = operand(1), &keys = operand(2),
                &obs = operand(3), &actions = operand(4),
                &path = *static_cast<const Operand*>(call.rets.rets[0]);
  const int64_t axes = path.rank - 5;
  if (axes < 0 || axes > MAX_BATCH_AXES) return "jax.vmap is nested too deeply";
  for (int i = 0; i < 5; ++i)
    if (operand(i).rank < axes) return "an operand lacks an axis";
  const int64_t* const dims = path.dims + axes;  // [N, H + 1, E, P, OBS]
  rollout.weights = static_cast<const Weight*>(weights.data);
  rollout.shared = static_cast<const float*>(shared.data);
  rollout.keys = static_cast<const uint32_t*>(keys.data);
  rollout.obs = static_cast<const float*>(obs.data);
  rollout.actions = static_cast<const float*>(actions.data);
  rollout.path = static_cast<float*>(path.data);
  rollout.num_candidates = dims[0];
  rollout.horizon = dims[1] - 1;
  rollout.num_members = dims[2];
  rollout.particles = dims[3];
  if (dims[4] != OBS || weights.dims[axes] != rollout.num_members ||
      weights.dims[axes + 1] != MEMBER_WEIGHTS || shared.dims[axes] != SHARED_NUMBERS ||
      keys.dims[axes + 1] != KEY)
    return "the operands are those of another model";
  if (product(path, axes) > INT32_MAX || product(actions, axes) > INT32_MAX)
    return "a path has more than 2^31 numbers; plan in chunks";
  rollout.batch = 1;
  for (int axis = 0; axis < MAX_BATCH_AXES; ++axis) {
    BatchAxis& out = rollout.axes[axis];
    if (axis >= axes) {
      out = {1, 0, 0, 0, 0, 0};
      continue;
    }
    out.size = path.dims[axis];
    out.weights = batch_stride(weights, axis);
    out.shared = batch_stride(shared, axis);
    out.keys = batch_stride(keys, axis);
    out.obs = batch_stride(obs, axis);
    out.actions = batch_stride(actions, axis);
    rollout.batch *= out.size;
  }
  return nullptr;
}

}  // namespace
