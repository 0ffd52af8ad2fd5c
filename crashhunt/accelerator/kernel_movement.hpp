// How vehicles move. A part of kernel.cpp.

#pragma once

#include "kernel_policies.hpp"

#include <limits>

namespace {

void clip_actions(Actor &actor) {
    double speed = actor.speed.value;
    if (actor.crashed) {
        actor.steering.value = 0;
        actor.acceleration.value = -1.0 * speed;
    }
    actor.steering = {actor.steering.value, false, false};
    actor.acceleration = {actor.acceleration.value, false, false};
    if (speed > actor.parameters.max_speed) {
        double most = 1.0 * (actor.parameters.max_speed - speed);
        if (most < actor.acceleration.value) {
            actor.acceleration = {most, actor.speed.is_numpy, false};
        }
    } else if (speed < actor.parameters.min_speed) {
        double least = 1.0 * (actor.parameters.min_speed - speed);
        if (least > actor.acceleration.value) {
            actor.acceleration = {least, actor.speed.is_numpy, false};
        }
    }
    actor.changed_action = true; // at least, both numbers become Python floats
}

int closest_lane(Traffic *self, size_t row) {
    const Actor &actor = (*self->actors)[row];
    int nearest = 0;
    double least = std::numeric_limits<double>::infinity(), angle = 0, of_heading = NAN;
    for (int number = 0; number < static_cast<int>(self->lanes); number++) {
        const Lane &lane = self->network->lane(number);
        double s, r;
        coordinates(self, row, number, s, r);
        double heading = lane.heading_at(s);
        if (!(heading == of_heading)) { // lanes of one road are mostly parallel
            angle = std::fabs(wrap_to_pi(actor.heading - heading));
            of_heading = heading;
        }
        double beyond = s - lane.length > 0 ? s - lane.length : 0.0, before = 0 - s > 0 ? 0 - s : 0.0;
        double distance = std::fabs(r) + beyond + before + 1.0 * angle;
        if (distance < least) {
            least = distance;
            nearest = number;
        }
    }
    return nearest;
}

// Lets highway-env move a vehicle with the dynamic bicycle model. False: an error.
bool slide_vehicle(Traffic *self, Actor &actor, PyObject *dt) {
    if (!publish_contact(actor)) {
        return false;
    }
    PyObject *done = PyObject_CallFunctionObjArgs(slide, actor.object, dt, nullptr);
    if (!done) {
        return false;
    }
    Py_DECREF(done);
    int lane = actor.lane; // is searched afterwards, for all vehicles
    std::vector<const void *> actions;
    read_pose(actor); // false for numbers that are not finite, which `move_all` reports
    if (!actor.is_open || !read_vehicle(self->network, actor, actions)) {
        PyErr_SetString(PyExc_RuntimeError, "highway-env's step set an unknown value");
        return false;
    }
    actor.lane = lane;
    actor.moved = true;
    return true;
}

void move(Actor &actor, double dt) {
    double speed = actor.speed.value;
    actor.moved = true;
    if (actor.changes_lanes) {
        actor.timer = {actor.timer.value + dt, actor.timer.is_numpy, false};
    }
    clip_actions(actor);
    double slip = call(ARCTAN, 1 / 2. * call(TAN, actor.steering.value));
    double course = actor.heading + slip;
    actor.x += speed * call(COS, course) * dt;
    actor.y += speed * call(SIN, course) * dt;
    if (actor.has_impact) {
        actor.x += actor.impact_x;
        actor.y += actor.impact_y;
        actor.crashed = actor.new_crash = true;
        actor.has_impact = false;
        actor.new_impact = true;
    }
    actor.heading += speed * call(SIN, slip) / (actor.parameters.length / 2) * dt;
    actor.speed = {speed + actor.acceleration.value * dt, actor.speed.is_numpy || actor.acceleration.is_numpy, false};
}

enum Moved { FINITE, NOT_FINITE, FAILED };

Moved move_all(Traffic *self, double dt, PyObject *as_object) {
    bool finite = true;
    size_t row = 0;
    for (; row < self->vehicles; row++) {
        Actor &actor = (*self->actors)[row];
        if (!actor.slides) {
            move(actor, dt);
        } else if (!slide_vehicle(self, actor, as_object)) {
            break; // highway-env has moved the vehicles before this one
        }
        finite = finite && is_finite(actor);
    }
    self->now++;
    for (size_t moved = 0; finite && moved < row; moved++) {
        Actor &actor = (*self->actors)[moved];
        turn(actor);
        actor.lane = closest_lane(self, moved);
    }
    return row < self->vehicles ? FAILED : finite ? FINITE : NOT_FINITE;
}

bool act_all(Traffic *self) {
    for (size_t row = 0; row < self->vehicles; row++) {
        if (!act(self, row)) {
            return false;
        }
    }
    return true;
}

} // namespace
