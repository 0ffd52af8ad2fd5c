// Members of classes, modules and objects at one time, to find out in microseconds whether they have changed. A part of
// kernel.cpp.

#pragma once

#include "kernel_actors.hpp"

namespace {

// Calls a function for each member of a container until it returns false; returns whether it never did.
template <typename Do> bool visit(PyObject *container, Do see) {
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
    if (PyTuple_CheckExact(container)) { // a dictionary, and the keys of the members that matter
        for (Py_ssize_t at = 1; at < PyTuple_GET_SIZE(container); at++) {
            PyObject *value = PyDict_GetItemWithError(PyTuple_GET_ITEM(container, 0), PyTuple_GET_ITEM(container, at));
            if (!see(value ? value : Py_None)) {
                return false;
            }
        }
        return true;
    }
    const Ref space(PyDict_CheckExact(container) ? Py_NewRef(container)
                    : PyType_Check(container)    ? Py_NewRef(reinterpret_cast<PyTypeObject *>(container)->tp_dict)
                                                 : PyObject_GenericGetDict(container, nullptr));
    if (!space) {
        throw Raised();
    }
    PyObject *key, *value;
    Py_ssize_t at = 0;
    while (PyDict_Next(space.object, &at, &key, &value)) {
        if (!see(key) || !see(value)) {
            return false;
        }
    }
    return true;
}

// --------------------------------------------------------------------------------------------------------------- Contents

// The contents of containers at one time: dictionaries, also with only some of their keys, and lists, arrays of NumPy,
// classes, and objects with their attributes.
struct Contents {
    std::vector<Ref> containers;
    std::vector<PyTypeObject *> types; // of each container, which live as long as something has them: compared only
    std::vector<Ref> members;          // of all containers, one after the other: keys and values, or values
    std::vector<size_t> ends;          // of the members of each container
    std::vector<Buffer> views;         // of the arrays
    std::vector<char> bytes;           // of the arrays, one after the other
};
struct ContentsObject {
    PyObject_HEAD Contents *contents;
};
template <> Contents &self_of<Contents>(PyObject *object) { return *reinterpret_cast<ContentsObject *>(object)->contents; }

// Contents(containers)
std::unique_ptr<Contents> make_contents(List containers) {
    auto made = std::make_unique<Contents>();
    for (PyObject *container : From<std::vector<PyObject *>>::of(containers)) {
        visit(container, [&made](PyObject *member) {
            made->members.emplace_back(Py_NewRef(member));
            return true;
        });
        made->containers.emplace_back(Py_NewRef(container));
        made->types.push_back(Py_TYPE(container));
        made->ends.push_back(made->members.size());
        if (has_type(container, numpy_array)) {
            const Buffer &view = made->views.emplace_back(container, PyBUF_SIMPLE);
            made->bytes.insert(made->bytes.end(), view.bytes(), view.bytes() + view.size());
        }
    }
    return made;
}

// is_same(): whether all containers still have the same members in the same order, and the same bytes.
bool contents_is_same(Contents &self) {
    size_t at = 0;
    for (size_t number = 0; number < self.ends.size(); number++) {
        PyObject *container = self.containers[number].object;
        const size_t end = self.ends[number];
        const auto is_known = [&self, &at, end](PyObject *member) {
            return at < end && self.members[at++].object == member;
        };
        if (Py_TYPE(container) != self.types[number] || !visit(container, is_known) || at != end) {
            return false;
        }
    }
    const char *bytes = self.bytes.data();
    for (const Buffer &view : self.views) {
        if (std::memcmp(bytes, view.bytes(), view.size())) {
            return false;
        }
        bytes += view.size();
    }
    return true;
}

PyMethodDef contents_methods[] = {
    {"is_same", METHOD(contents_is_same), nullptr},
    {nullptr, nullptr, 0, nullptr},
};

// ----------------------------------------------------------------------------------------------------------------- Traffic

// Calls a function for each key of an object's attributes until it returns false; returns whether it never did.
template <typename Do> bool visit_keys(PyObject *object, Do see) {
    bool is_key = false; // keys and values take turns
    return visit(object, [&see, &is_key](PyObject *member) { return !(is_key = !is_key) || see(member); });
}

// The values of attributes, as a tuple; null with an error if one is missing.
Ref values_of(PyObject *object, PyObject *names) {
    Ref values(PyTuple_New(PyTuple_GET_SIZE(names)));
    for (Py_ssize_t at = 0; values && at < PyTuple_GET_SIZE(names); at++) {
        PyObject *value = PyObject_GetAttr(object, PyTuple_GET_ITEM(names, at));
        if (!value) {
            return Ref();
        }
        PyTuple_SET_ITEM(values.object, at, value);
    }
    return values;
}

std::vector<Ref> keys_of(PyObject *object) {
    std::vector<Ref> keys;
    visit_keys(object, [&keys](PyObject *key) {
        keys.emplace_back(Py_NewRef(key));
        return true;
    });
    return keys;
}

// Whether an actor has got no attribute that it must not get.
bool has_kept_attributes(PyObject *object, Watched &watched) {
    size_t at = 0;
    const auto is_known = [&watched, &at](PyObject *key) {
        return at < watched.keys.size() && watched.keys[at++].object == key;
    };
    if (visit_keys(object, is_known) && at == watched.keys.size()) {
        return true;
    }
    if (!visit_keys(object, [&watched](PyObject *key) { return !checked(PySet_Contains(watched.fixed.object, key)); })) {
        return false;
    }
    watched.keys = keys_of(object);
    return true;
}

// Whether an example has equal values of the same types.
bool has_kept_values(const Example &example) {
    const Ref values = values_of(example.object.object, example.names.object);
    if (!values) {
        PyErr_Clear(); // an attribute is missing
        return false;
    }
    for (Py_ssize_t at = 0; at < PyTuple_GET_SIZE(values.object); at++) {
        PyObject *before = PyTuple_GET_ITEM(example.values.object, at), *now = PyTuple_GET_ITEM(values.object, at);
        if (before != now &&
            (Py_TYPE(before) != Py_TYPE(now) || !checked(PyObject_RichCompareBool(before, now, Py_EQ)))) {
            return false;
        }
    }
    return true;
}

// Whether a list has the actors from a row on. False also if it is no list.
bool has_actors(const Traffic &self, const Ref &list, size_t first, size_t count) {
    bool same = list && PyList_CheckExact(list.object) && static_cast<size_t>(PyList_GET_SIZE(list.object)) == count;
    for (size_t at = 0; same && at < count; at++) {
        same = PyList_GET_ITEM(list.object, static_cast<Py_ssize_t>(at)) == self.actors[first + at].object;
    }
    return same;
}

// is_current(road): whether the road has the same vehicles and objects, and everything about them that must stay the same.
bool traffic_is_current(Traffic &self, PyObject *road) {
    const size_t objects = self.actors.size() - self.vehicles;
    bool kept = road == self.road.object && has_actors(self, attribute(road, s_vehicles), 0, self.vehicles) &&
                has_actors(self, attribute(road, s_objects), self.vehicles, objects);
    for (size_t row = 0; kept && row < self.actors.size(); row++) {
        const Actor &actor = self.actors[row];
        Watched &watched = self.watched[row];
        Number delta;
        kept = reinterpret_cast<PyObject *>(Py_TYPE(actor.object)) == watched.type.object &&
               has_kept_attributes(actor.object, watched) &&
               (!actor.moves || attribute(actor.object, s_road).object == road) &&
               (!actor.changes_lanes ||
                (read_number(actor.object, s_delta, delta) && delta.value == actor.parameters.delta));
    }
    return kept && std::all_of(self.examples.begin(), self.examples.end(), has_kept_values);
}

} // namespace
