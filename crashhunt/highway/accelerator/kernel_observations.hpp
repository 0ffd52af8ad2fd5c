// What an agent sees of the road: the objects near it, and their basic features. A part of kernel.cpp.

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

// `Road.close_objects_to` without a limit to their number: the rows of objects within a distance (m) of a vehicle.
std::vector<size_t> close_objects_to(Traffic *self, size_t row, double limit, bool sees_behind, bool is_sorted, size_t count) {
    const std::vector<Actor> &actors = self->actors;
    const Actor &observer = actors[row];
    std::vector<std::pair<double, size_t>> found;
    for (size_t other = 0; other < count; other++) {
        const double dx = actors[other].x - observer.x, dy = actors[other].y - observer.y;
        if (other == row || !(std::sqrt(dot(dx, dy, dx, dy)) < limit)) {
            continue;
        }
        const double ahead = lane_distance(self, row, other);
        if ((sees_behind && actors[other].moves) || -2 * observer.parameters.length < ahead) {
            found.emplace_back(std::fabs(ahead), other);
        }
    }
    if (is_sorted) {
        std::stable_sort(found.begin(), found.end(), [](const auto &one, const auto &two) { return one.first < two.first; });
    }
    std::vector<size_t> rows;
    for (const auto &[ahead, other] : found) {
        rows.push_back(other);
    }
    return rows;
}

// Whether the end of a vehicle's route is on the road; otherwise highway-env raises an error.
bool arrives(const Network *network, const Actor &actor) {
    const Ref route = attribute(actor.object, s_route);
    if (!route || route.object == Py_None) {
        return true;
    }
    const Py_ssize_t parts = PyList_CheckExact(route.object) ? PyList_GET_SIZE(route.object) : -1;
    PyObject *last = parts > 0 ? PyList_GET_ITEM(route.object, parts - 1) : nullptr;
    return last ? PyTuple_CheckExact(last) && PyTuple_GET_SIZE(last) == 3 && lane_of_part(network, last, 0) >= 0
                : parts == 0;
}

double feature(const Actor &actor, int which) {
    const double vx = actor.moves ? actor.speed.value * actor.cosine : 0, vy = actor.moves ? actor.speed.value * actor.sine : 0;
    const double values[FEATURES] = {1, actor.x, actor.y, vx, vy, actor.heading, actor.cosine, actor.sine};
    return values[which];
}

// Whether highway-env describes an actor without an error: it does not describe the heading of an object that is no
// vehicle.
bool is_described(const Network *network, const Actor &actor, const char *features, size_t columns) {
    return arrives(network, actor) && (actor.moves || !std::memchr(features, HEADING, columns));
}

// Writes the features of an actor, from the point of view of an observer if there is one.
void describe(const Actor &actor, const Actor *observer, const char *features, const Scale *scales, size_t columns,
              bool clips, double *cells) {
    for (size_t column = 0; column < columns; column++) {
        const int which = features[column];
        double value = feature(actor, which);
        if (observer && X <= which && which <= VY) {
            value -= feature(*observer, which);
        }
        const Scale &scale = scales[column];
        if (scale.is_used) {
            value = -1 + (value - scale.low) * 2 / scale.span;
            value = clips ? clip(value, -1, 1) : value;
        }
        cells[column] = value;
    }
}

} // namespace
