// The GPU kernel's rollout in plain C++, from the same operands: what it computes,
// without its instructions. For tests on machines without a GPU.

#include <vector>

#include "gpu_activation.h"
#include "gpu_layout.h"
// The layout comes first.
#include "handler.h"

namespace {

using Half = _Float16;

std::vector<float> multiply(const std::vector<Half>& inputs, const Half* weights,
                            int columns) {
  std::vector<float> sums(columns, 0.0f);
  for (size_t first = 0; first < inputs.size(); first += DEPTH)
    for (int column = 0; column < columns; ++column)
      for (int row = 0; row < DEPTH; ++row)
        sums[column] += inputs[first + row] *
                        float(weights[first * columns + place(row, column, columns)]);
  return sums;
}

// A hidden layer's products: all chunks of its left columns, then those of the right.
std::vector<float> multiply_halves(const std::vector<Half>& inputs, const Half* weights) {
  std::vector<float> sums = multiply(inputs, weights, LEFT);
  const std::vector<float> right =
      multiply(inputs, weights + inputs.size() * LEFT, RIGHT);
  sums.insert(sums.end(), right.begin(), right.end());
  return sums;
}

std::vector<Half> activate(const std::vector<float>& sums) {
  std::vector<Half> activations(HIDDEN_CHUNKS * DEPTH, Half(0));
  for (int i = 0; i < WIDTH; ++i)
    activations[i] = Half(activated(sums[i], [](float x) { return std::tanh(x); }));
  activations[WIDTH] = activations[WIDTH + 1] = Half(1);
  return activations;
}

void run_particle(const Rollout& rollout, int member, int particle) {
  const int candidate = particle / rollout.particles;
  const int64_t stride = path_stride(rollout);
  float* path = path_of(rollout, member, particle);
  float obs[OBS];
  for (int i = 0; i < OBS; ++i) path[i] = obs[i] = rollout.obs[i];
  for (int step = 0; step < rollout.horizon; ++step) {
    const float* actions =
        rollout.actions + (int64_t(candidate) * rollout.horizon + step) * ACTION;
    const Half* weights =
        reinterpret_cast<const Half*>(rollout.weights) + int64_t(member) * MEMBER_WEIGHTS;
    float values[FEATURES];
    features(obs, values);
    std::vector<Half> inputs(INPUT_CHUNKS * DEPTH, Half(0));
    for (int i = 0; i < INPUTS; ++i)
      inputs[i] = Half(
          scaled(i < FEATURES ? values[i] : actions[i - FEATURES], i, rollout.shared));
    inputs[INPUTS] = inputs[INPUTS + 1] = Half(1);
    std::vector<Half> activations = activate(multiply_halves(inputs, weights));
    weights += INPUT_WEIGHTS;
    for (int layer = 1; layer < LAYERS; ++layer, weights += HIDDEN_WEIGHTS)
      activations = activate(multiply_halves(activations, weights));
    const std::vector<float> head = multiply(activations, weights, 2 * HEAD);
    float target[OBS];
    const uint32_t* key = rollout.keys + KEY * step;
    uint32_t bits[OBS];
    float noise[OBS];
    threefry(key[0], key[1], noise_counter(rollout, key, member, particle), 1, bits);
    normal(bits, noise);
    for (int i = 0; i < OBS; ++i)
      target[i] = head[mean_column(i)] +
                  noise[i] * deviation(head[variance_column(i)],
                                       rollout.shared[MIN_VARIANCE + i],
                                       rollout.shared[MAX_PRECISION + i]);
    move(obs, target, rollout.shared);
    for (int i = 0; i < OBS; ++i) path[(step + 1) * stride + i] = obs[i];
  }
}

XLA_FFI_Error* run(const Call&, const Rollout& whole) {
  for (int64_t batch = 0; batch < whole.batch; ++batch) {
    const Rollout rollout = at_batch(whole, batch);
    for (int member = 0; member < rollout.num_members; ++member)
      for (int row = 0; row < rollout.num_candidates * rollout.particles; ++row)
        run_particle(rollout, member, row);
  }
  return nullptr;
}

}  // namespace

extern "C" XLA_FFI_Error* jaxpets_rollout(XLA_FFI_CallFrame* call) {
  return handle<Rollout>(*call, 0, read, run);
}
