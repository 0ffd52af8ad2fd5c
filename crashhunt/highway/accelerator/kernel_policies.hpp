// How vehicles decide: IDM, MOBIL and the linear model. A part of kernel.cpp.

#pragma once

#include "kernel_neighbours.hpp"

namespace {

// -------------------------------------------------------------------------------------------------------------- decisions

double desired_gap(const Actor &driver, const Actor &ego, const Actor &front) {
    double vx = ego.speed.value * ego.cosine - front.speed.value * front.cosine;
    double vy = ego.speed.value * ego.sine - front.speed.value * front.sine;
    double closing = dot(vx, vy, ego.cosine, ego.sine), speed = ego.speed.value;
    return driver.parameters.distance_wanted + speed * driver.parameters.time_wanted +
           speed * closing / driver.gap_root;
}

// `IDMVehicle.acceleration`
double idm_acceleration(Traffic *self, size_t driver_row, size_t ego_row, size_t front) {
    const std::vector<Actor> &actors = self->actors;
    const Actor &driver = actors[driver_row];
    const Parameters &parameters = driver.parameters;
    if (ego_row == NO_ROW || !actors[ego_row].moves) {
        return 0;
    }
    const Actor &ego = actors[ego_row];
    double target = ego.target_speed.value;
    double limit = self->network->lane(ego.lane).limit;
    if (!std::isnan(limit)) {
        target = clip(target, 0, limit);
    }
    double speed = ego.speed.value > 0 ? ego.speed.value : 0.0;
    double found = parameters.comfort_acc_max * (1 - call(POWER, speed / std::fabs(not_zero(target)), parameters.delta));
    if (front != NO_ROW) {
        double distance = lane_distance(self, ego_row, front);
        double gap = desired_gap(driver, ego, actors[front]);
        found -= parameters.comfort_acc_max * call(POWER, gap / not_zero(distance), 2);
    }
    return found;
}

// `LinearVehicle.acceleration_features`
void acceleration_features(Traffic *self, const Parameters &parameters, size_t ego_row, size_t front, double *features) {
    features[0] = features[1] = features[2] = 0;
    if (ego_row == NO_ROW) {
        return;
    }
    const Actor &ego = self->actors[ego_row];
    double speed = ego.speed.value;
    features[0] = (ego.has_target_speed ? ego.target_speed.value : speed) - speed;
    if (front != NO_ROW) {
        double safe = parameters.distance_wanted + (speed > 0 ? speed : 0.0) * parameters.time_wanted;
        double faster = self->actors[front].speed.value - speed;
        double farther = lane_distance(self, ego_row, front) - safe;
        features[1] = 0 < faster ? 0 : faster;
        features[2] = 0 < farther ? 0 : farther;
    }
}

double acceleration(Traffic *self, size_t driver_row, size_t ego_row, size_t front_row) {
    const Actor &driver = self->actors[driver_row];
    if (driver.model != LINEAR) {
        return idm_acceleration(self, driver_row, ego_row, front_row);
    }
    double features[3];
    acceleration_features(self, driver.parameters, ego_row, front_row, features);
    return dot(driver.acceleration_parameters, features);
}

// `LinearVehicle.steering_features`
void steering_features(Traffic *self, size_t row, double *features) {
    const Actor &actor = self->actors[row];
    double s, r, length = actor.parameters.length, speed = not_zero(actor.speed.value);
    coordinates(self, row, actor.target, s, r);
    double ahead = self->network->lane(actor.target).heading_at(s + actor.speed.value * actor.parameters.tau_pursuit);
    features[0] = wrap_to_pi(ahead - actor.heading) * length / speed;
    features[1] = -r * length / square(speed);
}

double steering_control(Traffic *self, size_t row) {
    const Actor &actor = self->actors[row];
    const Parameters &parameters = actor.parameters;
    double angle;
    if (actor.model == LINEAR) {
        double features[2];
        steering_features(self, row, features);
        angle = dot(actor.steering_parameters[0], actor.steering_parameters[1], features[0], features[1]);
    } else {
        double s, r, speed = actor.speed.value;
        coordinates(self, row, actor.target, s, r);
        double ahead = self->network->lane(actor.target).heading_at(s + speed * parameters.tau_pursuit);
        double command = call(ARCSIN, clip(-parameters.kp_lateral * r / not_zero(speed), -1, 1));
        double reference = ahead + clip(command, -PI / 4, PI / 4);
        double rate = parameters.kp_heading * wrap_to_pi(reference - actor.heading);
        double slip = call(ARCSIN, clip(parameters.length / 2 / not_zero(speed) * rate, -1, 1));
        angle = call(ARCTAN, 2 * call(TAN, slip));
    }
    return clip(angle, -parameters.max_steering_angle, parameters.max_steering_angle);
}

int sign_of(long x) { return (x > 0) - (x < 0); }

// `IDMVehicle.mobil`
bool mobil(Traffic *self, size_t row, int number) {
    const Actor &actor = self->actors[row];
    const Parameters &parameters = actor.parameters;
    size_t new_front, new_rear, old_front, old_rear;
    neighbour_vehicles(self, row, number, new_front, new_rear);
    double rear_then = acceleration(self, row, new_rear, row);
    if (rear_then < -parameters.lane_change_max_braking_imposed) {
        return false;
    }
    double own_then = acceleration(self, row, row, new_front);
    if (actor.has_prescribed_lane) {
        long current = self->network->lane(actor.target).id;
        if (sign_of(self->network->lane(number).id - current) != sign_of(actor.prescribed_lane - current)) {
            return false;
        }
        return !(own_then < -parameters.lane_change_max_braking_imposed);
    }
    neighbour_vehicles(self, row, actor.lane, old_front, old_rear);
    double rear_now = acceleration(self, row, new_rear, new_front);
    double own_now = acceleration(self, row, row, old_front);
    double old_now = acceleration(self, row, old_rear, row);
    double old_then = acceleration(self, row, old_rear, old_front);
    double gain = own_then - own_now + parameters.politeness * (rear_then - rear_now + old_then - old_now);
    return !(gain < parameters.lane_change_min_acc_gain);
}

// `IDMVehicle.change_lane_policy`
void change_lane_policy(Traffic *self, size_t row) {
    std::vector<Actor> &actors = self->actors;
    const Network &network = *self->network;
    Actor &actor = actors[row];
    if (actor.lane != actor.target) {
        if (network.lane(actor.lane).road != network.lane(actor.target).road) {
            return;
        }
        for (size_t other = 0; other < self->vehicles; other++) {
            const Actor &two = actors[other];
            if (other == row || two.lane == actor.target || !two.has_target || two.target != actor.target) {
                continue;
            }
            double distance = lane_distance(self, row, other);
            if (0 < distance && distance < desired_gap(actor, actor, two)) {
                actor.target = actor.lane;
                actor.changed_target = true;
                return;
            }
        }
        return;
    }
    if (!(actor.parameters.lane_change_delay < actor.timer.value)) {
        return;
    }
    actor.timer = {0, false, true};
    actor.reset_timer = true;
    const Lane &lane = network.lane(actor.lane);
    for (int number : {lane.left, lane.right}) {
        double s, r;
        if (number < 0) {
            continue;
        }
        coordinates(self, row, number, s, r);
        if (!network.lane(number).is_reachable_from(s, r) || std::fabs(actor.speed.value) < 1) {
            continue;
        }
        if (mobil(self, row, number)) {
            actor.target = number;
            actor.changed_target = true;
        }
    }
}

// Lets highway-env choose the next lane at the end of the target lane. False: it has raised an error.
bool follow_road(Traffic *self, size_t row) {
    Actor &actor = self->actors[row];
    double s, r;
    coordinates(self, row, actor.target, s, r);
    if (!(s > self->network->lane(actor.target).length - 5 / 2.)) {
        return true;
    }
    if (!publish_decision(self, actor)) {
        return false;
    }
    double *place = static_cast<double *>(actor.position.buf);
    place[0] = actor.x;
    place[1] = actor.y;
    const Ref done(PyObject_CallMethodNoArgs(actor.object, s_follow_road));
    if (!done) {
        return false;
    }
    if (!read_lane(self->network, actor.object, s_target_lane_index, actor.target) || !read_route(actor)) {
        PyErr_SetString(PyExc_RuntimeError, "highway-env's follow_road returned an unknown lane");
        return false;
    }
    return true;
}

// Appends features and their output to the data of a linear vehicle. False: an error.
bool append_data(PyObject *data, const char *name, const double *features, Py_ssize_t count, double output) {
    PyObject *part = PyDict_GetItemString(data, name); // borrowed
    if (!part) {
        const Ref made(Py_BuildValue("{s[]s[]}", "features", "outputs"));
        part = made && PyDict_SetItemString(data, name, made.object) == 0 ? PyDict_GetItemString(data, name) : nullptr;
    }
    PyObject *all = part && PyDict_CheckExact(part) ? PyDict_GetItemString(part, "features") : nullptr;
    PyObject *outputs = all ? PyDict_GetItemString(part, "outputs") : nullptr;
    if (!outputs || !PyList_CheckExact(all) || !PyList_CheckExact(outputs)) {
        if (!PyErr_Occurred()) {
            PyErr_SetString(PyExc_TypeError, "the data of a linear vehicle must consist of lists");
        }
        return false;
    }
    const Ref array = as_array(features, count), number = as_python(output, true);
    return array && number && PyList_Append(all, array.object) == 0 && PyList_Append(outputs, number.object) == 0;
}

// `LinearVehicle.collect_data`. False: an error.
bool collect_data(Traffic *self, size_t row) {
    const Actor &actor = self->actors[row];
    size_t front, rear;
    neighbour_vehicles(self, row, actor.lane, front, rear);
    double pursuit[3], steering[2];
    acceleration_features(self, actor.parameters, row, front, pursuit);
    steering_features(self, row, steering);
    const double *of_steering = actor.steering_parameters;
    const Ref data(PyObject_GetAttr(actor.object, s_data));
    return data &&
           append_data(data.object, "longitudinal", pursuit, 3, dot(actor.acceleration_parameters, pursuit)) &&
           append_data(data.object, "lateral", steering, 2, dot(of_steering[0], of_steering[1], steering[0], steering[1]));
}

// Decides for one vehicle, as its method `act` does. False: an error.
bool act(Traffic *self, size_t row) {
    Actor &actor = self->actors[row];
    if (actor.model == LINEAR && actor.collects_data && !collect_data(self, row)) {
        return false;
    }
    if (actor.model == PASSIVE || (actor.changes_lanes && actor.crashed)) {
        return true;
    }
    if (!follow_road(self, row)) {
        return false;
    }
    if (actor.model == CONTROLLED) {
        actor.steering.value = steering_control(self, row);
        actor.acceleration.value = actor.parameters.kp_a * (actor.target_speed.value - actor.speed.value);
        actor.acceleration.is_numpy = actor.target_speed.is_numpy || actor.speed.is_numpy;
    } else {
        if (actor.enable_lane_change) {
            change_lane_policy(self, row);
        }
        actor.steering.value = steering_control(self, row);
        size_t front, rear;
        neighbour_vehicles(self, row, actor.lane, front, rear);
        double found = acceleration(self, row, row, front);
        if (actor.lane != actor.target) {
            neighbour_vehicles(self, row, actor.target, front, rear);
            double there = acceleration(self, row, row, front);
            found = there < found ? there : found;
        }
        actor.acceleration.value = clip(found, -actor.parameters.acc_max, actor.parameters.acc_max);
        actor.acceleration.is_numpy = true;
    }
    actor.steering.is_numpy = true;
    actor.new_action = true;
    return true;
}

} // namespace
