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
#include <deque>
#include <exception>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <unordered_map>
#include <unordered_set>
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
typedef int (*WholeOf)(const std::string &);
typedef std::string (*NameOf)(const std::string &);
typedef double (*NumberAt)(const std::string &, double);
typedef void (*Command)(const std::string &, double);
typedef std::pair<std::string, double> (*NeighborOf)(const std::string &, double);
typedef double (*Number)();
typedef int (*Count)();
typedef std::vector<std::string> (*Names)();

// libsumo::TraCICollision: only whether there is one is asked, but who is given one has to do away with it.
struct Collision {
    std::string collider, victim, collider_type, victim_type;
    double collider_speed, victim_speed;
    std::string type, lane;
    double position;
};
typedef std::vector<Collision> (*Collisions)();

// A vehicle itself, of SUMO's class MSVehicle: looked up once instead of by name for each of its values.
struct Place { // SUMO's Position, which has a destructor, and so is returned by way of memory
    double x, y, z;
    ~Place() {}
};
typedef const void *(*VehicleOf)(const std::string &);
typedef bool (*TruthOf)(const void *);
typedef Place (*PlaceOf)(const void *, double);
typedef double (*ValueOf)(const void *);
typedef double (*Conversion)(double);
typedef const void *(*Singleton)();

struct Sumo {
    PositionOf position;
    NumberOf angle, speed;
    NumberOf driven, aside, aside_speed, along, decel, acceleration, min_gap, speed_limit, length, width;
    WholeOf lane_index, stop_state, signals, route_index;
    NameOf road, lane, route, light, kind;
    NumberAt lane_angle;
    NeighborOf follower, leader;
    Command set_speed;
    Number time;
    Count departed, arrived, vanishing, appearing, parking, unparking, on_foot, emergencies;
    Collisions collisions;
    Names everybody;
    VehicleOf vehicle;
    TruthOf is_visible;
    PlaceOf place;
    ValueOf turned, drives;
    Conversion degrees;
    Singleton net;
    const long long *made; // how many vehicles SUMO has made
    const char *vehicle_table; // that of the virtual functions of MSVehicle, and of nothing derived from it
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
                 find(library, "_ZN7libsumo10Simulation32getParkingStartingVehiclesNumberEv", found.parking) &&
                 find(library, "_ZN7libsumo10Simulation30getParkingEndingVehiclesNumberEv", found.unparking) &&
                 find(library, "_ZN7libsumo6Person10getIDCountEv", found.on_foot) &&
                 find(library, "_ZN7libsumo10Simulation13getCollisionsEv", found.collisions) &&
                 find(library, "_ZN7libsumo10Simulation23getEndingTeleportNumberEv", found.appearing) &&
                 find(library, "_ZN7libsumo10Simulation34getEmergencyStoppingVehiclesNumberEv", found.emergencies) &&
                 find(library, "_ZN7libsumo10Simulation7getTimeEv", found.time) &&
                 find(library, "_ZN7libsumo7Vehicle11getDistanceE" STRING, found.driven) &&
                 find(library, "_ZN7libsumo7Vehicle22getLateralLanePositionE" STRING, found.aside) &&
                 find(library, "_ZN7libsumo7Vehicle15getLateralSpeedE" STRING, found.aside_speed) &&
                 find(library, "_ZN7libsumo7Vehicle15getLanePositionE" STRING, found.along) &&
                 find(library, "_ZN7libsumo7Vehicle8getDecelE" STRING, found.decel) &&
                 find(library, "_ZN7libsumo7Vehicle15getAccelerationE" STRING, found.acceleration) &&
                 find(library, "_ZN7libsumo7Vehicle10getSignalsE" STRING, found.signals) &&
                 find(library, "_ZN7libsumo7Vehicle12getLaneIndexE" STRING, found.lane_index) &&
                 find(library, "_ZN7libsumo7Vehicle13getRouteIndexE" STRING, found.route_index) &&
                 find(library, "_ZN7libsumo7Vehicle10getRouteIDE" STRING, found.route) &&
                 find(library, "_ZN7libsumo7Vehicle12getStopStateE" STRING, found.stop_state) &&
                 find(library, "_ZN7libsumo7Vehicle15getVehicleClassE" STRING, found.kind) &&
                 find(library, "_ZN7libsumo7Vehicle9getLengthE" STRING, found.length) &&
                 find(library, "_ZN7libsumo7Vehicle8getWidthE" STRING, found.width) &&
                 find(library, "_ZN7libsumo7Vehicle9getRoadIDE" STRING, found.road) &&
                 find(library, "_ZN7libsumo7Vehicle9getLaneIDE" STRING, found.lane) &&
                 find(library, "_ZN7libsumo7Vehicle11getFollowerE" STRING "d", found.follower) &&
                 find(library, "_ZN7libsumo7Vehicle9getLeaderE" STRING "d", found.leader) &&
                 find(library, "_ZN7libsumo7Vehicle9getMinGapE" STRING, found.min_gap) &&
                 find(library, "_ZN7libsumo7Vehicle8setSpeedE" STRING "d", found.set_speed) &&
                 find(library, "_ZN7libsumo12TrafficLight22getRedYellowGreenStateE" STRING, found.light) &&
                 find(library, "_ZN7libsumo4Lane11getMaxSpeedE" STRING, found.speed_limit) &&
                 find(library, "_ZN7libsumo4Lane8getAngleE" STRING "d", found.lane_angle) &&
                 find(library, "_ZN7libsumo6Helper10getVehicleE" STRING, found.vehicle) &&
                 find(library, "_ZN7libsumo7Vehicle9isVisibleEPK11SUMOVehicle", found.is_visible) &&
                 find(library, "_ZNK9MSVehicle11getPositionEd", found.place) &&
                 find(library, "_ZNK9MSVehicle8getAngleEv", found.turned) &&
                 find(library, "_ZNK9MSVehicle8getSpeedEv", found.drives) &&
                 find(library, "_ZN10GeomHelper10naviDegreeEd", found.degrees) &&
                 find(library, "_ZN5MSNet11getInstanceEv", found.net) &&
                 find(library, "_ZN13MSBaseVehicle23myCurrentNumericalIndexE", found.made) &&
                 find(library, "_ZTV9MSVehicle", found.vehicle_table);
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

bool coming_or_going() {
    return sumo.departed() || sumo.arrived() || sumo.vanishing() || sumo.appearing() || sumo.parking() ||
           sumo.unparking();
}

PyObject *is_coming_or_going(PyObject *, PyObject *) {
    if (unbound()) {
        return nullptr;
    }
    try {
        return PyBool_FromLong(coming_or_going());
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// --------------------------------------------------------------------------------------------- vehicles, and a scene

PyTypeObject *vehicles_type = nullptr, *columns_type = nullptr; // those of the module that was loaded last

// Numbers of a Python list of floats; anything else is none of ours.
bool numbers_of(PyObject *list, std::vector<double> &values) {
    if (!PyList_CheckExact(list)) {
        return false;
    }
    for (Py_ssize_t row = 0; row < PyList_GET_SIZE(list); row++) {
        PyObject *value = PyList_GET_ITEM(list, row);
        if (!PyFloat_CheckExact(value)) {
            return false;
        }
        values.push_back(PyFloat_AS_DOUBLE(value));
    }
    return true;
}

// Frees an object of Python together with what it holds.
template <typename Object, auto held> void free_object(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    delete (reinterpret_cast<Object *>(object)->*held);
    type->tp_free(object);
    Py_DECREF(type);
}

// A name as libsumo's own getters take it; false with an exception.
bool encode_name(PyObject *name, std::string &encoded) {
    PyObject *text = PyUnicode_AsEncodedString(name, "utf-8", "surrogateescape");
    if (text) {
        encoded.assign(PyBytes_AS_STRING(text), static_cast<size_t>(PyBytes_GET_SIZE(text)));
        Py_DECREF(text);
    }
    return text != nullptr;
}

PyObject *text_of(const std::string &text) {
    return PyUnicode_DecodeUTF8(text.data(), static_cast<Py_ssize_t>(text.size()), "surrogateescape");
}

// Pairs of floats, as x and y alternating.
bool pairs(PyObject *list, std::vector<double> &values) {
    if (!PyList_CheckExact(list)) {
        return false;
    }
    for (Py_ssize_t row = 0; row < PyList_GET_SIZE(list); row++) {
        PyObject *point = PyList_GET_ITEM(list, row);
        if (!PyTuple_CheckExact(point) || PyTuple_GET_SIZE(point) != 2) {
            return false;
        }
        for (Py_ssize_t place = 0; place < 2; place++) {
            PyObject *value = PyTuple_GET_ITEM(point, place);
            if (!PyFloat_CheckExact(value)) {
                return false;
            }
            values.push_back(PyFloat_AS_DOUBLE(value));
        }
    }
    return true;
}

// Who may be in a scene: the ids of the vehicles among them, and the sizes of all.
struct Roster {
    std::vector<std::string> ids;
    std::vector<double> lengths, widths, reaches;
    // The vehicles themselves, as of when they were looked up last; empty where they are of another class of SUMO's.
    mutable std::vector<const void *> found;
    mutable const void *net = nullptr;
};
struct Vehicles {
    PyObject_HEAD Roster *roster;
};

// Numbers of one scene as they are recorded: x and y alternating, all headings, all speeds.
struct Columns {
    PyObject_HEAD Vehicles *vehicles;
    std::vector<double> *values;
};

struct Scene {
    size_t size;
    const double *points, *headings, *speeds;
    const Roster *roster;

    Scene(const std::vector<double> &values, const Roster *who)
        : size(values.size() / 4), points(values.data()), headings(points + 2 * size), speeds(headings + size),
          roster(who) {}
    explicit Scene(const Columns *columns) : Scene(*columns->values, columns->vehicles->roster) {}
    double x(size_t row) const { return points[2 * row]; }
    double y(size_t row) const { return points[2 * row + 1]; }
    bool sized() const { return roster->lengths.size() == size; }
};

// Vehicles(ids, lengths, widths, reaches)
PyObject *vehicles_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *names, *lengths, *widths, *reaches;
    if (!PyArg_ParseTuple(arguments, "O!OOO", &PyTuple_Type, &names, &lengths, &widths, &reaches)) {
        return nullptr;
    }
    Vehicles *self = reinterpret_cast<Vehicles *>(type->tp_alloc(type, 0));
    if (!self) {
        return nullptr;
    }
    Roster *roster = self->roster = new Roster();
    for (Py_ssize_t row = 0; row < PyTuple_GET_SIZE(names); row++) {
        Py_ssize_t size;
        const char *known = PyUnicode_AsUTF8AndSize(PyTuple_GET_ITEM(names, row), &size);
        if (known) {
            roster->ids.emplace_back(known, static_cast<size_t>(size));
            continue;
        }
        PyErr_Clear();
        if (!encode_name(PyTuple_GET_ITEM(names, row), roster->ids.emplace_back())) {
            Py_DECREF(self);
            return nullptr;
        }
    }
    if (!numbers_of(lengths, roster->lengths) || !numbers_of(widths, roster->widths) || !numbers_of(reaches, roster->reaches) ||
        roster->lengths.size() != roster->widths.size() || roster->lengths.size() != roster->reaches.size()) {
        Py_DECREF(self);
        PyErr_SetString(PyExc_TypeError, "lengths, widths and reaches are lists of floats, as many of each");
        return nullptr;
    }
    return reinterpret_cast<PyObject *>(self);
}

Vehicles *vehicles_of(PyObject *object) {
    if (Py_TYPE(object) != vehicles_type) {
        PyErr_SetString(PyExc_TypeError, "these are no vehicles of the core");
        return nullptr;
    }
    return reinterpret_cast<Vehicles *>(object);
}

Columns *new_columns(Vehicles *vehicles, std::vector<double> &&values) {
    Columns *self = reinterpret_cast<Columns *>(columns_type->tp_alloc(columns_type, 0));
    if (self) {
        Py_INCREF(vehicles);
        self->vehicles = vehicles;
        self->values = new std::vector<double>(std::move(values));
    }
    return self;
}

void columns_free(PyObject *object) {
    Py_XDECREF(reinterpret_cast<Columns *>(object)->vehicles);
    free_object<Columns, &Columns::values>(object);
}

Columns *columns_of(PyObject *object) {
    if (Py_TYPE(object) != columns_type) {
        PyErr_SetString(PyExc_TypeError, "these are no columns of the core");
        return nullptr;
    }
    return reinterpret_cast<Columns *>(object);
}

// columns(vehicles, points, headings, speeds) -> Columns | None
PyObject *columns(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Vehicles *vehicles = count == 4 ? vehicles_of(given[0]) : nullptr;
    if (!vehicles) {
        PyErr_SetString(PyExc_TypeError, "columns takes vehicles and three lists");
        return nullptr;
    }
    std::vector<double> values;
    const bool known = pairs(given[1], values) && numbers_of(given[2], values) && numbers_of(given[3], values);
    if (!known || PyList_GET_SIZE(given[1]) != PyList_GET_SIZE(given[2]) ||
        PyList_GET_SIZE(given[1]) != PyList_GET_SIZE(given[3])) {
        Py_RETURN_NONE;
    }
    return reinterpret_cast<PyObject *>(new_columns(vehicles, std::move(values)));
}

// A list of which a part has been filled must not be seen by anybody; the garbage collector knows what is empty in it.
PyObject *list_of(const double *values, size_t size) {
    PyObject *list = PyList_New(static_cast<Py_ssize_t>(size));
    for (size_t row = 0; list && row < size; row++) {
        PyObject *value = PyFloat_FromDouble(values[row]);
        if (!value) {
            Py_CLEAR(list);
        } else {
            PyList_SET_ITEM(list, static_cast<Py_ssize_t>(row), value);
        }
    }
    return list;
}

PyObject *columns_points(PyObject *object, void *) {
    const Scene scene(reinterpret_cast<Columns *>(object));
    PyObject *list = PyList_New(static_cast<Py_ssize_t>(scene.size));
    for (size_t row = 0; list && row < scene.size; row++) {
        PyObject *x = PyFloat_FromDouble(scene.x(row)), *y = PyFloat_FromDouble(scene.y(row));
        PyObject *point = x && y ? PyTuple_New(2) : nullptr;
        if (!point) {
            Py_XDECREF(x);
            Py_XDECREF(y);
            Py_CLEAR(list);
            break;
        }
        PyTuple_SET_ITEM(point, 0, x);
        PyTuple_SET_ITEM(point, 1, y);
        PyList_SET_ITEM(list, static_cast<Py_ssize_t>(row), point);
    }
    return list;
}

PyObject *columns_headings(PyObject *object, void *) {
    const Scene scene(reinterpret_cast<Columns *>(object));
    return list_of(scene.headings, scene.size);
}

PyObject *columns_speeds(PyObject *object, void *) {
    const Scene scene(reinterpret_cast<Columns *>(object));
    return list_of(scene.speeds, scene.size);
}

PyObject *columns_speed(PyObject *object, PyObject *number) {
    const Scene scene(reinterpret_cast<Columns *>(object));
    const Py_ssize_t row = PyLong_AsSsize_t(number);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    if (row < 0 || static_cast<size_t>(row) >= scene.size) {
        PyErr_SetString(PyExc_IndexError, "nobody has this row");
        return nullptr;
    }
    return PyFloat_FromDouble(scene.speeds[row]);
}

// As max(speeds) of Python's, also of what is not a number.
double fastest(const Scene &scene) {
    double most = scene.speeds[0];
    for (size_t row = 1; row < scene.size; row++) {
        if (scene.speeds[row] > most) {
            most = scene.speeds[row];
        }
    }
    return most;
}

// Looks vehicles up by name; throws what libsumo's getters throw.
void find_vehicles(const Roster &roster) {
    roster.found.clear();
    roster.net = sumo.net();
    for (const std::string &id : roster.ids) {
        const void *vehicle = sumo.vehicle(id);
        // The first two words of the table are none of its functions.
        if (*static_cast<const char *const *>(vehicle) != sumo.vehicle_table + 2 * sizeof(void *)) {
            roster.found.clear(); // such as those of sumo-gui
            return;
        }
        roster.found.push_back(vehicle);
    }
}

// What libsumo says about vehicles now; throws what its getters throw.
// Where they are still those that were found last, they are not looked up.
void read_into(const Roster &roster, std::vector<double> &values, bool still = false) {
    const size_t count = roster.ids.size();
    values.resize(4 * count);
    if (!still || roster.net != sumo.net()) {
        find_vehicles(roster);
    }
    for (size_t row = 0; row < count; row++) {
        const std::string &id = roster.ids[row];
        const void *vehicle = roster.found.empty() ? nullptr : roster.found[row];
        if (vehicle && sumo.is_visible(vehicle)) {
            const Place place = sumo.place(vehicle, 0.0);
            values[2 * row] = place.x;
            values[2 * row + 1] = place.y;
            values[2 * count + row] = (90.0 - sumo.degrees(sumo.turned(vehicle))) * (3.141592653589793 / 180.0);
            values[3 * count + row] = sumo.drives(vehicle);
            continue;
        }
        const Position place = sumo.position(id, false);
        values[2 * row] = place.x;
        values[2 * row + 1] = place.y;
        // SUMO's angles are in degrees, clockwise from north.
        values[2 * count + row] = (90.0 - sumo.angle(id)) * (3.141592653589793 / 180.0);
        values[3 * count + row] = sumo.speed(id);
    }
}

std::vector<double> read_now(const Roster &roster) {
    std::vector<double> values;
    read_into(roster, values);
    return values;
}

PyObject *vehicles_read(PyObject *object, PyObject *) {
    if (unbound()) {
        return nullptr;
    }
    Vehicles *self = reinterpret_cast<Vehicles *>(object);
    try {
        return reinterpret_cast<PyObject *>(new_columns(self, read_now(*self->roster)));
    } catch (...) { // libsumo's own exceptions: its getters raise the same, as Python's
        Py_RETURN_NONE;
    }
}

// Who is near one of some vehicles, as numbers of the names, and the numbers of these vehicles.
struct Surroundings {
    std::vector<std::string> names;
    std::vector<double> places;
    std::vector<size_t> eyes, near;

    void look(const Roster &controlled, double within) {
        names = sumo.everybody();
        places.clear();
        eyes.clear();
        near.clear();
        for (const std::string &name : names) {
            const Position place = sumo.position(name, false);
            places.push_back(place.x);
            places.push_back(place.y);
        }
        for (const std::string &eye : controlled.ids) {
            const size_t row = static_cast<size_t>(std::find(names.begin(), names.end(), eye) - names.begin());
            if (row < names.size()) {
                eyes.push_back(row);
            }
        }
        for (size_t row = 0; row < names.size(); row++) {
            for (size_t eye : eyes) {
                const double dx = places[2 * row] - places[2 * eye], dy = places[2 * row + 1] - places[2 * eye + 1];
                if (dx * dx + dy * dy < within) {
                    near.push_back(row);
                    break;
                }
            }
        }
    }

    bool same(const Roster &roster) const {
        if (near.size() != roster.ids.size()) {
            return false;
        }
        for (size_t number = 0; number < near.size(); number++) {
            if (names[near[number]] != roster.ids[number]) {
                return false;
            }
        }
        return true;
    }
};
Surroundings around; // used again: looks are many and alike

// The row of each actor in the scene before; -1 of who was not in it. Empty where all are the same.
typedef std::vector<long> Earlier;

// The names of those near, as Python has them.
PyObject *near_names() {
    PyObject *ids = PyTuple_New(static_cast<Py_ssize_t>(around.near.size()));
    for (size_t number = 0; ids && number < around.near.size(); number++) {
        PyObject *id = text_of(around.names[around.near[number]]);
        if (!id) {
            Py_CLEAR(ids);
        } else {
            PyTuple_SET_ITEM(ids, static_cast<Py_ssize_t>(number), id);
        }
    }
    return ids;
}

// Vehicles.look(controlled: Vehicles, distance squared) -> Columns | ids | None
// What most steps come to: nobody has come or gone, nobody is on foot, nobody has collided. None where any of this is
// otherwise; the ids of all who are near, where there is a distance and these are others than before.
PyObject *vehicles_look(PyObject *object, PyObject *const *given, Py_ssize_t count) {
    Vehicles *controlled = count == 2 ? vehicles_of(given[0]) : nullptr;
    if (!controlled) {
        PyErr_SetString(PyExc_TypeError, "look takes vehicles and a number");
        return nullptr;
    }
    const double within = PyFloat_AsDouble(given[1]);
    if (unbound() || PyErr_Occurred()) {
        return nullptr;
    }
    Vehicles *self = reinterpret_cast<Vehicles *>(object);
    try {
        if (coming_or_going() || sumo.on_foot() || !sumo.collisions().empty()) {
            Py_RETURN_NONE;
        }
        if (within > 0) {
            around.look(*controlled->roster, within);
            if (!around.same(*self->roster)) {
                return near_names();
            }
        }
        return reinterpret_cast<PyObject *>(new_columns(self, read_now(*self->roster)));
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// in_sight(controlled: Vehicles, distance squared) -> (ids, eyes) | None
// As Sight._in_sight of sumo/_range_of_sight.py: who is near one of the controlled vehicles, and where
// these are.
PyObject *in_sight(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Vehicles *controlled = count == 2 ? vehicles_of(given[0]) : nullptr;
    if (!controlled) {
        PyErr_SetString(PyExc_TypeError, "in_sight takes vehicles and a number");
        return nullptr;
    }
    const double within = PyFloat_AsDouble(given[1]);
    if (unbound() || PyErr_Occurred()) {
        return nullptr;
    }
    try {
        around.look(*controlled->roster, within);
    } catch (...) {
        Py_RETURN_NONE;
    }
    PyObject *ids = near_names(), *points = PyList_New(0);
    bool good = ids && points;
    for (size_t eye : around.eyes) {
        PyObject *point = good ? Py_BuildValue("(dd)", around.places[2 * eye], around.places[2 * eye + 1]) : nullptr;
        good = point && PyList_Append(points, point) == 0;
        Py_XDECREF(point);
    }
    PyObject *found = good ? PyTuple_Pack(2, ids, points) : nullptr;
    Py_XDECREF(ids);
    Py_XDECREF(points);
    return found;
}

// ----------------------------------------------------------------------------------------------- those near to each other

typedef std::pair<double, size_t> Near; // squared distance of front bumpers, row; sorted as Python sorts such tuples
std::vector<Near> nearest;

// As Scene.neighbors, of those below a limit, and sorted up to a number of them.
bool find_nearest(const Scene &scene, size_t row, double below, size_t wanted) {
    nearest.clear();
    const double x = scene.x(row), y = scene.y(row);
    for (size_t other = 0; other < scene.size; other++) {
        const double dx = scene.x(other) - x, dy = scene.y(other) - y;
        const double squared = dx * dx + dy * dy;
        if (!std::isfinite(squared)) {
            return false; // Python sorts what is not a number somehow, and what is too far away it cannot pack
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

// As Kinematics.observe in its usual form; null without an exception where that is Python's to do.
PyObject *observed(const Scene &present, size_t row, size_t shown, double distance, double from_left,
                   double lateral_speed) {
    const std::vector<double> &lengths = present.roster->lengths;
    if (!find_nearest(present, row, HUGE_VAL, shown)) {
        return nullptr;
    }
    const double heading = present.headings[row], speed = present.speeds[row];
    const size_t seen = std::min(shown, nearest.size());
    bool whole = std::isfinite(heading); // else Python's sine raises
    for (size_t number = 0; number < seen; number++) {
        whole = whole && std::isfinite(present.headings[nearest[number].second]);
    }
    if (!whole) {
        return nullptr;
    }
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
        Py_CLEAR(bytes);
    }
    return bytes;
}

// observe(columns, row, others, distance, from_left, lateral_speed) -> bytes | None
PyObject *observe(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *columns = count == 6 ? columns_of(given[0]) : nullptr;
    if (!columns) {
        PyErr_SetString(PyExc_TypeError, "observe takes columns and five numbers");
        return nullptr;
    }
    const Py_ssize_t row = PyLong_AsSsize_t(given[1]), others = PyLong_AsSsize_t(given[2]);
    const double distance = PyFloat_AsDouble(given[3]), from_left = PyFloat_AsDouble(given[4]);
    const double lateral_speed = PyFloat_AsDouble(given[5]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    const Scene present(columns);
    if (!present.sized() || row < 0 || others < 0 || static_cast<size_t>(row) >= present.size) {
        Py_RETURN_NONE;
    }
    PyObject *bytes = observed(present, static_cast<size_t>(row), static_cast<size_t>(others), distance, from_left,
                               lateral_speed);
    return bytes || PyErr_Occurred() ? bytes : Py_NewRef(Py_None);
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
    const Roster &roster = *scene.roster;
    return {scene.x(row), scene.y(row), scene.headings[row], roster.lengths[row], roster.widths[row]};
}

struct Moved {
    double x, y, aside;
};

long earlier_row(const Earlier &earlier, size_t row) { return earlier.empty() ? static_cast<long>(row) : earlier[row]; }

// As _moved of oracles/_included_oracles.py.
Moved moved(const Scene &previous, const Scene &present, size_t row, const Earlier &earlier) {
    const long found = earlier_row(earlier, row);
    if (found < 0) {
        return {0.0, 0.0, 0.0};
    }
    const size_t was = static_cast<size_t>(found);
    const double heading = previous.headings[was];
    const double dx = present.x(row) - previous.x(was), dy = present.y(row) - previous.y(was);
    double aside = 2 * fabs(dy * cos(heading) - dx * sin(heading));
    const double turn = present.headings[row] - heading;
    if (turn != 0.0) {
        aside += fabs(remainder(turn, TAU)) * (present.roster->reaches[row] + fabs(dx) + fabs(dy));
    }
    return {dx, dy, aside};
}

// As _within_reach of oracles/_included_oracles.py, of two scenes; false where that is Python's to do.
bool reach(const Scene &present, const Scene &previous, size_t row, double step_s, double hardest,
           std::vector<size_t> &found, const Earlier &earlier = Earlier()) {
    const std::vector<double> &reaches = present.roster->reaches;
    const double further = 2 * (1.5 * (fastest(present) + hardest * step_s) * step_s + 1.0); // as reachable_m has it
    const double most = 2 * *std::max_element(reaches.begin(), reaches.end()) + further;
    found.clear();
    if (!std::isfinite(most * most) || !find_nearest(present, row, most * most, present.size)) {
        return false;
    }
    if (nearest.empty()) {
        return true;
    }
    const Moved mine = moved(previous, present, row, earlier);
    const long was = earlier_row(earlier, row);
    const Rectangle own = outline(present, row), own_before = was < 0 ? own : outline(previous, static_cast<size_t>(was));
    for (const Near &near : nearest) {
        const size_t other = near.second;
        const double reach = reaches[row] + reaches[other];
        if (near.first >= (reach + further) * (reach + further)) {
            continue;
        }
        const Moved theirs = moved(previous, present, other, earlier);
        const double rx = mine.x - theirs.x, ry = mine.y - theirs.y;
        const double margin = sqrt(rx * rx + ry * ry) + mine.aside + theirs.aside;
        if (!std::isfinite(margin)) {
            return false; // such as where a heading is infinite, of which Python's cosine raises
        }
        if (!(near.first < (reach + margin) * (reach + margin))) {
            continue;
        }
        const Rectangle two = outline(present, other);
        const long before = earlier_row(earlier, other);
        if (overlap(own, two, margin) &&
            (overlap(own, two, margin / 2) || was < 0 || before < 0 ||
             overlap(own_before, outline(previous, static_cast<size_t>(before)), margin / 2))) {
            found.push_back(other);
        }
    }
    return true;
}

std::vector<size_t> reached; // used again

// The earlier row of each row, or -1, as a list; false with an exception where it is none.
bool read_earlier(PyObject *list, size_t rows, size_t earlier_rows, Earlier &found) {
    found.clear();
    if (!PyList_CheckExact(list) || static_cast<size_t>(PyList_GET_SIZE(list)) != rows) {
        PyErr_SetString(PyExc_TypeError, "earlier rows are a list with a row, or -1, for each row");
        return false;
    }
    for (size_t row = 0; row < rows; row++) {
        const long was = PyLong_AsLong(PyList_GET_ITEM(list, static_cast<Py_ssize_t>(row)));
        if (was == -1 && PyErr_Occurred()) {
            return false;
        }
        if (was < -1 || was >= static_cast<long>(earlier_rows)) {
            PyErr_SetString(PyExc_IndexError, "there is no such earlier row");
            return false;
        }
        found.push_back(was);
    }
    return true;
}

Earlier rows_before; // used again

// within_reach(columns, earlier columns, row, step_s, hardest, earlier rows | None) -> list of rows | None
PyObject *within_reach(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *columns = count == 6 ? columns_of(given[0]) : nullptr;
    Columns *earlier = columns ? columns_of(given[1]) : nullptr;
    if (!earlier) {
        PyErr_SetString(PyExc_TypeError, "within_reach takes columns twice, three numbers and earlier rows");
        return nullptr;
    }
    const Py_ssize_t asked = PyLong_AsSsize_t(given[2]);
    const double step_s = PyFloat_AsDouble(given[3]), hardest = PyFloat_AsDouble(given[4]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    const Scene present(columns), previous(earlier);
    const size_t row = static_cast<size_t>(asked);
    rows_before.clear(); // empty where the actors are the same
    if (given[5] != Py_None && !read_earlier(given[5], present.size, previous.size, rows_before)) {
        return nullptr;
    }
    if ((given[5] == Py_None && previous.size != present.size) || !present.sized() || !previous.sized() || asked < 0 ||
        row >= present.size || !reach(present, previous, row, step_s, hardest, reached, rows_before)) {
        Py_RETURN_NONE;
    }
    PyObject *found = PyList_New(static_cast<Py_ssize_t>(reached.size()));
    for (size_t number = 0; found && number < reached.size(); number++) {
        PyObject *other = PyLong_FromSize_t(reached[number]);
        if (!other) {
            Py_CLEAR(found);
        } else {
            PyList_SET_ITEM(found, static_cast<Py_ssize_t>(number), other);
        }
    }
    return found;
}

// The least of the changes of speed; 0 where nobody is, and not a number where that is Python's to say.
double least_of(const Scene &earlier, const Scene &later) {
    double least = later.size ? HUGE_VAL : 0.0;
    for (size_t row = 0; row < later.size; row++) {
        const double change = later.speeds[row] - earlier.speeds[row];
        if (std::isnan(change)) {
            return change;
        }
        least = std::min(least, change);
    }
    return least;
}

// least_change(earlier, later) -> float | None: the least of the changes of speed; 0 where nobody is
PyObject *least_change(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *was = count == 2 ? columns_of(given[0]) : nullptr, *is = was ? columns_of(given[1]) : nullptr;
    if (!is) {
        PyErr_SetString(PyExc_TypeError, "least_change takes columns twice");
        return nullptr;
    }
    const Scene earlier(was), later(is);
    if (earlier.size != later.size) {
        Py_RETURN_NONE;
    }
    const double least = least_of(earlier, later);
    return std::isnan(least) ? Py_NewRef(Py_None) : PyFloat_FromDouble(least);
}

// ------------------------------------------------------------------------------------------------ the closest approach

const double SLACK = 1e-6; // m, and relative: what NumPy rounds otherwise is far less
const double MOST_KNOWN = 1e9; // of numbers beyond, what is rounded otherwise may be more

// Successive scenes of one roster, of a Frame: (columns, row or -1, lengths, widths, numbers of the actors). Vehicles may
// stand for the lengths, and None for the widths then, and for numbers that are the rows.
struct Part {
    Py_buffer buffer = {};
    bool held = false;
    size_t scenes = 0, actors = 0;
    Py_ssize_t own = -1;
    std::vector<double> lengths, widths;
    std::vector<int64_t> numbers;

    Part() = default;
    Part(const Part &) = delete;
    Part(Part &&other) noexcept
        : buffer(other.buffer), held(other.held), scenes(other.scenes), actors(other.actors), own(other.own),
          lengths(std::move(other.lengths)), widths(std::move(other.widths)), numbers(std::move(other.numbers)) {
        other.held = false;
    }
    ~Part() {
        if (held) {
            PyBuffer_Release(&buffer);
        }
    }

    // False where it is not what the core knows; with an exception set where it is nothing of the kind.
    bool read(PyObject *given) {
        if (!PyTuple_CheckExact(given) || PyTuple_GET_SIZE(given) != 5) {
            PyErr_SetString(PyExc_TypeError, "a part of an episode has five parts itself");
            return false;
        }
        own = PyLong_AsSsize_t(PyTuple_GET_ITEM(given, 1));
        PyObject *sizes = PyTuple_GET_ITEM(given, 2), *whose = PyTuple_GET_ITEM(given, 4);
        if (Py_TYPE(sizes) == vehicles_type) {
            lengths = reinterpret_cast<Vehicles *>(sizes)->roster->lengths;
            widths = reinterpret_cast<Vehicles *>(sizes)->roster->widths;
        } else if (PyErr_Occurred() || !numbers_of(sizes, lengths) || !numbers_of(PyTuple_GET_ITEM(given, 3), widths)) {
            return false;
        }
        actors = lengths.size();
        if (whose != Py_None && !PyList_CheckExact(whose)) {
            return false;
        }
        for (size_t row = 0; whose == Py_None && row < actors; row++) {
            numbers.push_back(static_cast<int64_t>(row));
        }
        for (Py_ssize_t row = 0; whose != Py_None && row < PyList_GET_SIZE(whose); row++) {
            numbers.push_back(PyLong_AsLongLong(PyList_GET_ITEM(whose, row)));
        }
        if (PyErr_Occurred() || widths.size() != actors || numbers.size() != actors || own < -1 ||
            (own >= 0 && static_cast<size_t>(own) >= actors)) {
            return false;
        }
        if (PyObject_GetBuffer(PyTuple_GET_ITEM(given, 0), &buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
            PyErr_Clear(); // such as one that is not in order
            return false;
        }
        held = true;
        const size_t length = static_cast<size_t>(buffer.len);
        scenes = buffer.ndim == 2 ? static_cast<size_t>(buffer.shape[0]) : 0; // also of scenes without actors
        return buffer.itemsize == 8 && buffer.format && strchr(buffer.format, 'd') && length == scenes * 32 * actors &&
               known();
    }
    // Whether all of it are numbers as there are in traffic.
    bool known() const {
        const double *values = static_cast<const double *>(buffer.buf);
        size_t odd = 0;
        for (size_t place = 0; place < scenes * 4 * actors; place++) {
            odd += !(fabs(values[place]) <= MOST_KNOWN);
        }
        return !odd;
    }
    const double *scene(size_t number) const { return static_cast<const double *>(buffer.buf) + number * 4 * actors; }
};

// All parts of an episode; empty where one is not what the core knows.
bool read_parts(PyObject *list, std::vector<Part> &parts) {
    if (!PyList_CheckExact(list)) {
        PyErr_SetString(PyExc_TypeError, "the parts of an episode are a list");
        return false;
    }
    for (Py_ssize_t number = 0; number < PyList_GET_SIZE(list); number++) {
        Part part;
        if (!part.read(PyList_GET_ITEM(list, number))) {
            return false;
        }
        parts.push_back(std::move(part));
    }
    return true;
}

// Columns of numbers, one after another, as bytes.
template <typename Number> PyObject *bytes_of(const std::vector<std::vector<Number>> &columns) {
    const size_t size = columns[0].size() * sizeof(Number);
    PyObject *bytes = PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>(columns.size() * size));
    char *place = bytes ? PyBytes_AS_STRING(bytes) : nullptr;
    for (const std::vector<Number> &column : columns) {
        if (place && size) {
            memcpy(place, column.data(), size);
            place += size;
        }
    }
    return bytes;
}

PyObject *both(PyObject *one, PyObject *two) {
    PyObject *pair = one && two ? PyTuple_Pack(2, one, two) : nullptr;
    Py_XDECREF(one);
    Py_XDECREF(two);
    return pair;
}

// A pair of outlines as NumPy measures it in crashhunt/world/_geometry.py, up to what that rounds otherwise.
struct Pair {
    double x, y, vx, vy, c, s, one_l, one_w, two_l, two_w; // as seen from the first; c and s of the turn

    // As rectangle_gap.
    double gap() const {
        const double far = fabs(c), wide = fabs(s);
        const double apart = std::max(std::max(fabs(x) - one_l - two_l * far - two_w * wide,
                                               fabs(y) - one_w - two_l * wide - two_w * far),
                                      std::max(fabs(x * c + y * s) - two_l - one_l * far - one_w * wide,
                                               fabs(y * c - x * s) - two_w - one_l * wide - one_w * far));
        if (apart <= 0) {
            return 0;
        }
        const double back_x = -(x * c + y * s), back_y = x * s - y * c;
        double nearest = HUGE_VAL;
        const auto outside = [&](double px, double py, double length, double width) {
            const double dx = std::max(fabs(px) - length, 0.0), dy = std::max(fabs(py) - width, 0.0);
            nearest = std::min(nearest, dx * dx + dy * dy);
        };
        for (int corner = 0; corner < 4; corner++) {
            const double along = corner & 1 ? 1 : -1, across = corner & 2 ? 1 : -1;
            double px = along * two_l, py = across * two_w;
            outside(x + px * c - py * s, y + px * s + py * c, one_l, one_w);
            px = along * one_l, py = across * one_w;
            outside(back_x + px * c + py * s, back_y - px * s + py * c, two_l, two_w);
        }
        return sqrt(nearest);
    }

    // As time_to_contact: from when to when that may be, infinite where they surely never touch within a horizon; sure
    // is whether they do, and now whether they overlap already.
    void contact(double horizon, double &soonest, double &latest, bool &sure, bool &now) const {
        const double far = fabs(c), wide = fabs(s);
        const double axes[4][3] = {{1, 0, one_l + two_l * far + two_w * wide},
                                   {0, 1, one_w + two_l * wide + two_w * far},
                                   {c, s, two_l + one_l * far + one_w * wide},
                                   {-s, c, two_w + one_l * wide + one_w * far}};
        double enter = -HUGE_VAL, leave = HUGE_VAL, loose = SLACK;
        sure = true;
        now = false;
        soonest = latest = HUGE_VAL;
        for (const double(&axis)[3] : axes) {
            const double distance = x * axis[0] + y * axis[1], speed = vx * axis[0] + vy * axis[1], reach = axis[2];
            const double slack = SLACK * (1 + fabs(x) + fabs(y) + reach);
            if (fabs(speed) < SLACK) { // it hardly moves on this axis, for as long as anybody looks
                const double room = reach - fabs(distance), most = slack + SLACK * 4 * horizon;
                if (room < -most) {
                    sure = false;
                    return;
                }
                sure = sure && room > most;
                continue;
            }
            const double first = (-reach - distance) / speed, last = (reach - distance) / speed;
            loose = std::max(loose, slack * (1 + 1 / fabs(speed)) + 1e-9 * (fabs(first) + fabs(last)));
            enter = std::max(enter, std::min(first, last));
            leave = std::min(leave, std::max(first, last));
        }
        if (std::max(enter, 0.0) - loose > leave + loose || enter - loose > horizon) {
            sure = false;
            return;
        }
        now = sure && enter < -loose && leave > loose;
        enter = std::max(enter, 0.0);
        sure = sure && enter + loose < leave - loose && enter + loose < horizon;
        soonest = std::max(0.0, enter - loose);
        latest = enter + loose;
    }
};

// may_be_near(parts, gap, horizon, gap so far, time so far, braking so far, only the best) -> (numbers, places) | None
// The conditions of `approaches` in world/_closest_approach.py with some slack: who fulfils them there does so here.
// Where only the best is asked for, those are left out who are surely not as near, in any way, as somebody else.
PyObject *may_be_near(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 7) {
        PyErr_SetString(PyExc_TypeError, "may_be_near takes parts, five numbers and a truth");
        return nullptr;
    }
    const double gap = PyFloat_AsDouble(given[1]), horizon = PyFloat_AsDouble(given[2]);
    double best_gap = PyFloat_AsDouble(given[3]), best_time = PyFloat_AsDouble(given[4]);
    double best_braking = PyFloat_AsDouble(given[5]);
    const bool only_best = given[6] == Py_True;
    std::vector<Part> parts;
    if (PyErr_Occurred() || !read_parts(given[0], parts)) {
        return PyErr_Occurred() ? nullptr : Py_NewRef(Py_None);
    }
    struct Body {
        double x, y, vx, vy, c, s, reach, within, apart;
    };
    // Who may be near, with what is surely not exceeded: the least gap, the soonest contact, the hardest braking.
    struct Candidate {
        const Part *part;
        const double *line;
        int64_t step;
        size_t actor;
        double gap, time, braking;
    };
    std::vector<Body> bodies;
    std::vector<Candidate> candidates;
    // Nobody who surely touches nobody is sooner or harder than anybody.
    const auto beaten = [&](const Candidate &one) {
        return (one.gap > best_gap || one.gap == HUGE_VAL) && (one.time > best_time || one.time == HUGE_VAL) &&
               (one.braking < best_braking || one.braking == 0);
    };
    int64_t step = -1;
    bool touched = only_best && best_gap == 0 && best_time == 0; // those that overlap are all as near
    for (const Part &part : parts) {
        const size_t actors = part.actors, own = static_cast<size_t>(part.own);
        bodies.resize(actors);
        for (size_t scene = 0; scene < part.scenes; scene++) {
            step++;
            if (part.own < 0) {
                continue;
            }
            const double *line = part.scene(scene);
            for (size_t actor = 0; actor < actors; actor++) {
                const double heading = line[2 * actors + actor], speed = line[3 * actors + actor];
                const double half = part.lengths[actor] / 2, wide = part.widths[actor] / 2;
                double c, s;
                sincos(heading, &s, &c);
                bodies[actor] = {line[2 * actor] - half * c, line[2 * actor + 1] - half * s, speed * c, speed * s, c, s,
                                 sqrt(half * half + wide * wide), std::min(half, wide), 0.0};
            }
            const Body me = bodies[own];
            double best = best_gap;
            for (size_t actor = 0; actor < actors; actor++) {
                Body &body = bodies[actor];
                const double dx = body.x - me.x, dy = body.y - me.y;
                body.apart = sqrt(dx * dx + dy * dy);
                if (actor != own && body.apart - me.reach - body.reach < gap - SLACK * (1 + body.apart)) {
                    best = std::min(best, body.apart - body.within - me.within);
                }
            }
            for (size_t actor = 0; actor < actors; actor++) {
                if (actor == own) {
                    continue;
                }
                const Body &body = bodies[actor];
                const double dx = body.x - me.x, dy = body.y - me.y, vx = body.vx - me.vx, vy = body.vy - me.vy;
                const double reach = me.reach + body.reach, bound = body.apart - reach;
                const double slack = SLACK * (1 + body.apart), speed = sqrt(vx * vx + vy * vy);
                const double scale = SLACK * (1 + body.apart) * (1 + speed);
                // Said in the negative: what is not a number is kept, and left to Python.
                const bool far = bound > gap + slack || bound > best + slack;
                const bool harmless = (-(dx * vx + dy * vy) < -scale && body.apart > reach + slack) ||
                                      fabs(dx * vy - dy * vx) > reach * speed + scale ||
                                      bound > horizon * speed + scale ||
                                      // As near as they come, it is no sooner and no harder than once before.
                                      (bound > slack && bound - slack > best_time * (speed + scale) &&
                                       (speed + scale) * (speed + scale) < 2 * (bound - slack) * best_braking);
                if (far && harmless) {
                    continue;
                }
                const auto stood = [&](size_t one) { // since the scene before, which has been looked at
                    const double *was = line - 4 * actors;
                    return scene && was[2 * one] == line[2 * one] && was[2 * one + 1] == line[2 * one + 1] &&
                           was[2 * actors + one] == line[2 * actors + one] &&
                           was[3 * actors + one] == line[3 * actors + one];
                };
                if (only_best && stood(actor) && stood(own)) {
                    continue;
                }
                Candidate found = {&part, line, step, actor, -HUGE_VAL, -HUGE_VAL, HUGE_VAL};
                if (only_best && std::isfinite(body.apart) && std::isfinite(speed)) {
                    const Pair pair = {dx * me.c + dy * me.s,
                                       dy * me.c - dx * me.s,
                                       vx * me.c + vy * me.s,
                                       vy * me.c - vx * me.s,
                                       body.c * me.c + body.s * me.s,
                                       body.s * me.c - body.c * me.s,
                                       part.lengths[own] / 2,
                                       part.widths[own] / 2,
                                       part.lengths[actor] / 2,
                                       part.widths[actor] / 2};
                    found.gap = far ? HUGE_VAL : pair.gap() - slack;
                    if (!far && bound < gap - slack) {
                        best_gap = std::min(best_gap, found.gap + 2 * slack);
                    }
                    found.time = HUGE_VAL;
                    found.braking = 0;
                    if (!harmless) {
                        double latest;
                        bool sure, now;
                        pair.contact(horizon, found.time, latest, sure, now);
                        if (now && bound < -slack && speed > scale) {
                            if (touched) {
                                continue;
                            }
                            touched = true;
                        }
                        // What NumPy leaves out for being far from a collision course counts for nothing here either.
                        sure = sure && -(dx * vx + dy * vy) > scale && fabs(dx * vy - dy * vx) < reach * speed - scale &&
                               bound < horizon * speed - scale;
                        found.braking = found.time > 0 ? (speed + scale) / (2 * found.time) : HUGE_VAL;
                        if (sure) {
                            best_time = std::min(best_time, latest);
                            best_braking = found.time > 0 ? std::max(best_braking, (speed - scale) / (2 * latest))
                                                          : best_braking;
                        }
                    }
                    if (beaten(found)) {
                        continue;
                    }
                }
                candidates.push_back(found);
            }
        }
    }
    std::vector<std::vector<double>> found(6); // x, y, heading, speed, half length, half width
    std::vector<std::vector<int64_t>> places(2); // the scene, and where the agent is among those found
    const auto keep = [&](const Candidate &one, size_t actor, int64_t agent) {
        const size_t actors = one.part->actors;
        const double values[] = {one.line[2 * actor],          one.line[2 * actor + 1],
                                 one.line[2 * actors + actor], one.line[3 * actors + actor],
                                 one.part->lengths[actor] / 2, one.part->widths[actor] / 2};
        for (size_t column = 0; column < 6; column++) {
            found[column].push_back(values[column]);
        }
        places[0].push_back(one.step);
        places[1].push_back(agent);
    };
    int64_t agent = 0, last = -1;
    for (const Candidate &one : candidates) {
        if (beaten(one)) {
            continue; // by somebody after it
        }
        if (one.step != last) {
            last = one.step;
            agent = static_cast<int64_t>(places[0].size());
            keep(one, static_cast<size_t>(one.part->own), agent);
        }
        keep(one, one.actor, agent);
    }
    return both(bytes_of(found), bytes_of(places));
}

// The way of an agent as _Way of crashhunt/world/_danger.py has it, up to what NumPy rounds otherwise: enough to rule out
// that others touch it.
struct Way {
    struct Outline { // of another actor: the middle, the direction, half sizes, and how far the corners are
        double x, y, c, s, length, width, reach;
    };
    std::vector<double> x, y, heading, along, half_length, half_width, reach;
    double end = 0, spacing = 0;
    bool known = true;

    void add(const double *line, size_t actors, size_t row, double length, double width) {
        const double angle = line[2 * actors + row];
        x.push_back(line[2 * row] - length / 2 * cos(angle));
        y.push_back(line[2 * row + 1] - length / 2 * sin(angle));
        const double turn = heading.empty() ? 0.0 : remainder(angle - heading.back(), TAU);
        known = known && fabs(turn) < 3.0; // NumPy unwraps half a turn to one side or the other
        heading.push_back(heading.empty() ? angle : heading.back() + turn);
        half_length.push_back(length / 2);
        half_width.push_back(width / 2);
        reach.push_back(sqrt(length * length + width * width) / 2);
    }

    void finish(double unknown) {
        double driven = 0;
        for (size_t sample = 0; sample < x.size(); sample++) {
            driven += sample ? std::hypot(x[sample] - x[sample - 1], y[sample] - y[sample - 1]) : 0;
            along.push_back(driven + 1e-9 * static_cast<double>(sample));
        }
        if (x.empty()) {
            return;
        }
        const double last = heading.back();
        x.push_back(x.back() + unknown * cos(last));
        y.push_back(y.back() + unknown * sin(last));
        heading.push_back(last);
        along.push_back(along.back() + unknown);
        end = along.back();
        known = known && std::isfinite(end);
        spacing = std::min(std::max(1.6 * *std::min_element(half_length.begin(), half_length.end()), 1.0), 4.0);
    }

    // How far two outlines are apart, on the axis where that is most.
    double apart(size_t sample, double angle, double dx, double dy, const Outline &other) const {
        double c, s;
        sincos(angle, &s, &c);
        const double turn_c = other.c * c + other.s * s, turn_s = other.s * c - other.c * s;
        const double along_x = dx * c + dy * s, across = dy * c - dx * s, far = fabs(turn_c), wide = fabs(turn_s);
        const double own_l = half_length[sample], own_w = half_width[sample], length = other.length, width = other.width;
        double found = fabs(along_x) - own_l - length * far - width * wide;
        found = std::max(found, fabs(across) - own_w - length * wide - width * far);
        found = std::max(found, fabs(along_x * turn_c + across * turn_s) - length - own_l * far - own_w * wide);
        return std::max(found, fabs(across * turn_c - along_x * turn_s) - width - own_l * wide - own_w * far);
    }

    // Whether an actor may be touched on one of the places that are looked at, ahead of a sample (or behind it, with a
    // negative spacing). What is not a number may.
    bool touches(size_t sample, double gap, double far, const Outline &other) const {
        const double around = reach[sample] + other.reach, slack = SLACK * (1 + fabs(other.x) + fabs(other.y) + end);
        const long places = 3 * (static_cast<long>(far / (3 * fabs(gap))) + 1);
        size_t segment = std::min(sample, along.size() - 2);
        for (long place = 0; place < places;) {
            const double at = along[sample] + gap * static_cast<double>(place);
            if (at > end + slack || at < along[0] - slack) {
                return false;
            }
            while (segment + 2 < along.size() && along[segment + 1] < at) {
                segment++;
            }
            while (segment > 0 && along[segment] > at) {
                segment--;
            }
            const double share = (at - along[segment]) / (along[segment + 1] - along[segment]);
            const double dx = other.x - (x[segment] + share * (x[segment + 1] - x[segment]));
            const double dy = other.y - (y[segment] + share * (y[segment + 1] - y[segment]));
            const double room = sqrt(dx * dx + dy * dy) - around;
            if (room > 2 * far + 100) {
                return false;
            }
            if (room > slack) { // nobody gets there in less than that
                place += std::max(1L, static_cast<long>((room - slack) / fabs(gap)));
                continue;
            }
            const double own = heading[segment] + share * (heading[segment + 1] - heading[segment]);
            if (!(apart(sample, own, dx, dy, other) > slack)) {
                return true;
            }
            place++;
        }
        return false;
    }
};

// tracks(parts, every, within, ahead, behind, unknown) -> (numbers, places) | None, each a pair for the agent and the others
// As `_straight` of crashhunt/world/_tracks.py, of every so many scenes. Where a distance ahead is given, those are left
// out whom the agent would not touch so far ahead of it and behind it, on its way and as much further straight on.
PyObject *tracks(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 6) {
        PyErr_SetString(PyExc_TypeError, "tracks takes parts and five numbers");
        return nullptr;
    }
    const long long every = PyLong_AsLongLong(given[1]);
    const double within = PyFloat_AsDouble(given[2]), ahead = PyFloat_AsDouble(given[3]);
    const double behind = PyFloat_AsDouble(given[4]), unknown = PyFloat_AsDouble(given[5]);
    std::vector<Part> parts;
    if (PyErr_Occurred() || every < 1 || !read_parts(given[0], parts)) {
        return PyErr_Occurred() ? nullptr : Py_NewRef(Py_None);
    }
    std::vector<std::vector<double>> own(5), others(5); // x, y, heading, half length, half width
    std::vector<std::vector<int64_t>> steps(1), pairs(2); // the scene; the sample and whose
    int64_t step = -1, sample = -1;
    Way way;
    if (ahead > 0) {
        for (const Part &part : parts) {
            const size_t row = static_cast<size_t>(part.own);
            for (size_t scene = 0; scene < part.scenes; scene++) {
                step++;
                if (part.own >= 0 && step % every == 0) {
                    way.add(part.scene(scene), part.actors, row, part.lengths[row], part.widths[row]);
                }
            }
        }
        way.finish(unknown);
        step = -1;
    }
    const bool chosen = ahead > 0 && way.known;
    for (const Part &part : parts) {
        const size_t actors = part.actors, row = static_cast<size_t>(part.own);
        for (size_t scene = 0; scene < part.scenes; scene++) {
            step++;
            if (part.own < 0 || step % every) {
                continue;
            }
            sample++;
            const double *line = part.scene(scene);
            const auto put = [&](std::vector<std::vector<double>> &columns, size_t actor) {
                columns[0].push_back(line[2 * actor]);
                columns[1].push_back(line[2 * actor + 1]);
                columns[2].push_back(line[2 * actors + actor]);
                columns[3].push_back(part.lengths[actor] / 2);
                columns[4].push_back(part.widths[actor] / 2);
            };
            put(own, row);
            steps[0].push_back(step);
            for (size_t actor = 0; actor < actors; actor++) {
                const double dx = line[2 * actor] - line[2 * row], dy = line[2 * actor + 1] - line[2 * row + 1];
                const double reach = within + 2 * (part.lengths[actor] / 2) + 2 * (part.lengths[row] / 2);
                if (actor != row && dx * dx + dy * dy < reach * reach) {
                    if (chosen) {
                        const size_t number = static_cast<size_t>(sample);
                        const double half = part.lengths[actor] / 2, wide = part.widths[actor] / 2;
                        double c, s;
                        sincos(line[2 * actors + actor], &s, &c);
                        const Way::Outline other = {line[2 * actor] - half * c, line[2 * actor + 1] - half * s, c, s,
                                                    half, wide, sqrt(half * half + wide * wide)};
                        if (!way.touches(number, way.spacing, ahead, other) &&
                            !way.touches(number, -way.spacing, behind, other)) {
                            continue;
                        }
                    }
                    put(others, actor);
                    pairs[0].push_back(sample);
                    pairs[1].push_back(part.numbers[actor]);
                }
            }
        }
    }
    return both(both(bytes_of(own), bytes_of(steps)), both(bytes_of(others), bytes_of(pairs)));
}

// ---------------------------------------------------------------------------------------------------- the black box

// Where a process is, as the end of the header says: the last four of BlackBox's.
void say_where(char *start, size_t committed, long long step, int phase, uint32_t agent) {
    const uint64_t until = committed;
    const int64_t number = step;
    const int32_t what = phase;
    memcpy(start + 32, &until, 8);
    memcpy(start + 40, &number, 8);
    memcpy(start + 48, &what, 4);
    memcpy(start + 52, &agent, 4);
}

// A record of bytes, padded; returns where it ends.
size_t put_record(char *start, size_t offset, long tag, long agent, const void *data, size_t length) {
    char *place = start + offset;
    const size_t padding = -length & 7;
    const unsigned char head[2] = {static_cast<unsigned char>(tag), 0};
    const uint16_t whose = static_cast<uint16_t>(agent);
    const uint32_t size = static_cast<uint32_t>(length);
    memcpy(place, head, 2);
    memcpy(place + 2, &whose, 2);
    memcpy(place + 4, &size, 4);
    memcpy(place + 8, data, length);
    memset(place + 8 + length, 0, padding);
    return offset + 8 + length + padding;
}

// A record of a step but for the rewards, for which room is left; returns where these go.
char *put_step(char *place, long tag, long long step, double time_s, size_t agents, const std::vector<double> &values) {
    const auto put = [&](const void *value, size_t size) {
        memcpy(place, value, size);
        place += size;
    };
    const unsigned char head[4] = {static_cast<unsigned char>(tag), 0, 0, 0};
    const uint32_t length = static_cast<uint32_t>(8 * (2 + agents + values.size()));
    const int64_t number = step;
    put(head, 4);
    put(&length, 4);
    put(&number, 8);
    put(&time_s, 8);
    std::copy_n(reinterpret_cast<const char *>(values.data()), 8 * values.size(), place + 8 * agents);
    return place;
}

// write_array(buffer, offset, tag, agent, array, step, phase) -> end | None
// A record of an array as BlackBox._raw packs it.
PyObject *write_array(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 7) {
        PyErr_SetString(PyExc_TypeError, "write_array takes a buffer, an array and five numbers");
        return nullptr;
    }
    const Py_ssize_t offset = PyLong_AsSsize_t(given[1]);
    const long tag = PyLong_AsLong(given[2]), agent = PyLong_AsLong(given[3]), phase = PyLong_AsLong(given[6]);
    const long long step = PyLong_AsLongLong(given[5]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    Py_buffer array, buffer;
    if (PyObject_GetBuffer(given[4], &array, PyBUF_C_CONTIGUOUS) < 0) {
        PyErr_Clear(); // such as one that is not in order
        Py_RETURN_NONE;
    }
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_WRITABLE) < 0) {
        PyBuffer_Release(&array);
        return nullptr;
    }
    const size_t length = static_cast<size_t>(array.len), padding = -length & 7;
    const bool fits = offset >= 64 && buffer.len >= offset &&
                      length + padding + 8 <= static_cast<size_t>(buffer.len - offset) && length <= UINT32_MAX &&
                      tag >= 0 && tag <= 255 && agent >= 0 && agent <= 65535;
    if (fits) {
        char *start = static_cast<char *>(buffer.buf);
        const size_t end = put_record(start, static_cast<size_t>(offset), tag, agent, array.buf, length);
        say_where(start, end, step, static_cast<int>(phase), static_cast<uint32_t>(agent));
    }
    PyBuffer_Release(&array);
    PyBuffer_Release(&buffer);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "an array is written beyond the end");
        return nullptr;
    }
    return PyLong_FromSize_t(static_cast<size_t>(offset) + 8 + length + padding);
}

// changes_of(earlier, now) -> bytes
// Which words differ, as numpy.packbits writes bits, and then the words of the second that do.
PyObject *changes_of(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Py_buffer before, now;
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "changes_of takes two arrays");
        return nullptr;
    }
    if (PyObject_GetBuffer(given[0], &before, PyBUF_SIMPLE) < 0) {
        return nullptr;
    }
    if (PyObject_GetBuffer(given[1], &now, PyBUF_SIMPLE) < 0) {
        PyBuffer_Release(&before);
        return nullptr;
    }
    const size_t words = static_cast<size_t>(now.len) / 8, bytes = (words + 7) / 8;
    PyObject *found = nullptr;
    if (before.len != now.len || now.len % 8) {
        PyErr_SetString(PyExc_ValueError, "the arrays have different lengths, or no whole words");
    } else {
        std::vector<char> out(bytes + 8 * words, 0);
        const char *was = static_cast<const char *>(before.buf), *is = static_cast<const char *>(now.buf);
        char *end = out.data() + bytes;
        for (size_t group = 0; group < bytes; ++group) {
            const size_t first = 8 * group, last = std::min(first + 8, words);
            if (!memcmp(was + 8 * first, is + 8 * first, 8 * (last - first))) {
                continue;
            }
            unsigned mask = 0;
            for (size_t word = first; word < last; ++word) {
                if (memcmp(was + 8 * word, is + 8 * word, 8)) {
                    mask |= 128u >> (word - first);
                    memcpy(end, is + 8 * word, 8);
                    end += 8;
                }
            }
            out[group] = static_cast<char>(mask);
        }
        found = PyBytes_FromStringAndSize(out.data(), end - out.data());
    }
    PyBuffer_Release(&before);
    PyBuffer_Release(&now);
    return found;
}

// write_step(buffer, offset, tag, step, time_s, rewards, columns, phase) -> end | None
// A record of a step as BlackBox.step packs it, little-endian as every machine is for which this is built.
PyObject *write_step(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *columns = count == 8 ? columns_of(given[6]) : nullptr;
    if (!columns) {
        PyErr_SetString(PyExc_TypeError, "write_step takes a buffer, six more and columns");
        return nullptr;
    }
    const Py_ssize_t offset = PyLong_AsSsize_t(given[1]);
    const long tag = PyLong_AsLong(given[2]);
    const long long step = PyLong_AsLongLong(given[3]);
    const double time_s = PyFloat_AsDouble(given[4]);
    const long phase = PyLong_AsLong(given[7]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    PyObject *rewards = given[5];
    const std::vector<double> &values = *columns->values;
    if (!PyTuple_CheckExact(rewards) || tag < 0 || tag > 255) {
        Py_RETURN_NONE;
    }
    const size_t agents = static_cast<size_t>(PyTuple_GET_SIZE(rewards));
    const size_t payload = 8 * (2 + agents + values.size());
    Py_buffer buffer;
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_WRITABLE) < 0) {
        return nullptr;
    }
    if (offset < 64 || static_cast<size_t>(offset) + 8 + payload > static_cast<size_t>(buffer.len)) {
        PyBuffer_Release(&buffer);
        PyErr_SetString(PyExc_ValueError, "a step is written beyond the end");
        return nullptr;
    }
    char *place = put_step(static_cast<char *>(buffer.buf) + offset, tag, step, time_s, agents, values);
    for (size_t agent = 0; agent < agents; agent++) {
        const double reward = PyFloat_AsDouble(PyTuple_GET_ITEM(rewards, static_cast<Py_ssize_t>(agent)));
        if (reward == -1.0 && PyErr_Occurred()) {
            PyBuffer_Release(&buffer);
            return nullptr;
        }
        memcpy(place + 8 * agent, &reward, 8);
    }
    say_where(static_cast<char *>(buffer.buf), static_cast<size_t>(offset) + 8 + payload, step,
              static_cast<int>(phase), 0);
    PyBuffer_Release(&buffer);
    return PyLong_FromSize_t(static_cast<size_t>(offset) + 8 + payload);
}

#define FAST(function) reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function)), METH_FASTCALL

#include "observed_parts.hpp"
#include "fast_step.hpp"

// ---------------------------------------------------------------------------------------------------------- the module

PyMethodDef vehicles_methods[] = {
    {"read", vehicles_read, METH_NOARGS, "Return where everybody is; None where libsumo refuses."},
    {"look", FAST(vehicles_look), "Return where everybody is; None where anything else has happened."},
    {nullptr, nullptr, 0, nullptr},
};
PyType_Slot vehicles_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(vehicles_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<Vehicles, &Vehicles::roster>)},
    {Py_tp_methods, vehicles_methods},
    {Py_tp_doc, const_cast<char *>("Vehicles of the running simulation, by their ids.")},
    {0, nullptr},
};
PyMethodDef columns_methods[] = {
    {"speed", columns_speed, METH_O, "Return the speed of a row."},
    {nullptr, nullptr, 0, nullptr},
};
PyGetSetDef columns_getters[] = {
    {"points", columns_points, nullptr, "A new list of x and y.", nullptr},
    {"headings", columns_headings, nullptr, "A new list.", nullptr},
    {"speeds", columns_speeds, nullptr, "A new list.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};
PyType_Slot columns_slots[] = {
    {Py_tp_dealloc, reinterpret_cast<void *>(columns_free)},
    {Py_tp_methods, columns_methods},
    {Py_tp_getset, columns_getters},
    {Py_tp_doc, const_cast<char *>("Where everybody in a scene is.")},
    {0, nullptr},
};
PyType_Spec columns_spec = {"_crashhunt_core.Columns", sizeof(Columns), 0,
                            Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, columns_slots};
PyType_Spec vehicles_spec = {"_crashhunt_core.Vehicles", sizeof(Vehicles), 0, Py_TPFLAGS_DEFAULT, vehicles_slots};

PyMethodDef functions[] = {
    {"bind", bind, METH_O, "Find libsumo's functions in its library, given by its path."},
    {"is_coming_or_going", is_coming_or_going, METH_NOARGS, "Whether a vehicle has entered or left in the last step."},
    {"in_sight", FAST(in_sight), "Return who is near some vehicles, and where these are; None where libsumo refuses."},
    {"columns", FAST(columns), "Return lists as columns; None where they are none of numbers."},
    {"vehicle_states", vehicle_states, METH_O, "Return what is read of vehicles for observations, to be compared."},
    {"light_state", light_state, METH_O, "Return what the links of a traffic light show, to be compared."},
    {"observe", FAST(observe), "Return an observation as bytes."},
    {"within_reach", FAST(within_reach), "Return the rows of those that an actor may have touched."},
    {"least_change", FAST(least_change), "Return the least change of speed between two scenes."},
    {"may_be_near", FAST(may_be_near), "Return who may have a part in the closest approach."},
    {"tracks", FAST(tracks), "Return the way of an agent, and who was near it."},
    {"write_array", FAST(write_array), "Write the record of an array; return where it ends."},
    {"changes_of", FAST(changes_of), "Return where two arrays of words differ, and the changed words."},
    {"write_step", FAST(write_step), "Write the record of a step; return where it ends."},
    {nullptr, nullptr, 0, nullptr},
};

int fill(PyObject *module) {
    for (PyType_Spec *spec : {&vehicles_spec, &columns_spec, &usual_spec, &draft_spec, &lane_block_spec,
                              &streams_spec}) {
        PyObject *type = PyType_FromSpec(spec);
        if (!type || PyModule_AddObjectRef(module, strrchr(spec->name, '.') + 1, type) < 0) {
            Py_XDECREF(type);
            return -1;
        }
        // Never given back: columns may outlive the module.
        if (spec == &vehicles_spec) {
            vehicles_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &columns_spec) {
            columns_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &lane_block_spec) {
            lane_block_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &streams_spec) {
            streams_type = reinterpret_cast<PyTypeObject *>(type);
        } else if (spec == &draft_spec) {
            draft_type = reinterpret_cast<PyTypeObject *>(type);
        }
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
