// The launch of an epoch of training on a CPU: the GPU's source, run by fibers. For tests
// on machines without a GPU.

#include "fit_epoch.h"

namespace {

// Calls take turns in the order in which blocks run.
XLA_FFI_Error* run(const Call& call, const Fit& fit) {
  static int number = 0;
  memset(fit.scratch, 0, size_t(fit.num_seeds) * SCRATCH * 4);
  const int wave = least(2, fit.num_seeds);
  Fit part = fit;
  for (part.first_seed = 0; part.first_seed < fit.num_seeds; part.first_seed += wave) {
    const int seeds = least(wave, fit.num_seeds - part.first_seed);
    const char* problem = emulator::launch<Fit>(epoch_kernel, part, seeds * MEMBERS * CTAS,
                                                CTAS, THREADS, sizeof(Shared), number++);
    if (problem) return failure(call, XLA_FFI_Error_Code_INTERNAL, problem);
  }
  return nullptr;
}

}  // namespace

extern "C" XLA_FFI_Error* jaxpets_fit(XLA_FFI_CallFrame* call) {
  return handle<Fit>(*call, 0, read, run);
}
