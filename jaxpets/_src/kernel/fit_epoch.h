// An epoch of training of an ensemble in one launch.
//
// Launched update by update, training waits for its launches: 52 of them for 30 MFLOP. Here
// a cluster of blocks trains a member. Weights stay in its shared memory, and Adam's moments
// in its registers, for the whole epoch; what blocks compute they send one another, straight
// into shared memory, where an mbarrier counts what has come.
//
//   forward, each hidden layer: the own columns for all rows of a chunk; the activations go
//     to every block
//   outputs: a product with the own rows of the output weights; the partial sums go to the
//     block that has the dimension, which computes the loss and sends its gradient to all
//   back, each hidden layer: the own columns' part in the gradient of all inputs goes to the
//     blocks that have these; while the others' parts are on their way, the gradients of
//     weights that are due
//   once an update: all blocks of all members of a seed meet in global memory, for the
//     variance bounds that members share, and for whether the update is finite; then Adam,
//     of a layer's weights when the next forward pass comes to them
//
// Hidden layers multiply in TF32, the output layer and all else is float32.

#pragma once

#include "fit_backward.h"
#include "fit_forward.h"
#include "fit_state.h"

namespace {

// The way of the data: rows are fetched a chunk ahead, which rows two chunks ahead.
struct Data {
  const float *inputs, *targets;
  const int32_t* rows;
  int size, batch, num_chunks;

  DEVICE void fetch_index(const Block& block, int q) const {
    if (q >= num_chunks) return;
    const Chunk c = chunk_of(q, size, batch);
    // A short chunk is filled up with its batch's rows: the next one's may not be finite.
    for (int row = block.tid; row < ROWS; row += THREADS)
      copy_async(&block.s.index[q % 3][row], rows + c.start + least(row, c.count - 1));
  }
  DEVICE void fetch_rows(const Block& block, int q) const {
    if (q >= num_chunks) return;
    const int* index = block.s.index[q % 3];
    float *x = block.s.x0[q & 1], *y = block.s.target[q & 1];
    for (int i = block.tid; i < INPUTS * ROWS; i += THREADS) {
      const int row = i / INPUTS, f = i % INPUTS;
      copy_async(x + at(f, row), inputs + int64_t(index[row]) * INPUTS + f);
    }
    for (int i = block.tid; i < block.dims * ROWS; i += THREADS) {
      const int row = i / block.dims, d = i % block.dims;
      copy_async(y + d * ROWS + row,
                 targets + int64_t(index[row]) * OBS + block.rank * DIMS + d);
    }
  }
};

// Tells the barriers what will come in the next chunk.
DEVICE void arm(const Block& block) {
  Shared& s = block.s;
  if (block.tid != 0) return;
  if (block.dims) bar_expect(&s.bars[BAR_Z], CTAS * 2 * block.dims * ROWS * 4);
  bar_expect(&s.bars[BAR_DYO], OUTS * ROWS * 4);
  each<LAYERS>([&](auto layer) {
    constexpr int L = layer;
    if constexpr (L > 0) {
      constexpr int K = fan_in(L);
      bar_expect(&s.bars[BAR_X + L], K * ROWS * 4);
      if (block.template own_cols<L - 1>())
        bar_expect(&s.bars[BAR_PART + L],
                   CTAS * block.template own_cols<L - 1>() * ROWS * 4);
    }
  });
}

// Tells all members of the seed of the own gradients of bounds, and whether all is finite.
DEVICE void publish(const Block& block, int step, uint32_t* scratch) {
  Shared& s = block.s;
  float* bounds = reinterpret_cast<float*>(scratch + SCRATCH_BOUNDS) +
                  ((step & 1) * MEMBERS + block.member) * OUTS;
  bool bad = false;
  block_sync();
  for (int i = block.tid; i < PADDED_COLS; i += THREADS)
    bad |= i < block.own_cols<0>() && !finite(s.gb[0][i]);
  for (int d = block.tid; d < block.dims; d += THREADS) {
    bad |= !finite(s.gbound[1][d]) || !finite(s.nll[d]);
    for (int which = 0; which < 2; ++which)
      store_global(bounds + which * OBS + block.rank * DIMS + d, s.gbound[which][d]);
  }
  bad = block_sync_or(bad);
  if (block.tid == 0) {
    if (bad) store_global(scratch + SCRATCH_BAD + step % 3, uint32_t(step) + 1u);
    global_arrive(scratch);
  }
}

// Waits for all members of the seed; `s.good` is whether the update was finite everywhere.
DEVICE void meet(const Block& block, int step, const uint32_t* scratch) {
  if (block.tid == 0) {
    const uint32_t wanted = uint32_t(step + 1) * (MEMBERS * CTAS);
    Watchdog dog;
    while (load_acquire(scratch) < wanted) dog.turn();
    const uint32_t bad = load_global(scratch + SCRATCH_BAD + step % 3);
    block.s.good = bad != uint32_t(step) + 1u;
  }
  block_sync();
}

__global__ void __launch_bounds__(THREADS, 1)
    epoch_kernel(const __grid_constant__ Fit fit) {
  Shared& s = shared_memory<Shared>();
  const int tid = thread_index(), rank = block_index() % CTAS;
  const int member = block_index() / CTAS % MEMBERS;
  const int64_t seed = fit.first_seed + block_index() / (CTAS * MEMBERS);
  const int dims = OBS - rank * DIMS < 0 ? 0 : least(DIMS, OBS - rank * DIMS);
  const Block block{s, tid, tid / 32, tid % 32, rank, member, dims};

  const float* hyper = fit.hyper + seed * NUM_HYPER;
  const int size = fit.size[seed], batch = int(hyper[BATCH]);
  const int per_batch = (batch + ROWS - 1) / ROWS;
  const int num_batches = (size + batch - 1) / batch;
  const int num_chunks =
      size <= 0 ? 0
                : (num_batches - 1) * per_batch +
                      (size - (num_batches - 1) * batch + ROWS - 1) / ROWS;
  const Data data{fit.inputs + seed * fit.capacity * INPUTS,
                  fit.targets + seed * fit.capacity * OBS,
                  fit.rows + (seed * MEMBERS + member) * fit.capacity,
                  size, batch, num_chunks};
  uint32_t* scratch = fit.scratch + seed * SCRATCH;
  const float* all_bounds = reinterpret_cast<float*>(scratch + SCRATCH_BOUNDS);

  int count = fit.count[seed], skipped = 0;
  float kept_rows = 0.0f;
  Moments moments;
  if (tid == 0)
    s.adam = {hyper[B1], hyper[B2], hyper[ONE_B1], hyper[ONE_B2], hyper[EPS], 0.0f, 0.0f, 0.0f};
  read_state(block, fit, seed, hyper, moments);

  if (tid == 0) {
    for (int i = 0; i < 2 * LAYERS + 2; ++i) bar_init(&s.bars[i]);
    bar_init_fence();
  }
  arm(block);
  data.fetch_index(block, 0);
  data.fetch_index(block, 1);
  copy_async_wait();
  block_sync();
  data.fetch_rows(block, 0);
  copy_async_wait();
  block_sync();
  cluster_arrive();

  // The update of a step is put off until a layer's weights are needed again: it then takes
  // place while inputs are on their way.
  bool due = false;
  float due_rows = 0.0f;
  const auto update_before = [&](auto layer, int step) {
    constexpr int L = layer;
    const Adam adam = s.adam;
    update_weights<L>(block, adam, moments);
    if constexpr (L == LAST) {
      const float* gradients = all_bounds + (step & 1) * MEMBERS * OUTS + rank * DIMS;
      update_bounds(block, adam, gradients, hyper[BOUND_DECAY], due_rows);
      update_outputs(block, adam);
    }
  };

  for (int q = 0; q < num_chunks; ++q) {
    const Chunk chunk = chunk_of(q, size, batch);
    const int buffer = q & 1, parity = q & 1;
    data.fetch_rows(block, q + 1);
    data.fetch_index(block, q + 2);

    each<LAYERS>([&](auto layer) {
      constexpr int L = layer;
      if constexpr (L > 0) {
        if (due) update_before(Number<L>{}, chunk.step - 1);
        bar_wait(&s.bars[BAR_X + L], parity);
        if (due) block_sync();
      }
      multiply<L>(block.fresh(), block.template x_of<L>(buffer));
      block_sync();
      if constexpr (L == 0) cluster_wait();  // all have done with the last chunk
      activations<L>(block.fresh());
    });
    due = false;
    block_sync();
    outputs(block.fresh());
    if (tid == THREADS - 1)
      prepare(s.adam, hyper, count, float(chunk.step) / float(num_batches));
    if (dims > 0) bar_wait(&s.bars[BAR_Z], parity);
    loss(block.fresh(), buffer, chunk.count, 1.0f / float(chunk.batch_rows) / float(OBS),
         chunk.first);

    bar_wait(&s.bars[BAR_DYO], parity);
    last_gradient(block.fresh());
    if (chunk.first)
      each<SLOTS>([&](auto slot) {
#pragma unroll
        for (int i = 0; i < RUNS * RUN; ++i) moments.g[slot][i] = 0.0f;
      });
    block_sync();
    each<LAYERS>([&](auto back) {
      constexpr int L = LAST - back;
      if constexpr (L > 0) {
        send_gradient<L>(block.fresh());
        if constexpr (L == LAST) output_weight_gradient(block.fresh(), chunk.first);
        each<SLOTS>([&](auto slot) {
          if constexpr (needs(slot) == L)
            weight_gradient(block.fresh(), slot, buffer, moments.g[slot]);
        });
        if (block.template own_cols<L - 1>() > 0) bar_wait(&s.bars[BAR_PART + L], parity);
        add_gradient<L>(block.fresh());
        block_sync();
      } else if constexpr (L == LAST) {
        output_weight_gradient(block.fresh(), chunk.first);
      }
    });
    bias_gradients(block.fresh(), chunk.first);
    if (chunk.last) publish(block, chunk.step, scratch);
    each<SLOTS>([&](auto slot) {
      if constexpr (needs(slot) == 0)
        weight_gradient(block.fresh(), slot, buffer, moments.g[slot]);
    });
    if (chunk.last) {
      meet(block, chunk.step, scratch);
      if (s.good) {
        ++count;
        kept_rows += float(chunk.batch_rows);
        due = true;
        due_rows = float(chunk.batch_rows);
        update_biases(block, s.adam);
        update_before(Number<0>{}, chunk.step);
      } else {
        ++skipped;
      }
    }
    arm(block);  // before anybody can send what is armed for
    copy_async_wait();
    block_sync();
    cluster_arrive();
  }
  cluster_wait();
  if (due)
    each<LAYERS>([&](auto layer) {
      if constexpr (layer > 0) update_before(layer, num_batches - 1);
    });
  block_sync();
  write_state(block, fit, seed, moments);
  if (tid == 0 && member == 0 && rank == 0) {
    fit.count_out[seed] = count;
    fit.skipped[seed] = skipped;
    fit.num_rows[seed] = kept_rows;
  }
}

}  // namespace
