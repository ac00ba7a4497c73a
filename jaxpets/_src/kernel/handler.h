// The rollout as an XLA custom call. Included after the layout of the weights.
//
// A call comes as a frame of C structs. XLA also has C++ for them, which alone takes two
// seconds to compile. What is used here has the same names in jaxlib 0.10 and 0.11; zero
// is right for whatever else the structs have.
#pragma once

#include "rollout.h"
#include "xla/ffi/api/c_api.h"

namespace {

using Call = XLA_FFI_CallFrame;
using Operand = XLA_FFI_Buffer;

XLA_FFI_Error* failure(const Call& call, XLA_FFI_Error_Code code, const char* message) {
  XLA_FFI_Error_Create_Args args = {};
  args.struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE;
  args.message = message;
  args.errc = code;
  return call.api->XLA_FFI_Error_Create(&args);
}

int64_t product(const Operand& operand, int64_t first) {
  int64_t result = 1;
  for (int64_t i = first; i < operand.rank; ++i) result *= operand.dims[i];
  return result;
}

// Elements to move along axis `axis` of an operand.
int64_t batch_stride(const Operand& operand, int axis) {
  return operand.dims[axis] == 1 ? 0 : product(operand, axis + 1);
}

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

// What XLA calls: runs a rollout, or says what `run` was built for and what it may do.
XLA_FFI_Error* handle(const Call& call, XLA_FFI_Handler_Traits traits,
                      XLA_FFI_Error* run(const Call&, const Rollout&)) {
  auto* const asked = call.extension_start;
  if (asked && asked->type == XLA_FFI_Extension_Metadata) {
    auto& about = *reinterpret_cast<XLA_FFI_Metadata_Extension*>(asked)->metadata;
    about.api_version = {XLA_FFI_Api_Version_STRUCT_SIZE, nullptr, XLA_FFI_API_MAJOR,
                         XLA_FFI_API_MINOR};
    about.traits = traits;
    about.state_type_id = XLA_FFI_UNKNOWN_TYPE_ID;  // no state is kept
    return nullptr;
  }
  Rollout rollout = {};
  const char* const problem = read(call, rollout);
  return problem ? failure(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, problem)
                 : run(call, rollout);
}

}  // namespace
