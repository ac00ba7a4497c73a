// The weights of a member as the CPU kernel reads them: float32, in tiles.
#pragma once

#include "sizes.h"

// A layer is cut into tiles of TILE of its outputs; the last may have fewer. A tile holds
// the biases of its outputs, and then for every input the weights to its outputs.
using Weight = float;
constexpr int NUM_WIDTHS = sizeof(WIDTHS) / sizeof(WIDTHS[0]);  // inputs, hidden, outputs
constexpr int layer_weights(int layer) {
  return (WIDTHS[layer] + 1) * WIDTHS[layer + 1];
}
constexpr int member_weights() {
  int sum = 0;
  for (int layer = 0; layer + 1 < NUM_WIDTHS; ++layer) sum += layer_weights(layer);
  return sum;
}
constexpr int MEMBER_WEIGHTS = member_weights();
constexpr int widest() {
  int most = 0;
  for (int width : WIDTHS) most = width > most ? width : most;
  return most;
}
constexpr int WIDEST = widest();
