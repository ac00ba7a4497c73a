// The weights of a member as GPU kernel and reference read them: float16, in chunks.
#pragma once

#include <cstdint>

#include "sizes.h"

// Products are cut along the inner dimension into chunks of 16, the depth of one tensor
// core instruction. A chunk holds 16 x columns weights as blocks of 8 x 8. Two rows hold
// the bias, rounded, and what rounding left; activations end in two ones for them.
using Weight = uint16_t;
constexpr int DEPTH = 16;
constexpr int INPUT_CHUNKS = round_up(INPUTS + 2, DEPTH) / DEPTH;
constexpr int HIDDEN_CHUNKS = round_up(WIDTH + 2, DEPTH) / DEPTH;
constexpr int HEAD = round_up(OBS, 8);  // columns for means, then as many for variances
// Of a hidden layer all chunks of its LEFT columns come first, then those of the others.
constexpr int RIGHT = WIDTH - LEFT;
constexpr int INPUT_WEIGHTS = INPUT_CHUNKS * DEPTH * WIDTH;
constexpr int HIDDEN_WEIGHTS = HIDDEN_CHUNKS * DEPTH * WIDTH;
constexpr int OUTPUT_WEIGHTS = HIDDEN_CHUNKS * DEPTH * 2 * HEAD;
constexpr int MEMBER_WEIGHTS =
    INPUT_WEIGHTS + (LAYERS - 1) * HIDDEN_WEIGHTS + OUTPUT_WEIGHTS;
