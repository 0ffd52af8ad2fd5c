// Members of classes, modules and objects at one time, to find out in microseconds whether they have changed. A part of
// kernel.cpp.

#pragma once

#include "kernel_actors.hpp"

namespace {

// --------------------------------------------------------------------------------------------------------------- Snapshot

// The members that namespaces had at one time, to find out whether they still have them.
struct Snapshot {
    PyObject_HEAD
    PyObject *spaces, *names, *values; // tuples: modules' dictionaries or classes, tuples of names, tuples of values
};

void snapshot_dealloc(Snapshot *self) {
    Py_XDECREF(self->spaces);
    Py_XDECREF(self->names);
    Py_XDECREF(self->values);
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

// Snapshot(spaces, names, values)
PyObject *snapshot_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *spaces, *names, *values;
    if (!PyArg_ParseTuple(args, "O!O!O!", &PyTuple_Type, &spaces, &PyTuple_Type, &names, &PyTuple_Type, &values)) {
        return nullptr;
    }
    const Py_ssize_t count = PyTuple_GET_SIZE(spaces);
    bool usual = PyTuple_GET_SIZE(names) == count && PyTuple_GET_SIZE(values) == count;
    for (Py_ssize_t at = 0; usual && at < count; at++) {
        PyObject *space = PyTuple_GET_ITEM(spaces, at), *row = PyTuple_GET_ITEM(names, at);
        usual = (PyDict_CheckExact(space) || PyType_Check(space)) && PyTuple_CheckExact(row) &&
                PyTuple_CheckExact(PyTuple_GET_ITEM(values, at)) &&
                PyTuple_GET_SIZE(row) == PyTuple_GET_SIZE(PyTuple_GET_ITEM(values, at));
    }
    if (!usual) {
        PyErr_SetString(PyExc_TypeError, "each namespace needs as many names as values");
        return nullptr;
    }
    Snapshot *self = reinterpret_cast<Snapshot *>(type->tp_alloc(type, 0));
    if (self) {
        self->spaces = Py_NewRef(spaces);
        self->names = Py_NewRef(names);
        self->values = Py_NewRef(values);
    }
    return reinterpret_cast<PyObject *>(self);
}

// first_changed(sizes): the first namespace with another size or member; -1 if there is none.
PyObject *snapshot_first_changed(Snapshot *self, PyObject *sizes) {
    const Py_ssize_t count = PyTuple_GET_SIZE(self->spaces);
    if (!PyList_CheckExact(sizes) || PyList_GET_SIZE(sizes) != count) {
        PyErr_SetString(PyExc_TypeError, "one size is needed for each namespace");
        return nullptr;
    }
    for (Py_ssize_t at = 0; at < count; at++) {
        PyObject *space = PyTuple_GET_ITEM(self->spaces, at), *names = PyTuple_GET_ITEM(self->names, at);
        PyObject *values = PyTuple_GET_ITEM(self->values, at);
        PyObject *members = PyDict_CheckExact(space) ? space : reinterpret_cast<PyTypeObject *>(space)->tp_dict;
        bool same = PyDict_GET_SIZE(members) == PyLong_AsSsize_t(PyList_GET_ITEM(sizes, at));
        for (Py_ssize_t which = 0; same && which < PyTuple_GET_SIZE(names); which++) {
            PyObject *found = PyDict_GetItemWithError(members, PyTuple_GET_ITEM(names, which));
            same = found == PyTuple_GET_ITEM(values, which);
        }
        if (PyErr_Occurred()) {
            return nullptr;
        }
        if (!same) {
            return PyLong_FromSsize_t(at);
        }
    }
    return PyLong_FromLong(-1);
}

PyMethodDef snapshot_methods[] = {
    {"first_changed", reinterpret_cast<PyCFunction>(snapshot_first_changed), METH_O, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyType_Slot snapshot_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(snapshot_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(snapshot_dealloc)},
    {Py_tp_methods, snapshot_methods},
    {Py_tp_doc, const_cast<char *>("The members of namespaces at one time.")},
    {0, nullptr},
};
PyType_Spec snapshot_spec = {"_crashhunt_highway.Snapshot", sizeof(Snapshot), 0, Py_TPFLAGS_DEFAULT, snapshot_slots};

// --------------------------------------------------------------------------------------------------------------- Contents

// The contents of containers at one time: dictionaries and lists, arrays of NumPy, and objects with their attributes.
struct Contents {
    PyObject_HEAD
    PyObject *containers;                // a list
    std::vector<PyTypeObject *> *types;  // of each container
    std::vector<PyObject *> *members;    // of all containers, one after the other: keys and values, or values
    std::vector<size_t> *ends;           // of the members of each container
    std::vector<Py_buffer> *views;       // of the arrays
    std::vector<char> *bytes;            // of the arrays, one after the other
};

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
    PyObject *space = PyDict_CheckExact(container) ? Py_NewRef(container) : PyObject_GenericGetDict(container, nullptr);
    PyObject *key, *value;
    Py_ssize_t at = 0;
    bool all = space != nullptr;
    while (all && PyDict_Next(space, &at, &key, &value)) {
        all = see(key) && see(value);
    }
    Py_XDECREF(space);
    return all;
}

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

} // namespace
