// Parts of the observation of one agent, written into one array of float64. A part of core.cpp.
//
// Each function does what a reader of crashhunt/sumo does in Python, by the same expressions in the same order. Where a
// scene has what only Python reads (persons, heights, vehicles that SUMO does not have), it does nothing and says so.

const double NO_VALUE = -1073741824.0; // of libsumo's getters

double known_value(double value) { return value == NO_VALUE ? 0.0 : value; }

// A view of a float64 array, or of one of NumPy's indices, that stays valid as long as it is held.
struct Held : Buffer {
    void hold(PyObject *array) {
        if (!open(array, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT)) {
            throw Raised();
        }
        if (view.itemsize != 8) {
            raise(PyExc_TypeError, "these are no numbers of 8 bytes");
        }
    }
    size_t count() const { return size() / 8; }
    size_t length(int axis) const { return axis < view.ndim ? static_cast<size_t>(view.shape[axis]) : 0; }
    const double *numbers() const { return static_cast<const double *>(view.buf); }
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
void set_window(CandidateLane &lane, PyObject *path, const Lanes &lanes, int64_t window) {
    const auto [rows, places, start, last] = From<std::tuple<PyObject *, PyObject *, int64_t, int64_t>>::of(path);
    Held points;
    lane.rows.hold(rows);
    points.hold(places);
    lane.count = static_cast<int64_t>(lane.rows.length(0));
    if (lane.rows.length(1) != LANE_COLUMNS + 1 || points.length(0) != 2 || points.length(1) != lane.rows.length(0) ||
        start < 0 || last < start || last >= lane.count || window < 1) {
        raise(PyExc_ValueError, "these are not the points of a lane");
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
}

// LaneBlock([(rows, places, start, last) | None], middle_x, middle_y, window)
std::unique_ptr<Lanes> make_lanes(List paths, double middle_x, double middle_y, int64_t window) {
    auto lanes = std::make_unique<Lanes>();
    lanes->middle_x = middle_x;
    lanes->middle_y = middle_y;
    for (PyObject *path : From<std::vector<PyObject *>>::of(paths)) {
        CandidateLane &lane = lanes->lanes.emplace_back();
        if (path != Py_None) {
            set_window(lane, path, *lanes, window);
        }
    }
    return lanes;
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
    // Writes the columns, where there are zeros; false if Python has to do it. Nothing is noted yet.
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

template <> Observation &self_of<Observation>(PyObject *draft) { return *reinterpret_cast<Draft *>(draft)->observation; }

// Draft(agent, size)
std::unique_ptr<Observation> make_observation(std::string agent, size_t size) {
    auto whole = std::make_unique<Observation>();
    whole->agent = agent;
    whole->size = size;
    return whole;
}

// begin(columns | None, row, lane, time_s)
void draft_begin(Observation &whole, PyObject *columns, long row, std::string lane, double time_s) {
    require_bound();
    if (std::exchange(whole.going_on, false) && columns == reinterpret_cast<PyObject *>(whole.columns)) {
        return;
    }
    whole.parts.clear();
    whole.usable = whole.rest = false;
    whole.time_s = time_s;
    Py_CLEAR(whole.bytes);
    Py_CLEAR(whole.columns);
    if (columns == Py_None) {
        return;
    }
    const Scene scene(From<Columns *>::of(columns));
    if (!scene.sized() || row < 0 || static_cast<size_t>(row) >= scene.size) {
        return;
    }
    // These raise for an actor of a recording that is played back.
    whole.number = sumo.route_index(whole.agent);
    whole.route = sumo.route(whole.agent);
    whole.along = sumo.along(whole.agent);
    whole.lane = lane;
    whole.columns = reinterpret_cast<Columns *>(Py_NewRef(columns));
    whole.enter(whole.columns->vehicles, static_cast<size_t>(row));
    whole.usable = whole.along >= 0 && scene.roster->ids.size() == scene.size; // without persons
}

// has(place) -> whether the part there is written
bool draft_has(Observation &whole, size_t place) {
    return std::any_of(whole.parts.begin(), whole.parts.end(), [place](const auto &part) { return part->place == place; });
}

// enter(vehicles, row): who is in sight from now on
void draft_enter(Observation &whole, Vehicles *vehicles, size_t row) { whole.enter(vehicles, row); }

// Where a part begins.
double *part_at(Observation &whole, size_t place, size_t size) {
    if (place > whole.size || size > whole.size - place) {
        raise(PyExc_ValueError, "a part is written beyond the end");
    }
    double *values = whole.values();
    return values ? values + place : throw Raised();
}

// Writes a part and keeps it; returns whether that could be done.
bool write_part(Observation &whole, size_t place, std::unique_ptr<Written> part) {
    double *out = part_at(whole, place, part->size());
    if (!whole.columns) {
        return false;
    }
    part->place = place;
    const Scene scene(whole.columns);
    const Here here(scene, whole.row, whole.time_s, whole.along);
    bool done = false;
    try {
        done = part->write(here, out) && part->note(here);
    } catch (...) { // such as an actor of a recording that is played back
    }
    if (PyErr_Occurred()) {
        throw Raised();
    }
    if (done) {
        whole.parts.push_back(std::move(part));
    } else {
        std::fill(out, out + part->size(), 0.0);
    }
    return done;
}

// put(place, tuple of numbers)
void draft_put(Observation &whole, size_t place, std::vector<double> values) {
    std::copy(values.begin(), values.end(), part_at(whole, place, values.size()));
    whole.rest = true;
}

// put_array(place, array of float64)
void draft_put_array(Observation &whole, size_t place, PyObject *given) {
    Held array;
    array.hold(given);
    memcpy(part_at(whole, place, array.count()), array.view.buf, array.size());
    whole.rest = true;
}

// take() -> bytes: the values, which are 0 from then on
Ref draft_take(Observation &whole) { return Ref(whole.take()); }

const double WHEELBASE_SHARE = 0.6, MOST_BEND = 2.0; // as in simulators

// As bicycle_steering of simulators/_scene_observation.py.
double bicycle_steering(double yaw_rate, double speed, double length) {
    const double bend = speed > 0.0 ? yaw_rate * WHEELBASE_SHARE * length / speed : 0.0;
    if (fabs(bend) >= MOST_BEND) {
        return std::copysign(M_PI / 2, bend);
    }
    return atan(bend / sqrt(1.0 - bend * bend / 4.0));
}
