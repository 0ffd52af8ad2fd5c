// Members of classes, modules and objects at one time, to find out in microseconds whether they have changed. A part of
// kernel.cpp.

#pragma once

#include "kernel_actors.hpp"

namespace {

// Calls a function for each member of a container until it returns false; returns whether it never did.
template <typename Function> bool visit(PyObject *container, Function see) {
    if (PyList_CheckExact(container)) {
        for (Py_ssize_t at = 0; at < PyList_GET_SIZE(container); at++) {
            if (!see(PyList_GET_ITEM(container, at))) {
                return false;
            }
        }
        return true;
    }
    if (has_type(container, numpy_array)) {
        return true;
    }
    PyObject *space = PyDict_CheckExact(container) ? Py_NewRef(container)
                      : PyType_Check(container)    ? Py_NewRef(reinterpret_cast<PyTypeObject *>(container)->tp_dict)
                                                   : PyObject_GenericGetDict(container, nullptr);
    PyObject *key, *value;
    Py_ssize_t at = 0;
    bool all = space != nullptr;
    while (all && PyDict_Next(space, &at, &key, &value)) {
        all = see(key) && see(value);
    }
    Py_XDECREF(space);
    return all;
}

// --------------------------------------------------------------------------------------------------------------- Contents

// The contents of containers at one time: dictionaries and lists, arrays of NumPy, classes, and objects with their
// attributes.
struct Contents {
    PyObject_HEAD
    PyObject *containers;                // a list
    std::vector<PyTypeObject *> *types;  // of each container
    std::vector<PyObject *> *members;    // of all containers, one after the other: keys and values, or values
    std::vector<size_t> *ends;           // of the members of each container
    std::vector<Py_buffer> *views;       // of the arrays
    std::vector<char> *bytes;            // of the arrays, one after the other
};

void contents_dealloc(Contents *self) {
    for (PyObject *member : *self->members) {
        Py_DECREF(member);
    }
    for (Py_buffer &view : *self->views) {
        PyBuffer_Release(&view);
    }
    Py_XDECREF(self->containers);
    delete self->types;
    delete self->members;
    delete self->ends;
    delete self->views;
    delete self->bytes;
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

// Contents(containers)
PyObject *contents_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *containers;
    if (!PyArg_ParseTuple(args, "O!", &PyList_Type, &containers)) {
        return nullptr;
    }
    Contents *self = reinterpret_cast<Contents *>(type->tp_alloc(type, 0));
    if (!self) {
        return nullptr;
    }
    self->containers = PyList_GetSlice(containers, 0, PyList_GET_SIZE(containers));
    self->types = new std::vector<PyTypeObject *>();
    self->members = new std::vector<PyObject *>();
    self->ends = new std::vector<size_t>();
    self->views = new std::vector<Py_buffer>();
    self->bytes = new std::vector<char>();
    for (Py_ssize_t at = 0; self->containers && at < PyList_GET_SIZE(self->containers) && !PyErr_Occurred(); at++) {
        PyObject *container = PyList_GET_ITEM(self->containers, at);
        visit(container, [self](PyObject *member) {
            self->members->push_back(Py_NewRef(member));
            return true;
        });
        self->types->push_back(Py_TYPE(container)); // lives as long as something has it: compared only
        self->ends->push_back(self->members->size());
        Py_buffer view;
        if (has_type(container, numpy_array) && PyObject_GetBuffer(container, &view, PyBUF_SIMPLE) == 0) {
            const char *first = static_cast<const char *>(view.buf);
            self->views->push_back(view);
            self->bytes->insert(self->bytes->end(), first, first + view.len);
        }
    }
    if (PyErr_Occurred()) {
        Py_CLEAR(self);
    }
    return reinterpret_cast<PyObject *>(self);
}

// is_same(): whether all containers still have the same members in the same order, and the same bytes.
PyObject *contents_is_same(Contents *self, PyObject *) {
    size_t at = 0;
    for (size_t number = 0; number < self->ends->size(); number++) {
        PyObject *container = PyList_GET_ITEM(self->containers, static_cast<Py_ssize_t>(number));
        const size_t end = (*self->ends)[number];
        const bool same = Py_TYPE(container) == (*self->types)[number] && visit(container, [self, &at, end](PyObject *member) {
            return at < end && (*self->members)[at++] == member;
        });
        if (PyErr_Occurred()) {
            return nullptr;
        }
        if (!same || at != end) {
            Py_RETURN_FALSE;
        }
    }
    const char *bytes = self->bytes->data();
    for (const Py_buffer &view : *self->views) {
        if (std::memcmp(bytes, view.buf, static_cast<size_t>(view.len))) {
            Py_RETURN_FALSE;
        }
        bytes += view.len;
    }
    Py_RETURN_TRUE;
}

PyMethodDef contents_methods[] = {
    {"is_same", reinterpret_cast<PyCFunction>(contents_is_same), METH_NOARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyType_Slot contents_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(contents_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(contents_dealloc)},
    {Py_tp_methods, contents_methods},
    {Py_tp_doc, const_cast<char *>("The contents of containers at one time.")},
    {0, nullptr},
};
PyType_Spec contents_spec = {"_crashhunt_highway.Contents", sizeof(Contents), 0, Py_TPFLAGS_DEFAULT, contents_slots};

// ----------------------------------------------------------------------------------------------------------------- Traffic

// The values of attributes; null with an error if one is missing.
PyObject *values_of(PyObject *object, PyObject *names) {
    PyObject *values = PyTuple_New(PyTuple_GET_SIZE(names));
    for (Py_ssize_t at = 0; values && at < PyTuple_GET_SIZE(names); at++) {
        PyObject *value = PyObject_GetAttr(object, PyTuple_GET_ITEM(names, at));
        if (value) {
            PyTuple_SET_ITEM(values, at, value);
        } else {
            Py_CLEAR(values);
        }
    }
    return values;
}

// Notes everything about the actors that must stay the same. False: an error.
bool watch_all(Traffic *self, PyObject *fixed, PyObject *examples) {
    for (size_t row = 0; row < self->actors->size(); row++) {
        PyObject *object = (*self->actors)[row].object;
        PyObject *names = PyList_GET_ITEM(fixed, static_cast<Py_ssize_t>(row));
        Watched watched = {reinterpret_cast<PyTypeObject *>(Py_NewRef(Py_TYPE(object))), Py_NewRef(names), {}};
        bool is_key = true; // keys and values take turns
        visit(object, [&watched, &is_key](PyObject *member) {
            if (is_key) {
                watched.keys.push_back(Py_NewRef(member));
            }
            is_key = !is_key;
            return true;
        });
        self->watched->push_back(watched);
    }
    for (Py_ssize_t at = 0; at < PyList_GET_SIZE(examples) && !PyErr_Occurred(); at++) {
        PyObject *object, *names;
        if (!PyArg_ParseTuple(PyList_GET_ITEM(examples, at), "OO!", &object, &PyTuple_Type, &names)) {
            return false;
        }
        PyObject *values = values_of(object, names);
        if (values) {
            self->examples->push_back({Py_NewRef(object), Py_NewRef(names), values});
        }
    }
    return !PyErr_Occurred();
}

// Whether an actor has got no attribute that it must not get. -1: an error.
int has_kept_attributes(PyObject *object, Watched &watched) {
    size_t at = 0;
    bool is_key = true;
    const bool same = visit(object, [&watched, &at, &is_key](PyObject *member) {
        const bool fits = !is_key || (at < watched.keys.size() && watched.keys[at++] == member);
        is_key = !is_key;
        return fits;
    });
    if (PyErr_Occurred()) {
        return -1;
    }
    if (same && at == watched.keys.size()) {
        return 1;
    }
    std::vector<PyObject *> keys;
    is_key = true;
    const bool free = visit(object, [&watched, &keys, &is_key](PyObject *member) {
        if (is_key) {
            keys.push_back(member);
        }
        const bool fits = !is_key || PySet_Contains(watched.fixed, member) == 0;
        is_key = !is_key;
        return fits;
    });
    if (!free || PyErr_Occurred()) {
        return PyErr_Occurred() ? -1 : 0;
    }
    for (PyObject *key : keys) {
        Py_INCREF(key);
    }
    keys.swap(watched.keys);
    for (PyObject *key : keys) {
        Py_DECREF(key);
    }
    return 1;
}

// Whether an example has equal values of the same types. -1: an error.
int has_kept_values(const Example &example) {
    PyObject *values = values_of(example.object, example.names);
    if (!values) {
        PyErr_Clear(); // an attribute is missing
        return 0;
    }
    int same = 1;
    for (Py_ssize_t at = 0; same > 0 && at < PyTuple_GET_SIZE(values); at++) {
        PyObject *before = PyTuple_GET_ITEM(example.values, at), *now = PyTuple_GET_ITEM(values, at);
        if (before != now) {
            same = Py_TYPE(before) == Py_TYPE(now) ? PyObject_RichCompareBool(before, now, Py_EQ) : 0;
        }
    }
    Py_DECREF(values);
    return same;
}

// Whether a list has the actors from a row on. False also if it is no list.
bool has_actors(const Traffic *self, PyObject *list, size_t first, size_t count) {
    bool same = list && PyList_CheckExact(list) && static_cast<size_t>(PyList_GET_SIZE(list)) == count;
    for (size_t at = 0; same && at < count; at++) {
        same = PyList_GET_ITEM(list, static_cast<Py_ssize_t>(at)) == (*self->actors)[first + at].object;
    }
    return same;
}

// Whether the actors of a road are those of the kernel, with everything that must stay the same. -1: an error.
int is_current(Traffic *self, PyObject *road) {
    const size_t objects = self->actors->size() - self->vehicles;
    PyObject *vehicles = attribute(road, s_vehicles), *others = attribute(road, s_objects);
    bool same = road == self->road && has_actors(self, vehicles, 0, self->vehicles) &&
                has_actors(self, others, self->vehicles, objects);
    Py_XDECREF(vehicles);
    Py_XDECREF(others);
    int kept = same;
    for (size_t row = 0; kept > 0 && row < self->actors->size(); row++) {
        const Actor &actor = (*self->actors)[row];
        Watched &watched = (*self->watched)[row];
        kept = Py_TYPE(actor.object) == watched.type ? has_kept_attributes(actor.object, watched) : 0;
        if (kept > 0 && actor.moves) {
            PyObject *its_road = attribute(actor.object, s_road);
            kept = its_road == road;
            Py_XDECREF(its_road);
        }
        Number delta;
        if (kept > 0 && actor.changes_lanes) {
            kept = read_number(actor.object, s_delta, delta) && delta.value == actor.parameters.delta;
        }
    }
    for (size_t at = 0; kept > 0 && at < self->examples->size(); at++) {
        kept = has_kept_values((*self->examples)[at]);
    }
    return kept;
}

} // namespace
