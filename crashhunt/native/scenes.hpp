// Vehicles, where they are in a scene, and which of them are in sight. A part of core.cpp.

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
    if (!numbers_of(lengths, roster->lengths) || !numbers_of(widths, roster->widths) ||
        !numbers_of(reaches, roster->reaches) || roster->lengths.size() != roster->widths.size() ||
        roster->lengths.size() != roster->reaches.size()) {
        Py_DECREF(self);
        return PyErr_Format(PyExc_TypeError, "lengths, widths and reaches are lists of floats, as many of each");
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
        return PyErr_Format(PyExc_TypeError, "columns takes vehicles and three lists");
    }
    std::vector<double> values;
    const bool known = pairs(given[1], values) && numbers_of(given[2], values) && numbers_of(given[3], values);
    if (!known || PyList_GET_SIZE(given[1]) != PyList_GET_SIZE(given[2]) ||
        PyList_GET_SIZE(given[1]) != PyList_GET_SIZE(given[3])) {
        Py_RETURN_NONE;
    }
    return reinterpret_cast<PyObject *>(new_columns(vehicles, std::move(values)));
}

// Other code must not see a list that is filled in part; the garbage collector knows which entries are empty.
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
        return PyErr_Format(PyExc_IndexError, "no actor has this row");
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
// What most steps come to: no actor has come or gone, none is on foot, none has collided. None where any of this is
// otherwise; the ids of all who are near, where there is a distance and these are others than before.
PyObject *vehicles_look(PyObject *object, PyObject *const *given, Py_ssize_t count) {
    Vehicles *controlled = count == 2 ? vehicles_of(given[0]) : nullptr;
    if (!controlled) {
        return PyErr_Format(PyExc_TypeError, "look takes vehicles and a number");
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
// As Sight._in_sight of sumo/_scene_reader.py: who is near one of the controlled vehicles, and where
// these are.
PyObject *in_sight(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Vehicles *controlled = count == 2 ? vehicles_of(given[0]) : nullptr;
    if (!controlled) {
        return PyErr_Format(PyExc_TypeError, "in_sight takes vehicles and a number");
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
