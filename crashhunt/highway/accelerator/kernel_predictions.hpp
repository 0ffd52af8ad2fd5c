// What will happen if vehicles keep their speeds: conflicts at intersections, and times to collision. A part of kernel.cpp.

#pragma once

#include "kernel_collisions.hpp"

namespace {

// -------------------------------------------------------------------------------------------------------------- conflicts

// highway-env decides about outlines that are nearer to each other than this: the last bits of predicted positions may
// differ from its own.
const double MARGIN_M = 1e-6;
const double FARTHEST_M = 1e7; // beyond it, rounding may be as large as the margin

const int MOMENTS = 11; // np.arange(0.25, 3, 0.25)
const double INTERVAL_S = 0.25;

struct Pose {
    double x, y, heading;
};
typedef std::vector<Pose> Path; // of MOMENTS poses

enum Answer { NO, UNSURE, YES }; // in this order: that of an alternative is the largest, that of a conjunction the least

Answer is_below(double value, double limit) {
    return value < limit - MARGIN_M ? YES : value > limit + MARGIN_M ? NO : UNSURE;
}

// The number of the lane of one part of a route; -1 if highway-env must decide. A vehicle keeps the number of its own
// lane on a part that leaves it open.
int lane_of_part(const Network *network, PyObject *part, long own) {
    const bool is_open = PyTuple_GET_ITEM(part, 2) == Py_None;
    const Ref key(is_open ? Py_BuildValue("OOl", PyTuple_GET_ITEM(part, 0), PyTuple_GET_ITEM(part, 1), own)
                          : Py_NewRef(part));
    PyObject *found = key ? PyDict_GetItemWithError(network->index.object, key.object) : nullptr; // borrowed
    PyErr_Clear();
    return found ? static_cast<int>(PyLong_AsLong(found)) : -1;
}

// `ControlledVehicle.predict_trajectory_constant_speed`. False: highway-env must decide.
bool foresee(Traffic *self, size_t row, PyObject *route, Path &path) {
    const Network &network = *self->network;
    const Actor &actor = self->actors[row];
    const Py_ssize_t parts = route == Py_None ? 0 : PyList_GET_SIZE(route);
    double s, r;
    coordinates(self, row, actor.lane, s, r);
    for (int moment = 1; moment <= MOMENTS; moment++) {
        double along = s + actor.speed.value * (INTERVAL_S * moment);
        int lane = actor.lane;
        for (Py_ssize_t part = 0; part < parts; part++) {
            lane = lane_of_part(&network, PyList_GET_ITEM(route, part), network.lane(actor.lane).id);
            if (lane < 0) {
                return false;
            }
            if (part + 1 == parts || !(along > network.lane(lane).length)) {
                break;
            }
            along -= network.lane(lane).length;
        }
        Pose pose;
        network.lane(lane).position(along, pose.x, pose.y);
        pose.heading = network.lane(lane).heading_at(along);
        path.push_back(pose);
    }
    return true;
}

// `utils.has_corner_inside` for the outlines of two vehicles, which are longer and narrower than the vehicles
Answer has_corner_inside(const Actor &one, const Pose &here, const Actor &two, const Pose &there) {
    const double length = 1.5 * one.parameters.length / 2, width = 0.9 * one.parameters.width / 2;
    const double other_length = 1.5 * two.parameters.length / 2, other_width = 0.9 * two.parameters.width / 2;
    const double c = std::cos(here.heading), s = std::sin(here.heading);
    const double c2 = std::cos(there.heading), s2 = std::sin(there.heading);
    Answer found = NO;
    for (int along = -1; along <= 1; along++) { // the corners, the middles of the edges, and the centre
        for (int across = -1; across <= 1; across++) {
            const double dx = here.x + c * along * length - s * across * width - there.x;
            const double dy = here.y + s * along * length + c * across * width - there.y;
            // highway-env turns a point by the heading of the outline, and not against it.
            const Answer inside = std::min(is_below(std::fabs(c2 * dx - s2 * dy), other_length),
                                           is_below(std::fabs(s2 * dx + c2 * dy), other_width));
            found = std::max(found, inside);
        }
    }
    return found;
}

// `RegulatedRoad.is_conflict_possible`
Answer is_conflict_possible(const Actor &one, const Path &path, const Actor &two, const Path &other) {
    Answer found = NO;
    for (size_t moment = 0; moment < MOMENTS && found != YES; moment++) {
        const Pose &here = path[moment], &there = other[moment];
        const double dx = there.x - here.x, dy = there.y - here.y;
        const bool is_exact = std::fabs(here.x) + std::fabs(here.y) < FARTHEST_M && std::isfinite(here.heading) &&
                              std::fabs(there.x) + std::fabs(there.y) < FARTHEST_M && std::isfinite(there.heading);
        Answer touch = is_exact ? is_below(std::sqrt(dx * dx + dy * dy), one.parameters.length) : UNSURE;
        if (is_exact && touch != NO) {
            touch = std::min(touch, std::max(has_corner_inside(one, here, two, there),
                                             has_corner_inside(two, there, one, here)));
        }
        found = std::max(found, touch);
    }
    return found;
}

// `Vehicle.predict_trajectory_constant_speed`. False: highway-env must decide.
bool foresee_passive(const Actor &actor, Path &path) {
    const Ref kind = attribute(actor.object, s_prediction_type);
    const bool is_text = kind && PyUnicode_Check(kind.object);
    const bool is_straight = is_text && !PyUnicode_CompareWithASCIIString(kind.object, "zero_steering");
    const bool is_turning = is_text && !PyUnicode_CompareWithASCIIString(kind.object, "constant_steering");
    if (!is_straight && !is_turning) {
        return false; // raises an error
    }
    Actor ahead = actor;
    ahead.steering.value = is_turning ? actor.steering.value : 0;
    ahead.acceleration.value = 0;
    for (int moment = 1; moment <= MOMENTS; moment++) {
        if (!actor.slides) {
            move(ahead, INTERVAL_S);
        } else if (!slide_in_kernel(ahead, INTERVAL_S)) {
            return false;
        }
        path.push_back({ahead.x, ahead.y, ahead.heading});
    }
    return true;
}

// Predicts the paths of all vehicles. An empty result: highway-env must decide.
std::vector<Path> predict_all(Traffic *self) {
    std::vector<Path> paths(self->vehicles);
    for (size_t row = 0; row < self->vehicles; row++) {
        const Actor &actor = self->actors[row];
        bool done;
        if (actor.has_target) {
            const Ref route = attribute(actor.object, s_route);
            done = route && foresee(self, row, route.object, paths[row]);
        } else {
            done = foresee_passive(actor, paths[row]);
        }
        if (!done) {
            return {};
        }
    }
    return paths;
}

// -------------------------------------------------------------------------------------------------------- time to collision

// The grid of a time-to-collision observation: axes for the speeds of the observer, lanes and times.
struct TimeGrid {
    double *cells;
    Py_ssize_t lanes, times;
    double quantum; // the time between two cells, in s

    void mark(Py_ssize_t speed, Py_ssize_t first, Py_ssize_t last, double time, double cost) const {
        if (!(time < static_cast<double>(times))) {
            return;
        }
        for (Py_ssize_t lane = first; lane < last; lane++) {
            double &cell = cells[(speed * lanes + lane) * times + static_cast<Py_ssize_t>(time)];
            cell = std::max(cell, cost);
        }
    }
};

// How the lane of another vehicle relates to the road of the observer, see `_observe.fill_times`.
enum { APART, SAME_LANES, OTHER_LANES };

// `compute_ttc_grid` for one speed of the observer and one other vehicle
void fill_times(Traffic *self, const TimeGrid &grid, size_t row, size_t other, Py_ssize_t which, double speed, int relation) {
    const Actor &one = self->actors[row], &two = self->actors[other];
    if (other == row || speed == two.speed.value || relation == APART) {
        return;
    }
    const double margin = two.parameters.length / 2 + one.parameters.length / 2;
    const double points[3][2] = {{0, 1}, {-margin, 0.5}, {margin, 0.5}};
    const double projected = two.speed.value * dot(two.cosine, two.sine, one.cosine, one.sine);
    const int lane = self->network->lane(two.lane).id;
    for (const auto &[offset, cost] : points) {
        const double distance = lane_distance(self, row, other) + offset;
        const double time = distance / not_zero(speed - projected);
        if (!(time >= 0)) {
            continue;
        }
        const Py_ssize_t first = relation == SAME_LANES ? lane : 0;
        const Py_ssize_t last = relation == SAME_LANES ? lane + 1 : grid.lanes;
        grid.mark(which, first, last, std::floor(time / grid.quantum), cost);
        grid.mark(which, first, last, std::ceil(time / grid.quantum), cost);
    }
}

} // namespace
