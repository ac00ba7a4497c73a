// The weights of a member as GPU kernel and reference read them: float16, in chunks.
#pragma once

#include <cstdint>

#include "sizes.h"

// Products are cut along the inner dimension into chunks of 16, the depth of one tensor
// core instruction. Two rows hold the bias, rounded, and what rounding left; activations
// end in two ones for them.
using Weight = uint16_t;
constexpr int DEPTH = 16;
constexpr int INPUT_CHUNKS = round_up(INPUTS + 2, DEPTH) / DEPTH;
constexpr int HIDDEN_CHUNKS = round_up(WIDTH + 2, DEPTH) / DEPTH;
constexpr int HEAD = round_up(OBS, 8);  // columns for means, and as many for variances
// Of a hidden layer all chunks of its LEFT columns come first, then those of the others.
constexpr int RIGHT = WIDTH - LEFT;
constexpr int INPUT_WEIGHTS = INPUT_CHUNKS * DEPTH * WIDTH;
constexpr int HIDDEN_WEIGHTS = HIDDEN_CHUNKS * DEPTH * WIDTH;
constexpr int OUTPUT_WEIGHTS = HIDDEN_CHUNKS * DEPTH * 2 * HEAD;
constexpr int MEMBER_WEIGHTS =
    INPUT_WEIGHTS + (LAYERS - 1) * HIDDEN_WEIGHTS + OUTPUT_WEIGHTS;

// The place of a weight in a chunk of so many columns. In blocks of 8 x 8, column after
// column, as Hopper reads them in shared memory: for 8 columns, the upper rows first. Or
// in FRAGMENTS, as the 32 lanes of a warp hold them in registers: for 16 columns, each
// lane's four pairs of rows; for 8 that are left over, each lane's two.
constexpr int place(int row, int column, int columns) {
  if (!FRAGMENTS) return (column / 8 * 2 + row / 8) * 64 + column % 8 * 8 + row % 8;
  const bool is_alone = column / 16 * 16 + 8 == columns;
  const int lane = column % 8 * 4 + row % 8 / 2;
  const int in_lane = column % 16 / 8 * 4 + row / 8 * 2 + row % 2;
  return column / 16 * 256 + lane * (is_alone ? 4 : 8) + in_lane;
}

// The head's columns of an entry. In fragments a lane has both in one piece.
constexpr int mean_column(int entry) {
  return FRAGMENTS ? entry / 8 * 16 + entry % 8 : entry;
}
constexpr int variance_column(int entry) {
  return mean_column(entry) + (FRAGMENTS ? 8 : HEAD);
}
