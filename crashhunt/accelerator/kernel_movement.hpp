// How vehicles move, and which of them may touch. A part of kernel.cpp.

#pragma once

#include "kernel_policies.hpp"

#include <limits>

namespace {

// --------------------------------------------------------------------------------------------------------------- movement

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

// ------------------------------------------------------------------------------------------------------------- collisions

// Whether an axis separates the outlines of two actors with certainty, now and during the sub-step.
bool stay_apart(const Actor &one, const Actor &two, double dt) {
    const double margin = 1e-6;
    double dx = two.x - one.x, dy = two.y - one.y;
    double c1 = one.cosine, s1 = one.sine, c2 = two.cosine, s2 = two.sine;
    double vx = (one.speed.value * c1 - two.speed.value * c2) * dt;
    double vy = (one.speed.value * s1 - two.speed.value * s2) * dt;
    double along = std::fabs(c1 * c2 + s1 * s2), across = std::fabs(c1 * s2 - s1 * c2);
    double length = one.parameters.length / 2, width = one.parameters.width / 2;
    double other_length = two.parameters.length / 2, other_width = two.parameters.width / 2;
    const double axes[4][3] = {{-s1, c1, width + other_length * across + other_width * along},
                               {c1, s1, length + other_length * along + other_width * across},
                               {-s2, c2, other_width + length * across + width * along},
                               {c2, s2, other_length + length * along + width * across}};
    for (const double *axis : axes) {
        double place = dx * axis[0] + dy * axis[1], towards = vx * axis[0] + vy * axis[1];
        if (place < 0) {
            place = -place;
            towards = -towards;
        }
        if (place - axis[2] - (towards > 0 ? towards : 0.0) > margin) {
            return true;
        }
    }
    return false;
}

bool may_touch(const Actor &one, const Actor &two, double dt) {
    if (!(one.checks || two.checks) || !(one.collides && two.collides)) {
        return false;
    }
    double dx = two.x - one.x, dy = two.y - one.y;
    double reach = one.radius + two.radius + one.speed.value * dt;
    reach = (reach > 0 ? reach : 0.0) + 1e-6;
    return dx * dx + dy * dy <= reach * reach && !stay_apart(one, two, dt);
}

// Lets highway-env check a pair that may touch. False: it has raised an error, or set something unusual.
bool handle_collision(Traffic *self, size_t row, size_t other, PyObject *dt) {
    for (size_t which : {row, other}) {
        Actor &actor = (*self->actors)[which];
        if (actor.moves && (!publish_decision(self, actor) || !publish_movement(self, actor))) {
            return false;
        }
    }
    Actor &one = (*self->actors)[row], &two = (*self->actors)[other];
    PyObject *done = PyObject_CallMethodObjArgs(one.object, s_handle_collisions, two.object, dt, nullptr);
    if (!done) {
        return false;
    }
    Py_DECREF(done);
    for (Actor *actor : {&one, &two}) {
        if (actor->moves && (!read_bool(actor->object, s_crashed, actor->crashed) || !read_impact(*actor))) {
            PyErr_SetString(PyExc_RuntimeError, "highway-env's handle_collisions set an unknown value");
            return false;
        }
    }
    return true;
}

// Finds the pairs that may touch, in the order in which highway-env checks them. Only pairs near each other along x are
// compared: the search sorts by x.
std::vector<std::pair<size_t, size_t>> find_pairs(Traffic *self, double dt) {
    const std::vector<Actor> &actors = *self->actors;
    std::vector<std::pair<double, size_t>> sorted;
    double radius = 0, speed = 0;
    for (size_t row = 0; row < actors.size(); row++) {
        sorted.emplace_back(actors[row].x, row);
        radius = std::max(radius, actors[row].radius);
        speed = std::max(speed, std::fabs(actors[row].speed.value));
    }
    std::sort(sorted.begin(), sorted.end());
    const double reach = 2 * radius + speed * std::fabs(dt) + 1e-5;
    std::vector<std::pair<size_t, size_t>> pairs;
    for (size_t first = 0; first < sorted.size(); first++) {
        for (size_t second = first + 1; second < sorted.size(); second++) {
            if (sorted[second].first - sorted[first].first > reach) {
                break;
            }
            size_t row = std::min(sorted[first].second, sorted[second].second);
            size_t other = std::max(sorted[first].second, sorted[second].second);
            if (row < self->vehicles && may_touch(actors[row], actors[other], dt)) {
                pairs.emplace_back(row, other);
            }
        }
    }
    std::sort(pairs.begin(), pairs.end());
    return pairs;
}

bool collide_all(Traffic *self, double dt, PyObject *as_object) {
    for (const auto &[row, other] : find_pairs(self, dt)) { // a collision changes no position and no speed
        if (!handle_collision(self, row, other, as_object)) {
            return false;
        }
    }
    return true;
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
