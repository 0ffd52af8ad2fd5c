// Parts of the observation of one agent, written into one array of float64. A part of core.cpp.
//
// Each function does what a reader of crashhunt/sumo does in Python, by the same expressions in the same order. Where a
// scene has what only Python reads (persons, heights, vehicles that SUMO does not have), it does nothing and says so.

const double NO_VALUE = -1073741824.0; // of libsumo's getters

double known_value(double value) { return value == NO_VALUE ? 0.0 : value; }

// A view of a float64 array, or of one of NumPy's indices, that stays valid as long as it is held.
struct Held {
    Py_buffer buffer = {};
    Held() = default;
    Held(const Held &) = delete;
    ~Held() {
        if (buffer.obj) {
            PyBuffer_Release(&buffer);
        }
    }
    bool hold(PyObject *array) {
        if (PyObject_GetBuffer(array, &buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
            return false;
        }
        if (buffer.itemsize != 8) {
            PyErr_SetString(PyExc_TypeError, "these are no numbers of 8 bytes");
            return false;
        }
        return true;
    }
    size_t count() const { return static_cast<size_t>(buffer.len) / 8; }
    size_t length(int axis) const { return axis < buffer.ndim ? static_cast<size_t>(buffer.shape[axis]) : 0; }
    const double *numbers() const { return static_cast<const double *>(buffer.buf); }
    const int64_t *whole() const { return static_cast<const int64_t *>(buffer.buf); }
};

// The candidates of the lanes around a vehicle, as _Block of sumo/_road_readers.py, with the rows where they are.
struct CandidateLane {
    Held rows; // of a LanePath; not held where there is no lane
    int64_t count = 0, begin = 0, last = 0;
    std::vector<double> x, y, squared; // of the points among which the nearest is
};
struct Lanes {
    std::deque<CandidateLane> lanes;
    double middle_x = 0, middle_y = 0;
};
struct LaneBlock {
    PyObject_HEAD Lanes *lanes;
};
PyTypeObject *lane_block_type = nullptr;
const size_t LANE_COLUMNS = 6; // of a row of a LanePath, which has one more

// The points among which the nearest one is while the vehicle is in the square; as _block_of.
bool set_window(CandidateLane &lane, PyObject *rows, int64_t start, int64_t last, const Lanes &lanes, int64_t window) {
    if (!lane.rows.hold(rows)) {
        return false;
    }
    lane.count = static_cast<int64_t>(lane.rows.length(0));
    if (lane.rows.length(1) != LANE_COLUMNS + 1 || start < 0 || last < start || last >= lane.count || window < 1) {
        PyErr_SetString(PyExc_ValueError, "these are not the points of a lane");
        return false;
    }
    const double *numbers = lane.rows.numbers();
    const auto x = [&](int64_t row) { return numbers[static_cast<size_t>(row) * (LANE_COLUMNS + 1) + 1]; };
    const auto y = [&](int64_t row) { return numbers[static_cast<size_t>(row) * (LANE_COLUMNS + 1) + 2]; };
    int64_t nearest = start;
    double least = HUGE_VAL;
    for (int64_t row = start; row <= last; row++) {
        const double dx = x(row) - lanes.middle_x, dy = y(row) - lanes.middle_y, squared = dx * dx + dy * dy;
        if (squared < least) {
            least = squared;
            nearest = row;
        }
    }
    lane.begin = std::max(start, std::min(nearest - window / 2, last + 1 - window));
    lane.last = last;
    for (int64_t row = lane.begin; row <= std::min(lane.begin + window - 1, last); row++) {
        lane.x.push_back(x(row) - lanes.middle_x);
        lane.y.push_back(y(row) - lanes.middle_y);
        lane.squared.push_back(lane.x.back() * lane.x.back() + lane.y.back() * lane.y.back());
    }
    return true;
}

// LaneBlock([(rows, start, last) | None], middle_x, middle_y, window)
PyObject *lane_block_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *paths, *rows;
    double middle_x, middle_y;
    Py_ssize_t window, start, last;
    if (!PyArg_ParseTuple(arguments, "O!ddn", &PyList_Type, &paths, &middle_x, &middle_y, &window)) {
        return nullptr;
    }
    LaneBlock *self = reinterpret_cast<LaneBlock *>(type->tp_alloc(type, 0));
    if (!self) {
        return nullptr;
    }
    Lanes &lanes = *(self->lanes = new Lanes());
    lanes.middle_x = middle_x;
    lanes.middle_y = middle_y;
    for (Py_ssize_t number = 0; number < PyList_GET_SIZE(paths); number++) {
        PyObject *path = PyList_GET_ITEM(paths, number);
        CandidateLane &lane = (lanes.lanes.emplace_back(), lanes.lanes.back());
        if (path != Py_None && (!PyTuple_CheckExact(path) || !PyArg_ParseTuple(path, "Onn", &rows, &start, &last) ||
                                !set_window(lane, rows, start, last, lanes, window))) {
            if (!PyErr_Occurred()) {
                PyErr_SetString(PyExc_TypeError, "a candidate is a tuple or None");
            }
            Py_DECREF(self);
            return nullptr;
        }
    }
    return reinterpret_cast<PyObject *>(self);
}

struct Draft {
    PyObject_HEAD std::vector<double> *values;
};

std::vector<double> &values_of(PyObject *draft) { return *reinterpret_cast<Draft *>(draft)->values; }

// Draft(size)
PyObject *draft_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    Py_ssize_t size;
    if (!PyArg_ParseTuple(arguments, "n", &size) || size < 0) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_ValueError, "a draft of %zd values", size);
    }
    Draft *self = reinterpret_cast<Draft *>(type->tp_alloc(type, 0));
    if (self) {
        self->values = new std::vector<double>(static_cast<size_t>(size));
    }
    return reinterpret_cast<PyObject *>(self);
}

// Where a part begins; null with an exception where it does not fit.
double *part_at(PyObject *draft, Py_ssize_t place, size_t size) {
    std::vector<double> &values = values_of(draft);
    if (place < 0 || static_cast<size_t>(place) > values.size() || size > values.size() - static_cast<size_t>(place)) {
        PyErr_SetString(PyExc_ValueError, "a part is written beyond the end");
        return nullptr;
    }
    return values.data() + place;
}

// put(place, tuple of numbers)
PyObject *draft_put(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 2 || !PyTuple_CheckExact(given[1])) {
        PyErr_SetString(PyExc_TypeError, "put takes a place and a tuple");
        return nullptr;
    }
    const Py_ssize_t place = PyLong_AsSsize_t(given[0]), size = PyTuple_GET_SIZE(given[1]);
    double *out = PyErr_Occurred() ? nullptr : part_at(draft, place, static_cast<size_t>(size));
    for (Py_ssize_t number = 0; out && number < size; number++) {
        out[number] = PyFloat_AsDouble(PyTuple_GET_ITEM(given[1], number));
        if (out[number] == -1.0 && PyErr_Occurred()) {
            return nullptr;
        }
    }
    return out ? Py_NewRef(Py_None) : nullptr;
}

// put_array(place, array of float64)
PyObject *draft_put_array(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    Held array;
    const Py_ssize_t place = count == 2 ? PyLong_AsSsize_t(given[0]) : -1;
    if (PyErr_Occurred() || count != 2 || !array.hold(given[1])) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "put_array takes a place and an array");
    }
    double *out = part_at(draft, place, array.count());
    if (!out) {
        return nullptr;
    }
    memcpy(out, array.buffer.buf, static_cast<size_t>(array.buffer.len));
    Py_RETURN_NONE;
}

// take() -> bytes: the values, which are 0 from then on
PyObject *draft_take(PyObject *draft, PyObject *) {
    std::vector<double> &values = values_of(draft);
    PyObject *bytes = PyBytes_FromStringAndSize(reinterpret_cast<const char *>(values.data()),
                                                static_cast<Py_ssize_t>(8 * values.size()));
    std::fill(values.begin(), values.end(), 0.0);
    return bytes;
}

struct Seen {
    double squared;
    size_t row;
    double x, y;
    bool operator<(const Seen &other) const {
        return squared != other.squared ? squared < other.squared : row < other.row;
    }
};
std::vector<Seen> seen_actors; // used again

// The actors within a radius, as nearest_actors of simulators/_scene_parts.py; false where that is Python's to do.
bool see(const Scene &scene, size_t row, double radius, size_t limit) {
    seen_actors.clear();
    const std::vector<double> &lengths = scene.roster->lengths;
    double half = lengths[row] / 2;
    const double own_x = scene.x(row) - half * cos(scene.headings[row]);
    const double own_y = scene.y(row) - half * sin(scene.headings[row]);
    for (size_t other = 0; other < scene.size; other++) {
        half = lengths[other] / 2;
        const double x = scene.x(other) - half * cos(scene.headings[other]);
        const double y = scene.y(other) - half * sin(scene.headings[other]);
        const double squared = (x - own_x) * (x - own_x) + (y - own_y) * (y - own_y);
        if (!std::isfinite(squared)) {
            return false;
        }
        if (squared <= radius * radius && other != row) {
            seen_actors.push_back({squared, other, x, y});
        }
    }
    limit = std::min(limit, seen_actors.size());
    std::partial_sort(seen_actors.begin(), seen_actors.begin() + static_cast<std::ptrdiff_t>(limit), seen_actors.end());
    seen_actors.resize(limit);
    return true;
}

// Whether an actor on a lane is before or behind the vehicle on its path; -1 with an exception.
int is_on_path(PyObject *lanes, PyObject *entered, PyObject *ask, PyObject *lane, bool is_behind) {
    int found = PySet_Contains(lanes, lane);
    if (found || !is_behind) {
        return found;
    }
    PyObject *known = PyDict_GetItemWithError(entered, lane); // borrowed
    if (known || PyErr_Occurred()) {
        return known ? PyObject_IsTrue(known) : -1;
    }
    PyObject *answer = PyObject_CallOneArg(ask, lane);
    found = answer ? PyObject_IsTrue(answer) : -1;
    Py_XDECREF(answer);
    return found;
}

// actors(place, columns, row, (kinds, ids), (radius, limit, step_s), last speeds, (lanes, entered, ask)) ->
//     (rows, speeds) | None: the columns of the part `actors`
PyObject *draft_actors(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    const size_t WIDTH = 15;
    Columns *columns = count == 7 ? columns_of(given[1]) : nullptr;
    PyObject *kinds, *ids, *lanes, *entered, *ask;
    double radius, step_s;
    Py_ssize_t limit;
    if (!columns || !PyTuple_CheckExact(given[3]) || !PyTuple_CheckExact(given[4]) || !PyDict_CheckExact(given[5]) ||
        !PyTuple_CheckExact(given[6]) ||
        !PyArg_ParseTuple(given[3], "O!O!", &PyList_Type, &kinds, &PyTuple_Type, &ids) ||
        !PyArg_ParseTuple(given[4], "dnd", &radius, &limit, &step_s) ||
        !PyArg_ParseTuple(given[6], "O!O!O", &PyFrozenSet_Type, &lanes, &PyDict_Type, &entered, &ask) || unbound()) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "these are not the facts of actors");
    }
    const Py_ssize_t place = PyLong_AsSsize_t(given[0]), own = PyLong_AsSsize_t(given[2]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    const Scene scene(columns);
    const std::vector<std::string> &names = scene.roster->ids;
    const size_t row = static_cast<size_t>(own);
    if (!scene.sized() || names.size() != scene.size || own < 0 || row >= scene.size || limit < 0 ||
        static_cast<size_t>(PyList_GET_SIZE(kinds)) != scene.size ||
        static_cast<size_t>(PyTuple_GET_SIZE(ids)) != scene.size || !see(scene, row, radius, static_cast<size_t>(limit))) {
        Py_RETURN_NONE;
    }
    double *out = part_at(draft, place, WIDTH * static_cast<size_t>(limit));
    PyObject *rows = out ? PyTuple_New(static_cast<Py_ssize_t>(seen_actors.size())) : nullptr;
    PyObject *speeds = rows ? PyDict_New() : nullptr;
    if (!speeds) {
        Py_XDECREF(rows);
        return nullptr;
    }
    const double own_cos = cos(scene.headings[row]), own_sin = sin(scene.headings[row]);
    double half = scene.roster->lengths[row] / 2;
    const double own_x = scene.x(row) - half * own_cos, own_y = scene.y(row) - half * own_sin;
    bool good = true;
    const auto refuse = [&]() -> PyObject * {
        std::fill(out, out + WIDTH * static_cast<size_t>(limit), 0.0);
        Py_DECREF(rows);
        Py_DECREF(speeds);
        return PyErr_Occurred() ? nullptr : Py_NewRef(Py_None);
    };
    const std::vector<Seen> found(seen_actors); // what is called below may see others
    for (size_t number = 0; number < found.size(); number++) {
        const Seen &one = found[number];
        const std::string &name = names[one.row];
        PyObject *id = PyTuple_GET_ITEM(ids, static_cast<Py_ssize_t>(one.row)), *lane = nullptr;
        const double heading = scene.headings[one.row], speed = scene.speeds[one.row];
        double offset = 0.0, acceleration = 0.0;
        int signals = 0;
        PyObject *last = PyDict_GetItemWithError(given[5], id); // borrowed
        try {
            lane = text_of(sumo.lane(name));
            offset = known_value(sumo.aside(name));
            acceleration = last ? (speed - PyFloat_AsDouble(last)) / step_s : known_value(sumo.acceleration(name));
            signals = sumo.signals(name);
        } catch (...) { // such as an actor of a recording that is played back
            Py_XDECREF(lane);
            PyErr_Clear();
            return refuse();
        }
        const double ahead = (one.x - own_x) * own_cos + (one.y - own_y) * own_sin;
        const int same = lane ? is_on_path(lanes, entered, ask, lane, ahead < 0.0) : -1;
        Py_XDECREF(lane);
        PyObject *now = same < 0 ? nullptr : PyFloat_FromDouble(speed);
        good = now && PyDict_SetItem(speeds, id, now) == 0 && !PyErr_Occurred();
        Py_XDECREF(now);
        PyObject *index = good ? PyLong_FromSize_t(one.row) : nullptr;
        if (!index) {
            return refuse();
        }
        PyTuple_SET_ITEM(rows, static_cast<Py_ssize_t>(number), index);
        const bool left = signals & 2, right = signals & 1, hazard = signals & 4;
        const double indicator = hazard || (left && right) ? 2.0 : left ? 1.0 : right ? -1.0 : 0.0;
        const double columns_of_actor[WIDTH] = {
            1.0, one.x, one.y, remainder(heading, TAU), speed * cos(heading), speed * sin(heading), acceleration,
            scene.roster->lengths[one.row], scene.roster->widths[one.row],
            PyFloat_AsDouble(PyList_GET_ITEM(kinds, static_cast<Py_ssize_t>(one.row))), same ? 1.0 : 0.0, ahead, offset,
            signals & 8 ? 1.0 : 0.0, indicator};
        memcpy(out + WIDTH * number, columns_of_actor, sizeof columns_of_actor);
    }
    return Py_BuildValue("(NN)", rows, speeds);
}

std::vector<double> distances; // used again
std::vector<std::ptrdiff_t> nearest_points;
std::vector<size_t> chosen_lanes;
std::vector<std::pair<double, size_t>> other_lanes;

// lanes(place, block, x, y, limit, (number of lanes, points, before, stride)): the columns of the part `lanes`
PyObject *draft_lanes(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 6 || Py_TYPE(given[1]) != lane_block_type || !PyTuple_CheckExact(given[5])) {
        PyErr_SetString(PyExc_TypeError, "lanes takes a place, a block, three numbers and a tuple");
        return nullptr;
    }
    Py_ssize_t wanted, points, before, stride;
    const Py_ssize_t place = PyLong_AsSsize_t(given[0]);
    const double x = PyFloat_AsDouble(given[2]), y = PyFloat_AsDouble(given[3]), limit = PyFloat_AsDouble(given[4]);
    if (PyErr_Occurred() || !PyArg_ParseTuple(given[5], "nnnn", &wanted, &points, &before, &stride)) {
        return nullptr;
    }
    const Lanes &lanes = *reinterpret_cast<LaneBlock *>(given[1])->lanes;
    double *out = wanted < 0 || points < 0
                      ? nullptr
                      : part_at(draft, place, static_cast<size_t>(wanted * points) * LANE_COLUMNS);
    if (!out) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_ValueError, "there are no such lanes");
    }
    const double to_x = -2.0 * (x - lanes.middle_x), to_y = -2.0 * (y - lanes.middle_y);
    nearest_points.clear();
    chosen_lanes.clear();
    other_lanes.clear();
    for (size_t number = 0; number < lanes.lanes.size(); number++) {
        const CandidateLane &lane = lanes.lanes[number];
        const double *px = lane.x.data(), *py = lane.y.data(), *ps = lane.squared.data();
        const size_t window = lane.x.size();
        distances.resize(window);
        double *const away = distances.data();
        for (size_t point = 0; point < window; point++) {
            double squared = px[point] * to_x;
            squared += py[point] * to_y;
            squared += ps[point];
            away[point] = squared;
        }
        double least = HUGE_VAL;
        for (size_t point = 0; point < window; point++) {
            least = std::min(least, away[point]);
        }
        if (number >= 3) {
            nearest_points.push_back(0);
            if (least <= limit) {
                other_lanes.emplace_back(least, number);
            }
        } else if (static_cast<Py_ssize_t>(number) < wanted) {
            chosen_lanes.push_back(number);
        }
        if (number < 3 || least <= limit) {
            const auto nearest = std::find(away, away + window, least);
            nearest_points.resize(number + 1);
            nearest_points[number] = nearest - away;
        }
    }
    const size_t others = static_cast<size_t>(std::max<Py_ssize_t>(wanted - 3, 0));
    std::sort(other_lanes.begin(), other_lanes.end());
    for (size_t number = 0; number < std::min(others, other_lanes.size()); number++) {
        chosen_lanes.push_back(other_lanes[number].second);
    }
    for (size_t number : chosen_lanes) {
        const CandidateLane &lane = lanes.lanes[number];
        const int64_t start = lane.begin + nearest_points[number];
        for (int64_t point = 0; point < points; point++, out += LANE_COLUMNS) {
            const int64_t row = start + (point - before) * stride;
            if (row >= 0 && row < lane.count) { // before and behind a lane, and where there is none, are zeros
                memcpy(out, lane.rows.numbers() + static_cast<size_t>(row) * (LANE_COLUMNS + 1), 8 * LANE_COLUMNS);
            }
        }
    }
    Py_RETURN_NONE;
}

// route(place, rows of a path, (begin, last), x, y, (points, stride)): the columns of the part `route`
PyObject *draft_route(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    static const size_t WIDTH = 6, COLUMNS[WIDTH] = {0, 1, 2, 3, 5, 6}; // as _ROUTE_COLUMNS
    Py_ssize_t begin, last, points, stride;
    Held held;
    if (count != 6 || !PyTuple_CheckExact(given[2]) || !PyTuple_CheckExact(given[5]) ||
        !PyArg_ParseTuple(given[2], "nn", &begin, &last) || !PyArg_ParseTuple(given[5], "nn", &points, &stride) ||
        !held.hold(given[1])) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "these are not the points of a path");
    }
    const Py_ssize_t place = PyLong_AsSsize_t(given[0]);
    const double x = PyFloat_AsDouble(given[3]), y = PyFloat_AsDouble(given[4]);
    const Py_ssize_t total = static_cast<Py_ssize_t>(held.length(0));
    const size_t width = held.length(1);
    if (PyErr_Occurred() || begin < 0 || last < begin || last >= total || width != 7 || points < 0 || stride < 1) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_ValueError, "these are not the points of a path");
    }
    double *out = part_at(draft, place, static_cast<size_t>(points) * WIDTH);
    if (!out) {
        return nullptr;
    }
    const double *rows = held.numbers();
    double best = HUGE_VAL;
    Py_ssize_t nearest_row = begin;
    for (Py_ssize_t row = begin; row <= last; row++) {
        const double dx = rows[static_cast<size_t>(row) * width + 1] - x;
        const double dy = rows[static_cast<size_t>(row) * width + 2] - y;
        const double squared = dx * dx + dy * dy;
        if (squared < best) {
            best = squared;
            nearest_row = row;
        }
    }
    for (Py_ssize_t point = 0; point < points && nearest_row + point * stride < total; point++) {
        const double *row = rows + static_cast<size_t>(nearest_row + point * stride) * width;
        for (size_t column : COLUMNS) {
            *out++ = row[column];
        }
    }
    Py_RETURN_NONE;
}

// rows_on_lanes(columns, mapping of lanes) -> list of (row, lane, index on its route, position on the lane, route) |
//     None: the vehicles on these lanes
PyObject *rows_on_lanes(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *columns = count == 2 ? columns_of(given[0]) : nullptr;
    if (!columns || !PyDict_CheckExact(given[1]) || unbound()) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "rows_on_lanes takes columns and lanes");
    }
    const Scene scene(columns);
    const std::vector<std::string> &names = scene.roster->ids;
    if (names.size() != scene.size) {
        Py_RETURN_NONE;
    }
    PyObject *found = PyList_New(0);
    try {
        for (size_t row = 0; found && row < names.size(); row++) {
            PyObject *lane = text_of(sumo.lane(names[row]));
            const int known = lane ? PyDict_Contains(given[1], lane) : -1;
            PyObject *state = known > 0 ? Py_BuildValue("(nOidN)", static_cast<Py_ssize_t>(row), lane,
                                                        sumo.route_index(names[row]), sumo.along(names[row]),
                                                        text_of(sumo.route(names[row])))
                                        : nullptr;
            Py_XDECREF(lane);
            if (known < 0 || (known && (!state || PyList_Append(found, state) < 0))) {
                Py_CLEAR(found);
            }
            Py_XDECREF(state);
        }
    } catch (...) {
        Py_XDECREF(found);
        Py_RETURN_NONE;
    }
    return found;
}

// states(vehicles) -> what libsumo says of them by the functions that are used here alone; None where it refuses
PyObject *vehicle_states(PyObject *, PyObject *given) {
    Vehicles *vehicles = vehicles_of(given);
    if (!vehicles || unbound()) {
        return nullptr;
    }
    PyObject *found = PyList_New(0);
    try {
        for (const std::string &name : vehicles->roster->ids) {
            PyObject *state = found ? Py_BuildValue("(NddiidN)", text_of(sumo.lane(name)), sumo.aside(name),
                                                    sumo.acceleration(name), sumo.signals(name),
                                                    sumo.route_index(name), sumo.along(name), text_of(sumo.route(name)))
                                    : nullptr;
            if (!state || PyList_Append(found, state) < 0) {
                Py_CLEAR(found);
            }
            Py_XDECREF(state);
        }
    } catch (...) {
        Py_XDECREF(found);
        Py_RETURN_NONE;
    }
    return found;
}

PyMethodDef draft_methods[] = {
    {"put", FAST(draft_put), "Write numbers."},
    {"put_array", FAST(draft_put_array), "Write an array."},
    {"actors", FAST(draft_actors),
     "Write the part actors; return the rows in the scene, and the speeds; None where Python has to do it."},
    {"lanes", FAST(draft_lanes), "Write the part lanes."},
    {"route", FAST(draft_route), "Write the part route."},
    {"take", draft_take, METH_NOARGS, "Return what has been written as bytes, and begin again."},
    {nullptr, nullptr, 0, nullptr},
};
PyType_Slot draft_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(draft_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<Draft, &Draft::values>)},
    {Py_tp_methods, draft_methods},
    {Py_tp_doc, const_cast<char *>("An observation that is being written, part by part.")},
    {0, nullptr},
};
PyType_Spec draft_spec = {"_crashhunt_core.Draft", sizeof(Draft), 0, Py_TPFLAGS_DEFAULT, draft_slots};
PyType_Slot lane_block_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(lane_block_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<LaneBlock, &LaneBlock::lanes>)},
    {Py_tp_doc, const_cast<char *>("The candidates of the lanes around a vehicle.")},
    {0, nullptr},
};
PyType_Spec lane_block_spec = {"_crashhunt_core.LaneBlock", sizeof(LaneBlock), 0, Py_TPFLAGS_DEFAULT, lane_block_slots};
