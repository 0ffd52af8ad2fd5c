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
#include <string>
#include <tuple>
#include <unordered_map>
#include <unordered_set>
#include <utility>
#include <vector>

#define FAST(function) reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function)), METH_FASTCALL

namespace {

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
    {"read", vehicles_read, METH_NOARGS, "Return where everybody is; None where libsumo refuses."},
    {"look", FAST(vehicles_look), "Return where everybody is; None where anything else has happened."},
    {nullptr, nullptr, 0, nullptr},
};
PyType_Slot vehicles_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(vehicles_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<Vehicles, &Vehicles::roster>)},
    {Py_tp_methods, vehicles_methods},
    {Py_tp_doc, const_cast<char *>("Vehicles of the running simulation, by their ids.")},
    {0, nullptr},
};
PyMethodDef columns_methods[] = {
    {"speed", columns_speed, METH_O, "Return the speed of a row."},
    {nullptr, nullptr, 0, nullptr},
};
PyGetSetDef columns_getters[] = {
    {"points", columns_points, nullptr, "A new list of x and y.", nullptr},
    {"headings", columns_headings, nullptr, "A new list.", nullptr},
    {"speeds", columns_speeds, nullptr, "A new list.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};
PyType_Slot columns_slots[] = {
    {Py_tp_dealloc, reinterpret_cast<void *>(columns_free)},
    {Py_tp_methods, columns_methods},
    {Py_tp_getset, columns_getters},
    {Py_tp_doc, const_cast<char *>("Where everybody in a scene is.")},
    {0, nullptr},
};
PyType_Spec columns_spec = {"_crashhunt_core.Columns", sizeof(Columns), 0,
                            Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, columns_slots};
PyType_Spec vehicles_spec = {"_crashhunt_core.Vehicles", sizeof(Vehicles), 0, Py_TPFLAGS_DEFAULT, vehicles_slots};

PyMethodDef functions[] = {
    {"bind", bind, METH_O, "Find libsumo's functions in its library, given by its path."},
    {"is_coming_or_going", is_coming_or_going, METH_NOARGS, "Whether a vehicle has entered or left in the last step."},
    {"in_sight", FAST(in_sight), "Return who is near some vehicles, and where these are; None where libsumo refuses."},
    {"columns", FAST(columns), "Return lists as columns; None where they are none of numbers."},
    {"vehicle_states", vehicle_states, METH_O, "Return what is read of vehicles for observations, to be compared."},
    {"light_state", light_state, METH_O, "Return what the links of a traffic light show, to be compared."},
    {"observe", FAST(observe), "Return an observation as bytes."},
    {"within_reach", FAST(within_reach), "Return the rows of those that an actor may have touched."},
    {"least_change", FAST(least_change), "Return the least change of speed between two scenes."},
    {"may_be_near", FAST(may_be_near), "Return who may have a part in the closest approach."},
    {"tracks", FAST(tracks), "Return the way of an agent, and who was near it."},
    {"write_array", FAST(write_array), "Write the record of an array; return where it ends."},
    {"changes_of", FAST(changes_of), "Return where two arrays of words differ, and the changed words."},
    {"write_step", FAST(write_step), "Write the record of a step; return where it ends."},
    {nullptr, nullptr, 0, nullptr},
};

int fill(PyObject *module) {
    for (PyType_Spec *spec : {&vehicles_spec, &columns_spec, &usual_spec, &draft_spec, &lane_block_spec,
                              &streams_spec}) {
        PyObject *type = PyType_FromSpec(spec);
        if (!type || PyModule_AddObjectRef(module, strrchr(spec->name, '.') + 1, type) < 0) {
            Py_XDECREF(type);
            return -1;
        }
        // Never given back: columns may outlive the module.
        if (spec == &vehicles_spec) {
            vehicles_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &columns_spec) {
            columns_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &lane_block_spec) {
            lane_block_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &streams_spec) {
            streams_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &draft_spec) {
            draft_type = reinterpret_cast<PyTypeObject *>(type);
        }
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
