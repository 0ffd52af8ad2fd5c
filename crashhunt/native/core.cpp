// What every step on SUMO does, compiled: optional, and never another bit than the Python that stands beside each use.
//
// - libsumo's functions are looked up by name in the library that is loaded, so that none of SUMO's headers is needed.
//   What is taken for granted about them (arguments, results, std::string) holds for the versions that
//   crashhunt/native/_core.py lists; a self-test at the start of each process compares with libsumo's own getters.
// - Every expression stands as in Python, in the same order. It is compiled without contraction (a fused multiply-add
//   rounds once instead of twice), and sine and cosine come from the C library, as Python's do.
// - What a function cannot do as Python does it, it does not do: it returns None, and the Python does it.

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <dlfcn.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <deque>
#include <exception>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>
#include <unordered_map>
#include <unordered_set>
#include <utility>
#include <vector>

namespace {

#include "python.hpp"
#include "libsumo.hpp"
#include "scenes.hpp"
#include "near_actors.hpp"
#include "closest_approach.hpp"
#include "tracks.hpp"
#include "black_box.hpp"
#include "observation.hpp"
#include "observed_parts.hpp"
#include "fast_step.hpp"
#include "usual_steps.hpp"

// ---------------------------------------------------------------------------------------------------------- the module

PyMethodDef vehicles_methods[] = {
    {"read", METHOD(vehicles_read), "Return where everybody is; None where libsumo refuses."},
    {"look", METHOD(vehicles_look), "Return where everybody is; None where anything else has happened."},
    {nullptr, nullptr, 0, nullptr},
};
PyMethodDef columns_methods[] = {
    {"speed", METHOD(columns_speed), "Return the speed of a row."},
    {nullptr, nullptr, 0, nullptr},
};
PyGetSetDef columns_getters[] = {
    {"points", columns_points, nullptr, "A new list of x and y.", nullptr},
    {"headings", columns_headings, nullptr, "A new list.", nullptr},
    {"speeds", columns_speeds, nullptr, "A new list.", nullptr},
    {"recorded", columns_recorded, nullptr, "The numbers as they are recorded.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};

PyMethodDef no_methods[] = {{nullptr, nullptr, 0, nullptr}};

PyMethodDef functions[] = {
    {"bind", FUNCTION(bind), "Find libsumo's functions in its library, given by its path."},
    {"is_coming_or_going", FUNCTION(is_coming_or_going), "Whether a vehicle has entered or left in the last step."},
    {"in_sight", FUNCTION(in_sight), "Return who is near some vehicles, and where these are; None where libsumo refuses."},
    {"columns", FUNCTION(columns), "Return lists as columns; None where they are none of numbers."},
    {"vehicle_states", FUNCTION(vehicle_states), "Return what is read of vehicles for observations, to be compared."},
    {"light_state", FUNCTION(light_state), "Return what the links of a traffic light show, to be compared."},
    {"observe", FUNCTION(observe), "Return an observation as bytes."},
    {"within_reach", FUNCTION(within_reach), "Return the rows of those that an actor may have touched."},
    {"least_change", FUNCTION(least_change), "Return the least change of speed between two scenes."},
    {"may_be_near", FUNCTION(may_be_near), "Return who may have a part in the closest approach."},
    {"tracks", FUNCTION(tracks), "Return the way of an agent, and who was near it."},
    {"changes_of", FUNCTION(changes_of), "Return where two arrays of words differ, and the changed words."},
    {nullptr, nullptr, 0, nullptr},
};

int fill(PyObject *module) {
    try {
        vehicles_type = add_class<Vehicles, &Vehicles::roster, make_roster>(
            module, "_crashhunt_core.Vehicles", vehicles_methods, no_getters,
            "Vehicles of the running simulation, by their ids.");
        columns_type = add_class(module, "_crashhunt_core.Columns", sizeof(Columns), nullptr, columns_free,
                                 columns_methods, columns_getters, "Where everybody in a scene is.");
        add_class<UsualSteps, &UsualSteps::steps, make_steps>(
            module, "_crashhunt_core.UsualSteps", usual_methods, usual_getters,
            "Steps of an episode in which nothing happens, each in one call.");
        draft_type = add_class<Draft, &Draft::observation, make_observation>(
            module, "_crashhunt_core.Draft", draft_methods, no_getters,
            "An observation that is being written, part by part.");
        lane_block_type = add_class<LaneBlock, &LaneBlock::lanes, make_lanes>(
            module, "_crashhunt_core.LaneBlock", no_methods, no_getters,
            "The candidates of the lanes around a vehicle.");
        streams_type = add_class<Streams, &Streams::junction, make_junction>(
            module, "_crashhunt_core.Streams", no_methods, no_getters,
            "The streams that conflict with a path across a junction.");
    } catch (const Raised &) {
        return -1;
    }
    return PyModule_AddIntConstant(module, "INTERFACE", CRASHHUNT_INTERFACE);
}

PyModuleDef_Slot slots[] = {{Py_mod_exec, reinterpret_cast<void *>(fill)}, {0, nullptr}};
PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_crashhunt_core", "crashhunt's compiled core.", 0, functions,
                          slots,                 nullptr,           nullptr,                      nullptr};

} // namespace

PyMODINIT_FUNC PyInit__crashhunt_core(void) {
    static_assert(sizeof(double) == 8 && sizeof(float) == 4, "as IEEE 754 has them");
    return PyModuleDef_Init(&definition);
}
