// A kernel as an XLA custom call.
//
// A call comes as a frame of C structs. XLA also has C++ for them, which alone takes two
// seconds to compile. What is used here has the same names in jaxlib 0.10 and 0.11; zero
// is right for whatever else the structs have.
#pragma once

#include <cstdint>

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

// Finds the stream of a GPU that XLA calls on.
XLA_FFI_Error* get_stream(const Call& call, void*& stream) {
  XLA_FFI_Stream_Get_Args args = {};
  args.struct_size = XLA_FFI_Stream_Get_Args_STRUCT_SIZE;
  args.ctx = call.ctx;
  XLA_FFI_Error* const error = call.api->XLA_FFI_Stream_Get(&args);
  stream = args.stream;
  return error;
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

// What XLA calls: reads the operands and runs the work that they make, or says what `run`
// was built for and what it may do.
template <typename Work>
XLA_FFI_Error* handle(const Call& call, XLA_FFI_Handler_Traits traits,
                      const char* read(const Call&, Work&),
                      XLA_FFI_Error* run(const Call&, const Work&)) {
  auto* const asked = call.extension_start;
  if (asked && asked->type == XLA_FFI_Extension_Metadata) {
    auto& about = *reinterpret_cast<XLA_FFI_Metadata_Extension*>(asked)->metadata;
    about.api_version = {XLA_FFI_Api_Version_STRUCT_SIZE, nullptr, XLA_FFI_API_MAJOR,
                         XLA_FFI_API_MINOR};
    about.traits = traits;
    about.state_type_id = XLA_FFI_UNKNOWN_TYPE_ID;  // no state is kept
    return nullptr;
  }
  Work work = {};
  const char* const problem = read(call, work);
  return problem ? failure(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, problem)
                 : run(call, work);
}

}  // namespace
