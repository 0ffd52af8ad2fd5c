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
std::unique_ptr<Roster> make_roster(std::vector<std::string> ids, PyObject *lengths, PyObject *widths, PyObject *reaches) {
    auto roster = std::make_unique<Roster>();
    roster->ids = std::move(ids);
    if (!numbers_of(lengths, roster->lengths) || !numbers_of(widths, roster->widths) ||
        !numbers_of(reaches, roster->reaches) || roster->lengths.size() != roster->widths.size() ||
        roster->lengths.size() != roster->reaches.size()) {
        raise(PyExc_TypeError, "lengths, widths and reaches are lists of floats, as many of each");
    }
    return roster;
}

template <> struct From<Vehicles *> {
    static Vehicles *of(PyObject *given) {
        return Py_TYPE(given) == vehicles_type ? reinterpret_cast<Vehicles *>(given)
                                               : (raise(PyExc_TypeError, "these are no vehicles of the core"), nullptr);
    }
};

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
    Columns *self = reinterpret_cast<Columns *>(object);
    PyTypeObject *type = Py_TYPE(object);
    Py_XDECREF(self->vehicles);
    delete self->values;
    type->tp_free(object);
    Py_DECREF(type);
}

template <> struct From<Columns *> {
    static Columns *of(PyObject *given) {
        return Py_TYPE(given) == columns_type ? reinterpret_cast<Columns *>(given)
                                              : (raise(PyExc_TypeError, "these are no columns of the core"), nullptr);
    }
};
template <> Columns &self_of<Columns>(PyObject *object) { return *reinterpret_cast<Columns *>(object); }
PyObject *to_python(Columns *made) { return reinterpret_cast<PyObject *>(made); }

// columns(vehicles, points, headings, speeds) -> Columns | None
std::optional<Columns *> columns(Vehicles *vehicles, PyObject *points, PyObject *headings, PyObject *speeds) {
    std::vector<double> values;
    const bool known = pairs(points, values) && numbers_of(headings, values) && numbers_of(speeds, values);
    if (!known || PyList_GET_SIZE(points) != PyList_GET_SIZE(headings) ||
        PyList_GET_SIZE(points) != PyList_GET_SIZE(speeds)) {
        return {};
    }
    return new_columns(vehicles, std::move(values));
}

PyObject *columns_points(PyObject *object, void *) {
    const Scene scene(&self_of<Columns>(object));
    std::vector<std::tuple<double, double>> points;
    for (size_t row = 0; row < scene.size; row++) {
        points.emplace_back(scene.x(row), scene.y(row));
    }
    return to_python(points);
}

PyObject *columns_headings(PyObject *object, void *) {
    const Scene scene(&self_of<Columns>(object));
    return to_python(std::vector<double>(scene.headings, scene.headings + scene.size));
}

PyObject *columns_speeds(PyObject *object, void *) {
    const Scene scene(&self_of<Columns>(object));
    return to_python(std::vector<double>(scene.speeds, scene.speeds + scene.size));
}

PyObject *columns_recorded(PyObject *object, void *) {
    const std::vector<double> &values = *self_of<Columns>(object).values;
    return PyBytes_FromStringAndSize(reinterpret_cast<const char *>(values.data()),
                                     static_cast<Py_ssize_t>(8 * values.size()));
}

double columns_speed(Columns &columns, long row) {
    const Scene scene(&columns);
    return row < 0 || static_cast<size_t>(row) >= scene.size ? (raise(PyExc_IndexError, "no actor has this row"), 0)
                                                             : scene.speeds[row];
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

template <> Vehicles &self_of<Vehicles>(PyObject *object) { return *reinterpret_cast<Vehicles *>(object); }

Columns *vehicles_read(Vehicles &vehicles) {
    require_bound();
    return new_columns(&vehicles, read_now(*vehicles.roster));
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
PyObject *vehicles_look(Vehicles &vehicles, Vehicles *controlled, double within) {
    require_bound();
    if (coming_or_going() || sumo.on_foot() || !sumo.collisions().empty()) {
        return Py_NewRef(Py_None);
    }
    if (within > 0) {
        around.look(*controlled->roster, within);
        if (!around.same(*vehicles.roster)) {
            return near_names();
        }
    }
    return to_python(vehicles_read(vehicles));
}

// in_sight(controlled: Vehicles, distance squared) -> (ids, eyes) | None
// As Sight._in_sight of sumo/_scene_reader.py: who is near one of the controlled vehicles, and where
// these are.
std::tuple<Ref, std::vector<std::tuple<double, double>>> in_sight(Vehicles *controlled, double within) {
    require_bound();
    around.look(*controlled->roster, within);
    std::vector<std::tuple<double, double>> points;
    for (size_t eye : around.eyes) {
        points.emplace_back(around.places[2 * eye], around.places[2 * eye + 1]);
    }
    return {Ref(near_names()), points};
}
