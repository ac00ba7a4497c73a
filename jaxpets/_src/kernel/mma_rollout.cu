// A whole particle rollout in one kernel, for GPUs of compute capability 8.0 and later.
//
// A block owns 64 particles of one member for all H steps, 16 of them a warp. Activations
// stay in registers: the sums of one layer, through swish, are the left operand of the
// next layer's products. A member's weights stream from L2 through a ring in shared
// memory, chunk by chunk, every step anew; the warps of a block read each chunk together.
// The ring is small enough for two blocks on a multiprocessor: while one rounds and
// squashes, or waits for its warps, the other keeps the tensor cores busy.
//
// Operands are float16, as for Hopper; sums, the head, the state and its update float32.

#include "gpu_layout.h"
// The layout comes first.
#include "gpu_launch.h"
#include "gpu_warp.h"

namespace {

constexpr int WARPS = 4;
constexpr int THREADS = 32 * WARPS;
constexpr int TILE = ROWS * WARPS;  // particles of a block
constexpr int WIDE_CHUNKS = INPUT_CHUNKS + (LAYERS - 1) * HIDDEN_CHUNKS;
constexpr int HEAD_CHUNKS = HIDDEN_CHUNKS;
constexpr int SLOT = DEPTH * (WIDTH > 2 * HEAD ? WIDTH : 2 * HEAD);

struct alignas(16) Shared {
  __half ring[SLOTS][SLOT];
  float shared[SHARED_NUMBERS];
  float state[TILE * STATE_STRIDE];
  float target[TILE * STATE_STRIDE];  // noise, then what the model predicts
  alignas(16) __half inputs[TILE * INPUT_STRIDE];
  int path_offset[TILE], action_offset[TILE];  // of each row
};

// The ring. Chunks are used in the order in which they lie in memory, in every step.
struct Ring {
  Shared& smem;
  const uint16_t* weights;  // of the member
  const uint16_t* next = weights;
  int chunk = 0, free = 0, full = 0;  // which is next, and its slot; the slot to be read

  // Starts to copy the next chunk; around the end it is the first of the next step.
  __device__ __forceinline__ void feed() {
    const int columns = chunk < WIDE_CHUNKS ? WIDTH : 2 * HEAD;
    const int words = DEPTH * columns / 8;  // of 16 bytes
    for (int i = threadIdx.x; i < words; i += THREADS)
      asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(
                       address(smem.ring[free] + 8 * i)),
                   "l"(next + 8 * i)
                   : "memory");
    asm volatile("cp.async.commit_group;" ::: "memory");
    next += DEPTH * columns;
    if (++chunk == WIDE_CHUNKS + HEAD_CHUNKS) chunk = 0, next = weights;
    if (++free == SLOTS) free = 0;
  }

  // Returns the oldest chunk, once it is there; the one before it makes room.
  __device__ __forceinline__ uint32_t take() {
    asm volatile("cp.async.wait_group %0;" ::"n"(SLOTS - 2) : "memory");
    __syncthreads();
    feed();
    const uint32_t taken = address(smem.ring[full]);
    if (++full == SLOTS) full = 0;
    return taken;
  }
};

// Adds 16 rows x 16 deep times 16 deep x 8 columns to the sums of these columns.
template <int REGISTERS>
__device__ __forceinline__ void add_product(float (&sums)[REGISTERS], int at,
                                            const uint32_t* a, uint32_t low,
                                            uint32_t high) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
      "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+f"(sums[at]), "+f"(sums[at + 1]), "+f"(sums[at + 2]), "+f"(sums[at + 3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(low), "r"(high));
}

// sums = activations x weights: the next CHUNKS of the ring.
template <int CHUNKS, int COLUMNS, int REGISTERS>
__device__ __forceinline__ void multiply(float (&sums)[COLUMNS / 2],
                                         const uint32_t (&activations)[REGISTERS],
                                         Ring& ring, int lane) {
#pragma unroll
  for (int i = 0; i < COLUMNS / 2; ++i) sums[i] = 0.0f;
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    const uint32_t weights = ring.take() + 16 * lane;  // a row of 8 for every lane
    const uint32_t* a = activations + 4 * chunk;
#pragma unroll
    for (int block = 0; block < COLUMNS / 8; block += 2) {
      uint32_t w[4];
      if (block + 1 < COLUMNS / 8) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                     : "=r"(w[0]), "=r"(w[1]), "=r"(w[2]), "=r"(w[3])
                     : "r"(weights + 256 * block)
                     : "memory");
        add_product(sums, 4 * block, a, w[0], w[1]);
        add_product(sums, 4 * block + 4, a, w[2], w[3]);
      } else {
        asm volatile("ldmatrix.sync.aligned.m8n8.x2.shared.b16 {%0, %1}, [%2];"
                     : "=r"(w[0]), "=r"(w[1])
                     : "r"(weights + 256 * block)
                     : "memory");
        add_product(sums, 4 * block, a, w[0], w[1]);
      }
    }
  }
}

template <int CHUNKS, int REGISTERS>
__device__ __forceinline__ void hidden_layer(uint32_t (&activations)[4 * HIDDEN_CHUNKS],
                                             const uint32_t (&operand)[REGISTERS],
                                             Ring& ring, int lane) {
  float sums[WIDTH / 2];
  multiply<CHUNKS, WIDTH>(sums, operand, ring, lane);
  swish(sums);
  // Sums lie in registers as activations do.
#pragma unroll
  for (int i = 0; i < WIDTH / 4; ++i)
    activations[i] = pack(sums[2 * i], sums[2 * i + 1]);
  append_ones(activations, lane % 4);
}

__host__ __device__ __forceinline__ int blocks_of_member(const Rollout& rollout) {
  return (rollout.num_candidates * rollout.particles + TILE - 1) / TILE;
}

__global__ __launch_bounds__(THREADS, 2) void rollout_kernel(
    const __grid_constant__ Rollout whole) {
  extern __shared__ __align__(16) uint8_t bytes[];
  Shared& smem = *reinterpret_cast<Shared*>(bytes);
  const int blocks = blocks_of_member(whole), of_batch = blocks * whole.num_members;
  const Rollout rollout = at_batch(whole, blockIdx.x / of_batch);
  const int member = blockIdx.x % of_batch / blocks;
  const int lane = threadIdx.x % 32, own = threadIdx.x / 32 * ROWS;
  const int first = blockIdx.x % blocks * TILE + own;
  Ring ring = {smem, rollout.weights + int64_t(member) * MEMBER_WEIGHTS};
  for (int slot = 0; slot < SLOTS - 1; ++slot) ring.feed();
  for (int i = threadIdx.x; i < SHARED_NUMBERS; i += THREADS)
    smem.shared[i] = rollout.shared[i];
  __syncthreads();
  Warp warp = {rollout,
               smem.shared,
               smem.inputs + own * INPUT_STRIDE,
               smem.state + own * STATE_STRIDE,
               smem.target + own * STATE_STRIDE,
               smem.path_offset + own,
               smem.action_offset + own,
               lane,
               rollout.num_members * rollout.particles * OBS};
  warp.begin(member, first);

  // A lane draws as many numbers at once as it takes to need few rounds.
  constexpr int DRAWS = (ROWS * OBS + 31) / 32, ROUNDS = (DRAWS + 5) / 6;
  constexpr int AT_ONCE = (DRAWS + ROUNDS - 1) / ROUNDS;
  for (int step = 0; step < rollout.horizon; ++step) {
    __syncwarp();
    warp.load_actions(min(step + 1, rollout.horizon - 1));
    uint32_t activations[4 * HIDDEN_CHUNKS];
    {
      uint32_t operand[4 * INPUT_CHUNKS];
      warp.read_inputs(operand);
      hidden_layer<INPUT_CHUNKS>(activations, operand, ring, lane);
    }
#pragma unroll 1
    for (int layer = 1; layer < LAYERS; ++layer)
      hidden_layer<HIDDEN_CHUNKS>(activations, activations, ring, lane);
    const uint32_t* key = rollout.keys + KEY * step;
    draw_noise<ROWS * OBS, 32, AT_ONCE>(
        warp.targets, key, noise_counter(rollout, key, member, first), lane);
    float head[HEAD];
    multiply<HEAD_CHUNKS, 2 * HEAD>(head, activations, ring, lane);
    warp.write_actions();
    warp.store_states(step);
    warp.move_all(head);
  }
  __syncwarp();
  warp.store_states(rollout.horizon);
  asm volatile("cp.async.wait_all;" ::: "memory");
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
  return handle(*call, XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE, run);
}
