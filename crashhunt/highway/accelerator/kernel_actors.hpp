// The vehicles and objects of a road: their state, how it is read, and how it is written. A part of kernel.cpp.

#pragma once

#include "kernel_lanes.hpp"

#include <algorithm>
#include <cstdint>
#include <cstring>

namespace {

// Models of decision, see `_kernel_objects._MODELS`. FOREIGN vehicles decide by code that is not highway-env's.
enum { OBJECT, PASSIVE, CONTROLLED, IDM, LINEAR, FOREIGN };

// The order of the parameters of a vehicle, see `_kernel_objects._PARAMETERS`.
struct Parameters {
    double length, width, max_speed, min_speed;
    double tau_pursuit, kp_lateral, kp_heading, max_steering_angle, kp_a;
    double comfort_acc_max, comfort_acc_min, distance_wanted, time_wanted, acc_max, politeness;
    double lane_change_delay, lane_change_min_acc_gain, lane_change_max_braking_imposed, delta;
};

// The parameters of the dynamic bicycle model.
struct Bicycle {
    double mass, length_a, length_b, inertia_z, friction_front, friction_rear, max_angular_speed;
};

// A number of Python with its type, because later arithmetic depends on it.
struct Number {
    double value = 0;
    bool is_numpy = false; // of NumPy's type
    bool is_whole = false;
};

struct Actor {
    PyObject *object;
    Py_buffer position;
    bool is_open;            // whether `position` is
    int model;
    bool moves;              // a vehicle
    bool slides;             // moves by the dynamic bicycle model
    bool is_landmark;        // not a neighbour
    bool is_obstacle;        // is not pushed by a collision
    bool has_target;         // has a target lane
    bool changes_lanes;      // has a timer, and the MOBIL model
    Parameters parameters;
    double gap_root;         // 2 * np.sqrt(-COMFORT_ACC_MAX * COMFORT_ACC_MIN)

    double x, y, heading;
    double cosine, sine;     // of the heading
    Number speed, timer, target_speed;
    bool has_target_speed, reset_timer;
    int lane, target;        // numbers of lanes; -1 for none
    bool changed_target;
    bool is_solid, crashed;
    bool has_impact;
    double impact_x, impact_y;
    bool new_crash, new_impact, new_hit; // since they were written
    Number steering, acceleration;
    bool new_action, changed_action, moved; // since they were written
    bool enable_lane_change;
    bool has_prescribed_lane; // by the first part of the route
    long prescribed_lane;
    bool checks, collides;
    double radius;           // half the diagonal
    double acceleration_parameters[3], steering_parameters[2]; // of a linear vehicle
    bool collects_data;
    Bicycle bicycle;
    Number lateral_speed, yaw_rate; // of the dynamic bicycle model
};

#define NAMES_OF_ATTRIBUTES(NAME, CONSTANT) \
    NAME(position) NAME(heading) NAME(speed) NAME(lane) NAME(lane_index) NAME(target_lane_index) \
    NAME(target_speed) NAME(timer) NAME(crashed) NAME(impact) NAME(action) NAME(steering) NAME(acceleration) \
    NAME(route) NAME(enable_lane_change) NAME(check_collisions) NAME(collidable) NAME(diagonal) \
    NAME(follow_road) NAME(handle_collisions) CONSTANT(acceleration_parameters, ACCELERATION_PARAMETERS) \
    CONSTANT(steering_parameters, STEERING_PARAMETERS) NAME(collecting_data) NAME(data) NAME(solid) NAME(hit) \
    NAME(road) NAME(vehicles) NAME(objects) CONSTANT(delta, DELTA) NAME(prediction_type) NAME(lateral_speed) \
    NAME(yaw_rate) CONSTANT(mass, MASS) CONSTANT(length_a, LENGTH_A) CONSTANT(length_b, LENGTH_B) \
    CONSTANT(inertia_z, INERTIA_Z) CONSTANT(friction_front, FRICTION_FRONT) \
    CONSTANT(friction_rear, FRICTION_REAR) CONSTANT(max_angular_speed, MAX_ANGULAR_SPEED)
#define DECLARE(name, ...) PyObject *s_##name;
NAMES_OF_ATTRIBUTES(DECLARE, DECLARE)
PyObject *numpy_float; // the type np.float64
PyObject *numpy_int;   // the type np.int64
PyObject *numpy_short; // the type np.float32
PyObject *numpy_array; // the type np.ndarray
PyObject *make_array;  // the function np.zeros
PyObject *slide;       // the function that moves a vehicle with highway-env's dynamic bicycle model

const size_t NO_ROW = static_cast<size_t>(-1);

// The actors on a lane and on lanes connected to it, in their order along the lane.
struct Queue {
    uint64_t instant = 0; // at which it is valid
    std::vector<std::pair<double, size_t>> places; // longitudinal coordinates with rows
};

// What must stay the same about an actor, apart from its state.
struct Watched {
    Ref type;
    Ref fixed;             // a frozenset: the names of attributes that the actor must not get
    std::vector<Ref> keys; // of its attributes, which are none of these, or had them at the beginning
};

// Attributes that an actor shares with the others of its class, or its own ones that replace them.
struct Example {
    Ref object, names, values; // the latter are tuples
};

struct Traffic {
    Ref network_object;
    Network *network = nullptr;
    Ref road;
    std::vector<Watched> watched; // by row
    std::vector<Example> examples;
    std::vector<Actor> actors;          // vehicles, then objects
    std::vector<double> along, across;  // coordinates of actors on lanes
    std::vector<uint64_t> stamps;       // the instant at which these are valid
    std::vector<Queue> queues;          // by lane
    uint64_t now = 0;
    int completed = 0; // sub-steps of the last `run`
    size_t vehicles = 0;
    size_t lanes = 0;

    ~Traffic() {
        for (Actor &actor : actors) {
            if (actor.is_open) {
                PyBuffer_Release(&actor.position);
            }
            Py_XDECREF(actor.object);
        }
    }
};

bool has_type(PyObject *value, PyObject *type) { return Py_TYPE(value) == reinterpret_cast<PyTypeObject *>(type); }

// Reads a Python float or int, or a NumPy float or integer. Any other type makes the kernel refuse.
bool read_value(PyObject *value, Number &number) {
    number.is_numpy = has_type(value, numpy_float) || has_type(value, numpy_int);
    number.is_whole = PyLong_CheckExact(value) || has_type(value, numpy_int);
    if (PyFloat_CheckExact(value) || has_type(value, numpy_float)) {
        number.value = PyFloat_AS_DOUBLE(value); // np.float64 is a subclass of float
        return true;
    }
    if (!number.is_whole) {
        return false;
    }
    number.value = PyFloat_AsDouble(value);
    if (number.value == -1 && PyErr_Occurred()) {
        PyErr_Clear();
        return false;
    }
    return std::fabs(number.value) < 9007199254740992.0; // from 2**53 on, a float is not exact
}

// An attribute; null with no error set if it is missing.
Ref attribute(PyObject *object, PyObject *name) {
    PyObject *found = PyObject_GetAttr(object, name);
    if (!found) {
        PyErr_Clear();
    }
    return Ref(found);
}

bool read_number(PyObject *object, PyObject *name, Number &number) {
    const Ref found = attribute(object, name);
    return found && read_value(found.object, number);
}

bool read_bool(PyObject *object, PyObject *name, bool &truth) {
    const Ref found = attribute(object, name);
    if (!found || !PyBool_Check(found.object)) {
        return false;
    }
    truth = found.object == Py_True;
    return true;
}

// Opens an array of `count` floats; any other object makes the kernel refuse.
bool open_floats(PyObject *array, Py_buffer &view, Py_ssize_t count, int flags) {
    if (!has_type(array, numpy_array)) {
        return false;
    }
    if (PyObject_GetBuffer(array, &view, PyBUF_FORMAT | PyBUF_ND | flags)) { // fails if the numbers are not adjacent
        PyErr_Clear();
        return false;
    }
    if (view.ndim == 1 && view.shape[0] == count && view.format && !std::strcmp(view.format, "d")) {
        return true;
    }
    PyBuffer_Release(&view);
    return false;
}

// Reads a list of numbers, or an array of floats.
bool read_numbers(PyObject *object, PyObject *name, double *numbers, Py_ssize_t count) {
    const Ref found = attribute(object, name);
    Py_buffer view;
    bool read = bool(found);
    if (read && PyList_CheckExact(found.object)) {
        read = PyList_GET_SIZE(found.object) == count;
        for (Py_ssize_t which = 0; read && which < count; which++) {
            Number number;
            read = read_value(PyList_GET_ITEM(found.object, which), number) && std::isfinite(number.value);
            numbers[which] = number.value;
        }
    } else if (read && (read = open_floats(found.object, view, count, 0))) {
        std::memcpy(numbers, view.buf, static_cast<size_t>(count) * sizeof(double));
        read = std::all_of(numbers, numbers + count, [](double number) { return std::isfinite(number); });
        PyBuffer_Release(&view);
    }
    return read;
}

// Reads the number of the lane with the key that an attribute holds.
bool read_lane(const Network *network, PyObject *object, PyObject *name, int &lane) {
    const Ref key = attribute(object, name);
    PyObject *found = key ? PyDict_GetItemWithError(network->index.object, key.object) : nullptr; // borrowed
    PyErr_Clear(); // such as a list, which is not hashable
    if (found) {
        lane = static_cast<int>(PyLong_AsLong(found));
    }
    return found;
}

// Reads the lane on which an actor is, which must be the lane with its key.
bool read_own_lane(const Network *network, Actor &actor) {
    const Ref lane = attribute(actor.object, s_lane);
    return lane && read_lane(network, actor.object, s_lane_index, actor.lane) &&
           PyList_GET_ITEM(network->objects.object, actor.lane) == lane.object;
}

// Reads whether the first part of the route prescribes a lane. All parts must be usual, as each may become the first.
bool read_route(Actor &actor) {
    actor.has_prescribed_lane = false;
    const Ref found = attribute(actor.object, s_route);
    PyObject *route = found.object;
    bool read = route && (route == Py_None || PyList_CheckExact(route));
    for (Py_ssize_t part = 0; read && route != Py_None && part < PyList_GET_SIZE(route); part++) {
        PyObject *key = PyList_GET_ITEM(route, part);
        read = PyTuple_CheckExact(key) && PyTuple_GET_SIZE(key) == 3;
        PyObject *lane = read ? PyTuple_GET_ITEM(key, 2) : Py_None;
        if (lane != Py_None) {
            long number = PyLong_CheckExact(lane) ? PyLong_AsLong(lane) : -1;
            read = -1000000 < number && number < 1000000 && PyLong_CheckExact(lane);
            PyErr_Clear();
            if (part == 0) {
                actor.has_prescribed_lane = read;
                actor.prescribed_lane = number;
            }
        }
    }
    return read;
}

bool read_impact(Actor &actor) {
    const Ref impact = attribute(actor.object, s_impact);
    if (!impact) {
        return false;
    }
    actor.has_impact = impact.object != Py_None;
    Py_buffer view;
    bool read = !actor.has_impact || open_floats(impact.object, view, 2, 0);
    if (read && actor.has_impact) {
        const double *values = static_cast<const double *>(view.buf);
        actor.impact_x = values[0];
        actor.impact_y = values[1];
        PyBuffer_Release(&view);
    }
    return read;
}

// Reads a part of an action, which may also be a number of an action space of float32: a movement makes it a Python float.
bool read_action_value(PyObject *value, Number &number) {
    if (!has_type(value, numpy_short)) {
        return read_value(value, number);
    }
    number = {PyFloat_AsDouble(value), true, false};
    return true;
}

// Reads an action, and adds the address of its dictionary to a list.
bool read_action(Actor &actor, std::vector<const void *> &actions) {
    const Ref action = attribute(actor.object, s_action);
    actor.new_action = actor.changed_action = false;
    if (!action || !PyDict_CheckExact(action.object)) {
        return false;
    }
    PyObject *steering = PyDict_GetItemWithError(action.object, s_steering);
    PyObject *acceleration = PyDict_GetItemWithError(action.object, s_acceleration);
    PyErr_Clear();
    actions.push_back(action.object);
    return steering && acceleration && read_action_value(steering, actor.steering) &&
           read_action_value(acceleration, actor.acceleration);
}

bool is_finite(const Actor &actor) {
    return std::isfinite(actor.x) && std::isfinite(actor.y) && std::isfinite(actor.heading) &&
           std::isfinite(actor.speed.value);
}

void turn(Actor &actor) {
    actor.cosine = call(COS, actor.heading);
    actor.sine = call(SIN, actor.heading);
}

// Opens the array with the position of an actor, unless it is open.
bool open_position(Actor &actor) {
    const Ref position = attribute(actor.object, s_position);
    if (!position) {
        return false;
    }
    if (actor.is_open && actor.position.obj != position.object) {
        PyBuffer_Release(&actor.position);
        actor.is_open = false;
    }
    actor.is_open = actor.is_open || open_floats(position.object, actor.position, 2, PyBUF_WRITABLE);
    return actor.is_open;
}

bool read_pose(Actor &actor) {
    Number heading, diagonal;
    if (!open_position(actor) || !read_number(actor.object, s_heading, heading) ||
        !read_number(actor.object, s_speed, actor.speed) || !read_number(actor.object, s_diagonal, diagonal)) {
        return false;
    }
    const double *place = static_cast<const double *>(actor.position.buf);
    actor.x = place[0];
    actor.y = place[1];
    actor.heading = heading.value;
    actor.radius = diagonal.value / 2;
    turn(actor);
    return is_finite(actor);
}

bool read_target_speed(Actor &actor) {
    const Ref found = attribute(actor.object, s_target_speed);
    actor.target_speed = Number();
    actor.has_target_speed = bool(found);
    const bool read = found ? read_value(found.object, actor.target_speed) : !actor.has_target;
    return read && std::isfinite(actor.target_speed.value);
}

// Reads the data that a linear vehicle has collected: a dictionary in which a part is missing or usual.
bool read_data(Actor &actor) {
    const Ref data = attribute(actor.object, s_data);
    bool read = data && PyDict_CheckExact(data.object);
    for (const char *name : {"longitudinal", "lateral"}) {
        PyObject *part = read ? PyDict_GetItemString(data.object, name) : nullptr;
        for (const char *list : {"features", "outputs"}) {
            PyObject *found = part && PyDict_CheckExact(part) ? PyDict_GetItemString(part, list) : nullptr;
            read = read && (!part || (found && PyList_CheckExact(found)));
        }
    }
    PyErr_Clear();
    return read;
}

bool read_linear(Actor &actor) {
    return !actor.speed.is_whole && // otherwise its features might be whole numbers
           read_numbers(actor.object, s_acceleration_parameters, actor.acceleration_parameters, 3) &&
           read_numbers(actor.object, s_steering_parameters, actor.steering_parameters, 2) &&
           read_bool(actor.object, s_collecting_data, actor.collects_data) &&
           (!actor.collects_data || read_data(actor));
}

// Reads the parameters and the velocities of the dynamic bicycle model.
bool read_bicycle(Actor &actor) {
    Bicycle &bicycle = actor.bicycle;
    const std::pair<PyObject *, double *> parameters[] = {
        {s_mass, &bicycle.mass},
        {s_length_a, &bicycle.length_a},
        {s_length_b, &bicycle.length_b},
        {s_inertia_z, &bicycle.inertia_z},
        {s_friction_front, &bicycle.friction_front},
        {s_friction_rear, &bicycle.friction_rear},
        {s_max_angular_speed, &bicycle.max_angular_speed},
    };
    for (const auto &[name, place] : parameters) {
        Number number;
        if (!read_number(actor.object, name, number) || !std::isfinite(number.value)) {
            return false;
        }
        *place = number.value;
    }
    // Python raises an error for a division by zero.
    return bicycle.mass != 0 && bicycle.length_a != 0 && bicycle.inertia_z != 0 &&
           read_number(actor.object, s_lateral_speed, actor.lateral_speed) &&
           read_number(actor.object, s_yaw_rate, actor.yaw_rate);
}

bool read_vehicle(const Network *network, Actor &actor, std::vector<const void *> &actions) {
    PyObject *object = actor.object;
    actor.changed_target = actor.reset_timer = actor.moved = false;
    actor.target = -1;
    if (!read_own_lane(network, actor) || !read_bool(object, s_crashed, actor.crashed) || !read_impact(actor) ||
        !read_action(actor, actions) || !read_target_speed(actor)) {
        return false;
    }
    if (actor.has_target && !(read_lane(network, object, s_target_lane_index, actor.target) && read_route(actor))) {
        return false;
    }
    if (actor.changes_lanes && !(read_number(object, s_timer, actor.timer) &&
                                 read_bool(object, s_enable_lane_change, actor.enable_lane_change))) {
        return false;
    }
    return (actor.model != LINEAR || read_linear(actor)) && (!actor.slides || read_bicycle(actor));
}

bool are_different(std::vector<const void *> &pointers) {
    std::sort(pointers.begin(), pointers.end());
    return std::adjacent_find(pointers.begin(), pointers.end()) == pointers.end();
}

// Reads the state of all actors. False: something has an unusual type or value, and the kernel must not be used.
bool read_all(Traffic *self) {
    self->now++;
    std::vector<const void *> positions, actions; // a change of one that two actors share would change both
    for (Actor &actor : self->actors) {
        if (!read_pose(actor) || !read_bool(actor.object, s_check_collisions, actor.checks) ||
            !read_bool(actor.object, s_collidable, actor.collides) || !read_bool(actor.object, s_solid, actor.is_solid)) {
            return false;
        }
        actor.new_crash = actor.new_impact = actor.new_hit = false;
        positions.push_back(actor.position.buf);
        if (actor.moves && !read_vehicle(self->network, actor, actions)) {
            return false;
        }
        // A linear vehicle evaluates an object behind it like a vehicle.
        if (!actor.moves && !read_own_lane(self->network, actor)) {
            actor.lane = -1;
        }
    }
    return are_different(positions) && are_different(actions);
}

bool set(PyObject *object, PyObject *name, const Ref &value) {
    return value && PyObject_SetAttr(object, name, value.object) == 0;
}

Ref as_python(double value, bool as_numpy) {
    Ref number(PyFloat_FromDouble(value));
    return number && as_numpy ? Ref(PyObject_CallOneArg(numpy_float, number.object)) : std::move(number);
}

// A new array of NumPy.
Ref as_array(const double *numbers, Py_ssize_t count) {
    Ref array(PyObject_CallFunction(make_array, "n", count));
    Buffer buffer;
    if (!array || !buffer.open(array.object, PyBUF_WRITABLE)) {
        return Ref();
    }
    std::memcpy(buffer.bytes(), numbers, static_cast<size_t>(count) * sizeof(double));
    return array;
}

Ref as_python(const Number &number) { return as_python(number.value, number.is_numpy); }

// Writes the results of decisions.
bool publish_decision(Traffic *self, Actor &actor) {
    if (actor.changed_target) {
        PyObject *key = PyList_GET_ITEM(self->network->keys.object, actor.target);
        if (PyObject_SetAttr(actor.object, s_target_lane_index, key)) {
            return false;
        }
        actor.changed_target = false;
    }
    if (actor.reset_timer) {
        if (!set(actor.object, s_timer, Ref(PyLong_FromLong(0)))) {
            return false;
        }
        actor.reset_timer = false;
    }
    if (actor.new_action || actor.changed_action) {
        const Ref steering = as_python(actor.steering), acceleration = as_python(actor.acceleration);
        const Ref action(actor.new_action ? PyDict_New() : PyObject_GetAttr(actor.object, s_action));
        const bool is_new = actor.new_action;
        actor.new_action = actor.changed_action = false;
        return steering && acceleration && action && PyDict_SetItem(action.object, s_steering, steering.object) == 0 &&
               PyDict_SetItem(action.object, s_acceleration, acceleration.object) == 0 &&
               (!is_new || PyObject_SetAttr(actor.object, s_action, action.object) == 0);
    }
    return true;
}

// Writes the results of a movement.
bool publish_movement(Traffic *self, Actor &actor) {
    if (!actor.moved) {
        return true;
    }
    actor.moved = false;
    PyObject *object = actor.object;
    if (actor.slides) { // the dynamic bicycle model makes a new array
        const double place[2] = {actor.x, actor.y};
        if (!set(object, s_position, as_array(place, 2)) ||
            !set(object, s_lateral_speed, as_python(actor.lateral_speed)) ||
            !set(object, s_yaw_rate, as_python(actor.yaw_rate))) {
            return false;
        }
    } else {
        double *place = static_cast<double *>(actor.position.buf);
        place[0] = actor.x;
        place[1] = actor.y;
    }
    if (!set(object, s_heading, as_python(actor.heading, true)) || !set(object, s_speed, as_python(actor.speed))) {
        return false;
    }
    if (PyObject_SetAttr(object, s_lane_index, PyList_GET_ITEM(self->network->keys.object, actor.lane)) ||
        PyObject_SetAttr(object, s_lane, PyList_GET_ITEM(self->network->objects.object, actor.lane))) {
        return false;
    }
    // After an error, an actor may have reset its timer since its last movement.
    const bool is_whole = actor.timer.is_whole && !actor.timer.is_numpy;
    if (actor.changes_lanes &&
        !set(object, s_timer, is_whole ? Ref(PyLong_FromDouble(actor.timer.value)) : as_python(actor.timer))) {
        return false;
    }
    return true;
}

// Writes the results of collisions.
bool publish_contact(Actor &actor) {
    if (actor.new_crash && PyObject_SetAttr(actor.object, s_crashed, Py_True)) {
        return false;
    }
    if (actor.new_hit && PyObject_SetAttr(actor.object, s_hit, Py_True)) {
        return false;
    }
    const double impact[2] = {actor.impact_x, actor.impact_y};
    if (actor.new_impact && !set(actor.object, s_impact, actor.has_impact ? as_array(impact, 2) : Ref(Py_NewRef(Py_None)))) {
        return false;
    }
    actor.new_crash = actor.new_hit = actor.new_impact = false;
    return true;
}

bool publish_all(Traffic *self, bool moved) {
    for (Actor &actor : self->actors) {
        if (!publish_contact(actor)) {
            return false;
        }
        if (!actor.moves) {
            continue;
        }
        if (!publish_decision(self, actor) || (moved && !publish_movement(self, actor))) {
            return false;
        }
    }
    return true;
}

} // namespace
