// The producer of wgmma_rollout.cu: it feeds weights, and draws the noise.
#pragma once

#include "wgmma_memory.h"

namespace {

// Feeds what streams of a layer, or half of one: its last chunks, a unit at a time.
template <int CHUNKS, int COLUMNS, int STREAMED>
__device__ __forceinline__ void feed(Shared& smem, Cursor& cursor,
                                     const uint16_t* weights) {
  constexpr int CHUNK = DEPTH * COLUMNS;
  for (int chunk = CHUNKS - STREAMED; chunk < CHUNKS; chunk += UNIT) {
    wait(&smem.ring_empty[cursor.slot], cursor.round ^ 1);
    expect(&smem.ring_full[cursor.slot], UNIT * CHUNK * 2);
    copy(smem.ring[cursor.slot], weights + chunk * CHUNK, UNIT * CHUNK * 2,
         &smem.ring_full[cursor.slot]);
    cursor.advance();
  }
}

// Loads what stays, and returns where the next goes.
template <int CHUNKS, int COLUMNS, int STREAMED>
__device__ __forceinline__ __half* load_residents(Shared& smem, __half* to,
                                                  const uint16_t* weights) {
  constexpr int SIZE = (CHUNKS - STREAMED) * DEPTH * COLUMNS;
  if (SIZE > 0) copy(to, weights, SIZE * 2, &smem.resident_full);
  return to + SIZE;
}

__device__ void feed_weights(Shared& smem, const uint16_t* weights, int horizon) {
  constexpr int LEFT_WEIGHTS = HIDDEN_CHUNKS * DEPTH * LEFT;
  constexpr int INPUT_LEFT = INPUT_CHUNKS * DEPTH * LEFT;
  const uint16_t* hidden = weights + INPUT_WEIGHTS;
  const uint16_t* output = hidden + (LAYERS - 1) * HIDDEN_WEIGHTS;
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
  Cursor cursor;
  for (int step = 0; step < horizon; ++step) {
    for (int layer = 0; layer < LAYERS - 1; ++layer) {
      const uint16_t* from = hidden + layer * HIDDEN_WEIGHTS;
      feed<HIDDEN_CHUNKS, LEFT, LEFT_STREAMED>(smem, cursor, from);
      feed<HIDDEN_CHUNKS, RIGHT, RIGHT_STREAMED>(smem, cursor, from + LEFT_WEIGHTS);
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

}  // namespace
