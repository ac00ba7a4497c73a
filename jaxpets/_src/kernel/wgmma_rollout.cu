// A whole particle rollout in one kernel.
//
// A block owns 128 particles of one member for all H steps. Two consumer warpgroups take
// a tile of 64 each; where multiprocessors would idle, blocks own one tile, or one and a
// slice of 16. A tile's activations stay in registers: the accumulators of one layer, through
// their activation, are the left operand of the next layer's products, and only weights come
// from shared memory. While one warpgroup rounds and squashes, the other keeps the tensor
// cores busy. A member's weights do not fit into shared memory: as many chunks as do stay
// there, the others stream from L2 through a ring, every step anew. The producer warpgroup
// feeds the ring and draws the noise.
//
// Operands are float16: as fast as bfloat16, with three more bits. Sums, the head, the
// state and its update are float32.

#include "gpu_layout.h"
// The layout comes first.
#include "gpu_launch.h"
#include "wgmma.h"
#include "wgmma_feed.h"
#include "wgmma_slice.h"

namespace {

// Blocks of so many rows, and after them those that are cut in two blocks of one tile.
struct Split {
  int rows, whole, halved;
};

__host__ __device__ __forceinline__ int blocks_of_member(const Rollout& rollout,
                                                         int rows) {
  return (rollout.num_candidates * rollout.particles + rows - 1) / rows;
}

// A tile alone takes less time than one with a slice, and that less than two. So blocks are
// the smallest of which all find a multiprocessor at once. If none are, they have two
// tiles, and those that are left for a last, partial wave are cut if the multiprocessors
// have room for twice as many.
Split split_up(const Rollout& rollout, int multiprocessors) {
  const int members = rollout.num_members * rollout.batch;
  for (const int rows : {TILE, TILE + SLICE}) {
    const int blocks = members * blocks_of_member(rollout, rows);
    if (blocks <= multiprocessors) return {rows, blocks, 0};
  }
  const int blocks = members * blocks_of_member(rollout, 2 * TILE);
  const int left = blocks % multiprocessors;
  const int halved = 2 * left <= multiprocessors ? left : 0;
  return {2 * TILE, blocks - halved, halved};
}

__device__ __forceinline__ Block find_block(const Rollout& rollout, const Split& split,
                                            int index) {
  const int half = index - split.whole;
  const bool is_half = half >= 0;
  if (is_half) index = split.whole + half / 2;
  const int blocks = blocks_of_member(rollout, split.rows);
  const int of_batch = blocks * rollout.num_members;
  const int first_row = index % blocks * split.rows + (is_half ? half % 2 * TILE : 0);
  const int rows = rollout.num_candidates * rollout.particles - first_row;
  const bool is_more = rows > TILE && !is_half;
  const int tiles = rows <= 0 ? 0 : is_more && split.rows == 2 * TILE ? 2 : 1;
  return {index / of_batch, index % of_batch / blocks, first_row, tiles,
          is_more && split.rows == TILE + SLICE};
}

// Starts sums = activations x weights, as groups of products in flight. A slot of the
// ring, or one left PENDING from before, is handed back when the unit after it has been
// started: whoever waits for a slot holds only one. Returns the last slot, which the
// caller hands back, if any chunk streams.
template <int CHUNKS, int COLUMNS, int STREAMED, bool PENDING, int REGISTERS>
__device__ __forceinline__ int multiply(float (&sums)[COLUMNS / 2],
                                        const uint32_t (&activations)[REGISTERS],
                                        const __half* resident, Shared& smem,
                                        Cursor& cursor, int pending = 0) {
  constexpr int RESIDENT = CHUNKS - STREAMED;
  constexpr int CHUNK_STRIDE = DEPTH * COLUMNS * 2 / 16;  // in units of descriptors
  uint64_t weights = weight_descriptor(address(resident));
  if constexpr (FITS) {
    // Now, not between the products: nvcc runs no two of them at once around a branch.
    Cursor ahead = cursor;
#pragma unroll
    for (int unit = 0; unit < STREAMED / UNIT; ++unit) {
      wait(&smem.ring_full[ahead.slot], ahead.round);
      ahead.advance();
    }
  }
  wgmma_fence();
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    const bool streamed = chunk >= RESIDENT;
    const int in_unit = (chunk - RESIDENT) % UNIT;
    if (streamed && in_unit == 0) {
      if constexpr (!FITS) wait(&smem.ring_full[cursor.slot], cursor.round);
      weights = weight_descriptor(address(smem.ring[cursor.slot]));
      if constexpr (!FITS) wgmma_fence();
    }
    const uint32_t* a = activations + 4 * chunk;
    Wgmma<COLUMNS>::multiply(sums, a[0], a[1], a[2], a[3],
                             weights + (streamed ? in_unit : chunk) * CHUNK_STRIDE,
                             chunk > 0);
    if (chunk + 1 == RESIDENT) wgmma_commit();
    if (streamed && in_unit + 1 == UNIT) {
      wgmma_commit();
      if (PENDING || chunk >= RESIDENT + UNIT) {
        wgmma_wait<1>();
        release(smem, pending);
      }
      pending = cursor.slot;
      cursor.advance();
    }
  }
  return pending;
}

// Waits for all but the last IN_FLIGHT groups of products.
template <int IN_FLIGHT, int REGISTERS>
__device__ __forceinline__ void finish(float (&sums)[REGISTERS]) {
  wgmma_wait<IN_FLIGHT>();
#pragma unroll
  for (int i = 0; i < REGISTERS; ++i) asm volatile("" : "+f"(sums[i])::"memory");
}

// Nothing that stands before is moved behind. The compiler knows of no time that products
// take: left alone it first waits for them, and then does what could have been done.
__device__ __forceinline__ void keep_order() { asm volatile("pmevent 0;" ::: "memory"); }

// The consumers take turns at the tensor cores. Those that shared them would also finish
// together, and leave them idle together.
template <int TILES>
__device__ __forceinline__ void begin_turn(int consumer) {
  if constexpr (FITS && TILES == 2)
    asm volatile("bar.sync %0, 256;" ::"r"(CONSUMERS + 1 + consumer) : "memory");
}

template <int TILES>
__device__ __forceinline__ void pass_turn(int consumer) {
  if constexpr (FITS && TILES == 2)
    asm volatile("bar.arrive %0, 256;" ::"r"(2 * CONSUMERS - consumer) : "memory");
}

// One hidden layer. While the right half of its products runs, the left half goes
// through their activation.
template <int TILES, int CHUNKS, int LEFT_STREAMED, int RIGHT_STREAMED, int REGISTERS>
__device__ __forceinline__ void hidden_layer(uint32_t (&activations)[4 * HIDDEN_CHUNKS],
                                             const uint32_t (&operand)[REGISTERS],
                                             const __half* resident, Shared& smem,
                                             Cursor& cursor, int pair, int consumer) {
  constexpr int RESIDENT_LEFT = (CHUNKS - LEFT_STREAMED) * DEPTH * LEFT;
  float left[LEFT / 2], right[RIGHT / 2];
  begin_turn<TILES>(consumer);
  const int left_slot =
      multiply<CHUNKS, LEFT, LEFT_STREAMED, false>(left, operand, resident, smem, cursor);
  const int right_slot = multiply<CHUNKS, RIGHT, RIGHT_STREAMED, (LEFT_STREAMED > 0)>(
      right, operand, resident + RESIDENT_LEFT, smem, cursor, left_slot);
  pass_turn<TILES>(consumer);
  finish<1>(left);
  if (LEFT_STREAMED > 0 && RIGHT_STREAMED == 0) release(smem, left_slot);
  activate(left);
  keep_order();
  finish<0>(right);
  if (RIGHT_STREAMED > 0) release(smem, right_slot);
  activate(right);
  // Sums lie in registers as activations do. Rounding waits until here, since no register
  // that a product reads may be written while another product runs.
#pragma unroll
  for (int i = 0; i < LEFT / 4; ++i)
    activations[i] = pack(left[2 * i], left[2 * i + 1]);
#pragma unroll
  for (int i = 0; i < RIGHT / 4; ++i)
    activations[LEFT / 4 + i] = pack(right[2 * i], right[2 * i + 1]);
  append_ones(activations, pair);
}

template <int TILES>
__device__ void consume(Shared& smem, const Rollout& rollout, const Block& block,
                        int consumer, int thread) {
  const int lane = thread % 32, pair = lane % 4, own = thread / 32 * ROWS;
  Warp warp = warp_of(smem.rows.tiles[consumer], own, smem, rollout, lane);
  warp.begin(block.member, block.first_row + consumer * TILE + own);
  sync_warpgroup(consumer);
  wait(&smem.resident_full, 0);
  if (consumer == 1) pass_turn<TILES>(consumer);  // the other one is first

  Cursor cursor;
  for (int step = 0; step < rollout.horizon; ++step) {
    warp.load_actions(min(step + 1, rollout.horizon - 1));
    float head[HEAD];
    {
      uint32_t activations[4 * HIDDEN_CHUNKS], operand[4 * INPUT_CHUNKS];
      warp.read_inputs(operand);
      hidden_layer<TILES, INPUT_CHUNKS, 0, 0>(activations, operand, smem.resident, smem,
                                              cursor, pair, consumer);
      const __half* resident = smem.resident + RESIDENT_INPUT;
#pragma unroll 1
      for (int layer = 1; layer < LAYERS; ++layer) {
        hidden_layer<TILES, HIDDEN_CHUNKS, LEFT_STREAMED, RIGHT_STREAMED>(
            activations, activations, resident, smem, cursor, pair, consumer);
        resident += RESIDENT_HIDDEN;
      }
      multiply<HIDDEN_CHUNKS, 2 * HEAD, 0, false>(head, activations, resident, smem,
                                                  cursor);
      warp.write_actions();
      warp.store_states(step);
      keep_order();
      finish<0>(head);
    }
    wait(&smem.noise_full[consumer], step & 1);
    warp.move_by(head);
    sync_warpgroup(consumer);
    if (thread == 0) arrive(&smem.noise_empty[consumer]);
  }
  warp.store_states(rollout.horizon);
}

__global__ __launch_bounds__(THREADS, 1) void rollout_kernel(
    const __grid_constant__ Rollout whole, const Split split) {
  extern __shared__ __align__(128) uint8_t bytes[];
  Shared& smem = *reinterpret_cast<Shared*>(bytes);
  const Block block = find_block(whole, split, blockIdx.x);
  if (block.tiles < 1) return;
  const Rollout rollout = at_batch(whole, block.batch);
  const uint16_t* weights = rollout.weights + int64_t(block.member) * MEMBER_WEIGHTS;
  if (threadIdx.x == 0) {
    init_barrier(&smem.resident_full, 1);
    for (int slot = 0; slot < SLOTS; ++slot) {
      init_barrier(&smem.ring_full[slot], 1);
      init_barrier(&smem.ring_empty[slot], block.consumers() * WARPGROUP / 32);
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
    asm volatile("setmaxnreg.dec.sync.aligned.u32 56;");
    if (thread >= 32)
      feed_noise(smem, rollout, block, thread - 32);
    else if (thread == 0)
      feed_weights(smem, weights, rollout.horizon);
  } else {
    asm volatile("setmaxnreg.inc.sync.aligned.u32 224;");
    if (block.tiles == 2)
      consume<2>(smem, rollout, block, warpgroup, thread);
    else if (warpgroup == 0)
      consume<1>(smem, rollout, block, warpgroup, thread);
    else if (block.has_slice)
      consume_slice(smem, rollout, block, thread);
  }
}

XLA_FFI_Error* run(const Call& call, const Rollout& rollout) {
  constexpr size_t size = sizeof(Shared);
  static_assert(size <= 232448, "a block's shared memory is too small for this model");
  const auto kernel = reinterpret_cast<const void*>(rollout_kernel);
  return launch_on_stream(call, kernel, size, [&](cudaStream_t stream) {
    int device = 0, multiprocessors = 1;
    cudaError_t error = cudaGetDevice(&device);
    if (error == cudaSuccess)
      error = cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount,
                                     device);
    if (error != cudaSuccess) return error;
    const Split split = split_up(rollout, multiprocessors);
    rollout_kernel<<<split.whole + 2 * split.halved, THREADS, size, stream>>>(rollout,
                                                                              split);
    return cudaSuccess;
  });
}

}  // namespace

extern "C" XLA_FFI_Error* jaxpets_rollout(XLA_FFI_CallFrame* call) {
  return handle<Rollout>(*call, XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE, read, run);
}
