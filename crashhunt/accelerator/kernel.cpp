// Sub-steps of highway-env's roads, compiled: decisions, movement and the search for lanes, with the bits of highway-env.
//
// - Each function computes what the method of highway-env with the same name computes, vehicle after vehicle in
//   highway-env's order. Every expression stands as it does there, in the same order of operations.
// - It is compiled without contraction, because a fused multiply-add rounds once instead of twice.
// - Sine, cosine and their like are the inner loops of NumPy's own functions, because NumPy has several versions of them
//   for different processors. crashhunt/accelerator/_kernel.py compares all of them with NumPy when a process starts.
// - What the kernel does not know, it refuses: `read` returns False, and Python code does the work. For two events it
//   calls highway-env's own methods: the end of a lane, and a pair of vehicles that may touch.

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

namespace {

// ------------------------------------------------------------------------------------------------------------- arithmetic

// The beginning of NumPy's `PyUFuncObject`, which is a part of NumPy's stable interface.
typedef void (*Loop)(char **, const Py_ssize_t *, const Py_ssize_t *, void *);
struct UFunc {
    PyObject_HEAD
    int nin, nout, nargs, identity;
    Loop *functions;
    void *const *data;
    int ntypes, reserved;
    const char *name;
    const char *types;
};
const char DOUBLE = 12; // NumPy's number of the type float64

struct Function {
    Loop loop;
    void *data;
};
enum { SIN, COS, TAN, ARCSIN, ARCTAN, ARCTAN2, POWER, FUNCTIONS };
const char *const NAMES[FUNCTIONS] = {"sin", "cos", "tan", "arcsin", "arctan", "arctan2", "power"};

Function functions[FUNCTIONS];
bool fused = false;         // whether NumPy's scalar product of two vectors uses fused multiply-adds
Py_ssize_t exponent_step = 0; // the stride with which NumPy passes the exponent of a power of two numbers

const double PI = 3.14159265358979323846;
const double TAU = 2 * PI;

double call(int number, double x) {
    double y;
    char *args[2] = {reinterpret_cast<char *>(&x), reinterpret_cast<char *>(&y)};
    const Py_ssize_t count = 1, steps[2] = {sizeof(double), sizeof(double)};
    functions[number].loop(args, &count, steps, functions[number].data);
    return y;
}

double call(int number, double x, double y) {
    double z;
    char *args[3] = {reinterpret_cast<char *>(&x), reinterpret_cast<char *>(&y), reinterpret_cast<char *>(&z)};
    const Py_ssize_t count = 1;
    const Py_ssize_t steps[3] = {sizeof(double), number == POWER ? exponent_step : Py_ssize_t(sizeof(double)),
                                 sizeof(double)};
    functions[number].loop(args, &count, steps, functions[number].data);
    return z;
}

// np.dot of two vectors of two numbers: BLAS begins with 0, which decides the sign of a zero result.
double dot(double ax, double ay, double bx, double by) {
    if (fused) {
        return std::fma(ay, by, std::fma(ax, bx, 0.0));
    }
    return (0.0 + ax * bx) + ay * by;
}

// Python's and NumPy's remainder, which has the sign of the divisor.
double remainder_of(double a, double b) {
    double found = std::fmod(a, b);
    if (found != 0) {
        if ((b < 0) != (found < 0)) {
            found += b;
        }
        return found;
    }
    return std::copysign(0.0, b);
}

double wrap_to_pi(double x) { return remainder_of(x + PI, TAU) - PI; }

double not_zero(double x) { return std::fabs(x) > 1e-2 ? x : (x >= 0 ? 1e-2 : -1e-2); }

double clip(double x, double low, double high) {
    double found = x < low ? low : x;
    return found > high ? high : found;
}

// ------------------------------------------------------------------------------------------------------------------ lanes

enum { STRAIGHT, SINE, CIRCULAR };

struct Lane {
    int kind;
    double x, y;               // start, or centre of a circle
    double along_x, along_y;   // direction
    double across_x, across_y; // direction_lateral
    double length, width, heading;
    double limit; // of speeds, in m/s; NaN for none
    bool forbidden;
    double amplitude, pulsation, phase;     // of a sine
    double radius, start_phase, direction; // of a circle
    int left, right;                        // numbers of the neighbours with the number - 1 and + 1 on the same road
    int road;                               // the same for all lanes between two nodes
    int id;                                 // the last part of the key

    void local_coordinates(double px, double py, double &s, double &r) const {
        double dx = px - x, dy = py - y;
        if (kind == CIRCULAR) {
            double phi = start_phase + wrap_to_pi(call(ARCTAN2, dy, dx) - start_phase);
            double distance = std::sqrt(dot(dx, dy, dx, dy));
            s = direction * (phi - start_phase) * radius;
            r = direction * (radius - distance);
            return;
        }
        s = dot(dx, dy, along_x, along_y);
        r = dot(dx, dy, across_x, across_y);
        if (kind == SINE) {
            r = r - amplitude * call(SIN, pulsation * s + phase);
        }
    }

    double heading_at(double s) const {
        if (kind == STRAIGHT) {
            return heading;
        }
        if (kind == SINE) {
            return heading + call(ARCTAN, amplitude * pulsation * call(COS, pulsation * s + phase));
        }
        return (direction * s / radius + start_phase) + PI / 2 * direction;
    }

    bool on_lane(double s, double r, double margin) const {
        return std::fabs(r) <= width / 2 + margin && -5 <= s && s < length + 5;
    }

    bool is_reachable_from(double s, double r) const {
        return !forbidden && std::fabs(r) <= 2 * width && 0 <= s && s < length + 5;
    }
};

struct Network {
    PyObject_HEAD
    std::vector<Lane> *lanes;
    std::vector<std::vector<std::pair<int, double>>> *connected; // with offsets; empty if the road does not search them
    PyObject *keys;  // the list of keys
    PyObject *found; // the list of lane objects
    PyObject *index; // from a key to the number of its lane
};

// --------------------------------------------------------------------------------------------------------------- vehicles

enum { OBJECT, NOTHING, CONTROLLED, IDM };

// The order of the parameters of a vehicle, see `_kernel.PARAMETERS`.
struct Parameters {
    double length, width, max_speed, min_speed;
    double tau_pursuit, kp_lateral, kp_heading, max_steering_angle, kp_a;
    double comfort_acc_max, comfort_acc_min, distance_wanted, time_wanted, acc_max, politeness;
    double lane_change_delay, lane_change_min_acc_gain, lane_change_max_braking_imposed, delta;
};

struct Thing {
    PyObject *object;
    Py_buffer place;
    bool has_place;
    int model;
    bool moves;      // a vehicle
    bool landmark;   // not a neighbour
    bool aims;       // has a target lane
    Parameters of;
    double gap_root; // 2 * np.sqrt(-COMFORT_ACC_MAX * COMFORT_ACC_MIN)

    double x, y, heading, speed;
    double cosine, sine;       // of the heading
    bool numpy_speed;          // whether the speed is a NumPy float
    double target_speed;
    double timer;
    bool numpy_timer, reset_timer;
    int lane, target;          // numbers of lanes; -1 for none
    bool changed_target;
    bool crashed, new_crash;
    bool has_impact;
    double impact_x, impact_y;
    double steering, acceleration;
    bool numpy_steering, numpy_acceleration, numpy_target;
    bool new_action, changed_action;
    bool change_lanes;          // enable_lane_change
    bool has_way;               // whether the first part of the route prescribes a lane
    long way;
    bool checks, collides;
    double radius;              // half the diagonal
};

PyObject *s_position, *s_heading, *s_speed, *s_lane, *s_lane_index, *s_target_lane_index, *s_target_speed, *s_timer,
    *s_crashed, *s_impact, *s_action, *s_steering, *s_acceleration, *s_route, *s_enable_lane_change, *s_check_collisions,
    *s_collidable, *s_diagonal, *s_follow_road, *s_handle_collisions;
PyObject *numpy_float; // the type np.float64
PyObject *numpy_int;   // the type np.int64
PyObject *numpy_array; // the type np.ndarray

struct Traffic {
    PyObject_HEAD
    Network *network;
    std::vector<Thing> *things; // vehicles, then objects
    std::vector<double> *along, *across; // coordinates of things on lanes
    std::vector<unsigned> *stamps;       // the instant for which these are valid
    unsigned now;
    int completed; // sub-steps of the last `run`
    size_t vehicles;
    size_t lanes;
};

// Reads a number: a Python float or int, or a NumPy float or integer. Any other type makes the kernel refuse.
bool number_of(PyObject *value, double &number, bool *is_numpy = nullptr) {
    if (PyFloat_CheckExact(value)) {
        number = PyFloat_AS_DOUBLE(value);
    } else if (Py_TYPE(value) == reinterpret_cast<PyTypeObject *>(numpy_float)) {
        number = PyFloat_AS_DOUBLE(value); // np.float64 is a subclass of float
        if (is_numpy) {
            *is_numpy = true;
        }
        return true;
    } else if (PyLong_CheckExact(value) || Py_TYPE(value) == reinterpret_cast<PyTypeObject *>(numpy_int)) {
        number = PyFloat_AsDouble(value);
        if (number == -1 && PyErr_Occurred()) {
            PyErr_Clear();
            return false;
        }
        if (std::fabs(number) >= 9007199254740992.0) { // from 2**53 on, a float is not exact
            return false;
        }
    } else {
        return false;
    }
    if (is_numpy) {
        *is_numpy = !PyFloat_CheckExact(value) && !PyLong_CheckExact(value);
    }
    return true;
}

// An attribute that must be there; a new reference, or null with no error set.
PyObject *attribute(PyObject *object, PyObject *name) {
    PyObject *found = PyObject_GetAttr(object, name);
    if (!found) {
        PyErr_Clear();
    }
    return found;
}

bool read_number(PyObject *object, PyObject *name, double &number, bool *is_numpy = nullptr) {
    PyObject *found = attribute(object, name);
    bool read = found && number_of(found, number, is_numpy);
    Py_XDECREF(found);
    return read;
}

bool read_truth(PyObject *object, PyObject *name, bool &truth) {
    PyObject *found = attribute(object, name);
    bool read = found && PyBool_Check(found);
    if (read) {
        truth = found == Py_True;
    }
    Py_XDECREF(found);
    return read;
}

// The number of the lane with the key that an attribute holds.
bool read_lane(const Network *network, PyObject *object, PyObject *name, int &lane) {
    PyObject *key = attribute(object, name);
    if (!key) {
        return false;
    }
    PyObject *found = PyDict_GetItemWithError(network->index, key);
    PyErr_Clear(); // such as a list, which is not hashable
    if (found) {
        lane = static_cast<int>(PyLong_AsLong(found));
    }
    Py_DECREF(key);
    return found != nullptr;
}

// Reads whether the first part of the route prescribes a lane. All parts must be usual, as each may become the first.
bool read_route(Thing &thing) {
    thing.has_way = false;
    PyObject *route = attribute(thing.object, s_route);
    if (!route) {
        return false;
    }
    bool read = route == Py_None || PyList_CheckExact(route);
    for (Py_ssize_t part = 0; read && route != Py_None && part < PyList_GET_SIZE(route); part++) {
        PyObject *key = PyList_GET_ITEM(route, part);
        read = PyTuple_CheckExact(key) && PyTuple_GET_SIZE(key) == 3;
        PyObject *way = read ? PyTuple_GET_ITEM(key, 2) : Py_None;
        if (way != Py_None) {
            long number = PyLong_CheckExact(way) ? PyLong_AsLong(way) : -1;
            read = -1000000 < number && number < 1000000 && PyLong_CheckExact(way);
            PyErr_Clear();
            if (part == 0) {
                thing.has_way = read;
                thing.way = number;
            }
        }
    }
    Py_DECREF(route);
    return read;
}

bool read_impact(Thing &thing) {
    PyObject *impact = attribute(thing.object, s_impact);
    if (!impact) {
        return false;
    }
    thing.has_impact = impact != Py_None;
    bool read = true;
    if (thing.has_impact) {
        Py_buffer view;
        read = PyObject_GetBuffer(impact, &view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS) == 0;
        if (read) {
            read = view.len == 16 && view.itemsize == 8 && view.format && !std::strcmp(view.format, "d");
            if (read) {
                const double *values = static_cast<const double *>(view.buf);
                thing.impact_x = values[0];
                thing.impact_y = values[1];
            }
            PyBuffer_Release(&view);
        }
        PyErr_Clear();
    }
    Py_DECREF(impact);
    return read;
}

bool read_action(Thing &thing, std::vector<const void *> &actions) {
    PyObject *action = attribute(thing.object, s_action);
    bool read = action && PyDict_CheckExact(action);
    if (read) {
        PyObject *steering = PyDict_GetItemWithError(action, s_steering);
        PyObject *acceleration = PyDict_GetItemWithError(action, s_acceleration);
        PyErr_Clear();
        read = steering && acceleration && number_of(steering, thing.steering) &&
               number_of(acceleration, thing.acceleration, &thing.numpy_acceleration);
    }
    actions.push_back(action);
    Py_XDECREF(action);
    thing.new_action = thing.changed_action = false;
    return read;
}

bool is_finite(const Thing &thing) {
    return std::isfinite(thing.x) && std::isfinite(thing.y) && std::isfinite(thing.heading) && std::isfinite(thing.speed);
}

void turn(Thing &thing) {
    thing.cosine = call(COS, thing.heading);
    thing.sine = call(SIN, thing.heading);
}

// Opens the array with the position of a thing, unless it is open.
bool read_place(Thing &thing) {
    PyObject *position = attribute(thing.object, s_position);
    if (!position) {
        return false;
    }
    if (thing.has_place && thing.place.obj != position) {
        PyBuffer_Release(&thing.place);
        thing.has_place = false;
    }
    if (!thing.has_place && Py_TYPE(position) == reinterpret_cast<PyTypeObject *>(numpy_array)) {
        thing.has_place = PyObject_GetBuffer(position, &thing.place, PyBUF_WRITABLE | PyBUF_FORMAT | PyBUF_ND) == 0;
        PyErr_Clear();
    }
    Py_DECREF(position);
    return thing.has_place && thing.place.ndim == 1 && thing.place.shape[0] == 2 && thing.place.format &&
           !std::strcmp(thing.place.format, "d");
}

bool are_different(std::vector<const void *> &pointers) {
    std::sort(pointers.begin(), pointers.end());
    return std::adjacent_find(pointers.begin(), pointers.end()) == pointers.end();
}

// Reads the state of all things. False: something has an unusual type or value, and the kernel must not be used.
bool read_all(Traffic *self) {
    self->now++;
    std::vector<const void *> places, actions; // two things may share one, which one of them then changes
    for (size_t row = 0; row < self->things->size(); row++) {
        Thing &thing = (*self->things)[row];
        if (!read_place(thing)) {
            return false;
        }
        places.push_back(thing.place.buf);
        const double *place = static_cast<const double *>(thing.place.buf);
        thing.x = place[0];
        thing.y = place[1];
        PyObject *object = thing.object;
        if (!read_number(object, s_heading, thing.heading) ||
            !read_number(object, s_speed, thing.speed, &thing.numpy_speed) || !is_finite(thing) ||
            !read_truth(object, s_check_collisions, thing.checks) ||
            !read_truth(object, s_collidable, thing.collides)) {
            return false;
        }
        double diagonal;
        if (!read_number(object, s_diagonal, diagonal)) {
            return false;
        }
        thing.radius = diagonal / 2;
        turn(thing);
        if (!thing.moves) {
            continue;
        }
        PyObject *lane = attribute(object, s_lane);
        bool known = lane && read_lane(self->network, object, s_lane_index, thing.lane) &&
                     PyList_GET_ITEM(self->network->found, thing.lane) == lane;
        Py_XDECREF(lane);
        if (!known || !read_truth(object, s_crashed, thing.crashed) || !read_impact(thing) ||
            !read_action(thing, actions)) {
            return false;
        }
        thing.new_crash = false;
        thing.target_speed = 0;
        thing.target = -1;
        thing.changed_target = thing.reset_timer = false;
        PyObject *target_speed = attribute(object, s_target_speed);
        thing.numpy_target = false;
        bool usual = target_speed ? number_of(target_speed, thing.target_speed, &thing.numpy_target) : !thing.aims;
        Py_XDECREF(target_speed);
        if (!usual || !std::isfinite(thing.target_speed)) {
            return false;
        }
        if (thing.aims && (!read_lane(self->network, object, s_target_lane_index, thing.target) || !read_route(thing))) {
            return false;
        }
        if (thing.model == IDM) {
            if (!read_number(object, s_timer, thing.timer, &thing.numpy_timer) ||
                !read_truth(object, s_enable_lane_change, thing.change_lanes)) {
                return false;
            }
        }
    }
    return are_different(places) && are_different(actions);
}

bool set(PyObject *object, PyObject *name, PyObject *value) { // takes the reference to the value
    bool done = value && PyObject_SetAttr(object, name, value) == 0;
    Py_XDECREF(value);
    return done;
}

PyObject *typed(double value, bool as_numpy) {
    PyObject *number = PyFloat_FromDouble(value);
    if (!number || !as_numpy) {
        return number;
    }
    PyObject *found = PyObject_CallOneArg(numpy_float, number);
    Py_DECREF(number);
    return found;
}

// Writes the results of decisions.
bool publish_decision(Traffic *self, Thing &thing) {
    if (thing.changed_target) {
        PyObject *key = PyList_GET_ITEM(self->network->keys, thing.target);
        if (PyObject_SetAttr(thing.object, s_target_lane_index, key)) {
            return false;
        }
        thing.changed_target = false;
    }
    if (thing.reset_timer) {
        if (!set(thing.object, s_timer, PyLong_FromLong(0))) {
            return false;
        }
        thing.reset_timer = false;
    }
    if (thing.new_action || thing.changed_action) {
        PyObject *steering = typed(thing.steering, thing.numpy_steering);
        PyObject *acceleration = typed(thing.acceleration, thing.numpy_acceleration);
        PyObject *action = thing.new_action ? PyDict_New() : PyObject_GetAttr(thing.object, s_action);
        bool done = steering && acceleration && action && PyDict_SetItem(action, s_steering, steering) == 0 &&
                    PyDict_SetItem(action, s_acceleration, acceleration) == 0 &&
                    (!thing.new_action || PyObject_SetAttr(thing.object, s_action, action) == 0);
        Py_XDECREF(steering);
        Py_XDECREF(acceleration);
        Py_XDECREF(action);
        thing.new_action = thing.changed_action = false;
        return done;
    }
    return true;
}

// Writes the results of a movement.
bool publish_movement(Traffic *self, Thing &thing) {
    double *place = static_cast<double *>(thing.place.buf);
    place[0] = thing.x;
    place[1] = thing.y;
    PyObject *object = thing.object;
    if (!set(object, s_heading, typed(thing.heading, true)) ||
        !set(object, s_speed, typed(thing.speed, thing.numpy_speed)) ||
        PyObject_SetAttr(object, s_lane_index, PyList_GET_ITEM(self->network->keys, thing.lane)) ||
        PyObject_SetAttr(object, s_lane, PyList_GET_ITEM(self->network->found, thing.lane))) {
        return false;
    }
    if (thing.model == IDM && !set(object, s_timer, typed(thing.timer, thing.numpy_timer))) {
        return false;
    }
    if (thing.new_crash) {
        thing.new_crash = false;
        if (PyObject_SetAttr(object, s_crashed, Py_True) || PyObject_SetAttr(object, s_impact, Py_None)) {
            return false;
        }
    }
    return true;
}

bool publish_all(Traffic *self, bool moved) {
    for (size_t row = 0; row < self->vehicles; row++) {
        Thing &thing = (*self->things)[row];
        bool reset = thing.reset_timer && !moved;
        thing.reset_timer = reset;
        if (!publish_decision(self, thing) || (moved && !publish_movement(self, thing))) {
            return false;
        }
    }
    return true;
}

// ------------------------------------------------------------------------------------------------------ what drivers know

void coordinates(Traffic *self, size_t row, int lane, double &s, double &r) {
    size_t at = row * self->lanes + static_cast<size_t>(lane);
    if ((*self->stamps)[at] != self->now) {
        const Thing &thing = (*self->things)[row];
        (*self->network->lanes)[static_cast<size_t>(lane)].local_coordinates(thing.x, thing.y, (*self->along)[at],
                                                                            (*self->across)[at]);
        (*self->stamps)[at] = self->now;
    }
    s = (*self->along)[at];
    r = (*self->across)[at];
}

double lane_distance(Traffic *self, size_t row, size_t other) {
    int lane = (*self->things)[row].lane;
    double s, other_s, r;
    coordinates(self, other, lane, other_s, r);
    coordinates(self, row, lane, s, r);
    return other_s - s;
}

const size_t NOBODY = std::numeric_limits<size_t>::max();

void neighbour_vehicles(Traffic *self, size_t row, int number, size_t &front, size_t &rear) {
    const std::vector<Lane> &lanes = *self->network->lanes;
    const std::vector<Thing> &things = *self->things;
    double s, r, s_front = 0, s_rear = 0;
    coordinates(self, row, number, s, r);
    front = rear = NOBODY;
    const std::pair<int, double> only(number, 0.0), *searched = &only;
    size_t count = 1;
    if (!self->network->connected->empty()) {
        const auto &connected = (*self->network->connected)[static_cast<size_t>(number)];
        searched = connected.data();
        count = connected.size();
    }
    for (size_t other = 0; other < things.size(); other++) {
        if (other == row || things[other].landmark) {
            continue;
        }
        for (size_t which = 0; which < count; which++) {
            double other_s, other_r;
            coordinates(self, other, searched[which].first, other_s, other_r);
            if (!lanes[static_cast<size_t>(searched[which].first)].on_lane(other_s, other_r, 1)) {
                continue;
            }
            other_s += searched[which].second;
            if (s <= other_s && (front == NOBODY || other_s <= s_front)) {
                s_front = other_s;
                front = other;
            }
            if (other_s < s && (rear == NOBODY || other_s > s_rear)) {
                s_rear = other_s;
                rear = other;
            }
            break;
        }
    }
}

// -------------------------------------------------------------------------------------------------------------- decisions

double desired_gap(const Thing &driver, const Thing &ego, const Thing &front) {
    double vx = ego.speed * ego.cosine - front.speed * front.cosine;
    double vy = ego.speed * ego.sine - front.speed * front.sine;
    double closing = dot(vx, vy, ego.cosine, ego.sine);
    return driver.of.distance_wanted + ego.speed * driver.of.time_wanted + ego.speed * closing / driver.gap_root;
}

double acceleration(Traffic *self, size_t driver_row, size_t ego_row, size_t front_row) {
    const std::vector<Thing> &things = *self->things;
    if (ego_row == NOBODY || !things[ego_row].moves) {
        return 0;
    }
    const Thing &driver = things[driver_row], &ego = things[ego_row];
    double target = ego.target_speed;
    double limit = (*self->network->lanes)[static_cast<size_t>(ego.lane)].limit;
    if (!std::isnan(limit)) {
        target = clip(target, 0, limit);
    }
    double speed = ego.speed > 0 ? ego.speed : 0.0;
    double found = driver.of.comfort_acc_max * (1 - call(POWER, speed / std::fabs(not_zero(target)), driver.of.delta));
    if (front_row != NOBODY) {
        double distance = lane_distance(self, ego_row, front_row);
        double gap = desired_gap(driver, ego, things[front_row]);
        found -= driver.of.comfort_acc_max * call(POWER, gap / not_zero(distance), 2);
    }
    return found;
}

double steering_control(Traffic *self, size_t row) {
    const Thing &thing = (*self->things)[row];
    const Lane &lane = (*self->network->lanes)[static_cast<size_t>(thing.target)];
    double s, r;
    coordinates(self, row, thing.target, s, r);
    double ahead = lane.heading_at(s + thing.speed * thing.of.tau_pursuit);
    double command = call(ARCSIN, clip(-thing.of.kp_lateral * r / not_zero(thing.speed), -1, 1));
    double reference = ahead + clip(command, -PI / 4, PI / 4);
    double rate = thing.of.kp_heading * wrap_to_pi(reference - thing.heading);
    double slip = call(ARCSIN, clip(thing.of.length / 2 / not_zero(thing.speed) * rate, -1, 1));
    double angle = call(ARCTAN, 2 * call(TAN, slip));
    return clip(angle, -thing.of.max_steering_angle, thing.of.max_steering_angle);
}

int sign_of(long x) { return (x > 0) - (x < 0); }

bool mobil(Traffic *self, size_t row, int number) {
    const Thing &thing = (*self->things)[row];
    const Parameters &of = thing.of;
    size_t new_front, new_rear, old_front, old_rear;
    neighbour_vehicles(self, row, number, new_front, new_rear);
    double rear_then = acceleration(self, row, new_rear, row);
    if (rear_then < -of.lane_change_max_braking_imposed) {
        return false;
    }
    double own_then = acceleration(self, row, row, new_front);
    if (thing.has_way) {
        const std::vector<Lane> &lanes = *self->network->lanes;
        long current = lanes[static_cast<size_t>(thing.target)].id;
        if (sign_of(lanes[static_cast<size_t>(number)].id - current) != sign_of(thing.way - current)) {
            return false;
        }
        return !(own_then < -of.lane_change_max_braking_imposed);
    }
    neighbour_vehicles(self, row, thing.lane, old_front, old_rear);
    double rear_now = acceleration(self, row, new_rear, new_front);
    double own_now = acceleration(self, row, row, old_front);
    double old_now = acceleration(self, row, old_rear, row);
    double old_then = acceleration(self, row, old_rear, old_front);
    double gain = own_then - own_now + of.politeness * (rear_then - rear_now + old_then - old_now);
    return !(gain < of.lane_change_min_acc_gain);
}

void change_lane_policy(Traffic *self, size_t row) {
    std::vector<Thing> &things = *self->things;
    const std::vector<Lane> &lanes = *self->network->lanes;
    Thing &thing = things[row];
    if (thing.lane != thing.target) {
        if (lanes[static_cast<size_t>(thing.lane)].road != lanes[static_cast<size_t>(thing.target)].road) {
            return;
        }
        for (size_t other = 0; other < self->vehicles; other++) {
            const Thing &two = things[other];
            if (other == row || two.lane == thing.target || !two.aims || two.target != thing.target) {
                continue;
            }
            double distance = lane_distance(self, row, other);
            if (0 < distance && distance < desired_gap(thing, thing, two)) {
                thing.target = thing.lane;
                thing.changed_target = true;
                return;
            }
        }
        return;
    }
    if (!(thing.of.lane_change_delay < thing.timer)) {
        return;
    }
    thing.timer = 0;
    thing.numpy_timer = false;
    thing.reset_timer = true;
    const Lane &lane = lanes[static_cast<size_t>(thing.lane)];
    for (int number : {lane.left, lane.right}) {
        double s, r;
        if (number < 0) {
            continue;
        }
        coordinates(self, row, number, s, r);
        if (!lanes[static_cast<size_t>(number)].is_reachable_from(s, r) || std::fabs(thing.speed) < 1) {
            continue;
        }
        if (mobil(self, row, number)) {
            thing.target = number;
            thing.changed_target = true;
        }
    }
}

// Lets highway-env choose the next lane at the end of the target lane. False: it has raised an error.
bool follow_road(Traffic *self, size_t row) {
    Thing &thing = (*self->things)[row];
    double s, r;
    coordinates(self, row, thing.target, s, r);
    if (!(s > (*self->network->lanes)[static_cast<size_t>(thing.target)].length - 5 / 2.)) {
        return true;
    }
    if (!publish_decision(self, thing)) {
        return false;
    }
    double *place = static_cast<double *>(thing.place.buf);
    place[0] = thing.x;
    place[1] = thing.y;
    PyObject *done = PyObject_CallMethodNoArgs(thing.object, s_follow_road);
    if (!done) {
        return false;
    }
    Py_DECREF(done);
    if (!read_lane(self->network, thing.object, s_target_lane_index, thing.target) || !read_route(thing)) {
        PyErr_SetString(PyExc_RuntimeError, "highway-env's follow_road returned an unknown lane");
        return false;
    }
    return true;
}

bool act(Traffic *self, size_t row) {
    Thing &thing = (*self->things)[row];
    if (thing.model == NOTHING || (thing.model == IDM && thing.crashed)) {
        return true;
    }
    if (!follow_road(self, row)) {
        return false;
    }
    if (thing.model == CONTROLLED) {
        thing.steering = steering_control(self, row);
        thing.acceleration = thing.of.kp_a * (thing.target_speed - thing.speed);
        thing.numpy_acceleration = thing.numpy_target || thing.numpy_speed;
    } else {
        if (thing.change_lanes) {
            change_lane_policy(self, row);
        }
        thing.steering = steering_control(self, row);
        size_t front, rear;
        neighbour_vehicles(self, row, thing.lane, front, rear);
        thing.acceleration = acceleration(self, row, row, front);
        if (thing.lane != thing.target) {
            neighbour_vehicles(self, row, thing.target, front, rear);
            double there = acceleration(self, row, row, front);
            thing.acceleration = there < thing.acceleration ? there : thing.acceleration;
        }
        thing.acceleration = clip(thing.acceleration, -thing.of.acc_max, thing.of.acc_max);
        thing.numpy_acceleration = true;
    }
    thing.numpy_steering = true;
    thing.new_action = true;
    return true;
}

// --------------------------------------------------------------------------------------------------------------- movement

void clip_actions(Thing &thing) {
    if (thing.crashed) {
        thing.steering = 0;
        thing.acceleration = -1.0 * thing.speed;
    }
    thing.numpy_steering = thing.numpy_acceleration = false;
    if (thing.speed > thing.of.max_speed) {
        double most = 1.0 * (thing.of.max_speed - thing.speed);
        if (most < thing.acceleration) {
            thing.acceleration = most;
            thing.numpy_acceleration = thing.numpy_speed;
        }
    } else if (thing.speed < thing.of.min_speed) {
        double least = 1.0 * (thing.of.min_speed - thing.speed);
        if (least > thing.acceleration) {
            thing.acceleration = least;
            thing.numpy_acceleration = thing.numpy_speed;
        }
    }
    thing.changed_action = true; // at least, both numbers become Python floats
}

int closest_lane(Traffic *self, size_t row) {
    const std::vector<Lane> &lanes = *self->network->lanes;
    const Thing &thing = (*self->things)[row];
    int nearest = 0;
    double least = std::numeric_limits<double>::infinity(), angle = 0, of_heading = NAN;
    for (size_t number = 0; number < lanes.size(); number++) {
        const Lane &lane = lanes[number];
        double s, r;
        coordinates(self, row, static_cast<int>(number), s, r);
        double heading = lane.heading_at(s);
        if (!(heading == of_heading)) { // lanes of one road are mostly parallel
            angle = std::fabs(wrap_to_pi(thing.heading - heading));
            of_heading = heading;
        }
        double beyond = s - lane.length > 0 ? s - lane.length : 0.0, ahead = 0 - s > 0 ? 0 - s : 0.0;
        double distance = std::fabs(r) + beyond + ahead + 1.0 * angle;
        if (distance < least) {
            least = distance;
            nearest = static_cast<int>(number);
        }
    }
    return nearest;
}

// False: a number is not finite any more.
bool move_all(Traffic *self, double dt) {
    bool finite = true;
    for (size_t row = 0; row < self->vehicles; row++) {
        Thing &thing = (*self->things)[row];
        if (thing.model == IDM) {
            thing.timer += dt;
        }
        clip_actions(thing);
        double slip = call(ARCTAN, 1 / 2. * call(TAN, thing.steering));
        double course = thing.heading + slip;
        thing.x += thing.speed * call(COS, course) * dt;
        thing.y += thing.speed * call(SIN, course) * dt;
        if (thing.has_impact) {
            thing.x += thing.impact_x;
            thing.y += thing.impact_y;
            thing.crashed = thing.new_crash = true;
            thing.has_impact = false;
        }
        thing.heading += thing.speed * call(SIN, slip) / (thing.of.length / 2) * dt;
        thing.speed += thing.acceleration * dt;
        finite = finite && is_finite(thing);
    }
    self->now++;
    for (size_t row = 0; finite && row < self->vehicles; row++) {
        Thing &thing = (*self->things)[row];
        turn(thing);
        thing.lane = closest_lane(self, row);
    }
    return finite;
}

// Whether an axis separates the outlines of two things with certainty, now and during the sub-step.
bool stay_apart(const Thing &one, const Thing &two, double dt) {
    const double margin = 1e-6;
    double dx = two.x - one.x, dy = two.y - one.y;
    double c1 = one.cosine, s1 = one.sine, c2 = two.cosine, s2 = two.sine;
    double vx = (one.speed * c1 - two.speed * c2) * dt, vy = (one.speed * s1 - two.speed * s2) * dt;
    double along = std::fabs(c1 * c2 + s1 * s2), across = std::fabs(c1 * s2 - s1 * c2);
    double length = one.of.length / 2, width = one.of.width / 2;
    double other_length = two.of.length / 2, other_width = two.of.width / 2;
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

bool may_touch(const Thing &one, const Thing &two, double dt) {
    if (!(one.checks || two.checks) || !(one.collides && two.collides)) {
        return false;
    }
    double dx = two.x - one.x, dy = two.y - one.y;
    double reach = one.radius + two.radius + one.speed * dt;
    reach = (reach > 0 ? reach : 0.0) + 1e-6;
    return dx * dx + dy * dy <= reach * reach && !stay_apart(one, two, dt);
}

// Lets highway-env check a pair that may touch. False: it has raised an error, or set something unusual.
bool handle_collision(Traffic *self, size_t row, size_t other, PyObject *dt) {
    for (size_t which : {row, other}) {
        Thing &thing = (*self->things)[which];
        if (thing.moves && (!publish_decision(self, thing) || !publish_movement(self, thing))) {
            return false;
        }
    }
    Thing &one = (*self->things)[row], &two = (*self->things)[other];
    PyObject *done = PyObject_CallMethodObjArgs(one.object, s_handle_collisions, two.object, dt, nullptr);
    if (!done) {
        return false;
    }
    Py_DECREF(done);
    for (Thing *thing : {&one, &two}) {
        if (thing->moves && (!read_truth(thing->object, s_crashed, thing->crashed) || !read_impact(*thing))) {
            PyErr_SetString(PyExc_RuntimeError, "highway-env's handle_collisions set an unknown value");
            return false;
        }
    }
    return true;
}

bool collide_all(Traffic *self, double dt, PyObject *as_object) {
    const std::vector<Thing> &things = *self->things;
    for (size_t row = 0; row < self->vehicles; row++) {
        for (size_t other = row + 1; other < things.size(); other++) {
            if (may_touch(things[row], things[other], dt) && !handle_collision(self, row, other, as_object)) {
                return false;
            }
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

// ---------------------------------------------------------------------------------------------------------------- methods

// After an error of highway-env: writes what is known, so that the caller sees the state at the moment of the error.
PyObject *fail(Traffic *self, bool moved) {
    PyObject *kind, *value, *trace;
    PyErr_Fetch(&kind, &value, &trace);
    if (!publish_all(self, moved)) {
        PyErr_Clear();
    }
    PyErr_Restore(kind, value, trace);
    return nullptr;
}

PyObject *traffic_read(Traffic *self, PyObject *) { return PyBool_FromLong(read_all(self)); }

PyObject *traffic_act(Traffic *self, PyObject *) {
    if (!act_all(self)) {
        return fail(self, false);
    }
    if (!publish_all(self, false)) {
        return nullptr;
    }
    Py_RETURN_NONE;
}

PyObject *traffic_step(Traffic *self, PyObject *dt) {
    double length;
    if (!PyFloat_CheckExact(dt)) {
        PyErr_SetString(PyExc_TypeError, "the length of a sub-step must be a float");
        return nullptr;
    }
    length = PyFloat_AS_DOUBLE(dt);
    bool finite = move_all(self, length);
    if (!publish_all(self, true)) {
        return nullptr;
    }
    if (finite && !collide_all(self, length, dt)) {
        return nullptr;
    }
    return PyBool_FromLong(finite);
}

PyObject *traffic_run(Traffic *self, PyObject *args) {
    int count;
    PyObject *dt;
    if (!PyArg_ParseTuple(args, "iO!", &count, &PyFloat_Type, &dt)) {
        return nullptr;
    }
    double length = PyFloat_AS_DOUBLE(dt);
    int &done = self->completed;
    for (done = 0; done < count; done++) {
        if (!act_all(self)) {
            return fail(self, done > 0);
        }
        if (!move_all(self, length)) { // what follows a number that is not finite is highway-env's
            if (!publish_all(self, true)) {
                return nullptr;
            }
            return Py_BuildValue("iO", done, Py_True);
        }
        if (!collide_all(self, length, dt)) {
            return fail(self, true);
        }
    }
    if (!publish_all(self, true)) {
        return nullptr;
    }
    return Py_BuildValue("iO", done, Py_False);
}

void traffic_dealloc(Traffic *self) {
    if (self->things) {
        for (Thing &thing : *self->things) {
            if (thing.has_place) {
                PyBuffer_Release(&thing.place);
            }
            Py_XDECREF(thing.object);
        }
    }
    delete self->things;
    delete self->along;
    delete self->across;
    delete self->stamps;
    Py_XDECREF(reinterpret_cast<PyObject *>(self->network));
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

PyTypeObject *network_type = nullptr;

// Traffic(network, things, models, flags, parameters)
PyObject *traffic_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *network, *things;
    Py_buffer models, flags, parameters;
    if (!PyArg_ParseTuple(args, "O!O!y*y*y*", network_type, &network, &PyList_Type, &things, &models, &flags,
                          &parameters)) {
        return nullptr;
    }
    size_t count = static_cast<size_t>(PyList_GET_SIZE(things));
    Traffic *self = nullptr;
    if (static_cast<size_t>(models.len) != count || static_cast<size_t>(flags.len) != count ||
        static_cast<size_t>(parameters.len) != count * sizeof(Parameters)) {
        PyErr_SetString(PyExc_ValueError, "one model, flag and row of parameters is needed for each thing");
    } else {
        self = reinterpret_cast<Traffic *>(type->tp_alloc(type, 0));
    }
    if (self) {
        Py_INCREF(network);
        self->network = reinterpret_cast<Network *>(network);
        self->lanes = self->network->lanes->size();
        self->now = 0;
        self->completed = 0;
        self->things = new std::vector<Thing>(count);
        self->along = new std::vector<double>(count * self->lanes);
        self->across = new std::vector<double>(count * self->lanes);
        self->stamps = new std::vector<unsigned>(count * self->lanes, 0);
        self->vehicles = 0;
        for (size_t row = 0; row < count; row++) {
            Thing &thing = (*self->things)[row];
            thing = Thing();
            thing.object = PyList_GET_ITEM(things, static_cast<Py_ssize_t>(row));
            Py_INCREF(thing.object);
            thing.model = static_cast<const char *>(models.buf)[row];
            thing.moves = thing.model != OBJECT;
            thing.aims = thing.model == CONTROLLED || thing.model == IDM;
            thing.landmark = static_cast<const char *>(flags.buf)[row] != 0;
            std::memcpy(&thing.of, static_cast<const char *>(parameters.buf) + row * sizeof(Parameters), sizeof(Parameters));
            thing.gap_root = 2 * std::sqrt(-thing.of.comfort_acc_max * thing.of.comfort_acc_min);
            self->vehicles += thing.moves;
        }
    }
    PyBuffer_Release(&models);
    PyBuffer_Release(&flags);
    PyBuffer_Release(&parameters);
    return reinterpret_cast<PyObject *>(self);
}

PyObject *traffic_completed(Traffic *self, PyObject *) { return PyLong_FromLong(self->completed); }

PyMethodDef traffic_methods[] = {
    {"read", reinterpret_cast<PyCFunction>(traffic_read), METH_NOARGS, nullptr},
    {"act", reinterpret_cast<PyCFunction>(traffic_act), METH_NOARGS, nullptr},
    {"step", reinterpret_cast<PyCFunction>(traffic_step), METH_O, nullptr},
    {"completed", reinterpret_cast<PyCFunction>(traffic_completed), METH_NOARGS, nullptr},
    {"run", reinterpret_cast<PyCFunction>(traffic_run), METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyType_Slot traffic_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(traffic_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(traffic_dealloc)},
    {Py_tp_methods, traffic_methods},
    {Py_tp_doc, const_cast<char *>("The vehicles and objects of a road.")},
    {0, nullptr},
};
PyType_Spec traffic_spec = {"_crashhunt_highway.Traffic", sizeof(Traffic), 0, Py_TPFLAGS_DEFAULT, traffic_slots};

void network_dealloc(Network *self) {
    delete self->lanes;
    delete self->connected;
    Py_XDECREF(self->keys);
    Py_XDECREF(self->found);
    Py_XDECREF(self->index);
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

// Network(keys, lanes, index, table, connected): the table has 21 numbers for each lane, see `_kernel.py`.
PyObject *network_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *keys, *found, *index, *connected;
    Py_buffer table;
    if (!PyArg_ParseTuple(args, "O!O!O!y*O!", &PyList_Type, &keys, &PyList_Type, &found, &PyDict_Type, &index, &table,
                          &PyList_Type, &connected)) {
        return nullptr;
    }
    const size_t width = 21, count = static_cast<size_t>(PyList_GET_SIZE(keys));
    Network *self = nullptr;
    if (static_cast<size_t>(table.len) != count * width * sizeof(double) ||
        static_cast<size_t>(PyList_GET_SIZE(found)) != count) {
        PyErr_SetString(PyExc_ValueError, "one row of the table is needed for each lane");
    } else {
        self = reinterpret_cast<Network *>(type->tp_alloc(type, 0));
    }
    if (self) {
        self->lanes = new std::vector<Lane>(count);
        self->connected = new std::vector<std::vector<std::pair<int, double>>>();
        self->keys = keys;
        self->found = found;
        self->index = index;
        Py_INCREF(keys);
        Py_INCREF(found);
        Py_INCREF(index);
        for (size_t number = 0; number < count; number++) {
            const double *row = static_cast<const double *>(table.buf) + number * width;
            Lane &lane = (*self->lanes)[number];
            lane = {static_cast<int>(row[0]), row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9],
                    row[10], row[11] != 0, row[12], row[13], row[14], row[15], row[16], row[17],
                    static_cast<int>(row[18]), static_cast<int>(row[19]), static_cast<int>(row[20]), 0};
            lane.id = static_cast<int>(PyLong_AsLong(PyTuple_GetItem(PyList_GET_ITEM(keys, static_cast<Py_ssize_t>(number)), 2)));
        }
        for (Py_ssize_t number = 0; number < PyList_GET_SIZE(connected) && !PyErr_Occurred(); number++) {
            std::vector<std::pair<int, double>> row;
            PyObject *pairs = PyList_GET_ITEM(connected, number);
            for (Py_ssize_t at = 0; at < PyList_Size(pairs); at++) {
                int other;
                double offset;
                if (!PyArg_ParseTuple(PyList_GET_ITEM(pairs, at), "id", &other, &offset)) {
                    break;
                }
                row.emplace_back(other, offset);
            }
            self->connected->push_back(row);
        }
        if (PyErr_Occurred()) {
            Py_CLEAR(self);
        }
    }
    PyBuffer_Release(&table);
    return reinterpret_cast<PyObject *>(self);
}

PyType_Slot network_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(network_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(network_dealloc)},
    {Py_tp_doc, const_cast<char *>("The lanes of a road.")},
    {0, nullptr},
};
PyType_Spec network_spec = {"_crashhunt_highway.Network", sizeof(Network), 0, Py_TPFLAGS_DEFAULT, network_slots};

// bind(float64, int64, ndarray, [sin, cos, ...], fused, exponent_step): NumPy's types and functions.
PyObject *bind(PyObject *, PyObject *args) {
    PyObject *number, *whole, *array, *ufuncs;
    int is_fused;
    Py_ssize_t step;
    if (!PyArg_ParseTuple(args, "OOOO!pn", &number, &whole, &array, &PyList_Type, &ufuncs, &is_fused, &step)) {
        return nullptr;
    }
    if (PyList_GET_SIZE(ufuncs) != FUNCTIONS) {
        PyErr_SetString(PyExc_ValueError, "seven functions are needed");
        return nullptr;
    }
    for (int wanted = 0; wanted < FUNCTIONS; wanted++) {
        const UFunc *ufunc = reinterpret_cast<const UFunc *>(PyList_GET_ITEM(ufuncs, wanted));
        int arguments = wanted == ARCTAN2 || wanted == POWER ? 2 : 1, which = 0;
        if (ufunc->nin != arguments || ufunc->nout != 1 || ufunc->nargs != arguments + 1 || !ufunc->name ||
            std::strcmp(ufunc->name, NAMES[wanted])) {
            PyErr_Format(PyExc_OSError, "NumPy's function %s has an unknown layout", NAMES[wanted]);
            return nullptr;
        }
        for (; which < ufunc->ntypes; which++) {
            const char *types = ufunc->types + which * ufunc->nargs;
            bool all = true;
            for (int argument = 0; argument < ufunc->nargs; argument++) {
                all = all && types[argument] == DOUBLE;
            }
            if (all) {
                break;
            }
        }
        if (which == ufunc->ntypes || !ufunc->functions[which]) {
            PyErr_Format(PyExc_OSError, "NumPy's function %s is not for float64", NAMES[wanted]);
            return nullptr;
        }
        functions[wanted] = {ufunc->functions[which], ufunc->data ? ufunc->data[which] : nullptr};
    }
    Py_INCREF(number);
    Py_XSETREF(numpy_float, number);
    Py_INCREF(whole);
    Py_XSETREF(numpy_int, whole);
    Py_INCREF(array);
    Py_XSETREF(numpy_array, array);
    fused = is_fused;
    exponent_step = step;
    Py_RETURN_NONE;
}

// compute(name, *numbers): the result of one function, for the comparison with NumPy.
PyObject *compute(PyObject *, PyObject *args) {
    const char *name;
    double a, b = 0, c = 0, d = 0;
    if (!PyArg_ParseTuple(args, "sd|ddd", &name, &a, &b, &c, &d)) {
        return nullptr;
    }
    for (int number = 0; number < FUNCTIONS; number++) {
        if (!std::strcmp(name, NAMES[number])) {
            return PyFloat_FromDouble(number == ARCTAN2 || number == POWER ? call(number, a, b) : call(number, a));
        }
    }
    if (!std::strcmp(name, "dot")) {
        return PyFloat_FromDouble(dot(a, b, c, d));
    }
    if (!std::strcmp(name, "remainder")) {
        return PyFloat_FromDouble(remainder_of(a, b));
    }
    PyErr_Format(PyExc_ValueError, "unknown function %s", name);
    return nullptr;
}

PyMethodDef methods[] = {
    {"bind", bind, METH_VARARGS, nullptr},
    {"compute", compute, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_crashhunt_highway", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

bool intern_names() {
    const struct {
        PyObject **place;
        const char *text;
    } names[] = {
        {&s_position, "position"}, {&s_heading, "heading"}, {&s_speed, "speed"}, {&s_lane, "lane"},
        {&s_lane_index, "lane_index"}, {&s_target_lane_index, "target_lane_index"}, {&s_target_speed, "target_speed"},
        {&s_timer, "timer"}, {&s_crashed, "crashed"}, {&s_impact, "impact"}, {&s_action, "action"},
        {&s_steering, "steering"}, {&s_acceleration, "acceleration"}, {&s_route, "route"},
        {&s_enable_lane_change, "enable_lane_change"}, {&s_check_collisions, "check_collisions"},
        {&s_collidable, "collidable"}, {&s_diagonal, "diagonal"}, {&s_follow_road, "follow_road"},
        {&s_handle_collisions, "handle_collisions"},
    };
    for (const auto &name : names) {
        *name.place = PyUnicode_InternFromString(name.text);
        if (!*name.place) {
            return false;
        }
    }
    return true;
}

} // namespace

PyMODINIT_FUNC PyInit__crashhunt_highway() {
    PyObject *module = intern_names() ? PyModule_Create(&definition) : nullptr;
    PyObject *network = module ? PyType_FromSpec(&network_spec) : nullptr;
    PyObject *traffic = network ? PyType_FromSpec(&traffic_spec) : nullptr;
    if (!traffic || PyModule_AddIntConstant(module, "INTERFACE", CRASHHUNT_INTERFACE) ||
        PyModule_AddObjectRef(module, "Network", network) || PyModule_AddObjectRef(module, "Traffic", traffic)) {
        Py_CLEAR(module);
    } else {
        network_type = reinterpret_cast<PyTypeObject *>(network); // keeps the reference
        network = nullptr;
    }
    Py_XDECREF(network);
    Py_XDECREF(traffic);
    return module;
}
