// What an agent sees of the road: `KinematicObservation` with its basic features. A part of kernel.cpp.

#pragma once

#include "kernel_predictions.hpp"

namespace {

// The features, see `_observe._CODES`.
enum { PRESENCE, X, Y, VX, VY, HEADING, COS_H, SIN_H, FEATURES };

// How to scale the values of a column to -1 to 1: those at the lower end become -1.
struct Scale {
    double low, span;
    bool is_used;
};

// What `Road.close_objects_to` is asked.
struct Search {
    double distance; // in m
    size_t most;
    bool sees_behind, is_sorted, includes_objects;
};

// `Road.close_objects_to`: the rows of objects near a vehicle.
std::vector<size_t> close_objects_to(Traffic *self, size_t row, const Search &search) {
    const std::vector<Actor> &actors = *self->actors;
    const Actor &observer = actors[row];
    std::vector<std::pair<double, size_t>> found;
    const size_t count = search.includes_objects ? actors.size() : self->vehicles;
    for (size_t other = 0; other < count; other++) {
        const double dx = actors[other].x - observer.x, dy = actors[other].y - observer.y;
        if (other == row || !(std::sqrt(dot(dx, dy, dx, dy)) < search.distance)) {
            continue;
        }
        const double ahead = lane_distance(self, row, other);
        if ((search.sees_behind && actors[other].moves) || -2 * observer.parameters.length < ahead) {
            found.emplace_back(std::fabs(ahead), other);
        }
    }
    if (search.is_sorted) {
        std::stable_sort(found.begin(), found.end(), [](const auto &one, const auto &two) { return one.first < two.first; });
    }
    std::vector<size_t> rows;
    for (size_t at = 0; at < found.size() && at < search.most; at++) {
        rows.push_back(found[at].second);
    }
    return rows;
}

// Whether the end of a vehicle's route is on the road; otherwise highway-env raises an error.
bool arrives(const Network *network, const Actor &actor) {
    PyObject *route = attribute(actor.object, s_route);
    bool found = !route || route == Py_None;
    if (!found && PyList_CheckExact(route)) {
        const Py_ssize_t parts = PyList_GET_SIZE(route);
        PyObject *last = parts ? PyList_GET_ITEM(route, parts - 1) : nullptr;
        found = !last || (PyTuple_CheckExact(last) && PyTuple_GET_SIZE(last) == 3 && lane_of_part(network, last, 0) >= 0);
    }
    Py_XDECREF(route);
    return found;
}

double feature(const Actor &actor, int which) {
    const double speed = actor.moves ? actor.speed.value : 0;
    const double values[FEATURES] = {1,       actor.x,      actor.y,     speed * actor.cosine, speed * actor.sine, actor.heading,
                                     actor.cosine, actor.sine};
    return values[which];
}

// Writes the rows of a vehicle and of other actors.
void show(Traffic *self, size_t row, const std::vector<size_t> &close, const char *features, const Scale *scales,
          size_t columns, bool is_absolute, bool clips, double *cells) {
    const Actor &observer = (*self->actors)[row];
    for (size_t line = 0; line <= close.size(); line++) {
        const Actor &actor = line ? (*self->actors)[close[line - 1]] : observer;
        for (size_t column = 0; column < columns; column++) {
            const int which = features[column];
            double value = feature(actor, which);
            if (line && !is_absolute && X <= which && which <= VY) {
                value -= feature(observer, which);
            }
            const Scale &scale = scales[column];
            if (scale.is_used) {
                value = -1 + (value - scale.low) * 2 / scale.span;
                value = clips ? clip(value, -1, 1) : value;
            }
            cells[line * columns + column] = value;
        }
    }
}

} // namespace
