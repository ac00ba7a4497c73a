// What one particle needs in one step, on GPU and CPU alike: noise, the Gaussian head,
// rounding of activations. The model's coordinates are generated into model.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifdef __CUDACC__
#define ROW_FUNCTION __host__ __device__ __forceinline__
#define UNROLLED _Pragma("unroll")
#else
#define ROW_FUNCTION inline
#define UNROLLED
#endif

// Like jnp.maximum and jnp.minimum, and unlike fmaxf, these keep a NaN.
ROW_FUNCTION float higher(float a, float b) { return a > b || a != a ? a : b; }
ROW_FUNCTION float lower(float a, float b) { return a < b || a != a ? a : b; }

// On the GPU these are instructions of about 22 bits, not calls.
#ifdef __CUDA_ARCH__
ROW_FUNCTION float fast_exp(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.44269504f));
  return y;
}
ROW_FUNCTION float fast_log(float x) {
  float y;
  asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y * 0.693147181f;
}
ROW_FUNCTION float fast_inverse(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
ROW_FUNCTION float fast_sqrt(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
#else
ROW_FUNCTION float fast_exp(float x) { return expf(x); }
ROW_FUNCTION float fast_log(float x) { return logf(x); }
ROW_FUNCTION float fast_inverse(float x) { return 1.0f / x; }
ROW_FUNCTION float fast_sqrt(float x) { return sqrtf(x); }
#endif

// An angle without its full turns; 2 pi is cut in three so that little is lost up to
// a million radians.
ROW_FUNCTION float within_turn(float angle) {
  const float turns = rintf(angle * 0.15915494f);
  angle = fmaf(turns, -6.28125f, angle);
  angle = fmaf(turns, -0.00193500518798828125f, angle);
  return fmaf(turns, -3.01991605e-07f, angle);
}

ROW_FUNCTION float sine(float angle) {
#ifdef __CUDA_ARCH__
  return __sinf(within_turn(angle));
#else
  return sinf(within_turn(angle));
#endif
}

ROW_FUNCTION float cosine(float angle) {
#ifdef __CUDA_ARCH__
  return __cosf(within_turn(angle));
#else
  return cosf(within_turn(angle));
#endif
}

ROW_FUNCTION uint32_t rotated(uint32_t x, int distance) {
  return (x << distance) | (x >> (32 - distance));
}

// 32 random bits each: elements `first + i * stride` of a draw of at most 2^32 with jax's
// threefry2x32. All advance together: a single one would wait for itself at every step.
template <int COUNT>
ROW_FUNCTION void threefry(uint32_t key0, uint32_t key1, uint32_t first, uint32_t stride,
                           uint32_t (&bits)[COUNT]) {
  const uint32_t keys[3] = {key0, key1, key0 ^ key1 ^ 0x1BD11BDAu};
  uint32_t x[COUNT], y[COUNT];
  UNROLLED
  for (int i = 0; i < COUNT; ++i) {
    x[i] = key0;  // the upper half of the counter is 0
    y[i] = first + i * stride + key1;
  }
  UNROLLED
  for (int block = 0; block < 5; ++block) {
    const int distances[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
    UNROLLED
    for (int round = 0; round < 4; ++round) {
      UNROLLED
      for (int i = 0; i < COUNT; ++i) {
        x[i] += y[i];
        y[i] = rotated(y[i], distances[block % 2][round]) ^ x[i];
      }
    }
    UNROLLED
    for (int i = 0; i < COUNT; ++i) {
      x[i] += keys[(block + 1) % 3];
      y[i] += keys[(block + 2) % 3] + (block + 1);
    }
  }
  UNROLLED
  for (int i = 0; i < COUNT; ++i) bits[i] = x[i] ^ y[i];
}

// What jax.random.normal makes of 32 bits: sqrt(2) erfinv(u), u uniform in (-1, 1), by
// M. Giles, "Approximating the erfinv function", single precision.
template <int COUNT>
ROW_FUNCTION void normal(const uint32_t (&bits)[COUNT], float (&drawn)[COUNT]) {
  float u[COUNT], w[COUNT];
  bool in_tail = false;
  UNROLLED
  for (int i = 0; i < COUNT; ++i) {
    const uint32_t one_to_two = (bits[i] >> 9) | 0x3F800000u;
    float fraction;
    memcpy(&fraction, &one_to_two, sizeof fraction);
    u[i] = fmaf(fraction - 1.0f, 2.0f, -0.99999994f);
    w[i] = -fast_log(fmaf(-u[i], u[i], 1.0f));
    in_tail |= w[i] >= 5.0f;
    const float v = w[i] - 2.5f;
    float p = 2.81022636e-08f;
    p = fmaf(p, v, 3.43273939e-07f);
    p = fmaf(p, v, -3.5233877e-06f);
    p = fmaf(p, v, -4.39150654e-06f);
    p = fmaf(p, v, 0.00021858087f);
    p = fmaf(p, v, -0.00125372503f);
    p = fmaf(p, v, -0.00417768164f);
    p = fmaf(p, v, 0.246640727f);
    p = fmaf(p, v, 1.50140941f);
    drawn[i] = 1.41421356f * p * u[i];
  }
  if (!in_tail) return;  // one number in 300
  UNROLLED
  for (int i = 0; i < COUNT; ++i) {
    const float v = fast_sqrt(w[i]) - 3.0f;
    float p = -0.000200214257f;
    p = fmaf(p, v, 0.000100950558f);
    p = fmaf(p, v, 0.00134934322f);
    p = fmaf(p, v, -0.00367342844f);
    p = fmaf(p, v, 0.00573950773f);
    p = fmaf(p, v, -0.0076224613f);
    p = fmaf(p, v, 0.00943887047f);
    p = fmaf(p, v, 1.00167406f);
    p = fmaf(p, v, 2.83297682f);
    if (w[i] >= 5.0f) drawn[i] = 1.41421356f * p * u[i];
  }
}

// The standard deviation behind a raw log-variance, bounded softly from both sides:
// lv = max - softplus(max - raw), lv = min + softplus(lv - min), exp(lv / 2). In terms of
// variances that is exp(lv) = exp(min) + 1 / (exp(-max) + exp(-raw)).
ROW_FUNCTION float deviation(float raw, float min_variance, float max_precision) {
  return fast_sqrt(min_variance + fast_inverse(max_precision + fast_exp(-raw)));
}
