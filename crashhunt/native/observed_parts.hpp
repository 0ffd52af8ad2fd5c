// The parts of which an observation consists, each as Python writes it. A part of core.cpp.

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
bool draft_ego(Observation &whole, size_t place, List last, std::tuple<double, double, double, double> facts) {
    auto part = std::make_unique<Ego>(last);
    part->agent = whole.agent;
    std::tie(part->start_m, part->start_s, part->step_s, part->lane_index) = facts;
    return write_part(whole, place, std::move(part));
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

// The actors within a radius, as nearest_actors of simulators/_scene_parts.py; false if Python has to do it.
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

    Actors(const std::tuple<List, List> &who, const std::tuple<Dict, List> &state,
           const std::tuple<Exact<&PyFrozenSet_Type>, PyObject *> &path)
        : kinds(std::get<0>(who)), ids(std::get<1>(who)), speeds(std::get<0>(state)), rows(std::get<1>(state)),
          lanes(std::get<0>(path)), ask(std::get<1>(path)) {}
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
bool draft_actors(Observation &whole, size_t place, std::tuple<List, List> who, std::tuple<double, size_t, double> limits,
                  std::tuple<Dict, List> state, std::tuple<Exact<&PyFrozenSet_Type>, PyObject *> path) {
    auto part = std::make_unique<Actors>(who, state, path);
    std::tie(part->radius, part->limit, part->step_s) = limits;
    return write_part(whole, place, std::move(part));
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
bool draft_lanes(Observation &whole, size_t place, PyObject *ask,
                 std::tuple<Py_ssize_t, Py_ssize_t, Py_ssize_t, Py_ssize_t, double, double> shape) {
    auto part = std::make_unique<NearLanes>(ask);
    std::tie(part->wanted, part->points, part->before, part->stride, part->near_m, part->square_m) = shape;
    if (part->wanted < 0 || part->points < 0) {
        raise(PyExc_ValueError, "there are no such lanes");
    }
    return write_part(whole, place, std::move(part));
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
bool draft_route(Observation &whole, size_t place, PyObject *rows,
                 std::tuple<Py_ssize_t, Py_ssize_t, Py_ssize_t, Py_ssize_t> window) {
    auto part = std::make_unique<Route>();
    std::tie(part->begin, part->last, part->points, part->stride) = window;
    part->held.hold(rows);
    if (part->begin < 0 || part->last < part->begin || static_cast<size_t>(part->last) >= part->held.length(0) ||
        part->held.length(1) != Route::ROW || part->points < 0 || part->stride < 1) {
        raise(PyExc_ValueError, "these are not the points of a path");
    }
    return write_part(whole, place, std::move(part));
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
bool draft_signals(Observation &whole, size_t place, std::vector<std::tuple<double, std::string, size_t, List>> lights,
                   double step_s) {
    auto part = std::make_unique<Signals>();
    part->step_s = step_s;
    for (const auto &[distance, light, link, state] : lights) {
        if (PyList_GET_SIZE(state.object) != 2) {
            raise(PyExc_ValueError, "these are not the facts of a light");
        }
        part->lights.emplace_back(light, link, distance, state);
    }
    return write_part(whole, place, std::move(part));
}

// Who takes the streams that conflict with a path across a junction, as _taken of RightOfWayReader.
struct Stream {
    bool must_yield;
    double begin, end, other_begin, other_end, offset;
    std::string light; // that of the stream, without which nothing takes its priority away
    Py_ssize_t link;
};
template <> struct From<Stream> {
    static Stream of(PyObject *given) {
        const auto [must_yield, begin, end, other_begin, other_end, offset, light, link] =
            From<std::tuple<bool, double, double, double, double, double, std::string, Py_ssize_t>>::of(given);
        return {must_yield, begin, end, other_begin, other_end, offset, light, link};
    }
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
        const Ref list(PyObject_CallFunction(ask.object, "NNiN", text_of(name), text_of(lane), number, text_of(route)));
        try {
            return list ? &(taken[key] = From<std::vector<Stream>>::of(list.object)) : nullptr;
        } catch (const Raised &) {
            return nullptr;
        }
    }
};
struct Streams {
    PyObject_HEAD Junction *junction;
};
PyTypeObject *streams_type = nullptr;

// Streams(lanes, ask)
std::unique_ptr<Junction> make_junction(std::vector<std::string> lanes, PyObject *ask) {
    auto junction = std::make_unique<Junction>(ask);
    junction->lanes.insert(lanes.begin(), lanes.end());
    return junction;
}

struct RightOfWay : Written {
    static const size_t WIDTH = 8;
    Kept streams;
    Junction &junction;
    double line_m = 0, stop_sign = 0; // where the stop line is on the lane
    size_t limit = 0;

    explicit RightOfWay(PyObject *given)
        : streams(given), junction(*reinterpret_cast<Streams *>(given)->junction) {}
    size_t size() const override { return limit * WIDTH; }

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
        rows.resize(std::min(rows.size(), limit));
        for (const auto &[arrival, away, name, must_yield, distance, speed] : rows) {
            for (double value : {1.0, must_yield ? 1.0 : 0.0, line, distance, away, speed, arrival, stop_sign}) {
                *out++ = value;
            }
        }
        return true;
    }
};

// right_of_way(place, streams, (line_m, stop_sign, limit)) -> whether it could be written
bool draft_right_of_way(Observation &whole, size_t place, PyObject *streams, std::tuple<double, double, size_t> facts) {
    if (Py_TYPE(streams) != streams_type) {
        raise(PyExc_TypeError, "these are no streams of the core");
    }
    auto part = std::make_unique<RightOfWay>(streams);
    std::tie(part->line_m, part->stop_sign, part->limit) = facts;
    return write_part(whole, place, std::move(part));
}

// vehicle_states(vehicles) -> what libsumo says of them by the functions that are used here alone; None where it refuses
std::vector<std::tuple<std::string, double, double, int, int, double, std::string>> vehicle_states(Vehicles *vehicles) {
    require_bound();
    std::vector<std::tuple<std::string, double, double, int, int, double, std::string>> found;
    for (const std::string &name : vehicles->roster->ids) {
        found.emplace_back(sumo.lane(name), sumo.aside(name), sumo.acceleration(name), sumo.signals(name),
                           sumo.route_index(name), sumo.along(name), sumo.route(name));
    }
    return found;
}

// Columns of which some grow by as much as the vehicle drives along its lane, or shrink.
struct Along : Written {
    std::vector<double> values;
    std::vector<std::tuple<size_t, double, double, double>> columns; // index, from, offset and least

    size_t size() const override { return values.size(); }

    bool write(const Here &here, double *out) override {
        if (here.along < 0) {
            return false;
        }
        std::copy(values.begin(), values.end(), out);
        for (const auto &[index, from, offset, least] : columns) {
            out[index] = std::max(least, from + (-here.along + offset));
        }
        return true;
    }
};

// along(place, values, [(index, from, offset, least)]) -> whether it could be written
bool draft_along(Observation &whole, size_t place, std::vector<double> values,
                 std::vector<std::tuple<size_t, double, double, double>> columns) {
    auto part = std::make_unique<Along>();
    for (const auto &one : columns) {
        if (std::get<0>(one) >= values.size()) {
            raise(PyExc_IndexError, "there is no such column");
        }
    }
    part->values = values;
    part->columns = columns;
    return write_part(whole, place, std::move(part));
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
bool draft_speed_limit(Observation &whole, size_t place) {
    auto part = std::make_unique<SpeedLimit>();
    part->lane = whole.lane;
    return write_part(whole, place, std::move(part));
}

// light_state(traffic light) -> what its links show; None where libsumo refuses
std::string light_state(std::string light) {
    require_bound();
    return sumo.light(light);
}

PyMethodDef draft_methods[] = {
    {"begin", METHOD(draft_begin), "Begin the observation of a step."},
    {"has", METHOD(draft_has), "Whether a part is written already."},
    {"enter", METHOD(draft_enter), "Take who is in sight from now on."},
    {"put", METHOD(draft_put), "Write numbers."},
    {"put_array", METHOD(draft_put_array), "Write an array."},
    {"ego", METHOD(draft_ego), "Write the part ego; return whether it could be done, as the others here do."},
    {"actors", METHOD(draft_actors), "Write the part actors."},
    {"lanes", METHOD(draft_lanes), "Write the part lanes."},
    {"route", METHOD(draft_route), "Write the part route."},
    {"signals", METHOD(draft_signals), "Write the part signals."},
    {"right_of_way", METHOD(draft_right_of_way), "Write the part right_of_way."},
    {"along", METHOD(draft_along), "Write numbers of which some depend on the position on the lane."},
    {"speed_limit", METHOD(draft_speed_limit), "Write the part speed_limit."},
    {"take", METHOD(draft_take), "Return what has been written as bytes, and begin again."},
    {nullptr, nullptr, 0, nullptr},
};
