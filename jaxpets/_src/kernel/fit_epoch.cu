// The launch of an epoch of training, for Hopper.

#include "fit_epoch.h"
#include "gpu_launch.h"

namespace {

const auto kernel = reinterpret_cast<const void*>(epoch_kernel);

// Finds how many clusters the GPU runs at once; there are 16 blocks in one if it is asked.
cudaError_t room(cudaLaunchConfig_t& config, int& clusters) {
  cudaError_t error =
      cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, sizeof(Shared));
  if (error == cudaSuccess)
    error = cudaFuncSetAttribute(kernel, cudaFuncAttributeNonPortableClusterSizeAllowed, 1);
  if (error == cudaSuccess)
    error = cudaOccupancyMaxActiveClusters(&clusters, kernel, &config);
  return error;
}

cudaLaunchConfig_t clustered(cudaLaunchAttribute& attribute) {
  attribute = {};
  attribute.id = cudaLaunchAttributeClusterDimension;
  attribute.val.clusterDim.x = CTAS;
  attribute.val.clusterDim.y = attribute.val.clusterDim.z = 1;
  cudaLaunchConfig_t config = {};
  config.blockDim = dim3(THREADS);
  config.gridDim = dim3(CTAS);
  config.dynamicSmemBytes = sizeof(Shared);
  config.attrs = &attribute;
  config.numAttrs = 1;
  return config;
}

XLA_FFI_Error* run(const Call& call, const Fit& fit) {
  return launch_on_stream(call, kernel, sizeof(Shared), [&](cudaStream_t stream) {
    cudaLaunchAttribute attribute;
    cudaLaunchConfig_t config = clustered(attribute);
    config.stream = stream;
    int clusters = 0;
    cudaError_t error = room(config, clusters);
    if (error == cudaSuccess && clusters < MEMBERS)
      error = cudaErrorCooperativeLaunchTooLarge;
    if (error == cudaSuccess)
      error = cudaMemsetAsync(fit.scratch, 0, size_t(fit.num_seeds) * SCRATCH * 4, stream);
    // The members of a seed wait for one another, so they must run at once.
    const int wave = least(most(clusters / MEMBERS, 1), fit.num_seeds);
    Fit part = fit;
    for (part.first_seed = 0; error == cudaSuccess && part.first_seed < fit.num_seeds;
         part.first_seed += wave) {
      const int seeds = least(wave, fit.num_seeds - part.first_seed);
      config.gridDim = dim3(CTAS * MEMBERS * seeds);
      error = cudaLaunchKernelEx(&config, epoch_kernel, part);
    }
    return error;
  });
}

}  // namespace

// Returns why this GPU cannot run it, or nothing.
extern "C" const char* jaxpets_problem() {
  cudaLaunchAttribute attribute;
  cudaLaunchConfig_t config = clustered(attribute);
  int clusters = 0;
  const cudaError_t error = room(config, clusters);
  if (error != cudaSuccess) return cudaGetErrorString(error);
  return clusters < MEMBERS ? "the GPU has no room for all members at once" : nullptr;
}

extern "C" XLA_FFI_Error* jaxpets_fit(XLA_FFI_CallFrame* call) {
  return handle<Fit>(*call, 0, read, run);
}
