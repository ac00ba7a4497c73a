// A whole particle rollout in one kernel.
//
// A block owns 128 particles of one member for all H steps. Two consumer warpgroups take
// a tile of 64 each; where multiprocessors would idle, blocks own one tile, or one and a
// slice of 16. A tile's activations stay in registers: the accumulators of one layer, through
// their activation, are the left operand of the next layer's products, and only weights come
// from shared memory. While one warpgroup rounds and squashes, the other keeps the tensor
// cores busy. A member's weights do not fit into shared memory: as many chunks as do stay
// there, the others stream from L2, every step anew. The producer warpgroup feeds them and
// draws the noise.
//
// Operands are float16: as fast as bfloat16, with three more bits. Sums, the head, the
// state and its update are float32.

#include "gpu_layout.h"
// The layout comes first.
#include "gpu_launch.h"
#include "wgmma.h"
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

// Two tiles together take longer than one with a slice, and that longer than one. So
// blocks have a slice if all of them then find a multiprocessor at once, and did not with
// one tile. Of two tiles the blocks that are left for a last, partial wave are cut if the
// multiprocessors have room for twice as many.
Split split_up(const Rollout& rollout, int multiprocessors) {
  const int members = rollout.num_members * rollout.batch;
  const int sliced = members * blocks_of_member(rollout, TILE + SLICE);
  const int tiles = members * blocks_of_member(rollout, TILE);
  if (sliced <= multiprocessors && multiprocessors < tiles)
    return {TILE + SLICE, sliced, 0};
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
  const bool is_more = rows > TILE && !is_half, is_sliced = split.rows < 2 * TILE;
  const int tiles = rows <= 0 ? 0 : is_more && !is_sliced ? 2 : 1;
  return {index / of_batch, index % of_batch / blocks, first_row, tiles,
          is_more && is_sliced};
}

// Begins to feed what streams of half a layer: its first chunks.
template <Half HALF>
__device__ __forceinline__ void feed(Shared& smem, const uint16_t* weights,
                                     uint32_t round) {
  constexpr int SIZE = (HALF == LEFT_HALF ? STREAMED_LEFT : STREAMED_RIGHT) * 2;
  if constexpr (SIZE > 0) {
    wait(&smem.streamed_empty[HALF], round ^ 1);
    expect(&smem.streamed_full[HALF], SIZE);
    copy(HALF == LEFT_HALF ? smem.streamed_left : smem.streamed_right, weights, SIZE,
         &smem.streamed_full[HALF]);
  }
}

// Tiles wait for their right half between products, where nvcc takes no branch: it would
// run no two products at once. So the warp that feeds waits in their place, and meets them.
__device__ __forceinline__ void meet_feeder(int consumer) {
  asm volatile("bar.sync %0, 160;" ::"r"(2 * CONSUMERS + 1 + consumer) : "memory");
}

__device__ __forceinline__ void meet_tiles(Shared& smem, int tiles, uint32_t round) {
  if (RIGHT_STREAMED == 0) return;
  wait(&smem.streamed_full[RIGHT_HALF], round);
  __syncwarp();
  for (int consumer = 0; consumer < tiles; ++consumer)
    asm volatile("bar.arrive %0, 160;" ::"r"(2 * CONSUMERS + 1 + consumer) : "memory");
}

// Loads what stays, and returns where the next goes.
template <int CHUNKS, int COLUMNS, int STREAMED>
__device__ __forceinline__ __half* load_residents(Shared& smem, __half* to,
                                                  const uint16_t* weights) {
  constexpr int SIZE = (CHUNKS - STREAMED) * DEPTH * COLUMNS;
  const uint16_t* const from = weights + STREAMED * DEPTH * COLUMNS;
  if (SIZE > 0) copy(to, from, SIZE * 2, &smem.resident_full);
  return to + SIZE;
}

__device__ void feed_weights(Shared& smem, const uint16_t* weights, int horizon,
                             int tiles, int lane) {
  constexpr int LEFT_WEIGHTS = HIDDEN_CHUNKS * DEPTH * LEFT;
  constexpr int INPUT_LEFT = INPUT_CHUNKS * DEPTH * LEFT;
  const uint16_t* hidden = weights + INPUT_WEIGHTS;
  const uint16_t* output = hidden + (LAYERS - 1) * HIDDEN_WEIGHTS;
  if (lane == 0) {
    __half* to = smem.resident;
    expect(&smem.resident_full, RESIDENT_WEIGHTS * 2);
    to = load_residents<INPUT_CHUNKS, LEFT, 0>(smem, to, weights);
    to = load_residents<INPUT_CHUNKS, RIGHT, 0>(smem, to, weights + INPUT_LEFT);
    for (int layer = 0; layer < LAYERS - 1; ++layer) {
      const uint16_t* from = hidden + layer * HIDDEN_WEIGHTS;
      to = load_residents<HIDDEN_CHUNKS, LEFT, LEFT_STREAMED>(smem, to, from);
      to = load_residents<HIDDEN_CHUNKS, RIGHT, RIGHT_STREAMED>(smem, to,
                                                                from + LEFT_WEIGHTS);
    }
    load_residents<HIDDEN_CHUNKS, 2 * HEAD, 0>(smem, to, output);
  }
  uint32_t round = 0;
  for (int step = 0; step < horizon; ++step) {
    for (int layer = 0; layer < LAYERS - 1; ++layer) {
      const uint16_t* from = hidden + layer * HIDDEN_WEIGHTS;
      if (lane == 0) {
        feed<LEFT_HALF>(smem, from, round);
        feed<RIGHT_HALF>(smem, from + LEFT_WEIGHTS, round);
      }
      meet_tiles(smem, tiles, round);
      round ^= 1;
    }
  }
}

// Draws the noise of `jax.random.normal(key of the step, [E, N, P, OBS])`.
__device__ void feed_noise(Shared& smem, const Rollout& rollout, const Block& block,
                           int thread) {
  constexpr int STRIDE = NOISE_WARPS * 32;
  constexpr int OF_SLICE = (SLICE * OBS + STRIDE - 1) / STRIDE;  // numbers of a thread
  for (int step = 0; step < rollout.horizon; ++step) {
    const uint32_t* key = rollout.keys + KEY * step;
    uint32_t counter = noise_counter(rollout, key, block.member, block.first_row);
    for (int consumer = 0; consumer < block.consumers(); ++consumer) {
      wait(&smem.noise_empty[consumer], (step & 1) ^ 1);
      if (consumer < block.tiles)
        draw_noise<TILE * OBS, STRIDE, 6>(smem.rows.tiles[consumer].target, key, counter,
                                          thread);
      else
        draw_noise<SLICE * OBS, STRIDE, (OF_SLICE < 6 ? OF_SLICE : 6)>(
            smem.rows.sliced.slice.target, key, counter, thread);
      counter += TILE * OBS;
      __syncwarp();
      if (thread % 32 == 0) arrive(&smem.noise_full[consumer]);
    }
  }
}

// Starts sums = activations x weights: the first chunks, which have streamed, and those
// that stay. Each is a group of products in flight, if there are any.
template <int CHUNKS, int COLUMNS, int STREAMED, int REGISTERS>
__device__ __forceinline__ void multiply(float (&sums)[COLUMNS / 2],
                                         const uint32_t (&activations)[REGISTERS],
                                         const __half* streamed, const __half* resident) {
  constexpr int STRIDE = DEPTH * COLUMNS * 2 / 16;  // in units of descriptors
  uint64_t weights = weight_descriptor(address(STREAMED > 0 ? streamed : resident));
  wgmma_fence();
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    if (STREAMED > 0 && chunk == STREAMED) {
      wgmma_commit();
      weights = weight_descriptor(address(resident));
    }
    const uint32_t* a = activations + 4 * chunk;
    Wgmma<COLUMNS>::multiply(
        sums, a[0], a[1], a[2], a[3],
        weights + (chunk < STREAMED ? chunk : chunk - STREAMED) * STRIDE, chunk > 0);
  }
  wgmma_commit();
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

// One hidden layer. While the right half of its products runs, the left half goes
// through their activation.
template <int TILES, int CHUNKS, int LEFT_STREAMED, int RIGHT_STREAMED, int REGISTERS>
__device__ __forceinline__ void hidden_layer(uint32_t (&activations)[4 * HIDDEN_CHUNKS],
                                             const uint32_t (&operand)[REGISTERS],
                                             const __half* resident, Shared& smem,
                                             uint32_t round, int pair, int consumer) {
  constexpr int RESIDENT_LEFT = (CHUNKS - LEFT_STREAMED) * DEPTH * LEFT;
  // Whether a half has products that read what streams, and others behind them.
  constexpr bool LEFT_BOTH = LEFT_STREAMED > 0 && LEFT_STREAMED < CHUNKS;
  constexpr bool RIGHT_BOTH = RIGHT_STREAMED > 0 && RIGHT_STREAMED < CHUNKS;
  float left[LEFT / 2], right[RIGHT / 2];
  if (TILES == 2) begin_turn(consumer);
  if (LEFT_STREAMED > 0) wait(&smem.streamed_full[LEFT_HALF], round);
  multiply<CHUNKS, LEFT, LEFT_STREAMED>(left, operand, smem.streamed_left, resident);
  if (LEFT_BOTH) {
    wgmma_wait<1>();
    release(&smem.streamed_empty[LEFT_HALF]);
  }
  if (RIGHT_STREAMED > 0) meet_feeder(consumer);
  multiply<CHUNKS, RIGHT, RIGHT_STREAMED>(right, operand, smem.streamed_right,
                                          resident + RESIDENT_LEFT);
  if (TILES == 2) pass_turn(consumer);
  finish<(RIGHT_BOTH ? 2 : 1)>(left);
  if (LEFT_STREAMED == CHUNKS) release(&smem.streamed_empty[LEFT_HALF]);
  activate(left);
  keep_order();
  if (RIGHT_BOTH) {
    wgmma_wait<1>();
    release(&smem.streamed_empty[RIGHT_HALF]);
  }
  finish<0>(right);
  if (RIGHT_STREAMED == CHUNKS) release(&smem.streamed_empty[RIGHT_HALF]);
  activate(right);
  // Rounding waits until here, since no register that a product reads may be written while
  // another product runs.
  // Sums lie in registers as activations do.
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
  Rows<TILE>& rows = smem.rows.tiles[consumer];
  Warp warp = {rollout,
               smem.shared,
               rows.inputs + own * INPUT_STRIDE,
               rows.state + own * STATE_STRIDE,
               rows.target + own * STATE_STRIDE,
               rows.path_offset + own,
               rows.action_offset + own,
               lane,
               rollout.num_members * rollout.particles * OBS};
  warp.begin(block.member, block.first_row + consumer * TILE + own);
  sync_warpgroup(consumer);
  wait(&smem.resident_full, 0);
  if (consumer == 1) pass_turn(consumer);  // the other one is first

  uint32_t round = 0;
  for (int step = 0; step < rollout.horizon; ++step) {
    warp.load_actions(min(step + 1, rollout.horizon - 1));
    float head[HEAD];
    {
      uint32_t activations[4 * HIDDEN_CHUNKS], operand[4 * INPUT_CHUNKS];
      warp.read_inputs(operand);
      hidden_layer<TILES, INPUT_CHUNKS, 0, 0>(activations, operand, smem.resident, smem,
                                              round, pair, consumer);
      const __half* resident = smem.resident + RESIDENT_INPUT;
#pragma unroll 1
      for (int layer = 1; layer < LAYERS; ++layer) {
        hidden_layer<TILES, HIDDEN_CHUNKS, LEFT_STREAMED, RIGHT_STREAMED>(
            activations, activations, resident, smem, round, pair, consumer);
        resident += RESIDENT_HIDDEN;
        round ^= 1;
      }
      multiply<HIDDEN_CHUNKS, 2 * HEAD, 0>(head, activations, nullptr, resident);
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
    for (int half = LEFT_HALF; half <= RIGHT_HALF; ++half) {
      init_barrier(&smem.streamed_full[half], 1);
      init_barrier(&smem.streamed_empty[half], block.consumers() * WARPGROUP / 32);
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
    else
      feed_weights(smem, weights, rollout.horizon, block.tiles, thread);
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
