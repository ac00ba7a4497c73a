// The sizes of a fit: a block's part in a model, and where its numbers lie.
//
// A cluster of CTAS blocks trains a member. A block owns a slice of the columns of every
// hidden layer, the same rows of the output layer, and a slice of the dimensions.
#pragma once

#include "fit_device.h"
#include "sizes.h"
// Of model.h: OBS, MEMBERS, LAYERS (hidden), WIDTHS, CTAS, THREADS, ROWS, SHARED_BYTES.

#define BOTH __host__ __device__ constexpr

namespace {

BOTH int ceil_div(int a, int b) { return (a + b - 1) / b; }
BOTH int most(int a, int b) { return a > b ? a : b; }
BOTH int least(int a, int b) { return a < b ? a : b; }

BOTH int width(int l) {
  constexpr int widths[] = {WIDTHS};
  return widths[l];
}
BOTH int fan_in(int l) { return l == 0 ? INPUTS : width(l - 1); }
BOTH int cols(int l) { return ceil_div(width(l), CTAS); }  // of a block
BOTH int most_cols(int l = 0) {
  return l == LAYERS ? 0 : most(cols(l), most_cols(l + 1));
}

constexpr int WARPS = THREADS / 32;
constexpr int COLS = most_cols();
constexpr int TILES_OF_COLS = ceil_div(COLS, 8);  // of a tensor core instruction
constexpr int PADDED_COLS = 8 * TILES_OF_COLS;
constexpr int W_STRIDE = PADDED_COLS + 4;  // of rows of weights; free of bank conflicts
constexpr int QUADS = ROWS / 4;
constexpr int OUTS = 2 * OBS;              // means, then raw log-variances
constexpr int OUT_STRIDE = OUTS + 1;       // of rows of output weights
constexpr int DIMS = ceil_div(OBS, CTAS);  // of a block
constexpr int LAST = LAYERS - 1;
constexpr int LAST_COLS = cols(LAST);

// In shared memory: of a layer's weights, of its inputs.
BOTH int w_offset(int l) {
  return l == 0 ? 0 : w_offset(l - 1) + fan_in(l - 1) * W_STRIDE;
}
BOTH int x_offset(int l) { return l <= 1 ? 0 : x_offset(l - 1) + fan_in(l - 1) * ROWS; }

// In a member's parameters: each layer's kernel [in, out] and its bias, the output last.
BOTH int p_offset(int l) {
  return l == 0 ? 0 : p_offset(l - 1) + (fan_in(l - 1) + 1) * width(l - 1);
}
constexpr int P_OUT = p_offset(LAYERS), P_OUT_BIAS = P_OUT + width(LAST) * OUTS;
constexpr int PARAMS = P_OUT_BIAS + OUTS;

// Gradients of weights come in units of a warp: 16 inputs of a layer by all own columns.
// What a lane has of them is what the instruction gives it: two runs of two columns in
// each tile. A warp has units in its slots, those of the last layer first.
constexpr int UNIT = 16;
constexpr int RUNS = 2 * TILES_OF_COLS, RUN = 2;
BOTH int units(int l) { return ceil_div(fan_in(l), UNIT); }
BOTH int first_unit(int l) {
  return l == LAST ? 0 : first_unit(l + 1) + units(l + 1);
}
constexpr int UNITS = first_unit(0) + units(0);
constexpr int SLOTS = ceil_div(UNITS, WARPS);
BOTH int layer_of_unit(int u, int l = LAST) {
  return l == 0 || u < first_unit(l) + units(l) ? l : layer_of_unit(u, l - 1);
}
// The layer whose gradient is the last that a slot needs.
BOTH int needs(int slot) {
  return layer_of_unit(least(UNITS, (slot + 1) * WARPS) - 1);
}

// Activations lie as [column][row], groups of four rows swizzled by the column.
DEVICE int quad(int column, int q) {
  return column * ROWS + ((q ^ ((column / (8 / QUADS)) & (QUADS - 1))) << 2);
}
DEVICE int at(int column, int row) { return quad(column, row >> 2) + (row & 3); }

static_assert(THREADS % 32 == 0 && (ROWS == 16 || ROWS == 32), "");

}  // namespace
