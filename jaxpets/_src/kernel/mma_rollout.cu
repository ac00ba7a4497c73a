// A whole particle rollout in one kernel, for GPUs of compute capability 8.0 and later.
//
// A block owns up to 80 particles of one member for all H steps. Its four or eight warps
// share the columns of every layer, not the rows: each warp multiplies all particles by its
// own weights, which so come from L2 once a step for all and need no shared memory. There
// lie the activations, as the left operand of the next layer. A layer has two barriers:
// when all warps have read what it overwrites, and when all have written.
//
// A block of four warps is small enough for two of them on a multiprocessor of any GPU:
// while one squashes, draws noise or waits, the other keeps the tensor cores busy.
//
// Operands are float16, as for Hopper; sums, the head, the state and its update float32.

#include "gpu_layout.h"
// The layout comes first.
#include "gpu_launch.h"
#include "gpu_particles.h"
#include "mma_product.h"

namespace {

constexpr int ROWS = TILES * TILE;  // particles of a block
constexpr int THREADS = 32 * WARPS;
constexpr int CHUNKS = INPUT_CHUNKS > HIDDEN_CHUNKS ? INPUT_CHUNKS : HIDDEN_CHUNKS;
// Of an operand's rows: an odd number of 16 byte words, for 8 rows to be read at once.
constexpr int STRIDE = CHUNKS * DEPTH + 8;
// Of a chunk.
constexpr int WIDE_WEIGHTS = DEPTH * WIDTH, HEAD_WEIGHTS = DEPTH * 2 * HEAD;

using Block = Particles<ROWS, THREADS, STRIDE>;
// Chunks come from L2 in the time of two or three products; if registers are left for so
// many. These numbers are of 255.
constexpr int SUMS = TILES * Hidden::OWN_SUMS + GROUPS * Hidden::REST_SUMS;
constexpr int FITTING = (204 - SUMS - 4 * TILES) / Hidden::WORDS;
constexpr int BUFFERS = FITTING < 2 ? 2 : FITTING > 4 ? 4 : FITTING;
using HiddenStream = Stream<Hidden, WIDE_WEIGHTS, BUFFERS>;
using HeadStream = Stream<Head, HEAD_WEIGHTS, 8>;

// What a block seldom needs lies in shared memory too: registers are for sums.
struct alignas(16) Shared {
  float shared[SHARED_NUMBERS];
  float state[ROWS * STATE_STRIDE];
  float target[ROWS * STATE_STRIDE];  // noise, then what the model predicts
  alignas(16) __half operand[ROWS * STRIDE];  // of the next layer: inputs, activations
  int path_offset[ROWS], action_offset[ROWS];  // of each row
  Rollout rollout;
  int member, first;  // the block's, and its first particle
  uint32_t key[KEY];  // of the step
};

// The compiler then knows nothing of a number. What follows from it is computed where it
// is needed; kept from step to step, it would take the registers of sums.
__device__ __forceinline__ void forget(int& number) {
  asm volatile("" : "+r"(number));
}

// Behind an operand's last column stand two ones, for the rows that hold the biases.
template <int COLUMN>
__device__ __forceinline__ void append_ones(__half* operand, int thread) {
  constexpr int COUNT = DEPTH * ((COLUMN + 2 + DEPTH - 1) / DEPTH) - COLUMN;
  for (int i = thread; i < ROWS * COUNT; i += THREADS)
    operand[i / COUNT * STRIDE + COLUMN + i % COUNT] =
        __half(i % COUNT < 2 ? 1.0f : 0.0f);
}

// A warp's activations of a layer, rounded: two to a word, in the order of the sums.
struct Activations {
  static constexpr int OWN = Hidden::OWN_SUMS / 2, REST = Hidden::REST_SUMS / 2;
  uint32_t own[TILES][OWN > 0 ? OWN : 1], rest[GROUPS][REST > 0 ? REST : 1];

  template <int COUNT>
  static __device__ __forceinline__ void round(uint32_t* rounded, float* sums) {
#pragma unroll
    for (int i = 0; i < COUNT; ++i) {
      float (&two)[2] = *reinterpret_cast<float (*)[2]>(sums + 2 * i);
      activate(two);
      rounded[i] = pack(two[0], two[1]);
    }
  }

  template <int COUNT>
  static __device__ __forceinline__ void store(__half* to, const uint32_t* rounded) {
#pragma unroll
    for (int i = 0; i < COUNT; ++i)
      *reinterpret_cast<uint32_t*>(to + i / 2 * 8 + i % 2 * 8 * STRIDE) = rounded[i];
  }

  __device__ __forceinline__ void compute(Sums<Hidden>& sums) {
#pragma unroll
    for (int tile = 0; tile < TILES; ++tile) round<OWN>(own[tile], sums.own[tile]);
#pragma unroll
    for (int group = 0; group < GROUPS; ++group) round<REST>(rest[group], sums.rest[group]);
  }

  __device__ __forceinline__ void write(__half* operand, int warp, int lane) const {
    __half* const place = operand + lane / 4 * STRIDE + 2 * (lane % 4);
#pragma unroll
    for (int tile = 0; tile < TILES; ++tile)
      store<OWN>(
          place + tile_of(tile, warp) * TILE * STRIDE + warp * 16 * Hidden::PAIRS,
          own[tile]);
#pragma unroll
    for (int group = 0; group < GROUPS; ++group)
      if (REST > 0 && warp < tiles_of(group))
        store<REST>(place + tile_of(group * WARPS, warp) * TILE * STRIDE +
                        WARPS * 16 * Hidden::PAIRS,
                    rest[group]);
  }
};

// A lane's addresses in each tile of the operand.
__device__ __forceinline__ void find_rows(uint32_t (&rows)[TILES], const __half* operand,
                                          int warp, int lane) {
#pragma unroll
  for (int tile = 0; tile < TILES; ++tile)
    rows[tile] = address(operand + (tile_of(tile, warp) * TILE + lane % 16) * STRIDE +
                         lane / 16 * 8);
}

// One hidden layer, and the way of the next one's weights.
__device__ __forceinline__ void hidden_layer(HiddenStream& stream, int chunks,
                                             const uint16_t* next, int next_chunks,
                                             __half* operand, int thread) {
  const int warp = thread / 32, lane = thread % 32, pair = warp * Hidden::PAIRS;
  uint32_t rows[TILES];
  find_rows(rows, operand, warp, lane);
  __syncthreads();  // the operand is written
  Sums<Hidden> sums;
  multiply(sums, rows, stream, chunks, lane);
  Activations activations;
  activations.compute(sums);
  // Now, when there are registers, and before there is much to wait for.
  stream.start(next, next_chunks, pair, lane);
  __syncthreads();  // all have read the operand
  activations.write(operand, warp, lane);
}

__device__ __forceinline__ Block particles(Shared& smem, int thread) {
  const Rollout& rollout = smem.rollout;
  const int step_stride = rollout.num_members * rollout.particles * OBS;
  return {rollout,          smem.shared,        smem.operand, smem.state, smem.target,
          smem.path_offset, smem.action_offset, thread,       step_stride};
}

__host__ __device__ __forceinline__ int blocks_of_member(const Rollout& rollout) {
  return (rollout.num_candidates * rollout.particles + ROWS - 1) / ROWS;
}

__global__ __launch_bounds__(THREADS, 8 / WARPS) void rollout_kernel(
    const __grid_constant__ Rollout whole) {
  extern __shared__ __align__(16) uint8_t bytes[];
  Shared& smem = *reinterpret_cast<Shared*>(bytes);
  const Rollout& rollout = smem.rollout;
  int thread = threadIdx.x;
  if (thread == 0) {
    const int blocks = blocks_of_member(whole), of_batch = blocks * whole.num_members;
    smem.rollout = at_batch(whole, blockIdx.x / of_batch);
    smem.member = blockIdx.x % of_batch / blocks;
    smem.first = blockIdx.x % blocks * ROWS;
  }
  __syncthreads();
  for (int i = thread; i < SHARED_NUMBERS; i += THREADS)
    smem.shared[i] = rollout.shared[i];
  if (thread < KEY) smem.key[thread] = rollout.keys[thread];
  __syncthreads();
  particles(smem, thread).begin(smem.member, smem.first);
  append_ones<INPUTS>(smem.operand, thread);

  const uint16_t* const weights = rollout.weights + int64_t(smem.member) * MEMBER_WEIGHTS;
  HiddenStream stream;
  stream.start(weights, INPUT_CHUNKS, thread / 32 * Hidden::PAIRS, thread % 32);
  // A thread draws as many numbers at once as it takes to need few rounds.
  constexpr int DRAWS = (ROWS * OBS + THREADS - 1) / THREADS, ROUNDS = (DRAWS + 5) / 6;
  constexpr int AT_ONCE = (DRAWS + ROUNDS - 1) / ROUNDS;
  for (int step = 0; step < rollout.horizon; ++step) {
    forget(thread);
    __syncthreads();
    particles(smem, thread).store_states(step);
    hidden_layer(stream, INPUT_CHUNKS, weights + (LAYERS > 1 ? INPUT_WEIGHTS : 0),
                 LAYERS > 1 ? HIDDEN_CHUNKS : INPUT_CHUNKS, smem.operand, thread);
    append_ones<WIDTH>(smem.operand, thread);
#pragma unroll 1
    for (int layer = 1; layer < LAYERS; ++layer) {
      forget(thread);
      const bool is_last = layer + 1 == LAYERS;
      hidden_layer(stream, HIDDEN_CHUNKS,
                   weights + (is_last ? 0 : INPUT_WEIGHTS + layer * HIDDEN_WEIGHTS),
                   is_last ? INPUT_CHUNKS : HIDDEN_CHUNKS, smem.operand, thread);
    }
    forget(thread);
    const int warp = thread / 32, lane = thread % 32;
    int pair = warp;  // of columns: means, and the log-variances of the same entries
    const uint16_t* const head_weights =
        weights + INPUT_WEIGHTS + (LAYERS - 1) * HIDDEN_WEIGHTS;
    HeadStream head;
    head.start(head_weights, HIDDEN_CHUNKS, min(pair, HEAD / 8 - 1), lane);
    Block block = particles(smem, thread);
    // What the next step needs is read now, for it comes from far.
    const int next = min(step + 1, rollout.horizon - 1);
    block.load_actions(next);
    const uint32_t next_key = rollout.keys[KEY * next + thread % KEY];
    draw_noise<ROWS * OBS, THREADS, AT_ONCE>(
        smem.target, smem.key,
        noise_counter(rollout, smem.key, smem.member, smem.first), thread);
    __syncthreads();
    uint32_t rows[TILES];
    while (pair < HEAD / 8) {
      find_rows(rows, smem.operand, warp, lane);
      Sums<Head> drawn;
      multiply(drawn, rows, head, HIDDEN_CHUNKS, lane);
#pragma unroll
      for (int tile = 0; tile < TILES; ++tile)
        draw_targets(smem.target + 8 * pair +
                         (tile_of(tile, warp) * TILE + lane / 4) * STATE_STRIDE,
                     drawn.own[tile], smem.shared + 8 * pair, lane % 4, OBS - 8 * pair);
      pair += WARPS;
      if (pair < HEAD / 8) head.start(head_weights, HIDDEN_CHUNKS, pair, lane);
    }
    __syncthreads();
    block.move_all();
    block.write_actions();
    smem.key[thread % KEY] = next_key;
    append_ones<INPUTS>(smem.operand, thread);
  }
  __syncthreads();
  particles(smem, thread).store_states(rollout.horizon);
}

XLA_FFI_Error* run(const Call& call, const Rollout& rollout) {
  constexpr size_t size = sizeof(Shared);
  static_assert(size <= SHARED_MEMORY, "a block's shared memory is too small");
  const auto kernel = reinterpret_cast<const void*>(rollout_kernel);
  return launch_on_stream(call, kernel, size, [&](cudaStream_t stream) {
    const int64_t blocks =
        blocks_of_member(rollout) * rollout.num_members * rollout.batch;
    rollout_kernel<<<blocks, THREADS, size, stream>>>(rollout);
    return cudaSuccess;
  });
}

}  // namespace

extern "C" XLA_FFI_Error* jaxpets_rollout(XLA_FFI_CallFrame* call) {
  return handle<Rollout>(*call, XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE, read, run);
}
