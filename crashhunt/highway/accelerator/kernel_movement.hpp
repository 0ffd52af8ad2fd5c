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
    const Actor &actor = self->actors[row];
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

const int STATES = 6; // x, y, heading, speed, lateral speed and yaw rate

// `BicycleVehicle.derivative_func`
void derivative(const Actor &actor, const double *state, double *found) {
    const Bicycle &bicycle = actor.bicycle;
    double heading = state[2], speed = state[3], lateral_speed = state[4], yaw_rate = state[5];
    double front_slip = call(ARCTAN2, lateral_speed + bicycle.length_a * yaw_rate, speed);
    double rear_slip = call(ARCTAN2, lateral_speed - bicycle.length_b * yaw_rate, speed);
    double front = 2 * bicycle.friction_front * (actor.steering.value - front_slip);
    double rear = 2 * bicycle.friction_rear * (0 - rear_slip);
    if (std::fabs(speed) < 1) {
        front = -bicycle.mass * lateral_speed - bicycle.inertia_z / bicycle.length_a * yaw_rate;
        rear = -bicycle.mass * lateral_speed + bicycle.inertia_z / bicycle.length_a * yaw_rate;
    }
    double c = call(COS, heading), s = call(SIN, heading);
    found[0] = turned(c, -s, speed, lateral_speed);
    found[1] = turned(s, c, speed, lateral_speed);
    found[2] = yaw_rate;
    found[3] = actor.acceleration.value;
    found[4] = 1 / bicycle.mass * (front + rear) - yaw_rate * speed;
    found[5] = 1 / bicycle.inertia_z * (bicycle.length_a * front - bicycle.length_b * rear);
}

// Moves a vehicle by the dynamic bicycle model. False, with nothing changed: highway-env must do it.
bool slide_in_kernel(Actor &actor, double dt) {
    if (turn_rounds == UNKNOWN) {
        return false;
    }
    const Number steering = actor.steering, acceleration = actor.acceleration;
    const bool changed_action = actor.changed_action;
    clip_actions(actor);
    actor.steering = {clip(actor.steering.value, -PI / 2, PI / 2), true, false};
    double most = actor.bicycle.max_angular_speed, yaw_rate = clip(actor.yaw_rate.value, -most, most);
    const double state[STATES] = {actor.x, actor.y, actor.heading, actor.speed.value, actor.lateral_speed.value, yaw_rate};
    double steps[4][STATES], ahead[STATES]; // of the method of Runge and Kutta
    derivative(actor, state, steps[0]);
    const double lengths[3] = {dt / 2, dt / 2, dt};
    for (int step = 1; step < 4; step++) {
        for (int part = 0; part < STATES; part++) {
            ahead[part] = state[part] + steps[step - 1][part] * lengths[step - 1];
        }
        derivative(actor, ahead, steps[step]);
    }
    bool finite = true;
    for (int part = 0; part < STATES; part++) {
        double sum = steps[0][part] + 2 * steps[1][part] + 2 * steps[2][part] + steps[3][part];
        ahead[part] = state[part] + dt / 6 * sum;
        finite = finite && std::isfinite(ahead[part]);
    }
    if (!finite) {
        actor.steering = steering;
        actor.acceleration = acceleration;
        actor.changed_action = changed_action;
        return false;
    }
    actor.x = ahead[0];
    actor.y = ahead[1];
    actor.heading = ahead[2];
    actor.speed = {ahead[3], true, false};
    actor.lateral_speed = {ahead[4], true, false};
    actor.yaw_rate = {ahead[5], true, false};
    actor.moved = true;
    return true;
}

// Lets highway-env move a vehicle with the dynamic bicycle model. False: an error.
bool slide_vehicle(Traffic *self, Actor &actor, PyObject *dt) {
    if (!publish_contact(actor) || !publish_decision(self, actor) || !publish_movement(self, actor)) {
        return false;
    }
    const Ref done(PyObject_CallFunctionObjArgs(slide, actor.object, dt, nullptr));
    if (!done) {
        return false;
    }
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
        actor.reset_timer = false;
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
        Actor &actor = self->actors[row];
        if (!actor.slides) {
            move(actor, dt);
        } else if (!slide_in_kernel(actor, dt) && !slide_vehicle(self, actor, as_object)) {
            break; // highway-env has moved the vehicles before this one
        }
        finite = finite && is_finite(actor);
    }
    self->now++;
    for (size_t moved = 0; finite && moved < row; moved++) {
        Actor &actor = self->actors[moved];
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
