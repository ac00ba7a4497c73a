// What follows from the sizes in model.h, which is generated for one kind of model.
#pragma once

#include "model.h"

constexpr int round_up(int x, int multiple) {
  return (x + multiple - 1) / multiple * multiple;
}

constexpr int INPUTS = FEATURES + ACTION;
