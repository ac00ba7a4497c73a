// The rollout as an XLA custom call. Included after the layout of the weights.
#pragma once

#include <string>
#include <utility>

#include "rollout.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;

int64_t product(ffi::AnyBuffer::Dimensions dims, size_t first, size_t last) {
  int64_t result = 1;
  for (size_t i = first; i < last; ++i) result *= dims[i];
  return result;
}

// Elements to move along axis `axis` of an operand.
int64_t batch_stride(const ffi::AnyBuffer& operand, size_t axis) {
  const auto dims = operand.dimensions();
  return dims[axis] == 1 ? 0 : product(dims, axis + 1, dims.size());
}

struct Problem {
  Rollout rollout;
  std::string error;
};

Problem read(ffi::AnyBuffer weights, ffi::AnyBuffer shared, ffi::AnyBuffer keys,
             ffi::AnyBuffer obs, ffi::AnyBuffer actions,
             ffi::AnyBuffer path) {
  const auto dims = path.dimensions();  // [..., N, H + 1, E, P, OBS]
  const size_t axes = dims.size() - 5;
  Rollout rollout = {};
  if (axes > MAX_BATCH_AXES) return {rollout, "jax.vmap is nested too deeply"};
  for (auto* operand : {&weights, &shared, &keys, &obs, &actions})
    if (operand->dimensions().size() < axes) return {rollout, "an operand lacks an axis"};
  rollout.weights = static_cast<const Weight*>(weights.untyped_data());
  rollout.shared = static_cast<const float*>(shared.untyped_data());
  rollout.keys = static_cast<const uint32_t*>(keys.untyped_data());
  rollout.obs = static_cast<const float*>(obs.untyped_data());
  rollout.actions = static_cast<const float*>(actions.untyped_data());
  rollout.path = static_cast<float*>(path.untyped_data());
  rollout.num_candidates = dims[axes];
  rollout.horizon = dims[axes + 1] - 1;
  rollout.num_members = dims[axes + 2];
  rollout.particles = dims[axes + 3];
  if (dims[axes + 4] != OBS ||
      weights.dimensions()[axes] != rollout.num_members ||
      weights.dimensions()[axes + 1] != MEMBER_WEIGHTS ||
      shared.dimensions()[axes] != SHARED_NUMBERS || keys.dimensions()[axes + 1] != KEY)
    return {rollout, "the operands are those of another model"};
  const auto action_dims = actions.dimensions();
  if (product(dims, axes, dims.size()) > INT32_MAX ||
      product(action_dims, axes, action_dims.size()) > INT32_MAX)
    return {rollout, "a path has more than 2^31 numbers; plan in chunks"};
  rollout.batch = product(dims, 0, axes);
  for (int axis = 0; axis < MAX_BATCH_AXES; ++axis) {
    BatchAxis& out = rollout.axes[axis];
    if (static_cast<size_t>(axis) >= axes) {
      out = {1, 0, 0, 0, 0, 0};
      continue;
    }
    out.size = dims[axis];
    out.weights = batch_stride(weights, axis);
    out.shared = batch_stride(shared, axis);
    out.keys = batch_stride(keys, axis);
    out.obs = batch_stride(obs, axis);
    out.actions = batch_stride(actions, axis);
  }
  return {rollout, ""};
}

// What every `run` takes after its contexts: the operands as `read` has them.
template <class Binding>
auto with_operands(Binding binding) {
  return std::move(binding)
      .template Arg<ffi::AnyBuffer>()
      .template Arg<ffi::AnyBuffer>()
      .template Arg<ffi::AnyBuffer>()
      .template Arg<ffi::AnyBuffer>()
      .template Arg<ffi::AnyBuffer>()
      .template Ret<ffi::AnyBuffer>();
}

}  // namespace
