// What every step on SUMO does, compiled: optional, and never another bit than the Python that stands beside each use.
//
// - libsumo's functions are looked up by name in the library that is loaded, so that none of SUMO's headers is needed.
//   What is taken for granted about them (arguments, results, std::string) holds for the versions that
//   crashhunt/native/_core.py lists; a self-test at the start of each process compares with libsumo's own getters.
// - Every expression stands as in Python, in the same order. It is compiled without contraction (a fused multiply-add
//   rounds once instead of twice), and sine and cosine come from the C library, as Python's do.
// - What a function cannot do as Python does it, it does not do: it returns None, and the Python does it.

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <dlfcn.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <exception>
#include <string>
#include <utility>
#include <vector>

namespace {

// ---------------------------------------------------------------------------------------------------- libsumo, by name

// libsumo::TraCIPosition: a result with virtual functions, and three numbers.
struct Result {
    virtual ~Result() {}
};
struct Position : Result {
    double x, y, z;
};
static_assert(sizeof(Position) == 32, "a pointer and three numbers");

typedef Position (*PositionOf)(const std::string &, bool);
typedef double (*NumberOf)(const std::string &);
typedef int (*Count)();
typedef std::vector<std::string> (*Names)();

struct Sumo {
    PositionOf position;
    NumberOf angle, speed;
    Count departed, arrived, vanishing, appearing;
    Names everybody;
    bool bound;
};
Sumo sumo = {};

#define STRING "RKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"

template <typename Function> bool find(void *library, const char *name, Function &function) {
    function = reinterpret_cast<Function>(dlsym(library, name));
    if (!function) {
        PyErr_Format(PyExc_OSError, "libsumo has no %s", name);
    }
    return function != nullptr;
}

PyObject *bind(PyObject *, PyObject *path) {
    PyObject *encoded = nullptr;
    if (!PyUnicode_FSConverter(path, &encoded)) {
        return nullptr;
    }
    void *library = dlopen(PyBytes_AS_STRING(encoded), RTLD_LAZY | RTLD_NOLOAD);
    Py_DECREF(encoded);
    if (!library) {
        PyErr_SetString(PyExc_OSError, "libsumo is not loaded");
        return nullptr;
    }
    Sumo found = {};
    bool whole = find(library, "_ZN7libsumo7Vehicle11getPositionE" STRING "b", found.position) &&
                 find(library, "_ZN7libsumo7Vehicle8getAngleE" STRING, found.angle) &&
                 find(library, "_ZN7libsumo7Vehicle8getSpeedE" STRING, found.speed) &&
                 find(library, "_ZN7libsumo7Vehicle9getIDListB5cxx11Ev", found.everybody) &&
                 find(library, "_ZN7libsumo10Simulation17getDepartedNumberEv", found.departed) &&
                 find(library, "_ZN7libsumo10Simulation16getArrivedNumberEv", found.arrived) &&
                 find(library, "_ZN7libsumo10Simulation25getStartingTeleportNumberEv", found.vanishing) &&
                 find(library, "_ZN7libsumo10Simulation23getEndingTeleportNumberEv", found.appearing);
    dlclose(library); // Python keeps it loaded
    if (!whole) {
        return nullptr;
    }
    found.bound = true;
    sumo = found;
    Py_RETURN_NONE;
}

bool unbound() {
    if (!sumo.bound) {
        PyErr_SetString(PyExc_RuntimeError, "bind has not been called");
    }
    return !sumo.bound;
}

PyObject *is_coming_or_going(PyObject *, PyObject *) {
    if (unbound()) {
        return nullptr;
    }
    try {
        return PyBool_FromLong(sumo.departed() || sumo.arrived() || sumo.vanishing() || sumo.appearing());
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// ------------------------------------------------------------------------------------------------- vehicles of a scene

struct Vehicles {
    PyObject_HEAD std::vector<std::string> *ids;
};

PyObject *vehicles_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *names;
    if (!PyArg_ParseTuple(arguments, "O!", &PyTuple_Type, &names)) {
        return nullptr;
    }
    Vehicles *self = reinterpret_cast<Vehicles *>(type->tp_alloc(type, 0));
    if (!self) {
        return nullptr;
    }
    self->ids = new std::vector<std::string>();
    for (Py_ssize_t row = 0; row < PyTuple_GET_SIZE(names); row++) {
        // As libsumo's own getters take names.
        PyObject *text = PyUnicode_AsEncodedString(PyTuple_GET_ITEM(names, row), "utf-8", "surrogateescape");
        if (!text) {
            Py_DECREF(self);
            return nullptr;
        }
        self->ids->emplace_back(PyBytes_AS_STRING(text), static_cast<size_t>(PyBytes_GET_SIZE(text)));
        Py_DECREF(text);
    }
    return reinterpret_cast<PyObject *>(self);
}

void vehicles_free(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    delete reinterpret_cast<Vehicles *>(object)->ids;
    type->tp_free(object);
    Py_DECREF(type);
}

// A list of which a part has been filled must not be seen by anybody; the garbage collector knows what is empty in it.
PyObject *vehicles_read(PyObject *object, PyObject *) {
    if (unbound()) {
        return nullptr;
    }
    const std::vector<std::string> &ids = *reinterpret_cast<Vehicles *>(object)->ids;
    const Py_ssize_t count = static_cast<Py_ssize_t>(ids.size());
    PyObject *points = PyList_New(count), *headings = PyList_New(count), *speeds = PyList_New(count);
    bool good = points && headings && speeds, ours = true;
    try {
        for (Py_ssize_t row = 0; good && row < count; row++) {
            const std::string &id = ids[static_cast<size_t>(row)];
            const Position place = sumo.position(id, false);
            // SUMO's angles are in degrees, clockwise from north.
            const double heading = (90.0 - sumo.angle(id)) * (3.141592653589793 / 180.0), speed = sumo.speed(id);
            PyObject *x = PyFloat_FromDouble(place.x), *y = PyFloat_FromDouble(place.y);
            PyObject *point = x && y ? PyTuple_New(2) : nullptr;
            if (point) {
                PyTuple_SET_ITEM(point, 0, x);
                PyTuple_SET_ITEM(point, 1, y);
            } else {
                Py_XDECREF(x);
                Py_XDECREF(y);
            }
            PyList_SET_ITEM(points, row, point);
            PyList_SET_ITEM(headings, row, PyFloat_FromDouble(heading));
            PyList_SET_ITEM(speeds, row, PyFloat_FromDouble(speed));
            good = point && PyList_GET_ITEM(headings, row) && PyList_GET_ITEM(speeds, row);
        }
    } catch (...) { // libsumo's own exceptions: its getters raise the same, as Python's
        good = ours = false;
    }
    PyObject *found = good ? PyTuple_Pack(3, points, headings, speeds) : nullptr;
    Py_XDECREF(points);
    Py_XDECREF(headings);
    Py_XDECREF(speeds);
    if (!ours) {
        Py_RETURN_NONE;
    }
    return found;
}

// in_sight(controlled: Vehicles, distance squared) -> (ids, eyes) | None
// As Sight._look_around of crashhunt/simulators/sumo/_sight.py: who is near one of the controlled vehicles, and where
// these are.
PyObject *in_sight(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 2 || strcmp(Py_TYPE(given[0])->tp_name, "_crashhunt_core.Vehicles") != 0) {
        PyErr_SetString(PyExc_TypeError, "in_sight takes vehicles and a number");
        return nullptr;
    }
    const double within = PyFloat_AsDouble(given[1]);
    if (unbound() || PyErr_Occurred()) {
        return nullptr;
    }
    static std::vector<std::string> names;
    static std::vector<double> places;
    std::vector<size_t> eyes;
    places.clear();
    try {
        names = sumo.everybody();
        for (const std::string &name : names) {
            const Position place = sumo.position(name, false);
            places.push_back(place.x);
            places.push_back(place.y);
        }
    } catch (...) {
        Py_RETURN_NONE;
    }
    for (const std::string &eye : *reinterpret_cast<Vehicles *>(given[0])->ids) {
        const size_t row = static_cast<size_t>(std::find(names.begin(), names.end(), eye) - names.begin());
        if (row < names.size()) {
            eyes.push_back(row);
        }
    }
    PyObject *ids = PyList_New(0), *points = PyList_New(0);
    bool good = ids && points;
    for (size_t eye : eyes) {
        PyObject *point = good ? Py_BuildValue("(dd)", places[2 * eye], places[2 * eye + 1]) : nullptr;
        good = point && PyList_Append(points, point) == 0;
        Py_XDECREF(point);
    }
    for (size_t row = 0; good && row < names.size(); row++) {
        for (size_t eye : eyes) {
            const double dx = places[2 * row] - places[2 * eye], dy = places[2 * row + 1] - places[2 * eye + 1];
            if (dx * dx + dy * dy < within) {
                PyObject *id = PyUnicode_DecodeUTF8(names[row].data(), static_cast<Py_ssize_t>(names[row].size()),
                                                    "surrogateescape");
                good = id && PyList_Append(ids, id) == 0;
                Py_XDECREF(id);
                break;
            }
        }
    }
    PyObject *whole = good ? PyList_AsTuple(ids) : nullptr;
    PyObject *found = whole ? PyTuple_Pack(2, whole, points) : nullptr;
    Py_XDECREF(whole);
    Py_XDECREF(ids);
    Py_XDECREF(points);
    return found;
}

// ------------------------------------------------------------------------------------------------------ plain numbers

// Numbers of a Python list of floats; anything else is none of ours.
bool numbers(PyObject *list, std::vector<double> &values) {
    if (!PyList_CheckExact(list)) {
        return false;
    }
    const Py_ssize_t count = PyList_GET_SIZE(list);
    values.resize(static_cast<size_t>(count));
    for (Py_ssize_t row = 0; row < count; row++) {
        PyObject *value = PyList_GET_ITEM(list, row);
        if (!PyFloat_CheckExact(value)) {
            return false;
        }
        values[static_cast<size_t>(row)] = PyFloat_AS_DOUBLE(value);
    }
    return true;
}

// Pairs of floats, as x and y alternating.
bool pairs(PyObject *list, std::vector<double> &values) {
    if (!PyList_CheckExact(list)) {
        return false;
    }
    const Py_ssize_t count = PyList_GET_SIZE(list);
    values.resize(static_cast<size_t>(2 * count));
    for (Py_ssize_t row = 0; row < count; row++) {
        PyObject *point = PyList_GET_ITEM(list, row);
        if (!PyTuple_CheckExact(point) || PyTuple_GET_SIZE(point) != 2) {
            return false;
        }
        for (Py_ssize_t place = 0; place < 2; place++) {
            PyObject *value = PyTuple_GET_ITEM(point, place);
            if (!PyFloat_CheckExact(value)) {
                return false;
            }
            values[static_cast<size_t>(2 * row + place)] = PyFloat_AS_DOUBLE(value);
        }
    }
    return true;
}

// One scene; the vectors are used again, as steps are many and scenes are alike.
struct Scene {
    std::vector<double> points, headings, speeds;

    bool read(PyObject *points_, PyObject *headings_, PyObject *speeds_) {
        return pairs(points_, points) && numbers(headings_, headings) && numbers(speeds_, speeds) &&
               points.size() == 2 * headings.size() && headings.size() == speeds.size();
    }
    size_t size() const { return headings.size(); }
    double x(size_t row) const { return points[2 * row]; }
    double y(size_t row) const { return points[2 * row + 1]; }
};
Scene present, previous;
std::vector<double> lengths, widths, reaches;
typedef std::pair<double, size_t> Near; // squared distance of front bumpers, row; sorted as Python sorts such tuples
std::vector<Near> nearest;

// As Scene.neighbors, of those below a limit, and sorted up to a number of them.
bool find_nearest(const Scene &scene, size_t row, double below, size_t wanted) {
    nearest.clear();
    const double x = scene.x(row), y = scene.y(row);
    for (size_t other = 0; other < scene.size(); other++) {
        const double dx = scene.x(other) - x, dy = scene.y(other) - y;
        const double squared = dx * dx + dy * dy;
        if (std::isnan(squared)) {
            return false; // Python sorts these somehow
        }
        if (other != row && squared < below) {
            nearest.emplace_back(squared, other);
        }
    }
    wanted = std::min(wanted, nearest.size());
    std::partial_sort(nearest.begin(), nearest.begin() + static_cast<std::ptrdiff_t>(wanted), nearest.end());
    return true;
}

// --------------------------------------------------------------------------------------------------- the observation

// observe(points, headings, speeds, lengths, row, others, distance, from_left, lateral_speed) -> bytes | None
PyObject *observe(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 9) {
        PyErr_SetString(PyExc_TypeError, "observe takes nine arguments");
        return nullptr;
    }
    const Py_ssize_t asked = PyLong_AsSsize_t(given[4]), others = PyLong_AsSsize_t(given[5]);
    const double distance = PyFloat_AsDouble(given[6]), from_left = PyFloat_AsDouble(given[7]);
    const double lateral_speed = PyFloat_AsDouble(given[8]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    if (!present.read(given[0], given[1], given[2]) || !numbers(given[3], lengths) ||
        lengths.size() != present.size() || asked < 0 || others < 0 || static_cast<size_t>(asked) >= present.size()) {
        Py_RETURN_NONE;
    }
    const size_t row = static_cast<size_t>(asked), shown = static_cast<size_t>(others);
    if (!find_nearest(present, row, HUGE_VAL, shown)) {
        Py_RETURN_NONE;
    }
    const double heading = present.headings[row], speed = present.speeds[row];
    const double own_cos = cos(heading), own_sin = sin(heading), half = lengths[row] / 2;
    const double center_x = present.x(row) - half * own_cos, center_y = present.y(row) - half * own_sin;
    const double own_vx = speed * own_cos, own_vy = speed * own_sin;
    PyObject *bytes = PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>((shown + 1) * 7 * sizeof(float)));
    if (!bytes) {
        return nullptr;
    }
    char *place = PyBytes_AS_STRING(bytes);
    bool small = true;
    const auto put = [&](const double (&values)[7]) {
        for (double value : values) {
            const float single = static_cast<float>(value);
            small = small && (std::isfinite(single) || !std::isfinite(value)); // struct.pack raises
            memcpy(place, &single, sizeof single);
            place += sizeof single;
        }
    };
    put({1.0, distance, from_left, speed, lateral_speed, own_cos, -own_sin});
    const size_t seen = std::min(shown, nearest.size());
    for (size_t number = 0; number < seen; number++) {
        const size_t other = nearest[number].second;
        const double c = cos(present.headings[other]), s = sin(present.headings[other]);
        const double other_half = lengths[other] / 2, other_speed = present.speeds[other];
        const double dx = present.x(other) - other_half * c - center_x;
        const double dy = present.y(other) - other_half * s - center_y;
        const double vx = other_speed * c - own_vx, vy = other_speed * s - own_vy;
        put({1.0, dx * own_cos + dy * own_sin, dx * own_sin - dy * own_cos, vx * own_cos + vy * own_sin,
             vx * own_sin - vy * own_cos, c * own_cos + s * own_sin, c * own_sin - s * own_cos});
    }
    memset(place, 0, (shown - seen) * 7 * sizeof(float));
    if (!small) {
        Py_DECREF(bytes);
        Py_RETURN_NONE;
    }
    return bytes;
}

// --------------------------------------------------------------------------------------------------- who may touch whom

const double TAU = 6.283185307179586;
const double TOUCH = 1e-9;

struct Rectangle {
    double x, y, heading, length, width;
};

// As outlines_overlap of crashhunt/world/_geometry.py.
bool overlap(const Rectangle &one, const Rectangle &two, double margin) {
    const double c1 = cos(one.heading), s1 = sin(one.heading), c2 = cos(two.heading), s2 = sin(two.heading);
    const double l1 = one.length, w1 = one.width, l2 = two.length, w2 = two.width;
    const double dx = (two.x - l2 / 2 * c2) - (one.x - l1 / 2 * c1);
    const double dy = (two.y - l2 / 2 * s2) - (one.y - l1 / 2 * s1);
    const double along = fabs(c1 * c2 + s1 * s2), across = fabs(c1 * s2 - s1 * c2);
    if (fabs(-dx * s1 + dy * c1) >= (w1 + l2 * across + w2 * along) / 2 - TOUCH + margin) {
        return false;
    }
    if (fabs(dx * c1 + dy * s1) >= (l1 + l2 * along + w2 * across) / 2 - TOUCH + margin) {
        return false;
    }
    if (fabs(-dx * s2 + dy * c2) >= (w2 + l1 * across + w1 * along) / 2 - TOUCH + margin) {
        return false;
    }
    return fabs(dx * c2 + dy * s2) < (l2 + l1 * along + w1 * across) / 2 - TOUCH + margin;
}

Rectangle outline(const Scene &scene, size_t row) {
    return {scene.x(row), scene.y(row), scene.headings[row], lengths[row], widths[row]};
}

struct Moved {
    double x, y, aside;
};

// As _moved of crashhunt/oracles/_crashes.py.
Moved moved(size_t row) {
    const double heading = previous.headings[row];
    const double dx = present.x(row) - previous.x(row), dy = present.y(row) - previous.y(row);
    double aside = 2 * fabs(dy * cos(heading) - dx * sin(heading));
    const double turn = present.headings[row] - heading;
    if (turn != 0.0) {
        aside += fabs(remainder(turn, TAU)) * (reaches[row] + fabs(dx) + fabs(dy));
    }
    return {dx, dy, aside};
}

// within_reach(points, headings, speeds, earlier points, earlier headings, earlier speeds,
//              lengths, widths, reaches, row, further, limit) -> list of rows | None
PyObject *within_reach(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 12) {
        PyErr_SetString(PyExc_TypeError, "within_reach takes twelve arguments");
        return nullptr;
    }
    const Py_ssize_t asked = PyLong_AsSsize_t(given[9]);
    const double further = PyFloat_AsDouble(given[10]), limit = PyFloat_AsDouble(given[11]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    const bool known = present.read(given[0], given[1], given[2]) && previous.read(given[3], given[4], given[5]) &&
                       numbers(given[6], lengths) && numbers(given[7], widths) && numbers(given[8], reaches);
    const size_t size = present.size(), row = static_cast<size_t>(asked);
    if (!known || previous.size() != size || lengths.size() != size || widths.size() != size ||
        reaches.size() != size || asked < 0 || row >= size || !find_nearest(present, row, limit, size)) {
        Py_RETURN_NONE;
    }
    PyObject *found = PyList_New(0);
    if (!found || nearest.empty()) {
        return found;
    }
    const Moved mine = moved(row);
    const Rectangle own = outline(present, row), own_before = outline(previous, row);
    for (const Near &near : nearest) {
        const size_t other = near.second;
        const double reach = reaches[row] + reaches[other];
        if (near.first >= (reach + further) * (reach + further)) {
            continue;
        }
        const Moved theirs = moved(other);
        const double rx = mine.x - theirs.x, ry = mine.y - theirs.y;
        const double margin = sqrt(rx * rx + ry * ry) + mine.aside + theirs.aside;
        if (!(near.first < (reach + margin) * (reach + margin))) {
            continue;
        }
        const Rectangle two = outline(present, other);
        if (!overlap(own, two, margin) ||
            !(overlap(own, two, margin / 2) || overlap(own_before, outline(previous, other), margin / 2))) {
            continue;
        }
        PyObject *number = PyLong_FromSize_t(other);
        if (!number || PyList_Append(found, number) < 0) {
            Py_XDECREF(number);
            Py_DECREF(found);
            return nullptr;
        }
        Py_DECREF(number);
    }
    return found;
}

// least_change(earlier, later) -> float | None: the least of the differences of two lists of numbers; 0 for empty ones
PyObject *least_change(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "least_change takes two arguments");
        return nullptr;
    }
    if (!numbers(given[0], lengths) || !numbers(given[1], widths) || lengths.size() != widths.size()) {
        Py_RETURN_NONE;
    }
    double least = lengths.empty() ? 0.0 : HUGE_VAL;
    for (size_t row = 0; row < lengths.size(); row++) {
        const double change = widths[row] - lengths[row];
        if (std::isnan(change)) {
            Py_RETURN_NONE;
        }
        least = std::min(least, change);
    }
    return PyFloat_FromDouble(least);
}

// ------------------------------------------------------------------------------------------------ the closest approach

const double SLACK = 1e-6; // m, and relative: what NumPy rounds otherwise is far less

// may_be_near(columns, actors, row, lengths, widths, gap, horizon) -> bytes | None
// The conditions of `approaches` in crashhunt/world/_approach.py with some slack: who fulfils them there does so here.
PyObject *may_be_near(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 7) {
        PyErr_SetString(PyExc_TypeError, "may_be_near takes seven arguments");
        return nullptr;
    }
    const Py_ssize_t all = PyLong_AsSsize_t(given[1]), asked = PyLong_AsSsize_t(given[2]);
    const double gap = PyFloat_AsDouble(given[5]), horizon = PyFloat_AsDouble(given[6]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    if (!numbers(given[3], lengths) || !numbers(given[4], widths) || all < 1 || asked < 0 || asked >= all ||
        lengths.size() != static_cast<size_t>(all) || widths.size() != static_cast<size_t>(all)) {
        Py_RETURN_NONE;
    }
    Py_buffer buffer;
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        return nullptr;
    }
    const size_t actors = static_cast<size_t>(all), own = static_cast<size_t>(asked), width = 4 * actors;
    const size_t scenes = static_cast<size_t>(buffer.len) / (8 * width);
    if (buffer.itemsize != 8 || !buffer.format || !strchr(buffer.format, 'd') ||
        static_cast<size_t>(buffer.len) != scenes * 8 * width) {
        PyBuffer_Release(&buffer);
        Py_RETURN_NONE;
    }
    struct Body {
        double x, y, vx, vy, reach, apart;
    };
    static std::vector<Body> bodies;
    static std::vector<int64_t> kept;
    bodies.resize(actors);
    kept.clear();
    for (size_t scene = 0; scene < scenes; scene++) {
        const double *line = static_cast<const double *>(buffer.buf) + scene * width;
        for (size_t actor = 0; actor < actors; actor++) {
            const double heading = line[2 * actors + actor], speed = line[3 * actors + actor];
            const double c = cos(heading), s = sin(heading), half = lengths[actor] / 2;
            bodies[actor] = {line[2 * actor] - half * c, line[2 * actor + 1] - half * s, speed * c, speed * s,
                             std::hypot(half, widths[actor] / 2), 0.0};
        }
        const Body me = bodies[own];
        double best = HUGE_VAL;
        for (size_t actor = 0; actor < actors; actor++) {
            Body &body = bodies[actor];
            body.apart = std::hypot(body.x - me.x, body.y - me.y);
            if (actor != own && body.apart - me.reach - body.reach < gap) {
                best = std::min(best, body.apart - widths[actor] / 2 - widths[own] / 2);
            }
        }
        const size_t before = kept.size();
        for (size_t actor = 0; actor < actors; actor++) {
            if (actor == own) {
                continue;
            }
            const Body &body = bodies[actor];
            const double dx = body.x - me.x, dy = body.y - me.y, vx = body.vx - me.vx, vy = body.vy - me.vy;
            const double reach = me.reach + body.reach, bound = body.apart - reach, slack = SLACK * (1 + body.apart);
            const double speed = sqrt(vx * vx + vy * vy), scale = SLACK * (1 + body.apart) * (1 + speed);
            // Said in the negative: what is not a number is kept, and left to Python.
            const bool far = bound > gap + slack || bound > best + slack;
            const bool harmless = (-(dx * vx + dy * vy) < -scale && body.apart > reach + slack) ||
                                  fabs(dx * vy - dy * vx) > reach * speed + scale || bound > horizon * speed + scale;
            if (!(far && harmless)) {
                if (kept.size() == before) {
                    kept.push_back(static_cast<int64_t>(scene * actors + own));
                }
                kept.push_back(static_cast<int64_t>(scene * actors + actor));
            }
        }
    }
    PyBuffer_Release(&buffer);
    return PyBytes_FromStringAndSize(reinterpret_cast<const char *>(kept.data()),
                                     static_cast<Py_ssize_t>(kept.size() * sizeof(int64_t)));
}

// ---------------------------------------------------------------------------------------------------- the black box

// write_step(buffer, offset, tag, step, time_s, rewards, points, headings, speeds) -> end | None
// A record of a step as BlackBox.step packs it, little-endian as every machine is for which this is built.
PyObject *write_step(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 9) {
        PyErr_SetString(PyExc_TypeError, "write_step takes nine arguments");
        return nullptr;
    }
    const Py_ssize_t offset = PyLong_AsSsize_t(given[1]);
    const long tag = PyLong_AsLong(given[2]);
    const long long step = PyLong_AsLongLong(given[3]);
    const double time_s = PyFloat_AsDouble(given[4]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    PyObject *rewards = given[5];
    if (!present.read(given[6], given[7], given[8]) || !PyTuple_CheckExact(rewards) || tag < 0 || tag > 255) {
        Py_RETURN_NONE;
    }
    const size_t agents = static_cast<size_t>(PyTuple_GET_SIZE(rewards));
    const size_t payload = 8 * (2 + agents + 4 * present.size());
    Py_buffer buffer;
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_WRITABLE) < 0) {
        return nullptr;
    }
    if (offset < 0 || static_cast<size_t>(offset) + 8 + payload > static_cast<size_t>(buffer.len)) {
        PyBuffer_Release(&buffer);
        PyErr_SetString(PyExc_ValueError, "a step is written beyond the end");
        return nullptr;
    }
    char *place = static_cast<char *>(buffer.buf) + offset;
    const auto put = [&](const void *value, size_t size) {
        memcpy(place, value, size);
        place += size;
    };
    const unsigned char head[4] = {static_cast<unsigned char>(tag), 0, 0, 0};
    const uint32_t length = static_cast<uint32_t>(payload);
    const int64_t number = step;
    put(head, 4);
    put(&length, 4);
    put(&number, 8);
    put(&time_s, 8);
    for (size_t agent = 0; agent < agents; agent++) {
        const double reward = PyFloat_AsDouble(PyTuple_GET_ITEM(rewards, static_cast<Py_ssize_t>(agent)));
        if (reward == -1.0 && PyErr_Occurred()) {
            PyBuffer_Release(&buffer);
            return nullptr;
        }
        put(&reward, 8);
    }
    put(present.points.data(), 8 * present.points.size());
    put(present.headings.data(), 8 * present.headings.size());
    put(present.speeds.data(), 8 * present.speeds.size());
    PyBuffer_Release(&buffer);
    return PyLong_FromSize_t(static_cast<size_t>(offset) + 8 + payload);
}

// ---------------------------------------------------------------------------------------------------------- the module

PyMethodDef vehicles_methods[] = {
    {"read", vehicles_read, METH_NOARGS, "Return points, headings (rad) and speeds; None where libsumo refuses."},
    {nullptr, nullptr, 0, nullptr},
};
PyType_Slot vehicles_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(vehicles_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(vehicles_free)},
    {Py_tp_methods, vehicles_methods},
    {Py_tp_doc, const_cast<char *>("Vehicles of the running simulation, by their ids.")},
    {0, nullptr},
};
PyType_Spec vehicles_spec = {"_crashhunt_core.Vehicles", sizeof(Vehicles), 0, Py_TPFLAGS_DEFAULT, vehicles_slots};

#define FAST(function) reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function)), METH_FASTCALL

PyMethodDef functions[] = {
    {"bind", bind, METH_O, "Find libsumo's functions in its library, given by its path."},
    {"is_coming_or_going", is_coming_or_going, METH_NOARGS, "Whether a vehicle has entered or left in the last step."},
    {"in_sight", FAST(in_sight), "Return who is near some vehicles, and where these are; None where libsumo refuses."},
    {"observe", FAST(observe), "Return an observation as bytes."},
    {"within_reach", FAST(within_reach), "Return the rows of those that an actor may have touched."},
    {"least_change", FAST(least_change), "Return the least difference between two lists of numbers."},
    {"may_be_near", FAST(may_be_near), "Return who may have a part in the closest approach, as int64."},
    {"write_step", FAST(write_step), "Write the record of a step; return where it ends."},
    {nullptr, nullptr, 0, nullptr},
};

int fill(PyObject *module) {
    PyObject *type = PyType_FromSpec(&vehicles_spec);
    if (!type || PyModule_AddObject(module, "Vehicles", type) < 0) {
        Py_XDECREF(type);
        return -1;
    }
    return PyModule_AddIntConstant(module, "INTERFACE", CRASHHUNT_INTERFACE);
}

PyModuleDef_Slot slots[] = {{Py_mod_exec, reinterpret_cast<void *>(fill)}, {0, nullptr}};
PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_crashhunt_core", "crashhunt's compiled core.", 0, functions,
                          slots,                 nullptr,           nullptr,                      nullptr};

} // namespace

PyMODINIT_FUNC PyInit__crashhunt_core(void) {
    static_assert(sizeof(double) == 8 && sizeof(float) == 4, "as IEEE 754 has them");
    return PyModuleDef_Init(&definition);
}
