// How a kernel of a GPU is launched for XLA.
#pragma once

#include "xla_call.h"

namespace {

// Lets a kernel's blocks have so much shared memory, and launches it with
// `launch(stream)`, which returns what fails before. The stream is only launched on, so
// XLA may record the call in a CUDA graph.
template <typename Launch>
XLA_FFI_Error* launch_on_stream(const Call& call, const void* kernel, size_t shared,
                                Launch launch) {
  void* stream;
  if (XLA_FFI_Error* none = get_stream(call, stream)) return none;
  cudaError_t error = cudaFuncSetAttribute(
      kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shared));
  if (error == cudaSuccess) error = launch(static_cast<cudaStream_t>(stream));
  if (error == cudaSuccess) error = cudaGetLastError();
  if (error == cudaSuccess) return nullptr;
  return failure(call, XLA_FFI_Error_Code_INTERNAL, cudaGetErrorString(error));
}

}  // namespace
