// A whole particle rollout on the cores of a CPU, in float32.
//
// A block is 32 particles of one member, imagined for all H steps by one core. Entry i of
// all its particles is one row of BLOCK numbers: what is done to a particle is a loop
// over a row, which the compiler turns into vector instructions. The inputs of a layer
// stay in the core's first cache, the weights of a member, half a megabyte at the paper's
// size, in its second or beyond. So a tile of them that was read serves all groups of a
// block: as many particles as the sums of a tile have registers for. Nothing but the
// path is written to memory, and cores meet only at the end.

#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <new>

#include "cpu_layout.h"
// The layout comes first.
#include "handler.h"

namespace {

// A tile's sums are VECTORS registers for each of its TILE outputs; beside them go the
// inputs and one weight.
#if defined(__AVX512F__)
constexpr int LANES = 16, VECTORS = 2;  // of 32 registers
#elif defined(__aarch64__)
constexpr int LANES = 4, VECTORS = 4;  // of 32
#else
constexpr int LANES = 8, VECTORS = 2;  // of 16
#endif
constexpr int GROUP = LANES * VECTORS, BLOCK = 32;
static_assert(BLOCK % GROUP == 0, "a block has whole groups");

typedef float Vector __attribute__((vector_size(4 * LANES), may_alias));
using Row = float[BLOCK];

struct alignas(64) Scratch {
  Row activations[2][WIDEST];
  Row obs[OBS], target[OBS];
  int used;  // particles of the block, in whole groups; of the others nothing is known
};

// Where one particle's entries are: those of row p of every row.
struct Column {
  Row* rows;
  int p;
  float& operator[](int i) const { return rows[i][p]; }
};

// x / (1 + exp(-rate)); NaN of -infinity, as by way of tanh.
float sigmoid_times(float x, float rate) {
  float twos = rate * -1.44269504f;
  twos = twos < 128.0f ? twos : 128.0f;  // of which the power is infinite
  twos = twos > -126.0f ? twos : -126.0f;
  const float shifted = twos + ROUNDER;
  return x / (1.0f + power_of_two(shifted, twos - (shifted - ROUNDER)));
}

float activated(float x) {
  if (ACTIVATION == RELU) return x < 0.0f ? 0.0f : x;
  if (ACTIVATION == TANH) return x != x ? x : sigmoid_times(2.0f, 2.0f * x) - 1.0f;
  if (ACTIVATION == GELU)
    return sigmoid_times(x, x * fmaf(0.0713548163f, x * x, 1.59576912f));
  return sigmoid_times(x, x);
}

// A tile for the group whose particles begin at `first`. Inlined, some of the sums would
// be kept in memory.
template <int OUTPUTS, bool IS_HEAD>
__attribute__((noinline)) void multiply_group(const float* weights, const Row* inputs,
                                              int num_inputs, Row* outputs, int first) {
  Vector sums[OUTPUTS][VECTORS];
#pragma GCC unroll 8
  for (int j = 0; j < OUTPUTS; ++j)
#pragma GCC unroll 8
    for (int v = 0; v < VECTORS; ++v) sums[j][v] = weights[j] - Vector{};  // to all
  for (int i = 0; i < num_inputs; ++i) {
    weights += OUTPUTS;
    Vector input[VECTORS];
#pragma GCC unroll 8
    for (int v = 0; v < VECTORS; ++v)
      input[v] = *reinterpret_cast<const Vector*>(&inputs[i][first + v * LANES]);
#pragma GCC unroll 8
    for (int j = 0; j < OUTPUTS; ++j)
#pragma GCC unroll 8
      for (int v = 0; v < VECTORS; ++v) sums[j][v] += weights[j] * input[v];
  }
#pragma GCC unroll 8
  for (int j = 0; j < OUTPUTS; ++j)
#pragma GCC unroll 8
    for (int v = 0; v < VECTORS; ++v)
      *reinterpret_cast<Vector*>(&outputs[j][first + v * LANES]) = sums[j][v];
  if (IS_HEAD) return;
  for (int j = 0; j < OUTPUTS; ++j)
    for (int p = first; p < first + GROUP; ++p)
      outputs[j][p] = activated(outputs[j][p]);
}

template <int OUTPUTS, bool IS_HEAD>
void multiply_tile(const float* weights, const Row* inputs, int num_inputs, Row* outputs,
                   int used) {
  for (int first = 0; first < used; first += GROUP)
    multiply_group<OUTPUTS, IS_HEAD>(weights, inputs, num_inputs, outputs, first);
}

// Runs a layer and those after it; returns where the last one's outputs are.
template <int LAYER = 0>
const Row* run_layers(const float* weights, Scratch& scratch) {
  constexpr int FROM = WIDTHS[LAYER], TO = WIDTHS[LAYER + 1];
  constexpr bool IS_HEAD = LAYER + 2 == NUM_WIDTHS;
  const Row* inputs = scratch.activations[LAYER % 2];
  Row* outputs = scratch.activations[(LAYER + 1) % 2];
  const float* tile = weights;
  for (int j = 0; j + TILE <= TO; j += TILE, tile += TILE * (FROM + 1))
    multiply_tile<TILE, IS_HEAD>(tile, inputs, FROM, outputs + j, scratch.used);
  if constexpr (TO % TILE != 0)
    multiply_tile<TO % TILE, IS_HEAD>(tile, inputs, FROM, outputs + TO / TILE * TILE,
                                      scratch.used);
  if constexpr (IS_HEAD)
    return outputs;
  else
    return run_layers<LAYER + 1>(weights + layer_weights(LAYER), scratch);
}

// Writes the network's inputs of a step; `actions` has every particle's first action.
void read_inputs(const float* const (&actions)[BLOCK], int step, const float* shared,
                 Scratch& scratch) {
  Row* inputs = scratch.activations[0];
#pragma GCC ivdep  // a particle reads and writes its own columns only
  for (int p = 0; p < BLOCK; ++p) features(Column{scratch.obs, p}, Column{inputs, p});
  for (int p = 0; p < BLOCK; ++p)
    for (int i = 0; i < ACTION; ++i)
      inputs[FEATURES + i][p] = actions[p][step * ACTION + i];
  for (int i = 0; i < INPUTS; ++i)
    for (int p = 0; p < BLOCK; ++p) inputs[i][p] = scaled(inputs[i][p], i, shared);
}

// `counter` is the place of the first particle's first entry in the draw of the step.
void draw_targets(const Row* head, const uint32_t* key, uint32_t counter,
                  const float* shared, Scratch& scratch) {
  for (int i = 0; i < OBS; ++i) {
    uint32_t bits[BLOCK];
    Row noise;
    threefry(key[0], key[1], counter + i, OBS, bits);
    normal(bits, noise);
    const float min_variance = shared[MIN_VARIANCE + i];
    const float max_precision = shared[MAX_PRECISION + i];
    for (int p = 0; p < BLOCK; ++p)
      scratch.target[i][p] =
          head[i][p] +
          noise[p] * deviation(head[OBS + i][p], min_variance, max_precision);
  }
}

void move_all(const float* shared, Scratch& scratch) {
#pragma GCC ivdep  // as above
  for (int p = 0; p < BLOCK; ++p) {
    float moved[OBS];
    next_obs(Column{scratch.obs, p}, Column{scratch.target, p}, moved);
    bound(moved, shared + LOW, shared + HIGH, Column{scratch.obs, p});
  }
}

// The last block of a member may have fewer particles than rows have room for: the rest
// of a row has the actions of the last one, and is not stored.
void run_block(const Rollout& rollout, int member, int first, Scratch& scratch) {
  const int count = rollout.num_candidates * rollout.particles - first;
  scratch.used = count < BLOCK ? round_up(count, GROUP) : BLOCK;
  const int64_t stride = path_stride(rollout);
  const float* actions[BLOCK];
  float* paths[BLOCK];
  for (int p = 0; p < BLOCK; ++p) {
    const int particle = first + (p < count ? p : count - 1);
    const int candidate = particle / rollout.particles;
    actions[p] = rollout.actions + int64_t(candidate) * rollout.horizon * ACTION;
    paths[p] = path_of(rollout, member, particle);
    for (int i = 0; i < OBS; ++i) paths[p][i] = scratch.obs[i][p] = rollout.obs[i];
  }
  const float* weights = rollout.weights + int64_t(member) * MEMBER_WEIGHTS;
  for (int step = 0; step < rollout.horizon; ++step) {
    read_inputs(actions, step, rollout.shared, scratch);
    const Row* head = run_layers(weights, scratch);
    const uint32_t* key = rollout.keys + KEY * step;
    const uint32_t counter = noise_counter(rollout, key, member, first);
    draw_targets(head, key, counter, rollout.shared, scratch);
    move_all(rollout.shared, scratch);
    for (int p = 0; p < BLOCK && p < count; ++p) {
      paths[p] += stride;
      for (int i = 0; i < OBS; ++i) paths[p][i] = scratch.obs[i][p];
    }
  }
}

// All blocks of all members and of the whole batch; whoever is free takes the next.
class Blocks {
 public:
  explicit Blocks(const Rollout& rollout)
      : rollout_(rollout),
        of_member_((int64_t(rollout.num_candidates) * rollout.particles + BLOCK - 1) /
                   BLOCK),
        count_(rollout.batch * rollout.num_members * of_member_) {}

  int64_t count() const { return count_; }

  void work(Scratch& scratch) {
    int64_t done = 0;
    for (int64_t i; (i = next_.fetch_add(1)) < count_; ++done) {
      const int64_t member = i / of_member_;
      run_block(at_batch(rollout_, member / rollout_.num_members),
                member % rollout_.num_members, i % of_member_ * BLOCK, scratch);
    }
    const std::lock_guard<std::mutex> lock(mutex_);
    done_ += done;
    if (done_ == count_) all_done_.notify_all();
  }

  void wait() {
    std::unique_lock<std::mutex> lock(mutex_);
    all_done_.wait(lock, [this] { return done_ == count_; });
  }

 private:
  const Rollout rollout_;
  const int64_t of_member_, count_;
  std::atomic<int64_t> next_{0};
  std::mutex mutex_;
  std::condition_variable all_done_;
  int64_t done_ = 0;
};

// Whether XLA did as it was asked to; its error, if not, is ours to end.
bool succeeds(const Call& call, XLA_FFI_Error* error) {
  if (!error) return true;
  XLA_FFI_Error_Destroy_Args args = {};
  args.struct_size = XLA_FFI_Error_Destroy_Args_STRUCT_SIZE;
  args.error = error;
  call.api->XLA_FFI_Error_Destroy(&args);
  return false;
}

// How many threads XLA has; none if it does not say.
int64_t num_threads(const Call& call) {
  int64_t count = 0;
  XLA_FFI_ThreadPool_NumThreads_Args args = {};
  args.struct_size = XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE;
  args.ctx = call.ctx;
  args.num_threads = &count;
  return succeeds(call, call.api->XLA_FFI_ThreadPool_NumThreads(&args)) ? count : 0;
}

// Lets one of XLA's threads help, if there is one.
void help(const Call& call, const std::shared_ptr<Blocks>& blocks) {
  using Shared = std::shared_ptr<Blocks>;
  auto own = std::make_unique<Shared>(blocks);
  XLA_FFI_ThreadPool_Schedule_Args args = {};
  args.struct_size = XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE;
  args.ctx = call.ctx;
  args.data = own.get();
  args.task = [](void* data) {
    const std::unique_ptr<Shared> blocks(static_cast<Shared*>(data));
    const std::unique_ptr<Scratch> scratch(new (std::nothrow) Scratch);
    if (scratch) (*blocks)->work(*scratch);
  };
  if (succeeds(call, call.api->XLA_FFI_ThreadPool_Schedule(&args))) own.release();
}

XLA_FFI_Error* run(const Call& call, const Rollout& rollout) {
  const std::unique_ptr<Scratch> own(new (std::nothrow) Scratch);
  if (!own) return failure(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "out of memory");
  // A helper that starts when all is done finds nothing to do, but must find the blocks.
  const auto blocks = std::make_shared<Blocks>(rollout);
  const int64_t threads = num_threads(call);
  for (int64_t i = 1; i < threads && i < blocks->count(); ++i) help(call, blocks);
  blocks->work(*own);
  blocks->wait();
  return nullptr;
}

}  // namespace

extern "C" XLA_FFI_Error* jaxpets_rollout(XLA_FFI_CallFrame* call) {
  return handle<Rollout>(*call, 0, read, run);
}
