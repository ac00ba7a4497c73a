// What one particle needs in one step, on GPU and CPU alike: noise, the Gaussian head,
// rounding of activations. The model's coordinates are generated into model.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifdef __CUDACC__
#define ROW_FUNCTION __host__ __device__ __forceinline__
#else
#define ROW_FUNCTION inline
#endif

// Like jnp.maximum and jnp.minimum, and unlike fmaxf, these keep a NaN.
ROW_FUNCTION float higher(float a, float b) { return a > b || a != a ? a : b; }
ROW_FUNCTION float lower(float a, float b) { return a < b || a != a ? a : b; }

ROW_FUNCTION float fast_exp(float x) {
#ifdef __CUDA_ARCH__
  return __expf(x);
#else
  return expf(x);
#endif
}

ROW_FUNCTION float fast_log(float x) {
#ifdef __CUDA_ARCH__
  return __logf(x);
#else
  return logf(x);
#endif
}

ROW_FUNCTION uint32_t rotated(uint32_t x, int distance) {
  return (x << distance) | (x >> (32 - distance));
}

// 32 random bits: element `counter` of a draw of less than 2^32 with jax's threefry2x32.
ROW_FUNCTION uint32_t threefry_bits(uint32_t key0, uint32_t key1, uint32_t counter) {
  const uint32_t keys[3] = {key0, key1, key0 ^ key1 ^ 0x1BD11BDAu};
  uint32_t x = key0, y = counter + key1;  // the upper half of the counter is 0
#ifdef __CUDA_ARCH__
#pragma unroll
#endif
  for (int block = 0; block < 5; ++block) {
    const int first[4] = {13, 15, 26, 6}, second[4] = {17, 29, 16, 24};
#ifdef __CUDA_ARCH__
#pragma unroll
#endif
    for (int round = 0; round < 4; ++round) {
      x += y;
      y = rotated(y, block % 2 ? second[round] : first[round]) ^ x;
    }
    x += keys[(block + 1) % 3];
    y += keys[(block + 2) % 3] + block + 1;
  }
  return x ^ y;
}

// What jax.random.normal makes of 32 bits: sqrt(2) erfinv(u), u uniform in (-1, 1).
ROW_FUNCTION float normal(uint32_t bits) {
  const uint32_t one_to_two = (bits >> 9) | 0x3F800000u;
  float fraction;
  memcpy(&fraction, &one_to_two, sizeof fraction);
  const float low = -0.99999994f;
  const float u = fmaxf(low, fmaf(fraction - 1.0f, 2.0f, low));
  // M. Giles, "Approximating the erfinv function", single precision.
  float w = -fast_log(fmaf(-u, u, 1.0f));
  float p;
  if (w < 5.0f) {
    w -= 2.5f;
    p = 2.81022636e-08f;
    p = fmaf(p, w, 3.43273939e-07f);
    p = fmaf(p, w, -3.5233877e-06f);
    p = fmaf(p, w, -4.39150654e-06f);
    p = fmaf(p, w, 0.00021858087f);
    p = fmaf(p, w, -0.00125372503f);
    p = fmaf(p, w, -0.00417768164f);
    p = fmaf(p, w, 0.246640727f);
    p = fmaf(p, w, 1.50140941f);
  } else {
    w = sqrtf(w) - 3.0f;
    p = -0.000200214257f;
    p = fmaf(p, w, 0.000100950558f);
    p = fmaf(p, w, 0.00134934322f);
    p = fmaf(p, w, -0.00367342844f);
    p = fmaf(p, w, 0.00573950773f);
    p = fmaf(p, w, -0.0076224613f);
    p = fmaf(p, w, 0.00943887047f);
    p = fmaf(p, w, 1.00167406f);
    p = fmaf(p, w, 2.83297682f);
  }
  return 1.41421356f * p * u;
}

// The standard deviation behind a raw log-variance, bounded softly from both sides:
// lv = max - softplus(max - raw), lv = min + softplus(lv - min), exp(lv / 2). In terms of
// variances that is exp(lv) = exp(min) + 1 / (exp(-max) + exp(-raw)).
ROW_FUNCTION float deviation(float raw, float min_variance, float max_precision) {
  return sqrtf(min_variance + 1.0f / (max_precision + fast_exp(-raw)));
}
