// What a hidden layer's units make of their sums, in the GPU kernels and the reference.
#pragma once

#include "particle.h"
#include "sizes.h"

// swish(2 h) = h + h tanh(h), and gelu alike with another number under tanh: the weights of
// both are halved when they are packed. NaN stays NaN.
template <typename Tanh>
PARTICLE_FUNCTION float activated(float sum, Tanh tanh) {
  if (ACTIVATION == RELU) return sum < 0.0f ? 0.0f : sum;
  float inner = sum;
  if (ACTIVATION == GELU) inner *= fmaf(0.285419265f, sum * sum, 1.59576912f);
  const float squashed = tanh(inner);
  return ACTIVATION == TANH ? squashed : fmaf(sum, squashed, sum);
}
