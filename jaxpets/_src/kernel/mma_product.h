// Products of a block's particles with weights, for mma_rollout.cu.
//
// Every warp of a block multiplies all of its particles by some of the columns. So hardly
// any weights are for two warps, and they go from L2 straight to the registers of the one
// that needs them, in the order in which its lanes hold them: they need neither shared
// memory nor barriers, and each is read once for all particles of the block.
#pragma once

#include <cstdint>

#include "gpu_layout.h"
#include "mma.h"

namespace {

// Particles are in tiles of as many rows as an instruction has.
constexpr int TILE = 16;

// Reads a lane's weights of 16 columns, or of 8, if they are wanted. No branch.
__device__ __forceinline__ void load_pair(uint32_t* to, const uint16_t* from,
                                          int wanted) {
  asm volatile(
      "{\n.reg .pred wanted;\nsetp.ne.b32 wanted, %5, 0;\n"
      "@wanted ld.global.nc.v4.u32 {%0, %1, %2, %3}, [%4];\n}"
      : "+r"(to[0]), "+r"(to[1]), "+r"(to[2]), "+r"(to[3])
      : "l"(from), "r"(wanted));
}

__device__ __forceinline__ void load_single(uint32_t* to, const uint16_t* from,
                                            int wanted) {
  asm volatile(
      "{\n.reg .pred wanted;\nsetp.ne.b32 wanted, %3, 0;\n"
      "@wanted ld.global.nc.v2.u32 {%0, %1}, [%2];\n}"
      : "+r"(to[0]), "+r"(to[1])
      : "l"(from), "r"(wanted));
}

// A warp's share of the columns: pairs of 8 that are its own, and single ones, the rest,
// that are left over. By those every warp multiplies only some tiles of rows.
template <int OWN_PAIRS, int LEFT_OVER>
struct Share {
  static constexpr int PAIRS = OWN_PAIRS, REST = LEFT_OVER;
  static constexpr int WORDS = 4 * PAIRS + 2 * REST;  // of a lane and chunk
  static constexpr int OWN_SUMS = 4 * 2 * PAIRS, REST_SUMS = 4 * REST;  // of a tile
};
// Of a hidden layer, and of the head, which is multiplied a pair at a time.
using Hidden = Share<WIDTH / 16 / WARPS, WIDTH / 8 % (2 * WARPS)>;
using Head = Share<1, 0>;

// Tiles of rows in groups of as many as there are warps: each begins with another one, by
// which it multiplies the columns that are left over. A tile of the last, smaller group
// may have more warps than one; the first computes what is stored.
constexpr int GROUPS = (TILES + WARPS - 1) / WARPS;
__host__ __device__ constexpr int tiles_of(int group) {
  return TILES - group * WARPS < WARPS ? TILES - group * WARPS : WARPS;
}
__device__ __forceinline__ int tile_of(int index, int warp) {
  const int group = index / WARPS;
  return group * WARPS + (index % WARPS + warp) % tiles_of(group);
}

// A lane's sums: of a row +0 two columns, of the row +8 the same, then the next columns.
template <typename Part>
struct Sums {
  float own[TILES][Part::OWN_SUMS > 0 ? Part::OWN_SUMS : 1];
  float rest[GROUPS][Part::REST_SUMS > 0 ? Part::REST_SUMS : 1];

  __device__ __forceinline__ void clear() {
#pragma unroll
    for (int tile = 0; tile < TILES; ++tile)
#pragma unroll
      for (int i = 0; i < Part::OWN_SUMS; ++i) own[tile][i] = 0.0f;
#pragma unroll
    for (int group = 0; group < GROUPS; ++group)
#pragma unroll
      for (int i = 0; i < Part::REST_SUMS; ++i) rest[group][i] = 0.0f;
  }
};

// Weights on their way to a lane: the next chunks of a layer, in turn in BUFFERS.
template <typename Part, int STRIDE, int BUFFERS>
struct Stream {
  const uint16_t *own, *rest;  // where the lane's weights lie in a chunk
  uint32_t words[BUFFERS][Part::WORDS];

  // Begins with a layer, of which `pair` is the warp's first. To be called long before
  // the products.
  __device__ __forceinline__ void start(const uint16_t* layer, int chunks, int pair,
                                        int lane) {
    own = layer + 256 * pair + 8 * lane;
    rest = layer + 256 * WARPS * Part::PAIRS + (Part::REST == 1 ? 4 : 8) * lane;
#pragma unroll
    for (int i = 0; i < BUFFERS; ++i) load(words[i], min(i, chunks - 1), true, lane);
  }

  __device__ __forceinline__ void load(uint32_t (&to)[Part::WORDS], int chunk, int wanted,
                                       int lane) {
#pragma unroll
    for (int i = 0; i < Part::PAIRS; ++i)
      load_pair(to + 4 * i, own + chunk * STRIDE + 256 * i, wanted);
#pragma unroll
    for (int i = 0; i < Part::REST; i += 2) {
      uint32_t* const place = to + 4 * Part::PAIRS + 2 * i;
      const uint16_t* const from = rest + chunk * STRIDE + 128 * i;
      if (i + 1 < Part::REST)
        load_pair(place, from, wanted);
      else
        load_single(place, Part::REST == 1 ? from : from - 4 * lane, wanted);
    }
  }

  __device__ __forceinline__ void advance(int chunks) {
    own += chunks * STRIDE;
    rest += chunks * STRIDE;
  }
};

// sums = operand x weights: a layer of a stream that was started. `rows` are a lane's
// addresses in each tile of the operand, and are moved.
template <typename Part, int STRIDE, int BUFFERS>
__device__ __forceinline__ void multiply(Sums<Part>& sums, uint32_t (&rows)[TILES],
                                         Stream<Part, STRIDE, BUFFERS>& stream,
                                         int chunks, int lane) {
  uint32_t a[TILES][4];
#pragma unroll
  for (int tile = 0; tile < TILES; ++tile) load_operand(a[tile], rows[tile]);
  sums.clear();
  // Unrolled by hand as often as there are buffers, with a branch after each chunk: of
  // more at once, the compiler would load the weights when they are needed, not before.
#pragma unroll 1
  for (int left = chunks;; left -= BUFFERS) {
#pragma unroll
    for (int i = 0; i < BUFFERS; ++i) {
      uint32_t (&words)[Part::WORDS] = stream.words[i];
#pragma unroll
      for (int tile = 0; tile < TILES; ++tile) {
#pragma unroll
        for (int k = 0; k < 2 * Part::PAIRS; ++k)
          add_product(sums.own[tile] + 4 * k, a[tile], words + 2 * k);
        if (tile % WARPS == 0)
#pragma unroll
          for (int k = 0; k < Part::REST; ++k)
            add_product(sums.rest[tile / WARPS] + 4 * k, a[tile],
                        words + 4 * Part::PAIRS + 2 * k);
        // Here, where the registers are free. Behind the last chunk nobody needs it.
        load_operand(a[tile], rows[tile] + (i + 1) * DEPTH * 2);
      }
      stream.load(words, i + BUFFERS, left > i + BUFFERS, lane);
      if (left == i + 1) return;
    }
#pragma unroll
    for (int tile = 0; tile < TILES; ++tile) rows[tile] += BUFFERS * DEPTH * 2;
    stream.advance(BUFFERS);
  }
}

}  // namespace
