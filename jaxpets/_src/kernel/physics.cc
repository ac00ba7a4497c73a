// C MuJoCo as an XLA custom call: a batch of states, by MuJoCo's own pool of threads.
#include <algorithm>
#include <atomic>
#include <climits>
#include <cmath>
#include <exception>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include <mujoco/mjbatch.h>
#include <mujoco/mujoco.h>

#include "gpu_copy.h"
#include "xla_call.h"

namespace {

using Array = mjtNum* mjData::*;

// What may be read, beside the number of contacts.
const std::map<std::string, Array> arrays = {
    {"sensordata", &mjData::sensordata}, {"site_xpos", &mjData::site_xpos},
    {"xpos", &mjData::xpos},             {"xipos", &mjData::xipos},
    {"xmat", &mjData::xmat},             {"subtree_linvel", &mjData::subtree_linvel},
};

// A number at a place of an array of MuJoCo's data, or of none the number of contacts.
struct Reading {
  Array array;
  int place;
};

// What a name stands for in compiled programs: physics of a model, or what reads it.
struct World {
  mjModel* model = nullptr;  // stays, as a program may
  mjBatch* batch = nullptr;  // as large as the largest call; goes with the last user
  std::atomic<int> users{0};
  int threads, substeps;     // without substeps it reads
  double start, least;       // of the clock: a state with less was reset
  std::vector<Reading> readings;
  std::vector<double> found;  // [simulations, readings]
  std::mutex turn;
};

// Never destroyed, as a program may run while the process ends.
auto& worlds = *new std::map<std::string, World>;
auto& of_worlds = *new std::mutex;

struct Work {
  World* world;
  const float* inputs;
  float* outputs;
  int rows, num_inputs, num_outputs;
};

const char* operands(const Call& call, Work& work) {
  if (call.args.size != 1 || call.rets.size != 1 || call.attrs.size != 1)
    return "there are other operands";
  const auto& in = *static_cast<const Operand*>(call.args.args[0]);
  const auto& out = *static_cast<const Operand*>(call.rets.rets[0]);
  const auto& name = *static_cast<const XLA_FFI_ByteSpan*>(call.attrs.attrs[0]);
  const std::lock_guard<std::mutex> turn(of_worlds);
  const auto known = worlds.find(std::string(name.ptr, name.len));
  if (known == worlds.end()) return "nobody has built the environment in this process";
  work.world = &known->second;
  work.inputs = static_cast<const float*>(in.data);
  work.outputs = static_cast<float*>(out.data);
  work.num_inputs = int(in.dims[in.rank - 1]);
  work.num_outputs = int(out.dims[out.rank - 1]);
  const int64_t rows = product(in, 0) / std::max<int64_t>(1, work.num_inputs);
  if (rows > INT_MAX) return "there are more than 2^31 states";
  work.rows = int(rows);
  return nullptr;
}

// Gives back a world's threads and states. Its turn must be held.
void leave(World& world) {
  if (world.batch) mjb_deleteBatch(world.batch);
  world.batch = nullptr;
  world.found = {};
}

// Lets a world have room for so many rows. Returns what MuJoCo says if it cannot.
std::string make_room(World& world, int rows) {
  if (world.batch && mjb_nsim(world.batch) >= rows) return "";
  std::vector<double> room(size_t(rows) * world.readings.size());
  mjBatchConfig config;
  mjb_defaultConfig(&config);
  config.nthread = std::min(world.threads, rows);
  char error[500] = "there is no memory for it";
  mjBatch* const larger =
      mjb_makeBatch(world.model, rows, &config, error, sizeof error);
  if (!larger) return error;
  leave(world);
  world.batch = larger;
  world.found = std::move(room);
  return "";
}

void read(const mjModel* model, mjData* data, int simulation, void* of) {
  World& world = *static_cast<World*>(of);
  mj_forward(model, data);
  mj_subtreeVel(model, data);
  double* found = world.found.data() + size_t(simulation) * world.readings.size();
  for (const auto& [array, place] : world.readings)
    *found++ = array ? (data->*array)[place] : data->ncon;
}

// Moves or reads every row. Returns what MuJoCo says if one fails.
std::string visit(const Work& work) {
  // Python's would be called in threads that it does not know.
  if (mjcb_passive || mjcb_control || mjcb_contactfilter || mjcb_sensor ||
      mjcb_act_dyn || mjcb_act_gain || mjcb_act_bias)
    return "it has a function to call, as mjcb_control, which is not called here";
  World& world = *work.world;
  const std::lock_guard<std::mutex> turn(world.turn);
  if (std::string problem = make_room(world, work.rows); !problem.empty())
    return problem;
  mjBatch* const batch = world.batch;
  const size_t num_outputs = work.num_outputs;
  if (work.num_inputs >= mjb_nstate(batch) ||
      (world.substeps ? work.num_outputs >= mjb_nstate(batch)
                      : num_outputs != world.readings.size()))
    return "a state is of another size";
  std::vector<int> ids(work.rows);
  for (int row = 0; row < work.rows; ++row) {
    // A state begins with the clock, then comes what the inputs are.
    mjtNum* const state = mjb_state(batch) + size_t(row) * mjb_nstate(batch);
    state[0] = world.start;
    const float* const inputs = work.inputs + size_t(row) * work.num_inputs;
    std::copy_n(inputs, work.num_inputs, state + 1);
    ids[row] = row;
  }
  const int failed =
      world.substeps
          ? mjb_step(batch, ids.data(), work.rows, world.substeps, mjSTAGE_NONE)
          : mjb_apply(batch, ids.data(), work.rows, read, &world, 0);
  for (int row = 0; failed && row < work.rows; ++row)
    if (mjb_status(batch)[row]) return mjb_error(batch, row);
  for (int row = 0; row < work.rows; ++row) {
    const mjtNum* const state = mjb_state(batch) + size_t(row) * mjb_nstate(batch);
    const double* const found =
        world.substeps ? state + 1 : world.found.data() + row * num_outputs;
    float* const outputs = work.outputs + row * num_outputs;
    for (int i = 0; i < work.num_outputs; ++i)
      outputs[i] = state[0] < world.least ? NAN : float(found[i]);
  }
  if (!world.users) leave(world);  // a program that is longer there than they
  return "";
}

XLA_FFI_Error* run(const Call& call, const Work& work) {
  try {
    const std::string problem = work.rows ? visit(work) : "";
    if (problem.empty()) return nullptr;
    return failure(call, XLA_FFI_Error_Code_INTERNAL, ("MuJoCo: " + problem).c_str());
  } catch (const std::exception& error) {
    return failure(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, error.what());
  }
}

// The same with operands that are on a GPU.
XLA_FFI_Error* run_from_gpu(const Call& call, const Work& work) {
  if (!work.rows) return nullptr;
  try {
    std::vector<float> inputs(size_t(work.rows) * work.num_inputs);
    std::vector<float> outputs(size_t(work.rows) * work.num_outputs);
    Work here = work;
    here.inputs = inputs.data();
    here.outputs = outputs.data();
    const size_t in = inputs.size() * sizeof(float), out = outputs.size() * sizeof(float);
    if (auto* error = copy(call, Way::to_host, inputs.data(), work.inputs, in))
      return error;
    if (auto* error = run(call, here)) return error;
    return copy(call, Way::to_gpu, work.outputs, outputs.data(), out);
  } catch (const std::exception& error) {
    return failure(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, error.what());
  }
}

}  // namespace

extern "C" {

// Lets a name stand for a world. Returns whether there was memory for it.
bool jaxpets_open(const char* name, const mjModel* model, int threads, int substeps,
                  double start, double least, int num_readings, const char** names,
                  const int* places) {
  const std::lock_guard<std::mutex> turn(of_worlds);
  World& world = worlds[name];
  if (!world.model) {
    world.model = mj_copyModel(nullptr, model);
    if (!world.model) return false;
    world.threads = threads;
    world.substeps = substeps;
    world.start = start;
    world.least = least;
    for (int i = 0; i < num_readings; ++i) {
      const auto known = arrays.find(names[i]);
      const Array array = known == arrays.end() ? nullptr : known->second;
      world.readings.push_back({array, places[i]});
    }
  }
  ++world.users;
  return true;
}

// Called once for every `jaxpets_open`.
void jaxpets_close(const char* name) {
  World& world = [name]() -> World& {
    const std::lock_guard<std::mutex> turn(of_worlds);
    return worlds[name];
  }();
  if (--world.users) return;
  const std::lock_guard<std::mutex> turn(world.turn);
  if (!world.users) leave(world);  // nobody has opened it in between
}

XLA_FFI_Error* jaxpets_physics(XLA_FFI_CallFrame* call) {
  return handle<Work>(*call, 0, operands, run);
}

XLA_FFI_Error* jaxpets_physics_cuda(XLA_FFI_CallFrame* call) {
  return handle<Work>(*call, 0, operands, run_from_gpu);
}

}  // extern "C"
