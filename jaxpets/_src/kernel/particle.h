// What one particle needs in one step, on GPU and CPU alike: noise, the Gaussian head,
// rounding of activations. The model's coordinates are generated into model.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifdef __CUDACC__
#define PARTICLE_FUNCTION __host__ __device__ __forceinline__
#define UNROLLED _Pragma("unroll")
#else
// Static: libraries of other models have functions of these names too.
#define PARTICLE_FUNCTION static inline
#define UNROLLED
#endif

// Like jnp.maximum and jnp.minimum, and unlike fmaxf, these keep a NaN.
PARTICLE_FUNCTION float higher(float a, float b) { return a > b || a != a ? a : b; }
PARTICLE_FUNCTION float lower(float a, float b) { return a < b || a != a ? a : b; }

// On the GPU these are instructions of about 22 bits, not calls.
#ifdef __CUDA_ARCH__
PARTICLE_FUNCTION float fast_exp(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.44269504f));
  return y;
}
PARTICLE_FUNCTION float fast_log(float x) {
  float y;
  asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y * 0.693147181f;
}
PARTICLE_FUNCTION float fast_inverse(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
PARTICLE_FUNCTION float fast_sqrt(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
#else
// On the CPU they have no branches and call no library, so that a loop over particles
// becomes vector instructions. Exponential and logarithm are right to one or two units
// in the last place; the former is infinite above 88 and 0 below -87.
PARTICLE_FUNCTION int32_t bits_of(float number) {
  int32_t bits;
  memcpy(&bits, &number, sizeof bits);
  return bits;
}
PARTICLE_FUNCTION float number_of(int32_t bits) {
  float number;
  memcpy(&number, &bits, sizeof number);
  return number;
}
// A sum with it has no digits left for fractions, and its last bits are a whole number.
constexpr float ROUNDER = 12582912.0f;
// 2^(shifted - ROUNDER + rest), for a rest within one half; normal or 2^128, infinite.
PARTICLE_FUNCTION float power_of_two(float shifted, float rest) {
  float p = 0.000152509994f;
  p = fmaf(p, rest, 0.00133905141f);
  p = fmaf(p, rest, 0.00961879175f);
  p = fmaf(p, rest, 0.0555036142f);
  p = fmaf(p, rest, 0.240226448f);
  p = fmaf(p, rest, 0.693147181f);
  p = fmaf(p, rest, 1.0f);
  const uint32_t exponent = uint32_t(bits_of(shifted)) << 23;
  return number_of(int32_t(uint32_t(bits_of(p)) + exponent));
}
PARTICLE_FUNCTION float fast_exp(float x) {
  const float shifted = fmaf(x, 1.44269502f, ROUNDER);
  float rest = fmaf(x, 1.44269502f, ROUNDER - shifted);
  rest = fmaf(x, 1.92596303e-08f, rest);
  const float y = power_of_two(shifted, rest);
  return x != x ? x : x > 88.0f ? HUGE_VALF : x < -87.0f ? 0.0f : y;
}
// Of normal numbers above 0.
PARTICLE_FUNCTION float fast_log(float x) {
  const int32_t root_half = 0x3F3504F3;
  const int32_t twos = (bits_of(x) - root_half) >> 23;
  const float t = number_of(bits_of(x) - twos * (1 << 23)) - 1.0f;
  float p = -0.0736329034f;
  p = fmaf(p, t, 0.126209527f);
  p = fmaf(p, t, -0.13202256f);
  p = fmaf(p, t, 0.14227046f);
  p = fmaf(p, t, -0.166213483f);
  p = fmaf(p, t, 0.199998289f);
  p = fmaf(p, t, -0.250008523f);
  p = fmaf(p, t, 0.333333552f);
  p = fmaf(p * t - 0.5f, t * t, t);
  return fmaf(float(twos), 0.693147181f, p);
}
PARTICLE_FUNCTION float fast_inverse(float x) { return 1.0f / x; }
PARTICLE_FUNCTION float fast_sqrt(float x) { return sqrtf(x); }
#endif

// An angle without its full turns; 2 pi is cut in three so that little is lost up to
// a million radians.
PARTICLE_FUNCTION float within_turn(float angle) {
  const float turns = rintf(angle * 0.15915494f);
  angle = fmaf(turns, -6.28125f, angle);
  angle = fmaf(turns, -0.00193500518798828125f, angle);
  return fmaf(turns, -3.01991605e-07f, angle);
}

#ifdef __CUDA_ARCH__
PARTICLE_FUNCTION float sine(float angle) { return __sinf(within_turn(angle)); }
PARTICLE_FUNCTION float cosine(float angle) { return __cosf(within_turn(angle)); }
#else
// Of angles within a quarter turn. Those of a hundred million radians are not, after
// their turns were rounded; they get a number that is some sine.
PARTICLE_FUNCTION float near_sine(float angle) {
  const float square = angle * angle;
  float p = 2.60668139e-06f;
  p = fmaf(p, square, -0.00019810081f);
  p = fmaf(p, square, 0.00833307393f);
  p = fmaf(p, square, -0.166666597f);
  return lower(higher(fmaf(p * square, angle, angle), -1.0f), 1.0f);
}
PARTICLE_FUNCTION float sine(float angle) {
  angle = within_turn(angle);
  const bool is_near = fabsf(angle) <= 1.57079633f;
  return near_sine(is_near ? angle : copysignf(3.14159265f, angle) - angle);
}
PARTICLE_FUNCTION float cosine(float angle) {
  return near_sine(1.57079633f - fabsf(within_turn(angle)));
}
#endif

PARTICLE_FUNCTION uint32_t rotated(uint32_t x, int distance) {
  return (x << distance) | (x >> (32 - distance));
}

// 32 random bits each: elements `first + i * stride` of a draw of at most 2^32 with jax's
// threefry2x32. All advance together: a single one would wait for itself at every step.
template <int COUNT>
PARTICLE_FUNCTION void threefry(uint32_t key0, uint32_t key1, uint32_t first,
                                uint32_t stride, uint32_t (&bits)[COUNT]) {
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
PARTICLE_FUNCTION void normal(const uint32_t (&bits)[COUNT], float (&drawn)[COUNT]) {
  float u[COUNT], w[COUNT];
  int num_tails = 0;
  UNROLLED
  for (int i = 0; i < COUNT; ++i) {
    const uint32_t one_to_two = (bits[i] >> 9) | 0x3F800000u;
    float fraction;
    memcpy(&fraction, &one_to_two, sizeof fraction);
    u[i] = fmaf(fraction - 1.0f, 2.0f, -0.99999994f);
    w[i] = -fast_log(fmaf(-u[i], u[i], 1.0f));
    num_tails += w[i] >= 5.0f;
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
  if (!num_tails) return;  // one number in 300, one row of 32 in ten
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
PARTICLE_FUNCTION float deviation(float raw, float min_variance, float max_precision) {
  return fast_sqrt(min_variance + fast_inverse(max_precision + fast_exp(-raw)));
}
