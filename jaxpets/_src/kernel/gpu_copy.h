// Copies between a GPU and the host, in the order of the stream that XLA calls on.
#pragma once

#include <dlfcn.h>

#include <string>

#include "xla_call.h"

namespace {

enum class Way { to_host, to_gpu };

// Calls CUDA's driver, which is there wherever XLA has such a GPU, so that nothing is
// linked for it. Returns what failed.
template <typename... Arguments>
std::string driver(const char* name, Arguments... arguments) {
  static void* const library = dlopen("libcuda.so.1", RTLD_NOW);
  void* const found = library ? dlsym(library, name) : nullptr;
  if (!found) return std::string("there is no ") + name + " of a GPU's driver";
  const int error = reinterpret_cast<int (*)(Arguments...)>(found)(arguments...);
  if (!error) return "";
  return name + (" of the GPU's driver failed with " + std::to_string(error));
}

// Copies, and waits for it and for all that the stream was given before. Returns what
// failed.
XLA_FFI_Error* copy(const Call& call, Way way, void* to, const void* from,
                    size_t bytes) {
  void* stream;
  if (XLA_FFI_Error* none = get_stream(call, stream)) return none;
  // The driver takes a place on a GPU as a number.
  std::string problem =
      way == Way::to_host
          ? driver("cuMemcpyDtoHAsync_v2", to, uint64_t(from), bytes, stream)
          : driver("cuMemcpyHtoDAsync_v2", uint64_t(to), from, bytes, stream);
  if (problem.empty()) problem = driver("cuStreamSynchronize", stream);
  if (problem.empty()) return nullptr;
  return failure(call, XLA_FFI_Error_Code_INTERNAL, problem.c_str());
}

}  // namespace
