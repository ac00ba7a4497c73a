// What follows from the sizes in model.h, which is generated for one kind of model.
#pragma once

#include "model.h"

constexpr int round_up(int x, int multiple) {
  return (x + multiple - 1) / multiple * multiple;
}

constexpr int INPUTS = FEATURES + ACTION;

// What ACTIVATION may be, in the order of ACTIVATIONS in network.py.
constexpr int SWISH = 0, TANH = 1, RELU = 2, GELU = 3;
