// A whole particle rollout in one kernel.
//
// A block owns 128 particles of one member for all H steps. Two consumer warpgroups take
// 64 each. Their activations stay in registers: the accumulators of one layer, through
// swish, are the left operand of the next layer's products, and only weights come from
// shared memory. While one warpgroup rounds and squashes, the other keeps the tensor
// cores busy. A member's weights do not fit into shared memory: as many chunks as do
// stay there, the others stream from L2 through a ring, every step anew. The producer
// warpgroup feeds the ring and draws the noise.
//
// Operands are float16: as fast as bfloat16, with three more bits. Sums, the head, the
// state and its update are float32.

#include <cuda_fp16.h>
#ifdef WATCHDOG
#include <cstdio>
#endif

#include "handler.h"
#include "rollout.h"
#include "wgmma.h"

namespace {

constexpr int TILE = 64;  // particles of one warpgroup, the height of a wgmma
constexpr int WARPGROUP = 128;
constexpr int CONSUMERS = 2;
constexpr int THREADS = (CONSUMERS + 1) * WARPGROUP;
constexpr int NOISE_WARPS = 3;

constexpr int TARGET_STRIDE = OBS | 1;  // odd: a thread a row without bank conflicts
constexpr int INPUT_STRIDE = INPUT_CHUNKS * DEPTH + 8;
constexpr int SLOT = HIDDEN_CHUNK > OUTPUT_CHUNK ? HIDDEN_CHUNK : OUTPUT_CHUNK;

// Which chunks of a layer stream: `streamed` of `chunks`, spread evenly.
__host__ __device__ constexpr bool streams(int chunk, int chunks, int streamed) {
  return (chunk + 1) * streamed / chunks > chunk * streamed / chunks;
}
__host__ __device__ constexpr int residents_before(int chunk, int chunks, int streamed) {
  return chunk - chunk * streamed / chunks;
}

constexpr int RESIDENT_INPUT = INPUT_CHUNKS - INPUT_STREAMED;
constexpr int RESIDENT_HIDDEN = HIDDEN_CHUNKS - HIDDEN_STREAMED;
constexpr int RESIDENT_OUTPUT = HIDDEN_CHUNKS - OUTPUT_STREAMED;
constexpr int RESIDENT_WEIGHTS =
    (RESIDENT_INPUT + (LAYERS - 1) * RESIDENT_HIDDEN) * HIDDEN_CHUNK +
    RESIDENT_OUTPUT * OUTPUT_CHUNK;

struct alignas(128) Shared {
  __half resident[RESIDENT_WEIGHTS > 0 ? RESIDENT_WEIGHTS : 8];
  __half ring[SLOTS][SLOT];
  float shared[round_up(SHARED_NUMBERS, 4)];
  float target[CONSUMERS][TILE * TARGET_STRIDE];  // noise, then what the model predicts
  __half inputs[CONSUMERS][TILE * INPUT_STRIDE];
  uint64_t resident_full, ring_full[SLOTS], ring_empty[SLOTS];
  uint64_t noise_full[CONSUMERS], noise_empty[CONSUMERS];
};

__device__ __forceinline__ uint32_t address(const void* pointer) {
  return static_cast<uint32_t>(__cvta_generic_to_shared(pointer));
}

__device__ __forceinline__ void init_barrier(uint64_t* barrier, int arrivals) {
  asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" ::"r"(address(barrier)),
               "r"(arrivals));
}

__device__ __forceinline__ void arrive(uint64_t* barrier) {
  asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" ::"r"(address(barrier))
               : "memory");
}

__device__ __forceinline__ void expect(uint64_t* barrier, uint32_t bytes) {
  asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(
                   address(barrier)),
               "r"(bytes)
               : "memory");
}

__device__ __forceinline__ void wait(uint64_t* barrier, uint32_t parity) {
  uint32_t done = 0;
#ifdef WATCHDOG
  int spins = 0;
#endif
  while (!done) {
    asm volatile(
        "{\n.reg .pred done;\n"
        "mbarrier.try_wait.parity.shared::cta.b64 done, [%1], %2;\n"
        "selp.u32 %0, 1, 0, done;\n}"
        : "=r"(done)
        : "r"(address(barrier)), "r"(parity)
        : "memory");
#ifdef WATCHDOG
    if (++spins > (1 << 22)) { printf("stuck block %d,%d thread %d barrier %d parity %d\n", blockIdx.x, blockIdx.y, threadIdx.x, (int)(address(barrier)), parity); __trap(); }
#endif
  }
}

__device__ __forceinline__ void copy(void* shared, const void* global, uint32_t bytes,
                                     uint64_t* barrier) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes"
      " [%0], [%1], %2, [%3];" ::"r"(address(shared)),
      "l"(global), "r"(bytes), "r"(address(barrier))
      : "memory");
}

__device__ __forceinline__ void sync_warpgroup(int warpgroup) {
  asm volatile("bar.sync %0, 128;" ::"r"(warpgroup + 1) : "memory");
}

__device__ __forceinline__ uint32_t pack(float low, float high) {
  const __half2 pair = __floats2half2_rn(low, high);
  return *reinterpret_cast<const uint32_t*>(&pair);
}

// swish(2 h) = h + h tanh(h) of a pair. The weights are halved when they are packed.
__device__ __forceinline__ uint32_t swish(float low, float high) {
  float tanh_low, tanh_high;
  asm("tanh.approx.f32 %0, %1;" : "=f"(tanh_low) : "f"(low));
  asm("tanh.approx.f32 %0, %1;" : "=f"(tanh_high) : "f"(high));
  return pack(fmaf(low, tanh_low, low), fmaf(high, tanh_high, high));
}

// A position in the ring: which slot, and how often the ring has been around.
struct Cursor {
  int slot = 0;
  uint32_t round = 0;
  __device__ __forceinline__ void advance() {
    if (++slot == SLOTS) slot = 0, round ^= 1;
  }
};

// Feeds the chunks of one layer that stream.
template <int CHUNKS, int STREAMED>
__device__ __forceinline__ void feed(Shared& smem, Cursor& cursor, const uint16_t* weights,
                                     int size) {
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    if (!streams(chunk, CHUNKS, STREAMED)) continue;
    wait(&smem.ring_empty[cursor.slot], cursor.round ^ 1);
    expect(&smem.ring_full[cursor.slot], size * 2);
    copy(smem.ring[cursor.slot], weights + chunk * size, size * 2,
         &smem.ring_full[cursor.slot]);
    cursor.advance();
  }
}

template <int CHUNKS, int STREAMED>
__device__ __forceinline__ __half* load_residents(Shared& smem, __half* to,
                                                  const uint16_t* weights, int size) {
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    if (streams(chunk, CHUNKS, STREAMED)) continue;
    copy(to, weights + chunk * size, size * 2, &smem.resident_full);
    to += size;
  }
  return to;
}

__device__ void feed_weights(Shared& smem, const uint16_t* weights, int horizon) {
  const uint16_t* hidden = weights + INPUT_WEIGHTS;
  const uint16_t* output = hidden + (LAYERS - 1) * HIDDEN_WEIGHTS;
  expect(&smem.resident_full, RESIDENT_WEIGHTS * 2);
  __half* to = smem.resident;
  to = load_residents<INPUT_CHUNKS, INPUT_STREAMED>(smem, to, weights, HIDDEN_CHUNK);
  for (int layer = 0; layer < LAYERS - 1; ++layer)
    to = load_residents<HIDDEN_CHUNKS, HIDDEN_STREAMED>(
        smem, to, hidden + layer * HIDDEN_WEIGHTS, HIDDEN_CHUNK);
  load_residents<HIDDEN_CHUNKS, OUTPUT_STREAMED>(smem, to, output, OUTPUT_CHUNK);
  Cursor cursor;
  for (int step = 0; step < horizon; ++step) {
    feed<INPUT_CHUNKS, INPUT_STREAMED>(smem, cursor, weights, HIDDEN_CHUNK);
    for (int layer = 0; layer < LAYERS - 1; ++layer)
      feed<HIDDEN_CHUNKS, HIDDEN_STREAMED>(
          smem, cursor, hidden + layer * HIDDEN_WEIGHTS, HIDDEN_CHUNK);
    feed<HIDDEN_CHUNKS, OUTPUT_STREAMED>(smem, cursor, output, OUTPUT_CHUNK);
  }
}

// Draws the noise of `jax.random.normal(key of the step, [E, B, OBS])`.
__device__ void draw_noise(Shared& smem, const Rollout& rollout, int member,
                           int first_row, int thread) {
  const int rows = rollout.num_candidates * rollout.particles;
  constexpr int STRIDE = NOISE_WARPS * 32, PER_TILE = TILE * OBS, UNROLL = 4;
  for (int step = 0; step < rollout.horizon; ++step) {
    const uint32_t key0 = rollout.keys[2 * step], key1 = rollout.keys[2 * step + 1];
    for (int consumer = 0; consumer < CONSUMERS; ++consumer) {
      const uint32_t first =
          (uint32_t(member) * rows + first_row + consumer * TILE) * OBS;
      wait(&smem.noise_empty[consumer], (step & 1) ^ 1);
      for (int i = thread; i < PER_TILE; i += STRIDE * UNROLL) {
        uint32_t bits[UNROLL];
#pragma unroll
        for (int k = 0; k < UNROLL; ++k)
          bits[k] = threefry_bits(key0, key1, first + i + k * STRIDE);
#pragma unroll
        for (int k = 0; k < UNROLL; ++k) {
          const int at = i + k * STRIDE;
          if (at < PER_TILE)
            smem.target[consumer][at / OBS * TARGET_STRIDE + at % OBS] = normal(bits[k]);
        }
      }
      __syncwarp();
      if (thread % 32 == 0) arrive(&smem.noise_full[consumer]);
    }
  }
}

// One layer's products: accumulators = activations x weights.
template <int CHUNKS, int COLUMNS, int STREAMED, int REGISTERS>
__device__ __forceinline__ void multiply(float (&sums)[COLUMNS / 2],
                                         const uint32_t (&activations)[REGISTERS],
                                         const __half* resident, Shared& smem,
                                         Cursor& cursor) {
  constexpr int CHUNK = DEPTH * COLUMNS;
  int pending = -1;  // a slot that is still being read
  const uint64_t descriptor = weight_descriptor(address(resident));
  const bool leader = threadIdx.x % 32 == 0;
  wgmma_fence();
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    uint64_t weights;
    int slot = -1;
    if (streams(chunk, CHUNKS, STREAMED)) {
      slot = cursor.slot;
      wait(&smem.ring_full[slot], cursor.round);
      weights = weight_descriptor(address(smem.ring[slot]));
      cursor.advance();
    } else {
      weights =
          descriptor + residents_before(chunk, CHUNKS, STREAMED) * (CHUNK * 2 / 16);
    }
    Wgmma<COLUMNS>::multiply(sums, activations[4 * chunk], activations[4 * chunk + 1],
                             activations[4 * chunk + 2], activations[4 * chunk + 3],
                             weights, chunk > 0);
    wgmma_commit();
    if (chunk > 0 && streams(chunk - 1, CHUNKS, STREAMED)) {
      wgmma_wait<1>();
      if (leader) arrive(&smem.ring_empty[pending]);
    }
    pending = slot;
  }
  wgmma_wait<0>();
  if (streams(CHUNKS - 1, CHUNKS, STREAMED) && leader)
    arrive(&smem.ring_empty[pending]);
#pragma unroll
  for (int i = 0; i < COLUMNS / 2; ++i) asm volatile("" : "+f"(sums[i])::"memory");
}

// Accumulators become activations, which lie alike in registers. Behind the last
// activation stand two ones, for the rows of the weights that hold the biases.
__device__ __forceinline__ void activate(uint32_t (&activations)[4 * HIDDEN_CHUNKS],
                                         const float (&sums)[WIDTH / 2], int pair) {
#pragma unroll
  for (int block = 0; block < 2 * HIDDEN_CHUNKS; ++block) {
    uint32_t* pairs = activations + 2 * block;
    if (8 * block < WIDTH) {
      const float* sum = sums + 4 * block;
      pairs[0] = swish(sum[0], sum[1]);
      pairs[1] = swish(sum[2], sum[3]);
    } else {
      pairs[0] = pairs[1] = 8 * block == WIDTH && pair == 0 ? pack(1.0f, 1.0f) : 0;
    }
  }
}

// Writes the features of one particle into the input tile.
__device__ __forceinline__ void write_features(__half* inputs, const float (&obs)[OBS],
                                               const float* shared) {
  float values[FEATURES];
  features(obs, values);
#pragma unroll
  for (int i = 0; i < FEATURES; ++i)
    inputs[i] = __float2half_rn(scaled(values[i], i, shared));
}

__device__ __forceinline__ void write_action(__half* inputs, const float (&action)[ACTION],
                                             const float* shared) {
#pragma unroll
  for (int i = 0; i < ACTION; ++i)
    inputs[FEATURES + i] = __float2half_rn(scaled(action[i], FEATURES + i, shared));
}

// Stores one observation; it is aligned to its own size as far as that is a power of 2.
__device__ __forceinline__ void store(float* path, const float (&obs)[OBS]) {
  if constexpr (OBS % 4 == 0) {
#pragma unroll
    for (int i = 0; i < OBS; i += 4)
      *reinterpret_cast<float4*>(path + i) =
          make_float4(obs[i], obs[i + 1], obs[i + 2], obs[i + 3]);
  } else if constexpr (OBS % 2 == 0) {
#pragma unroll
    for (int i = 0; i < OBS; i += 2)
      *reinterpret_cast<float2*>(path + i) = make_float2(obs[i], obs[i + 1]);
  } else {
#pragma unroll
    for (int i = 0; i < OBS; ++i) path[i] = obs[i];
  }
}

__device__ void consume(Shared& smem, const Rollout& rollout, int member, int first_row,
                        int consumer, int thread) {
  const int warp = thread / 32, group = thread % 32 / 4, pair = thread % 4;
  const int rows = rollout.num_candidates * rollout.particles;
  // Between the products half the threads own a particle each, half its actions.
  const bool owns_state = thread < TILE;
  const int row = thread % TILE, wanted = first_row + consumer * TILE + row;
  const int particle = min(wanted, rows - 1);
  const int candidate = particle / rollout.particles;
  const int step_stride = rollout.num_members * rollout.particles * OBS;
  const float* actions = rollout.actions + int64_t(candidate) * rollout.horizon * ACTION;
  float* path = rollout.path + candidate * (rollout.horizon + 1) * step_stride +
                (member * rollout.particles + particle % rollout.particles) * OBS;
  float* const target = smem.target[consumer];
  __half* const inputs = smem.inputs[consumer];
  __half* const row_inputs = inputs + row * INPUT_STRIDE;
  float obs[OBS], action[ACTION];

  for (int i = thread; i < TILE * INPUT_STRIDE; i += WARPGROUP) {
    const int column = i % INPUT_STRIDE;
    inputs[i] = column == INPUTS || column == INPUTS + 1 ? __half(1.0f) : __half(0.0f);
  }
  sync_warpgroup(consumer);
  if (owns_state) {
#pragma unroll
    for (int i = 0; i < OBS; ++i) obs[i] = rollout.obs[i];
    write_features(row_inputs, obs, smem.shared);
    if (wanted < rows) store(path, obs);
  } else {
#pragma unroll
    for (int i = 0; i < ACTION; ++i) action[i] = actions[i];
    write_action(row_inputs, action, smem.shared);
  }
  sync_warpgroup(consumer);
  wait(&smem.resident_full, 0);

  Cursor cursor;
  for (int step = 0; step < rollout.horizon; ++step) {
    actions += ACTION;
    path += step_stride;
    if (!owns_state && step + 1 < rollout.horizon) {
#pragma unroll
      for (int i = 0; i < ACTION; ++i) action[i] = actions[i];
    }
    float head[HEAD];
    {
      uint32_t activations[4 * HIDDEN_CHUNKS];
      float sums[WIDTH / 2];
      {
        uint32_t operand[4 * INPUT_CHUNKS];
        const __half* from = inputs + (warp * 16 + group) * INPUT_STRIDE + 2 * pair;
#pragma unroll
        for (int chunk = 0; chunk < INPUT_CHUNKS; ++chunk) {
          const __half* at = from + chunk * DEPTH;
          operand[4 * chunk] = *reinterpret_cast<const uint32_t*>(at);
          operand[4 * chunk + 1] =
              *reinterpret_cast<const uint32_t*>(at + 8 * INPUT_STRIDE);
          operand[4 * chunk + 2] = *reinterpret_cast<const uint32_t*>(at + 8);
          operand[4 * chunk + 3] =
              *reinterpret_cast<const uint32_t*>(at + 8 * INPUT_STRIDE + 8);
        }
        multiply<INPUT_CHUNKS, WIDTH, INPUT_STREAMED>(sums, operand, smem.resident, smem,
                                                      cursor);
      }
      activate(activations, sums, pair);
      const __half* resident = smem.resident + RESIDENT_INPUT * HIDDEN_CHUNK;
#pragma unroll 1
      for (int layer = 1; layer < LAYERS; ++layer) {
        multiply<HIDDEN_CHUNKS, WIDTH, HIDDEN_STREAMED>(sums, activations, resident, smem,
                                                        cursor);
        activate(activations, sums, pair);
        resident += RESIDENT_HIDDEN * HIDDEN_CHUNK;
      }
      multiply<HIDDEN_CHUNKS, 2 * HEAD, OUTPUT_STREAMED>(
          head, activations,
          smem.resident + RESIDENT_WEIGHTS - RESIDENT_OUTPUT * OUTPUT_CHUNK, smem, cursor);
    }

    // Mean and raw log-variance of one entry lie in the same thread.
    wait(&smem.noise_full[consumer], step & 1);
#pragma unroll
    for (int i = 0; i < HEAD / 2; ++i) {
      const int column = 8 * (i / 4) + 2 * pair + i % 2;
      const int tile_row = warp * 16 + group + 8 * (i % 4 / 2);
      if (column < OBS) {
        float& value = target[tile_row * TARGET_STRIDE + column];
        value = head[i] + value * deviation(head[HEAD / 2 + i],
                                            smem.shared[MIN_VARIANCE + column],
                                            smem.shared[MAX_PRECISION + column]);
      }
    }
    sync_warpgroup(consumer);
    if (owns_state) {
      float drawn[OBS];
#pragma unroll
      for (int i = 0; i < OBS; ++i) drawn[i] = target[row * TARGET_STRIDE + i];
      move(obs, drawn, smem.shared);
      write_features(row_inputs, obs, smem.shared);
      if (wanted < rows) store(path, obs);
    } else {
      write_action(row_inputs, action, smem.shared);
    }
    sync_warpgroup(consumer);
    if (thread == 0) arrive(&smem.noise_empty[consumer]);
  }
}

__global__ __launch_bounds__(THREADS, 1) void rollout_kernel(
    const __grid_constant__ Rollout whole) {
  extern __shared__ __align__(128) uint8_t bytes[];
  Shared& smem = *reinterpret_cast<Shared*>(bytes);
  const int member = blockIdx.y, first_row = blockIdx.x * CONSUMERS * TILE;
  const Rollout rollout = at_batch(whole, blockIdx.z);
  const uint16_t* weights = rollout.weights + int64_t(member) * MEMBER_WEIGHTS;
  if (threadIdx.x == 0) {
    init_barrier(&smem.resident_full, 1);
    for (int slot = 0; slot < SLOTS; ++slot) {
      init_barrier(&smem.ring_full[slot], 1);
      init_barrier(&smem.ring_empty[slot], CONSUMERS * WARPGROUP / 32);
    }
    for (int consumer = 0; consumer < CONSUMERS; ++consumer) {
      init_barrier(&smem.noise_full[consumer], NOISE_WARPS);
      init_barrier(&smem.noise_empty[consumer], 1);
    }
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
  }
  for (int i = threadIdx.x; i < SHARED_NUMBERS; i += THREADS)
    smem.shared[i] = rollout.shared[i];
  __syncthreads();

  const int warpgroup = threadIdx.x / WARPGROUP, thread = threadIdx.x % WARPGROUP;
  if (warpgroup == CONSUMERS) {
    asm volatile("setmaxnreg.dec.sync.aligned.u32 40;");
    if (thread >= 32)
      draw_noise(smem, rollout, member, first_row, thread - 32);
    else if (thread == 0)
      feed_weights(smem, weights, rollout.horizon);
  } else {
    asm volatile("setmaxnreg.inc.sync.aligned.u32 232;");
    consume(smem, rollout, member, first_row, warpgroup, thread);
  }
}

ffi::Error run(cudaStream_t stream, ffi::AnyBuffer weights,
               ffi::AnyBuffer shared, ffi::AnyBuffer keys, ffi::AnyBuffer obs,
               ffi::AnyBuffer actions, ffi::Result<ffi::AnyBuffer> path) {
  const Problem problem = read(weights, shared, keys, obs, actions, *path);
  if (!problem.error.empty()) return ffi::Error::InvalidArgument(problem.error);
  const Rollout& rollout = problem.rollout;
  constexpr size_t size = sizeof(Shared);
  static_assert(size <= 232448, "a block's shared memory is too small for this model");
  const int rows = rollout.num_candidates * rollout.particles;
  const dim3 grid((rows + CONSUMERS * TILE - 1) / (CONSUMERS * TILE), rollout.num_members,
                  rollout.batch);
  cudaError_t error = cudaFuncSetAttribute(
      rollout_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, size);
  if (error == cudaSuccess) {
    rollout_kernel<<<grid, THREADS, size, stream>>>(rollout);
    error = cudaGetLastError();
  }
  return error == cudaSuccess ? ffi::Error::Success()
                              : ffi::Error::Internal(cudaGetErrorString(error));
}

}  // namespace

// The stream is only launched on, so XLA may record the call in a CUDA graph.
XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxpets_rollout, run,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::PlatformStream<cudaStream_t>>()
                                  .Arg<ffi::AnyBuffer>()
                                  .Arg<ffi::AnyBuffer>()
                                  .Arg<ffi::AnyBuffer>()
                                  .Arg<ffi::AnyBuffer>()
                                  .Arg<ffi::AnyBuffer>()
                                  .Ret<ffi::AnyBuffer>(),
                              {ffi::Traits::kCmdBufferCompatible});
