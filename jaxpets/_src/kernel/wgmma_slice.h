// A slice: the 16 particles that a block of wgmma_rollout.cu may own beside one tile.
//
// The four warps of a slice share the columns of a layer and not its rows: each multiplies
// all 16 particles by every fourth 8 columns, by the instruction of older GPUs, which needs
// a quarter of the rows. Weights are those of the tile; activations lie in shared memory.
#pragma once

#include "mma.h"
#include "wgmma_memory.h"

namespace {

constexpr int SLICE_WARPS = WARPGROUP / 32;
constexpr int EIGHT = DEPTH * 8;  // weights of a chunk for 8 columns

// How many times 8 columns a warp has of so many, at most.
__host__ __device__ constexpr int eights_of_warp(int columns) {
  return (columns / 8 + SLICE_WARPS - 1) / SLICE_WARPS;
}

// Reads 16 deep x 8 columns as a right operand, or two of these. Each of 16 lanes has the
// address of 8 deep x 1 column, for the second one each of the 16 others.
__device__ __forceinline__ void load_weights(uint32_t (&b)[4], uint32_t from, bool two) {
  if (two)
    load_operand(b, from);  // as many words
  else
    asm volatile("ldmatrix.sync.aligned.m8n8.x2.shared.b16 {%0, %1}, [%2];"
                 : "=r"(b[0]), "=r"(b[1])
                 : "r"(from)
                 : "memory");
}

// Hands a slot back. An arrival may overtake what the warp has asked for and not yet read,
// and a copy would overwrite that. So its place seems to depend on a word of every read.
__device__ __forceinline__ void release_read(Shared& smem, int slot, uint32_t words) {
  release(smem, slot + (words & (gridDim.y - 1)));  // that is 0
}

// The slice's rows of an operand, all chunks of it.
template <int CHUNKS>
struct SliceOperand {
  uint32_t words[CHUNKS][4];

  __device__ __forceinline__ SliceOperand(const __half* rows, int stride, int lane) {
    const uint32_t from = address(rows + lane % 16 * stride + lane / 16 * 8);
#pragma unroll
    for (int chunk = 0; chunk < CHUNKS; ++chunk)
      load_operand(words[chunk], from + chunk * DEPTH * 2);
  }
};

// sums = operand x weights, of EIGHTS times 8 of COLUMNS columns: `first` and every
// `stride`-th after it. Beyond the last column the last are multiplied again, for nobody.
template <int COLUMNS, int STREAMED, int EIGHTS, int CHUNKS>
__device__ __forceinline__ void multiply(float (&sums)[EIGHTS][4],
                                         const SliceOperand<CHUNKS>& operand,
                                         const __half* resident, Shared& smem,
                                         Cursor& cursor, int first, int stride, int lane) {
  constexpr int RESIDENT = CHUNKS - STREAMED, CHUNK = DEPTH * COLUMNS * 2;  // bytes
  uint32_t places[(EIGHTS + 1) / 2];  // of two times 8 columns: in a chunk
#pragma unroll
  for (int i = 0; i < EIGHTS; i += 2) {
    const int eight = min(first + (i + lane / 16) * stride, COLUMNS / 8 - 1);
    places[i / 2] = (eight * EIGHT + lane % 16 * 8) * 2;
  }
#pragma unroll
  for (int i = 0; i < EIGHTS; ++i)
#pragma unroll
    for (int k = 0; k < 4; ++k) sums[i][k] = 0.0f;
  uint32_t from = address(resident), read = 0, pending_read = 0;
  int pending = 0;
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    const bool streamed = chunk >= RESIDENT;
    const int in_unit = (chunk - RESIDENT) % UNIT;
    if (streamed && in_unit == 0) {
      wait(&smem.ring_full[cursor.slot], cursor.round);
      from = address(smem.ring[cursor.slot]);
    }
#pragma unroll
    for (int i = 0; i < EIGHTS; i += 2) {
      uint32_t b[4];
      load_weights(b, from + (streamed ? in_unit : chunk) * CHUNK + places[i / 2],
                   i + 1 < EIGHTS);
      add_product(sums[i], operand.words[chunk], b);
      if (i + 1 < EIGHTS) add_product(sums[i + 1], operand.words[chunk], b + 2);
      if (streamed) read |= b[0];
    }
    if (streamed && in_unit + 1 == UNIT) {
      // A slot is handed back when the unit after it has been read, or none comes.
      if (chunk >= RESIDENT + UNIT) release_read(smem, pending, pending_read);
      pending = cursor.slot;
      pending_read = read;
      cursor.advance();
    }
  }
  if (STREAMED > 0) release_read(smem, pending, pending_read);
}

// Squashes a warp's sums of half a layer, and rounds them.
template <int EIGHTS>
__device__ __forceinline__ void squash(uint32_t (&rounded)[EIGHTS][2],
                                       float (&sums)[EIGHTS][4]) {
#pragma unroll
  for (int i = 0; i < EIGHTS; ++i) {
    activate(sums[i]);
    rounded[i][0] = pack(sums[i][0], sums[i][1]);
    rounded[i][1] = pack(sums[i][2], sums[i][3]);
  }
}

// Writes them to where they are the next operand.
template <int COLUMNS, int EIGHTS>
__device__ __forceinline__ void write(__half* activations,
                                      const uint32_t (&rounded)[EIGHTS][2], int warp,
                                      int lane) {
#pragma unroll
  for (int i = 0; i < EIGHTS; ++i) {
    const int eight = warp + i * SLICE_WARPS;
    __half* const place =
        activations + lane / 4 * ACTIVATION_STRIDE + eight * 8 + lane % 4 * 2;
    if (eight < COLUMNS / 8) {
      *reinterpret_cast<uint32_t*>(place) = rounded[i][0];
      *reinterpret_cast<uint32_t*>(place + 8 * ACTIVATION_STRIDE) = rounded[i][1];
    }
  }
}

// The warps of a slice meet, and no others.
__device__ __forceinline__ void sync_slice() { sync_warpgroup(1); }

// One hidden layer. All meet twice: when they have read what is overwritten, and when the
// activations are written, for which the caller waits.
template <int CHUNKS, int LEFT_STREAMED, int RIGHT_STREAMED>
__device__ __forceinline__ void slice_layer(__half* activations,
                                            const SliceOperand<CHUNKS>& operand,
                                            const __half* resident, Shared& smem,
                                            Cursor& cursor, int warp, int lane) {
  constexpr int RESIDENT_LEFT = (CHUNKS - LEFT_STREAMED) * DEPTH * LEFT;
  constexpr int LEFTS = eights_of_warp(LEFT), RIGHTS = eights_of_warp(RIGHT);
  float left[LEFTS][4], right[RIGHTS][4];
  uint32_t left_rounded[LEFTS][2], right_rounded[RIGHTS][2];
  multiply<LEFT, LEFT_STREAMED>(left, operand, resident, smem, cursor, warp, SLICE_WARPS,
                                lane);
  squash(left_rounded, left);
  multiply<RIGHT, RIGHT_STREAMED>(right, operand, resident + RESIDENT_LEFT, smem, cursor,
                                  warp, SLICE_WARPS, lane);
  squash(right_rounded, right);
  sync_slice();
  write<LEFT>(activations, left_rounded, warp, lane);
  write<RIGHT>(activations + LEFT, right_rounded, warp, lane);
}

__device__ void consume_slice(Shared& smem, const Rollout& rollout, const Block& block,
                              int thread) {
  const int warp = thread / 32, lane = thread % 32;
  Rows<SLICE>& rows = smem.rows.sliced.slice;
  __half* const activations = smem.rows.sliced.activations;
  // One warp moves the particles, another one stores them and reads their actions.
  constexpr int MOVER = 0, CLERK = SLICE_WARPS - 1;
  Warp particles = warp_of(rows, 0, smem, rollout, lane);
  if (warp == MOVER) particles.begin(block.member, block.first_row + TILE);
  constexpr int BEHIND = HIDDEN_CHUNKS * DEPTH - WIDTH;
  for (int i = thread; i < SLICE * BEHIND; i += WARPGROUP)
    activations[i / BEHIND * ACTIVATION_STRIDE + WIDTH + i % BEHIND] =
        __half(i % BEHIND < 2 ? 1.0f : 0.0f);
  sync_slice();
  wait(&smem.resident_full, 0);

  Cursor cursor;
  for (int step = 0; step < rollout.horizon; ++step) {
    if (warp == CLERK) {
      particles.store_states(step);
      particles.load_actions(min(step + 1, rollout.horizon - 1));
    }
    const __half* resident = smem.resident;
    slice_layer<INPUT_CHUNKS, 0, 0>(
        activations, SliceOperand<INPUT_CHUNKS>(rows.inputs, INPUT_STRIDE, lane), resident,
        smem, cursor, warp, lane);
    if (warp == CLERK) particles.write_actions();
    sync_slice();
    resident += RESIDENT_INPUT;
#pragma unroll 1
    for (int layer = 1; layer < LAYERS; ++layer) {
      slice_layer<HIDDEN_CHUNKS, LEFT_STREAMED, RIGHT_STREAMED>(
          activations, SliceOperand<HIDDEN_CHUNKS>(activations, ACTIVATION_STRIDE, lane),
          resident, smem, cursor, warp, lane);
      sync_slice();
      resident += RESIDENT_HIDDEN;
    }
    // Of 8 entries a warp has the means and the log-variances.
    if (warp < HEAD / 8) {
      const SliceOperand<HIDDEN_CHUNKS> operand(activations, ACTIVATION_STRIDE, lane);
      wait(&smem.noise_full[1], step & 1);
#pragma unroll
      for (int eight = warp; eight < HEAD / 8; eight += SLICE_WARPS) {
        float head[2][4];
        multiply<2 * HEAD, 0>(head, operand, resident, smem, cursor, eight, HEAD / 8, lane);
        const float(&drawn)[8] = reinterpret_cast<const float(&)[8]>(head);
        draw_targets(rows.target + 8 * eight + lane / 4 * STATE_STRIDE, drawn,
                     smem.shared + 8 * eight, lane % 4, OBS - 8 * eight);
      }
    }
    sync_slice();
    if (warp == MOVER) {
      particles.move_all();
      __syncwarp();
      if (lane == 0) arrive(&smem.noise_empty[1]);
    }
    sync_slice();
  }
  if (warp == CLERK) particles.store_states(rollout.horizon);
}

}  // namespace
