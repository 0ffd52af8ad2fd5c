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
    int64_t count = 0, begin = 0;
    std::vector<double> points; // all x, all y, all squared distances of the points among which the nearest is
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
bool set_window(CandidateLane &lane, PyObject *rows, PyObject *places, int64_t start, int64_t last, const Lanes &lanes,
                int64_t window) {
    Held points;
    if (!lane.rows.hold(rows) || !points.hold(places)) {
        return false;
    }
    lane.count = static_cast<int64_t>(lane.rows.length(0));
    if (lane.rows.length(1) != LANE_COLUMNS + 1 || points.length(0) != 2 || points.length(1) != lane.rows.length(0) ||
        start < 0 || last < start || last >= lane.count || window < 1) {
        PyErr_SetString(PyExc_ValueError, "these are not the points of a lane");
        return false;
    }
    const double *x = points.numbers(), *y = x + lane.count;
    int64_t nearest = start;
    double least = HUGE_VAL;
    for (int64_t row = start; row <= last; row++) {
        const double dx = x[row] - lanes.middle_x, dy = y[row] - lanes.middle_y, squared = dx * dx + dy * dy;
        if (squared < least) {
            least = squared;
            nearest = row;
        }
    }
    lane.begin = std::max(start, std::min(nearest - window / 2, last + 1 - window));
    const size_t count = static_cast<size_t>(std::min(lane.begin + window - 1, last) + 1 - lane.begin);
    lane.points.resize(3 * count);
    double *to_x = lane.points.data(), *to_y = to_x + count, *squared = to_y + count;
    for (size_t point = 0; point < count; point++) {
        to_x[point] = x[static_cast<size_t>(lane.begin) + point] - lanes.middle_x;
        to_y[point] = y[static_cast<size_t>(lane.begin) + point] - lanes.middle_y;
        squared[point] = to_x[point] * to_x[point] + to_y[point] * to_y[point];
    }
    return true;
}

// LaneBlock([(rows, places, start, last) | None], middle_x, middle_y, window)
PyObject *lane_block_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *paths, *rows, *places;
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
        if (path != Py_None && (!PyTuple_CheckExact(path) ||
                                !PyArg_ParseTuple(path, "OOnn", &rows, &places, &start, &last) ||
                                !set_window(lane, rows, places, start, last, lanes, window))) {
            if (!PyErr_Occurred()) {
                PyErr_SetString(PyExc_TypeError, "a candidate is a tuple or None");
            }
            Py_DECREF(self);
            return nullptr;
        }
    }
    return reinterpret_cast<PyObject *>(self);
}

// An object of Python that stays as long as it is held.
struct Kept {
    PyObject *object;
    explicit Kept(PyObject *given) : object(Py_NewRef(given)) {}
    Kept(const Kept &) = delete;
    ~Kept() { Py_DECREF(object); }
};

// What a step shows to the agent, and where its vehicle is.
struct Here {
    const Scene &scene;
    size_t row;
    double time_s, along, x, y; // of the vehicle: its position on the lane, and its middle
    mutable std::vector<std::string> lanes; // of the vehicles whose lane was read

    Here(const Scene &present, size_t own, double now_s, double position)
        : scene(present), row(own), time_s(now_s), along(position), lanes(scene.size) {
        const double half = scene.roster->lengths[row] / 2;
        x = scene.x(row) - half * cos(scene.headings[row]);
        y = scene.y(row) - half * sin(scene.headings[row]);
    }
    const std::string &lane_of(size_t actor) const {
        std::string &lane = lanes[actor];
        if (lane.empty()) {
            lane = sumo.lane(scene.roster->ids[actor]);
        }
        return lane;
    }
};

// A part of an observation, as long as the vehicle is on the same lane and route with the same actors around it.
struct Written {
    size_t place = 0;
    virtual ~Written() {}
    virtual size_t size() const = 0;
    // Writes the columns, where there are zeros; false where that is Python's to do. Nothing is noted yet.
    virtual bool write(const Here &here, double *out) = 0;
    // Notes what the next step needs; false with an exception.
    virtual bool note(const Here &) { return true; }
};

// An observation that is being written, and what it consists of in the steps that follow.
struct Observation {
    size_t size = 0;
    std::string agent;
    PyObject *bytes = nullptr;
    // of the step that has been written last by way of Python, and where the vehicle was
    Columns *columns = nullptr;
    Vehicles *vehicles = nullptr; // those of the columns, or who is in sight since
    size_t row = 0;
    double time_s = 0, along = 0;
    int number = 0;
    std::string lane, route;
    std::vector<std::unique_ptr<Written>> parts;
    bool usable = false; // whether the parts can be written again
    bool rest = false;   // whether there are others, which Python writes
    bool going_on = false; // whether Python has yet to write these

    Observation() = default;
    Observation(const Observation &) = delete;
    ~Observation() {
        Py_XDECREF(bytes);
        Py_XDECREF(reinterpret_cast<PyObject *>(columns));
        Py_XDECREF(reinterpret_cast<PyObject *>(vehicles));
    }

    void enter(Vehicles *who, size_t own) {
        Py_INCREF(who);
        Py_XDECREF(reinterpret_cast<PyObject *>(std::exchange(vehicles, who)));
        row = own;
    }

    double *values() {
        const Py_ssize_t length = static_cast<Py_ssize_t>(8 * size);
        if (!bytes && (bytes = PyBytes_FromStringAndSize(nullptr, length))) {
            memset(PyBytes_AS_STRING(bytes), 0, 8 * size);
        }
        return bytes ? reinterpret_cast<double *>(PyBytes_AS_STRING(bytes)) : nullptr;
    }

    PyObject *take() { return values() ? std::exchange(bytes, nullptr) : nullptr; }

    // Writes and notes the parts of a step, where they are those of the last one; false where Python has to begin it.
    bool again(const Scene &scene, const Vehicles *who, size_t own, const std::string &now_on, double now_s) {
        if (!usable || who != vehicles || own != row || now_on != lane ||
            sumo.route_index(agent) != number || sumo.route(agent) != route) {
            return false;
        }
        const Here here(scene, row, now_s, sumo.along(agent));
        Py_CLEAR(bytes);
        double *const out = here.along >= 0 ? values() : nullptr; // negative off every lane
        for (const auto &part : parts) {
            if (!out || !part->write(here, out + part->place)) {
                return false;
            }
        }
        for (const auto &part : parts) {
            if (!part->note(here)) {
                return false;
            }
        }
        time_s = now_s;
        along = here.along;
        return out != nullptr;
    }

    // Lets Python write the others.
    void go_on(Columns *now) {
        Py_INCREF(now);
        Py_XDECREF(reinterpret_cast<PyObject *>(std::exchange(columns, now)));
        rest = false;
        going_on = true;
    }
};
struct Draft {
    PyObject_HEAD Observation *observation;
};
PyTypeObject *draft_type = nullptr;

Observation &observation_of(PyObject *draft) { return *reinterpret_cast<Draft *>(draft)->observation; }

// Draft(agent, size)
PyObject *draft_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *name;
    Py_ssize_t size;
    std::string agent;
    if (!PyArg_ParseTuple(arguments, "Un", &name, &size) || size < 0 || !encode_name(name, agent)) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_ValueError, "a draft of %zd values", size);
    }
    Draft *self = reinterpret_cast<Draft *>(type->tp_alloc(type, 0));
    if (self) {
        self->observation = new Observation();
        self->observation->size = static_cast<size_t>(size);
        self->observation->agent = agent;
    }
    return reinterpret_cast<PyObject *>(self);
}

// begin(columns | None, row, lane, time_s)
PyObject *draft_begin(PyObject *draft, PyObject *arguments) {
    Observation &whole = observation_of(draft);
    PyObject *columns;
    Py_ssize_t row;
    const char *lane;
    double time_s;
    if (!PyArg_ParseTuple(arguments, "Onsd", &columns, &row, &lane, &time_s) ||
        (columns != Py_None && !columns_of(columns)) || unbound()) {
        return nullptr;
    }
    if (std::exchange(whole.going_on, false) && columns == reinterpret_cast<PyObject *>(whole.columns)) {
        Py_RETURN_NONE;
    }
    whole.parts.clear();
    whole.usable = whole.rest = false;
    whole.time_s = time_s;
    Py_CLEAR(whole.bytes);
    Py_CLEAR(whole.columns);
    if (columns == Py_None) {
        Py_RETURN_NONE;
    }
    const Scene scene(reinterpret_cast<Columns *>(columns));
    if (!scene.sized() || row < 0 || static_cast<size_t>(row) >= scene.size) {
        Py_RETURN_NONE;
    }
    try {
        whole.number = sumo.route_index(whole.agent);
        whole.route = sumo.route(whole.agent);
        whole.along = sumo.along(whole.agent);
    } catch (...) { // such as an actor of a recording that is played back
        Py_RETURN_NONE;
    }
    whole.lane = lane;
    whole.columns = reinterpret_cast<Columns *>(Py_NewRef(columns));
    whole.enter(whole.columns->vehicles, static_cast<size_t>(row));
    whole.usable = whole.along >= 0 && scene.roster->ids.size() == scene.size; // without persons
    Py_RETURN_NONE;
}

// has(place) -> whether the part there is written
PyObject *draft_has(PyObject *draft, PyObject *given) {
    const size_t place = PyLong_AsSize_t(given);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    const auto &parts = observation_of(draft).parts;
    return PyBool_FromLong(
        std::any_of(parts.begin(), parts.end(), [place](const auto &part) { return part->place == place; }));
}

// enter(vehicles, row): who is in sight from now on
PyObject *draft_enter(PyObject *draft, PyObject *arguments) {
    PyObject *vehicles;
    Py_ssize_t row;
    if (!PyArg_ParseTuple(arguments, "On", &vehicles, &row) || !vehicles_of(vehicles)) {
        return nullptr;
    }
    observation_of(draft).enter(reinterpret_cast<Vehicles *>(vehicles), static_cast<size_t>(row));
    Py_RETURN_NONE;
}

// Where a part begins; null with an exception where it does not fit.
double *part_at(PyObject *draft, Py_ssize_t place, size_t size) {
    Observation &whole = observation_of(draft);
    if (place < 0 || static_cast<size_t>(place) > whole.size || size > whole.size - static_cast<size_t>(place)) {
        PyErr_SetString(PyExc_ValueError, "a part is written beyond the end");
        return nullptr;
    }
    double *values = whole.values();
    return values ? values + place : nullptr;
}

// Writes a part and keeps it; returns whether that could be done.
PyObject *write_part(PyObject *draft, PyObject *place, std::unique_ptr<Written> part) {
    Observation &whole = observation_of(draft);
    const Py_ssize_t begin = PyLong_AsSsize_t(place);
    double *out = PyErr_Occurred() ? nullptr : part_at(draft, begin, part->size());
    if (!out) {
        return nullptr;
    }
    if (!whole.columns) {
        Py_RETURN_FALSE;
    }
    part->place = static_cast<size_t>(begin);
    const Scene scene(whole.columns);
    const Here here(scene, whole.row, whole.time_s, whole.along);
    bool done = false;
    try {
        done = part->write(here, out) && part->note(here);
    } catch (...) { // such as an actor of a recording that is played back
    }
    if (PyErr_Occurred()) {
        return nullptr;
    }
    if (done) {
        whole.parts.push_back(std::move(part));
    } else {
        std::fill(out, out + part->size(), 0.0);
    }
    return PyBool_FromLong(done);
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
    observation_of(draft).rest = true;
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
    observation_of(draft).rest = true;
    Py_RETURN_NONE;
}

// take() -> bytes: the values, which are 0 from then on
PyObject *draft_take(PyObject *draft, PyObject *) { return observation_of(draft).take(); }

const double WHEELBASE_SHARE = 0.6, MOST_BEND = 2.0; // as in simulators

// As bicycle_steering of simulators/_scene_observation.py.
double bicycle_steering(double yaw_rate, double speed, double length) {
    const double bend = speed > 0.0 ? yaw_rate * WHEELBASE_SHARE * length / speed : 0.0;
    if (fabs(bend) >= MOST_BEND) {
        return std::copysign(M_PI / 2, bend);
    }
    return atan(bend / sqrt(1.0 - bend * bend / 4.0));
}

struct Ego : Written {
    std::string agent;
    Kept last; // a list of heading and speed, empty before the first step
    double start_m = 0, start_s = 0, step_s = 0, lane_index = 0;

    explicit Ego(PyObject *state) : last(state) {}
    size_t size() const override { return 13; }

    bool write(const Here &here, double *out) override {
        const Scene &scene = here.scene;
        const double heading = scene.headings[here.row], speed = scene.speeds[here.row];
        const double length = scene.roster->lengths[here.row];
        double acceleration, yaw_rate = 0.0;
        if (PyList_GET_SIZE(last.object) == 2) {
            acceleration = (speed - PyFloat_AsDouble(PyList_GET_ITEM(last.object, 1))) / step_s;
            yaw_rate = remainder(heading - PyFloat_AsDouble(PyList_GET_ITEM(last.object, 0)), TAU) / step_s;
        } else {
            acceleration = known_value(sumo.acceleration(agent));
        }
        const double columns[] = {here.x, here.y, remainder(heading, TAU), speed, acceleration, yaw_rate,
                                  bicycle_steering(yaw_rate, speed, length), length, scene.roster->widths[here.row],
                                  lane_index, known_value(sumo.aside(agent)), sumo.driven(agent) - start_m,
                                  here.time_s - start_s};
        static_assert(sizeof columns == 13 * 8, "as many as its size");
        memcpy(out, columns, sizeof columns);
        return true;
    }

    bool note(const Here &here) override {
        PyObject *state = Py_BuildValue("[dd]", here.scene.headings[here.row], here.scene.speeds[here.row]);
        const bool done = state && PyList_SetSlice(last.object, 0, PyList_GET_SIZE(last.object), state) == 0;
        Py_XDECREF(state);
        return done;
    }
};

// ego(place, [heading, speed], (start_m, start_s, step_s, lane_index)) -> whether it could be written
PyObject *draft_ego(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 3 || !PyList_CheckExact(given[1]) || !PyTuple_CheckExact(given[2])) {
        return PyErr_Format(PyExc_TypeError, "ego takes a place, a list and a tuple");
    }
    auto part = std::make_unique<Ego>(given[1]);
    part->agent = observation_of(draft).agent;
    if (!PyArg_ParseTuple(given[2], "dddd", &part->start_m, &part->start_s, &part->step_s, &part->lane_index)) {
        return nullptr;
    }
    return write_part(draft, given[0], std::move(part));
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
bool see(const Here &here, double radius, size_t limit) {
    seen_actors.clear();
    const Scene &scene = here.scene;
    for (size_t other = 0; other < scene.size; other++) {
        const double half = scene.roster->lengths[other] / 2;
        const double x = scene.x(other) - half * cos(scene.headings[other]);
        const double y = scene.y(other) - half * sin(scene.headings[other]);
        const double squared = (x - here.x) * (x - here.x) + (y - here.y) * (y - here.y);
        if (!std::isfinite(squared)) {
            return false;
        }
        if (squared <= radius * radius && other != here.row) {
            seen_actors.push_back({squared, other, x, y});
        }
    }
    limit = std::min(limit, seen_actors.size());
    std::partial_sort(seen_actors.begin(), seen_actors.begin() + static_cast<std::ptrdiff_t>(limit), seen_actors.end());
    seen_actors.resize(limit);
    return true;
}

struct Actors : Written {
    static const size_t WIDTH = 15;
    Kept kinds, ids, speeds, rows, lanes, ask; // the kinds and ids are of those in sight, also when others enter
    double radius = 0, step_s = 0;
    size_t limit = 0;
    std::vector<Seen> found;
    std::unordered_map<std::string, bool> on_path[2]; // whether a lane is on the path of the vehicle, ahead and behind

    Actors(PyObject *who[2], PyObject *state[2], PyObject *path[2])
        : kinds(who[0]), ids(who[1]), speeds(state[0]), rows(state[1]), lanes(path[0]), ask(path[1]) {}
    size_t size() const override { return WIDTH * limit; }

    bool write(const Here &here, double *out) override {
        const Scene &scene = here.scene;
        if (scene.roster->ids.size() != scene.size ||
            static_cast<size_t>(PyList_GET_SIZE(kinds.object)) != scene.size ||
            static_cast<size_t>(PyList_GET_SIZE(ids.object)) != scene.size || !see(here, radius, limit)) {
            return false;
        }
        const double own_cos = cos(scene.headings[here.row]), own_sin = sin(scene.headings[here.row]);
        found = seen_actors;
        for (const Seen &one : found) {
            const std::string &name = scene.roster->ids[one.row];
            PyObject *id = PyList_GET_ITEM(ids.object, static_cast<Py_ssize_t>(one.row));
            const double heading = scene.headings[one.row], speed = scene.speeds[one.row];
            PyObject *last = PyDict_GetItemWithError(speeds.object, id); // borrowed
            const double offset = known_value(sumo.aside(name));
            const double acceleration =
                last ? (speed - PyFloat_AsDouble(last)) / step_s : known_value(sumo.acceleration(name));
            const int signals = sumo.signals(name);
            const double ahead = (one.x - here.x) * own_cos + (one.y - here.y) * own_sin;
            const int same = is_on_path(here.lane_of(one.row), ahead < 0.0);
            if (same < 0 || PyErr_Occurred()) {
                return false;
            }
            const bool left = signals & 2, right = signals & 1, hazard = signals & 4;
            const double indicator = hazard || (left && right) ? 2.0 : left ? 1.0 : right ? -1.0 : 0.0;
            const double columns_of_actor[WIDTH] = {
                1.0, one.x, one.y, remainder(heading, TAU), speed * cos(heading), speed * sin(heading), acceleration,
                scene.roster->lengths[one.row], scene.roster->widths[one.row],
                PyFloat_AsDouble(PyList_GET_ITEM(kinds.object, static_cast<Py_ssize_t>(one.row))), same ? 1.0 : 0.0,
                ahead, offset, signals & 8 ? 1.0 : 0.0, indicator};
            memcpy(out, columns_of_actor, sizeof columns_of_actor);
            out += WIDTH;
        }
        return true;
    }

    // Whether an actor on a lane is before or behind the vehicle on its path; -1 with an exception.
    int is_on_path(const std::string &name, bool is_behind) {
        const auto known = on_path[is_behind].find(name);
        if (known != on_path[is_behind].end()) {
            return known->second;
        }
        PyObject *lane = text_of(name);
        int found = lane ? PySet_Contains(lanes.object, lane) : -1;
        if (!found && is_behind) {
            PyObject *answer = PyObject_CallOneArg(ask.object, lane);
            found = answer ? PyObject_IsTrue(answer) : -1;
            Py_XDECREF(answer);
        }
        Py_XDECREF(lane);
        if (found >= 0) {
            on_path[is_behind][name] = found;
        }
        return found;
    }

    bool note(const Here &here) override {
        PyDict_Clear(speeds.object);
        PyObject *list = PyList_New(static_cast<Py_ssize_t>(found.size()));
        bool good = list != nullptr;
        for (size_t number = 0; good && number < found.size(); number++) {
            const size_t row = found[number].row;
            PyObject *index = PyLong_FromSize_t(row), *speed = PyFloat_FromDouble(here.scene.speeds[row]);
            good = index && speed &&
                   PyDict_SetItem(speeds.object, PyList_GET_ITEM(ids.object, static_cast<Py_ssize_t>(row)), speed) == 0;
            Py_XDECREF(speed);
            PyList_SET_ITEM(list, static_cast<Py_ssize_t>(number), index);
        }
        good = good && PyList_SetSlice(rows.object, 0, PyList_GET_SIZE(rows.object), list) == 0;
        Py_XDECREF(list);
        return good;
    }
};

// actors(place, (kinds, ids), (radius, limit, step_s), (last speeds, rows), (lanes, ask)) ->
//     whether it could be written
PyObject *draft_actors(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    PyObject *who[2], *state[2], *path[2];
    double radius, step_s;
    Py_ssize_t limit;
    if (count != 5 || !PyTuple_CheckExact(given[1]) || !PyTuple_CheckExact(given[2]) || !PyTuple_CheckExact(given[3]) ||
        !PyTuple_CheckExact(given[4]) ||
        !PyArg_ParseTuple(given[1], "O!O!", &PyList_Type, who, &PyList_Type, who + 1) ||
        !PyArg_ParseTuple(given[2], "dnd", &radius, &limit, &step_s) ||
        !PyArg_ParseTuple(given[3], "O!O!", &PyDict_Type, state, &PyList_Type, state + 1) ||
        !PyArg_ParseTuple(given[4], "O!O", &PyFrozenSet_Type, path, path + 1) || limit < 0) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "these are not the facts of actors");
    }
    auto part = std::make_unique<Actors>(who, state, path);
    part->radius = radius;
    part->limit = static_cast<size_t>(limit);
    part->step_s = step_s;
    return write_part(draft, given[0], std::move(part));
}

std::vector<double> distances; // used again
std::vector<std::ptrdiff_t> nearest_points;
std::vector<size_t> chosen_lanes;
std::vector<std::pair<double, size_t>> other_lanes;

struct NearLanes : Written {
    Kept ask;
    PyObject *block = nullptr; // that of the square in which the vehicle is
    Py_ssize_t wanted = 0, points = 0, before = 0, stride = 0;
    double near_m = 0, square_m = 0;

    explicit NearLanes(PyObject *asked) : ask(asked) {}
    ~NearLanes() override { Py_XDECREF(block); }
    size_t size() const override { return static_cast<size_t>(wanted * points) * LANE_COLUMNS; }

    bool write(const Here &here, double *out) override {
        const double column = floor(here.x / square_m), row = floor(here.y / square_m);
        const Lanes *known = block ? reinterpret_cast<LaneBlock *>(block)->lanes : nullptr;
        if (!known || (column + 0.5) * square_m != known->middle_x || (row + 0.5) * square_m != known->middle_y) {
            PyObject *made = PyObject_CallFunction(ask.object, "LL", static_cast<long long>(column),
                                                   static_cast<long long>(row));
            if (!made || Py_TYPE(made) != lane_block_type) {
                Py_XDECREF(made);
                return false;
            }
            Py_XSETREF(block, made);
        }
        const Lanes &lanes = *reinterpret_cast<LaneBlock *>(block)->lanes;
        const double dx = here.x - lanes.middle_x, dy = here.y - lanes.middle_y;
        const double limit = near_m * near_m - dx * dx - dy * dy, to_x = -2.0 * dx, to_y = -2.0 * dy;
        nearest_points.clear();
        chosen_lanes.clear();
        other_lanes.clear();
        for (size_t number = 0; number < lanes.lanes.size(); number++) {
            const CandidateLane &lane = lanes.lanes[number];
            const size_t window = lane.points.size() / 3;
            const double *px = lane.points.data(), *py = px + window, *ps = py + window;
            distances.assign(window + 4, HUGE_VAL);
            double *const away = distances.data();
            for (size_t point = 0; point < window; point++) {
                double squared = px[point] * to_x;
                squared += py[point] * to_y;
                squared += ps[point];
                away[point] = squared;
            }
            double four[4] = {HUGE_VAL, HUGE_VAL, HUGE_VAL, HUGE_VAL}; // four at a time, as the processor can
            for (size_t point = 0; point < window; point += 4) {
                for (size_t place = 0; place < 4; place++) {
                    four[place] = std::min(four[place], away[point + place]);
                }
            }
            const double least = std::min(std::min(four[0], four[1]), std::min(four[2], four[3]));
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
        return true;
    }
};

// lanes(place, ask, (number of lanes, points, before, stride, near_m, square_m)) -> whether it could be written
PyObject *draft_lanes(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 3 || !PyTuple_CheckExact(given[2])) {
        PyErr_SetString(PyExc_TypeError, "lanes takes a place, a function and a tuple");
        return nullptr;
    }
    auto part = std::make_unique<NearLanes>(given[1]);
    if (!PyArg_ParseTuple(given[2], "nnnndd", &part->wanted, &part->points, &part->before, &part->stride, &part->near_m,
                          &part->square_m)) {
        return nullptr;
    }
    if (part->wanted < 0 || part->points < 0) {
        return PyErr_Format(PyExc_ValueError, "there are no such lanes");
    }
    return write_part(draft, given[0], std::move(part));
}

struct Route : Written {
    static const size_t WIDTH = 6, ROW = 7;
    Held held;
    Py_ssize_t begin = 0, last = 0, points = 0, stride = 0;

    size_t size() const override { return static_cast<size_t>(points) * WIDTH; }

    bool write(const Here &here, double *out) override {
        static const size_t COLUMNS[WIDTH] = {0, 1, 2, 3, 5, 6}; // as _ROUTE_COLUMNS
        const double *rows = held.numbers();
        const Py_ssize_t total = static_cast<Py_ssize_t>(held.length(0));
        double best = HUGE_VAL;
        Py_ssize_t nearest_row = begin;
        for (Py_ssize_t row = begin; row <= last; row++) {
            const double dx = rows[static_cast<size_t>(row) * ROW + 1] - here.x;
            const double dy = rows[static_cast<size_t>(row) * ROW + 2] - here.y;
            const double squared = dx * dx + dy * dy;
            if (squared < best) {
                best = squared;
                nearest_row = row;
            }
        }
        for (Py_ssize_t point = 0; point < points && nearest_row + point * stride < total; point++) {
            const double *row = rows + static_cast<size_t>(nearest_row + point * stride) * ROW;
            for (size_t column : COLUMNS) {
                *out++ = row[column];
            }
        }
        return true;
    }
};

// route(place, rows of a path, (begin, last, points, stride)) -> whether it could be written
PyObject *draft_route(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    auto part = std::make_unique<Route>();
    if (count != 3 || !PyTuple_CheckExact(given[2]) ||
        !PyArg_ParseTuple(given[2], "nnnn", &part->begin, &part->last, &part->points, &part->stride) ||
        !part->held.hold(given[1])) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "these are not the points of a path");
    }
    if (part->begin < 0 || part->last < part->begin || static_cast<size_t>(part->last) >= part->held.length(0) ||
        part->held.length(1) != Route::ROW || part->points < 0 || part->stride < 1) {
        return PyErr_Format(PyExc_ValueError, "these are not the points of a path");
    }
    return write_part(draft, given[0], std::move(part));
}

struct Signals : Written {
    struct Light {
        std::string name;
        size_t link;
        double distance;
        Kept state; // a list of the state and the time when it began
        bool changed = false;
        double now = 0;

        Light(const std::string &id, size_t index, double away, PyObject *list)
            : name(id), link(index), distance(away), state(list) {}
    };
    std::deque<Light> lights;
    double step_s = 0;

    size_t size() const override { return 4 * lights.size(); }

    static double number_of(char state) { // as SIGNAL_STATES
        switch (state) {
        case 'G':
        case 'g':
            return 0.0;
        case 'y':
        case 'Y':
            return 1.0;
        case 'r':
        case 'R':
        case 'u':
        case 's':
            return 2.0;
        }
        return 3.0;
    }

    bool write(const Here &here, double *out) override {
        if (here.along < 0) {
            return false;
        }
        for (Light &light : lights) {
            const std::string states = sumo.light(light.name);
            if (light.link >= states.size()) {
                return false;
            }
            light.now = number_of(states[light.link]);
            light.changed = light.now != PyFloat_AsDouble(PyList_GET_ITEM(light.state.object, 0));
            const double since = light.changed ? here.time_s - step_s // it changed when the step began
                                               : PyFloat_AsDouble(PyList_GET_ITEM(light.state.object, 1));
            *out++ = 1.0;
            *out++ = light.now;
            *out++ = light.distance - here.along;
            *out++ = here.time_s - since;
        }
        return true;
    }

    bool note(const Here &here) override {
        for (const Light &light : lights) {
            PyObject *state = light.changed ? Py_BuildValue("[dd]", light.now, here.time_s - step_s) : nullptr;
            const bool done = !light.changed || (state && PyList_SetSlice(light.state.object, 0, 2, state) == 0);
            Py_XDECREF(state);
            if (!done) {
                return false;
            }
        }
        return true;
    }
};

// signals(place, [(distance, light, link, [state, since])], step_s) -> whether it could be written
PyObject *draft_signals(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    auto part = std::make_unique<Signals>();
    part->step_s = count == 3 ? PyFloat_AsDouble(given[2]) : 0.0;
    if (count != 3 || !PyList_CheckExact(given[1]) || PyErr_Occurred()) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "signals takes a place, a list and a time");
    }
    for (Py_ssize_t number = 0; number < PyList_GET_SIZE(given[1]); number++) {
        PyObject *name, *state;
        double distance;
        Py_ssize_t link;
        std::string id;
        if (!PyArg_ParseTuple(PyList_GET_ITEM(given[1], number), "dUnO!", &distance, &name, &link, &PyList_Type,
                              &state) ||
            !encode_name(name, id)) {
            return nullptr;
        }
        if (PyList_GET_SIZE(state) != 2 || link < 0) {
            return PyErr_Format(PyExc_ValueError, "these are not the facts of a light");
        }
        part->lights.emplace_back(id, static_cast<size_t>(link), distance, state);
    }
    return write_part(draft, given[0], std::move(part));
}

// Who takes the streams that conflict with a path across a junction, as _taken of RightOfWayReader.
struct Stream {
    int must_yield;
    double begin, end, other_begin, other_end, offset;
    std::string light; // that of the stream, without which nothing takes its priority away
    Py_ssize_t link;
};
struct Junction {
    std::unordered_set<std::string> lanes;
    std::unordered_map<std::string, std::vector<Stream>> taken; // by lane, route and place on it
    Kept ask;

    explicit Junction(PyObject *asked) : ask(asked) {}

    // The streams that a vehicle takes; null with an exception.
    const std::vector<Stream> *streams(const std::string &name, const std::string &lane) {
        const int number = sumo.route_index(name);
        const std::string route = sumo.route(name), key = lane + '\n' + std::to_string(number) + '\n' + route;
        const auto known = taken.find(key);
        if (known != taken.end()) {
            return &known->second;
        }
        PyObject *list =
            PyObject_CallFunction(ask.object, "NNiN", text_of(name), text_of(lane), number, text_of(route));
        std::vector<Stream> found;
        for (Py_ssize_t row = 0; list && PyList_CheckExact(list) && row < PyList_GET_SIZE(list); row++) {
            Stream one;
            PyObject *light;
            if (!PyArg_ParseTuple(PyList_GET_ITEM(list, row), "pdddddUn", &one.must_yield, &one.begin, &one.end,
                                  &one.other_begin, &one.other_end, &one.offset, &light, &one.link) ||
                !encode_name(light, one.light)) {
                break;
            }
            found.push_back(one);
        }
        Py_XDECREF(list);
        return PyErr_Occurred() ? nullptr : &(taken[key] = found);
    }
};
struct Streams {
    PyObject_HEAD Junction *junction;
};
PyTypeObject *streams_type = nullptr;

// Streams(lanes, ask)
PyObject *streams_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *lanes, *ask;
    if (!PyArg_ParseTuple(arguments, "O!O", &PyTuple_Type, &lanes, &ask)) {
        return nullptr;
    }
    Streams *self = reinterpret_cast<Streams *>(type->tp_alloc(type, 0));
    if (!self) {
        return nullptr;
    }
    self->junction = new Junction(ask);
    for (Py_ssize_t number = 0; number < PyTuple_GET_SIZE(lanes); number++) {
        std::string lane;
        if (!PyUnicode_Check(PyTuple_GET_ITEM(lanes, number)) || !encode_name(PyTuple_GET_ITEM(lanes, number), lane)) {
            Py_DECREF(self);
            return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "lanes have names");
        }
        self->junction->lanes.insert(lane);
    }
    return reinterpret_cast<PyObject *>(self);
}

struct RightOfWay : Written {
    static const size_t WIDTH = 8;
    Kept streams;
    Junction &junction;
    double line_m = 0, stop_sign = 0; // where the stop line is on the lane
    Py_ssize_t limit = 0;

    explicit RightOfWay(PyObject *given)
        : streams(given), junction(*reinterpret_cast<Streams *>(given)->junction) {}
    size_t size() const override { return static_cast<size_t>(limit) * WIDTH; }

    // Whether an actor that has priority by the rules also has it in this moment.
    static bool goes_first(const Stream &stream, double place_m) {
        if (stream.light.empty() || place_m > 0.0) {
            return true;
        }
        const char state = sumo.light(stream.light).at(static_cast<size_t>(stream.link));
        return !strchr("rRus", state);
    }

    bool write(const Here &here, double *out) override {
        typedef std::tuple<double, double, std::string, bool, double, double> Row;
        const double NEVER_S = 1000.0, STANDING_MPS = 0.1; // as in _right_of_way_readers.py
        const Scene &scene = here.scene;
        const std::vector<double> &lengths = scene.roster->lengths;
        if (here.along < 0 || scene.roster->ids.size() != scene.size) {
            return false;
        }
        const double line = line_m - here.along, front = -line, rear = front - lengths[here.row];
        std::vector<Row> rows;
        for (size_t other = 0; other < scene.size; other++) {
            const std::string &name = scene.roster->ids[other];
            const std::string &lane = here.lane_of(other);
            if (other == here.row || !junction.lanes.count(lane)) {
                continue;
            }
            const double position = sumo.along(name);
            const std::vector<Stream> *const taken = junction.streams(name, lane);
            if (!taken) {
                return false;
            }
            bool known = false;
            Row best;
            for (const Stream &stream : *taken) {
                const double place_m = stream.offset + position;
                if (rear > stream.end || place_m - lengths[other] > stream.other_end) {
                    continue; // one of them has passed
                }
                const double speed = std::max(0.0, scene.speeds[other]), away = stream.other_begin - place_m;
                const double arrival =
                    speed > STANDING_MPS ? std::max(0.0, away) / speed : away > 0.0 ? NEVER_S : 0.0;
                const Row row(std::min(arrival, NEVER_S), away, name, stream.must_yield && goes_first(stream, place_m),
                              stream.begin - front, speed);
                best = known ? std::min(best, row) : row;
                known = true;
            }
            if (known) {
                rows.push_back(best);
            }
        }
        std::sort(rows.begin(), rows.end());
        rows.resize(std::min(rows.size(), static_cast<size_t>(limit)));
        for (const auto &[arrival, away, name, must_yield, distance, speed] : rows) {
            for (double value : {1.0, must_yield ? 1.0 : 0.0, line, distance, away, speed, arrival, stop_sign}) {
                *out++ = value;
            }
        }
        return true;
    }
};

// right_of_way(place, streams, (line_m, stop_sign, limit)) -> whether it could be written
PyObject *draft_right_of_way(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 3 || Py_TYPE(given[1]) != streams_type || !PyTuple_CheckExact(given[2])) {
        return PyErr_Format(PyExc_TypeError, "right_of_way takes a place, streams and a tuple");
    }
    auto part = std::make_unique<RightOfWay>(given[1]);
    if (!PyArg_ParseTuple(given[2], "ddn", &part->line_m, &part->stop_sign, &part->limit)) {
        return nullptr;
    }
    return part->limit < 0 ? PyErr_Format(PyExc_ValueError, "there are no such rows")
                           : write_part(draft, given[0], std::move(part));
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

// Columns of which some grow by as much as the vehicle drives along its lane, or shrink.
struct Along : Written {
    struct Column {
        Py_ssize_t index;
        double from, offset, least;
    };
    std::vector<double> values;
    std::vector<Column> columns;

    size_t size() const override { return values.size(); }

    bool write(const Here &here, double *out) override {
        if (here.along < 0) {
            return false;
        }
        std::copy(values.begin(), values.end(), out);
        for (const Column &one : columns) {
            out[one.index] = std::max(one.least, one.from + (-here.along + one.offset));
        }
        return true;
    }
};

// along(place, values, [(index, from, offset, least)]) -> whether it could be written
PyObject *draft_along(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    auto part = std::make_unique<Along>();
    if (count != 3 || !PyTuple_CheckExact(given[1]) || !PyList_CheckExact(given[2])) {
        return PyErr_Format(PyExc_TypeError, "along takes a place, a tuple and a list");
    }
    for (Py_ssize_t number = 0; number < PyTuple_GET_SIZE(given[1]); number++) {
        part->values.push_back(PyFloat_AsDouble(PyTuple_GET_ITEM(given[1], number)));
    }
    for (Py_ssize_t number = 0; number < PyList_GET_SIZE(given[2]); number++) {
        Along::Column one;
        if (!PyArg_ParseTuple(PyList_GET_ITEM(given[2], number), "nddd", &one.index, &one.from, &one.offset,
                              &one.least)) {
            return nullptr;
        }
        if (one.index < 0 || one.index >= PyTuple_GET_SIZE(given[1])) {
            return PyErr_Format(PyExc_IndexError, "there is no such column");
        }
        part->columns.push_back(one);
    }
    return PyErr_Occurred() ? nullptr : write_part(draft, given[0], std::move(part));
}

struct SpeedLimit : Written {
    std::string lane;

    size_t size() const override { return 1; }

    bool write(const Here &, double *out) override {
        *out = sumo.speed_limit(lane);
        return true;
    }
};

// speed_limit(place) -> whether it could be written
PyObject *draft_speed_limit(PyObject *draft, PyObject *const *given, Py_ssize_t count) {
    if (count != 1) {
        return PyErr_Format(PyExc_TypeError, "speed_limit takes a place");
    }
    auto part = std::make_unique<SpeedLimit>();
    part->lane = observation_of(draft).lane;
    return write_part(draft, given[0], std::move(part));
}

// light_state(traffic light) -> what its links show; None where libsumo refuses
PyObject *light_state(PyObject *, PyObject *name) {
    std::string id;
    if (!PyUnicode_Check(name) || !encode_name(name, id) || unbound()) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_TypeError, "a traffic light has a name");
    }
    try {
        return text_of(sumo.light(id));
    } catch (...) {
        Py_RETURN_NONE;
    }
}

PyMethodDef draft_methods[] = {
    {"begin", draft_begin, METH_VARARGS, "Begin the observation of a step."},
    {"has", draft_has, METH_O, "Whether a part is written already."},
    {"enter", draft_enter, METH_VARARGS, "Take who is in sight from now on."},
    {"put", FAST(draft_put), "Write numbers."},
    {"put_array", FAST(draft_put_array), "Write an array."},
    {"ego", FAST(draft_ego), "Write the part ego; return whether it could be done, as the others here do."},
    {"actors", FAST(draft_actors), "Write the part actors."},
    {"lanes", FAST(draft_lanes), "Write the part lanes."},
    {"route", FAST(draft_route), "Write the part route."},
    {"signals", FAST(draft_signals), "Write the part signals."},
    {"right_of_way", FAST(draft_right_of_way), "Write the part right_of_way."},
    {"along", FAST(draft_along), "Write numbers of which some depend on the position on the lane."},
    {"speed_limit", FAST(draft_speed_limit), "Write the part speed_limit."},
    {"take", draft_take, METH_NOARGS, "Return what has been written as bytes, and begin again."},
    {nullptr, nullptr, 0, nullptr},
};
PyType_Slot draft_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(draft_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<Draft, &Draft::observation>)},
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
PyType_Slot streams_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(streams_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<Streams, &Streams::junction>)},
    {Py_tp_doc, const_cast<char *>("The streams that conflict with a path across a junction.")},
    {0, nullptr},
};
PyType_Spec streams_spec = {"_crashhunt_core.Streams", sizeof(Streams), 0, Py_TPFLAGS_DEFAULT, streams_slots};
