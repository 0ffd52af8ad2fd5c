// Steps of SUMO in which nothing happens, each in one call. A part of core.cpp.
//
// Most steps of an episode with one agent are usual: the agent receives its observation and answers a speed or an
// acceleration, and SUMO simulates. No vehicle comes into sight or leaves it, collides, changes roads, brakes hard,
// stands for long or comes within reach. What Episode.step, BlackBox, SumoSimulator.step, Sight.look, SumoEvents.look
// and the oracles do in such a step is done here, with the same records. Any other step is handed back as soon as that
// is seen, and until then nothing has been done that Python would do again.

enum Come { DONE, ASK, REFUSED, ANSWERED, SIMULATED };
enum Takes { NEITHER, SPEED, ACCELERATION };
enum Phase { ACTING = 1, SIMULATING = 2 }; // as BlackBoxHeader has them

const double LOOK_M = 60.0, LOOK_S = 6.0; // as in _surroundings.py
const int LANES_EVERY = 10, DIRECTION_EVERY = 10; // steps
const int PARKED = 2; // of SUMO's stop state
const double STANDING = 0.1;                      // m/s, as Standstill.SPEED
const double LOOKED_INTO = 2.0, TOLERANCE = 0.01; // m/s², as of HardBraking
const double ALONG = -0.4; // a cosine; what comes nearer to the -0.5 of SumoEvents is Python's to judge
const double MOST_SPEED = 100.0, MOST_ACCELERATION = 10.0; // as in _actions.py
const double RADIANS = 3.141592653589793 / 180.0;

struct Moment {
    double time_s = 0;
    std::vector<double> values;
    std::string lanes; // a line each; empty where the step does not look
};

// An actor of the episode, of which Python makes the object when it asks for a roster.
struct Met {
    std::string id, kind;
    double length = 0, width = 0, reach = 0;
    bool parked = false, controlled = false;
    PyObject *name = nullptr, *actor = nullptr;
    long long number = -1; // in the recording; negative until it is recorded

    Met() = default;
    Met(const Met &) = delete;
    ~Met() {
        Py_XDECREF(name);
        Py_XDECREF(actor);
    }

    // Its properties as Python has them; false, with or without an exception, where these are none that can be recorded.
    bool copy(PyObject *other) {
        PyObject *whole = PyObject_GetAttrString(other, "kind");
        Py_ssize_t size = 0;
        const char *text = whole ? PyUnicode_AsUTF8AndSize(whole, &size) : nullptr;
        if (text) {
            kind.assign(text, static_cast<size_t>(size));
        }
        Py_XDECREF(whole);
        double height = 0;
        for (const auto &[property, place] :
             {std::pair("length", &length), std::pair("width", &width), std::pair("height", &height)}) {
            PyObject *value = text ? PyObject_GetAttrString(other, property) : nullptr;
            text = value && PyFloat_CheckExact(value) ? text : nullptr;
            *place = text ? PyFloat_AS_DOUBLE(value) : 0;
            Py_XDECREF(value);
        }
        PyObject *stands = text ? PyObject_GetAttrString(other, "parked") : nullptr;
        parked = stands == Py_True;
        Py_XDECREF(stands);
        if (!stands || height != 0) {
            return false;
        }
        Py_INCREF(other);
        Py_XSETREF(actor, other);
        return true;
    }

    // Adds it to the payload of a record as `encode_actors` does; false where that is Python's to do.
    bool describe(std::string &payload) const {
        for (const std::string *text : {&id, &kind}) {
            for (char letter : *text) {
                if (letter < ' ' || letter > '~' || letter == '"' || letter == '\\') {
                    return false;
                }
            }
        }
        payload.append(payload.empty() ? "[" : ", ").append("[\"" + id + "\", \"" + kind + "\"");
        for (double size : {length, width}) {
            char *digits = std::isfinite(size) ? PyOS_double_to_string(size, 'r', 0, Py_DTSF_ADD_DOT_0, nullptr) : nullptr;
            if (!digits) {
                return false;
            }
            payload.append(", ").append(digits);
            PyMem_Free(digits);
        }
        payload += parked ? ", 0.0, true]" : "]";
        return true;
    }
};

template <typename Kept> void keep(Kept *&place, PyObject *value) {
    Py_INCREF(value);
    Py_XDECREF(reinterpret_cast<PyObject *>(std::exchange(place, reinterpret_cast<Kept *>(value))));
}

struct Steps {
    // of the episode
    std::string agent;
    PyObject *name = nullptr, *libsumo = nullptr, *array = nullptr, *shape = nullptr, *dtype = nullptr;
    PyObject *act = nullptr, *simulate = nullptr; // what these methods are called
    PyObject *perceive = nullptr, *restore = nullptr, *draft = nullptr; // of an observation that consists of parts
    PyObject *whole_type = nullptr, *part_names = nullptr; // null where `restore` has to be called
    PyObject *perceived = nullptr; // what the agent would be shown after `perceived_step`
    long long perceived_step = -1;
    Vehicles *eyes = nullptr;
    size_t others = 0;
    double step_s = 0, start_m = 0, hardest = 0, within = 0;
    int lateral = 0, takes = NEITHER;
    long every = 1;
    PyObject *limits = nullptr, *stood = nullptr; // of HardBraking, and of Standstill
    PyObject *driven_by_agents = nullptr; // the controlled vehicles, by id
    double limit = 0;
    long standstill = 0;
    int always_ask = 0, overlaps = 0;
    long long last = 0, now_and_then = 0;
    // The actors that the simulator knows, by id, and the numbers of those that are recorded. Called with a vehicle that it
    // does not know, with the properties of one for its reach, with all that are in sight, and to make room for them.
    PyObject *known_actors = nullptr, *know = nullptr, *measure = nullptr, *adopt = nullptr;
    PyObject *recorded = nullptr, *record_roster = nullptr;
    // of the present roster, and of the step that is complete
    bool ready = false, stopped = false, known = false; // whether the vehicles were found in the step before
    long long made = 0; // by SUMO so far when they were, vehicles of this and other runs
    struct Sight {
        Vehicles *vehicles = nullptr;
        PyObject *ids = nullptr;
        std::vector<Met *> actors;
        size_t row = 0;
        bool recorded = false;
    } sight, entered;
    Vehicles *before_vehicles = nullptr;
    Earlier earlier;
    long long step = 0;
    Moment now, before, next;
    std::string road, lane, follower, next_follower;
    int lane_index = 0;
    double from_left = 0, reward = 0;
    PyObject *observation = nullptr, *answer = nullptr;
    bool simulating = false;
    // of the black box
    PyObject *tape = nullptr;
    size_t offset = 0, reserved = 0;
    long tags[6] = {}; // of an observation, an action, a step, lanes, a roster, actors
    std::vector<Met *> fresh; // those that are recorded, in order, of which Python does not know that yet
    // Steps with the same actors, whose roster Python makes when it asks for it: many at a time take less.
    struct Run {
        PyObject *vehicles, *ids, *roster;
        std::vector<Met *> actors;
        size_t row;
        std::vector<uint64_t> places; // where the numbers of each step begin
    };
    std::vector<Run> runs;
    std::unordered_map<std::string, Met> met;
    std::map<std::tuple<std::string, double, double>, double> measured; // what `measure` has returned, 0 where it is none

    Steps() = default;
    Steps(const Steps &) = delete;
    ~Steps() {
        for (PyObject *one : {name, libsumo, array, shape, dtype, act, simulate, perceive, restore, draft, whole_type,
                              part_names, perceived, reinterpret_cast<PyObject *>(eyes),
                              limits, stood, driven_by_agents, reinterpret_cast<PyObject *>(sight.vehicles), sight.ids,
                              reinterpret_cast<PyObject *>(entered.vehicles), entered.ids,
                              reinterpret_cast<PyObject *>(before_vehicles), known_actors, know, measure, adopt,
                              recorded, record_roster, observation, answer, tape}) {
            Py_XDECREF(one);
        }
        clear_runs();
    }

    void clear_runs() {
        for (const Run &run : runs) {
            for (PyObject *one : {run.vehicles, run.ids, run.roster}) {
                Py_XDECREF(one);
            }
        }
        runs.clear();
    }

    // The next steps have these actors, whose roster may be null yet.
    void begin_run(Sight &seen, PyObject *roster) {
        runs.push_back({Py_NewRef(reinterpret_cast<PyObject *>(seen.vehicles)), Py_NewRef(seen.ids),
                        Py_XNewRef(roster), seen.actors, seen.row, {}});
        seen.recorded = true;
    }

    // Has Python make each roster that is still missing, and says which actors are recorded; false with an exception.
    bool adopt_all() {
        for (Run &run : runs) {
            if (!run.roster && !(run.roster = roster_of(run.vehicles, run.ids, run.actors, run.row))) {
                return false;
            }
        }
        for (Met *one : fresh) {
            PyObject *number = is_made(*one) ? PyLong_FromLongLong(one->number) : nullptr;
            const bool done = number && PyDict_SetItem(recorded, one->actor, number) == 0;
            Py_XDECREF(number);
            if (!done) {
                return false;
            }
        }
        fresh.clear();
        return true;
    }

    // Has Python make the object of an actor, if there is none yet; false with an exception.
    bool is_made(Met &one) const {
        if (!one.actor) {
            one.actor = PyObject_CallFunction(know, "OsdddO", one.name, one.kind.c_str(), one.length, one.width, 0.0,
                                              one.parked ? Py_True : Py_False);
        }
        return one.actor;
    }

    PyObject *roster_of(PyObject *vehicles, PyObject *ids, const std::vector<Met *> &whose, size_t row) const {
        PyObject *actors = PyTuple_New(static_cast<Py_ssize_t>(whose.size()));
        for (size_t place = 0; actors && place < whose.size(); place++) {
            if (is_made(*whose[place])) {
                PyTuple_SET_ITEM(actors, static_cast<Py_ssize_t>(place), Py_NewRef(whose[place]->actor));
            } else {
                Py_CLEAR(actors);
            }
        }
        return actors ? PyObject_CallFunction(adopt, "OONn", vehicles, ids, actors, static_cast<Py_ssize_t>(row))
                      : nullptr;
    }

    // Returns the roster of the actors in sight from now on, which Python makes at once; null with an exception.
    PyObject *adopt_entered() {
        return adopt_all() ? roster_of(reinterpret_cast<PyObject *>(entered.vehicles), entered.ids, entered.actors,
                                       entered.row)
                           : nullptr;
    }

    // Whether an answer is one that `command` carries out; anything else is Python's.
    bool takes_answer(double value) const {
        return takes == SPEED ? value >= 0.0 && value <= MOST_SPEED : fabs(value) <= MOST_ACCELERATION;
    }

    // As _apply_speed and _apply_acceleration of sumo/_driving.py, without a lane change.
    void command(double value) const {
        if (takes == ACCELERATION) {
            value = sumo.speed(agent) + value * step_s;
            value = value > 0.0 ? value : 0.0;
        }
        sumo.set_speed(agent, value);
    }

    bool able() const { return ready && !stopped && tape && sight.recorded; }

    // Writes a record and where the process is; false where that is Python's to do.
    bool record(int kind, const void *data, size_t length, Phase phase) {
        Py_buffer buffer;
        if (offset + length + 16 > reserved || length > UINT32_MAX) {
            return false;
        }
        if (PyObject_GetBuffer(tape, &buffer, PyBUF_WRITABLE) < 0) {
            PyErr_Clear();
            return false;
        }
        char *start = static_cast<char *>(buffer.buf);
        offset = put_record(start, offset, tags[kind], 0, data, length);
        say_where(start, offset, step, phase, 0);
        PyBuffer_Release(&buffer);
        return true;
    }

    bool record_array(int kind, PyObject *given, Phase phase) {
        Py_buffer array;
        if (PyObject_GetBuffer(given, &array, PyBUF_C_CONTIGUOUS) < 0) {
            PyErr_Clear();
            return false;
        }
        const bool done = record(kind, array.buf, static_cast<size_t>(array.len), phase);
        PyBuffer_Release(&array);
        return done;
    }

    // Takes the last record back, which nobody has read.
    void forget(size_t end) {
        Py_buffer buffer;
        if (PyObject_GetBuffer(tape, &buffer, PyBUF_WRITABLE) < 0) {
            PyErr_Clear();
            return;
        }
        offset = end;
        say_where(static_cast<char *>(buffer.buf), offset, step, ACTING, 0);
        PyBuffer_Release(&buffer);
    }

    // Which way it drives, where it is asked; false where that may be an event.
    bool is_going_along(const Scene &present, const Scene &last, size_t row) const {
        if (lane.empty() || lane[0] == ':') {
            return true;
        }
        const double dx = present.x(row) - last.x(sight.row), dy = present.y(row) - last.y(sight.row);
        const double driven = std::hypot(dx, dy);
        if (driven < STANDING * step_s) {
            return true;
        }
        const double angle = sumo.lane_angle(lane, sumo.along(agent)) * RADIANS;
        return (dx * sin(angle) + dy * cos(angle)) / driven >= ALONG;
    }

    // Whether somebody braked harder than its limit; -1 where Python has to say.
    int is_braking_hard(const Scene &present, const Scene &last, const Sight &who) {
        if (earlier.empty()) {
            const double least = least_of(last, present);
            if (std::isnan(least)) {
                return -1;
            }
            if (least > -LOOKED_INTO * step_s) {
                return 0;
            }
        }
        for (size_t actor = 0; actor < present.size; actor++) {
            const long was = earlier_row(earlier, actor);
            if (was < 0) {
                continue;
            }
            const double deceleration = (last.speeds[was] - present.speeds[actor]) / step_s;
            if (deceleration < LOOKED_INTO || who.actors[actor]->controlled) {
                continue;
            }
            if (std::isnan(deceleration)) {
                return -1;
            }
            PyObject *id = PyTuple_GET_ITEM(who.ids, static_cast<Py_ssize_t>(actor));
            PyObject *known = PyDict_GetItemWithError(limits, id); // borrowed
            double most = known ? PyFloat_AsDouble(known) : limit;
            if (!known && !PyErr_Occurred()) {
                most = limit ? limit : sumo.decel(who.vehicles->roster->ids[actor]);
                PyObject *value = PyFloat_FromDouble(most);
                if (value) {
                    PyDict_SetItem(limits, id, value);
                    Py_DECREF(value);
                }
            }
            if (PyErr_Occurred()) {
                PyErr_Clear();
                return -1;
            }
            if (deceleration > most + TOLERANCE) {
                return 1;
            }
        }
        return 0;
    }

    // Counts a step in which it stands; false where that is an event, or Python's to say. The last thing that is asked.
    bool stands_on(double speed) {
        if (fabs(speed) >= STANDING) {
            return speed > 0 && PyDict_GET_SIZE(stood) == 0;
        }
        if (sumo.stop_state(agent) & 1) {
            return PyDict_GET_SIZE(stood) == 0;
        }
        PyObject *before = PyDict_GetItemWithError(stood, name); // borrowed
        const long count = (before ? PyLong_AsLong(before) : 0) + 1;
        PyObject *value = count >= standstill || PyErr_Occurred() ? nullptr : PyLong_FromLong(count);
        const bool counted = value && PyDict_SetItem(stood, name, value) == 0;
        Py_XDECREF(value);
        if (!counted) {
            PyErr_Clear();
        }
        return counted;
    }

    // The lanes of everybody, as a record has them; false where they are not plain text, or nobody is on one.
    static bool note_lanes(std::string &text, const Roster &roster) {
        text.clear();
        bool first = true;
        for (const std::string &id : roster.ids) {
            const std::string where = sumo.lane(id); // nothing of who is parked
            for (unsigned char letter : where) {
                if (letter >= 128 || letter == '\n') {
                    return false;
                }
            }
            text.append(first ? "" : "\n").append(where);
            first = false;
        }
        return !text.empty();
    }

    // What the agent will be shown; null with or without an exception.
    PyObject *shown(const Scene &present, const Sight &who) {
        const size_t row = who.row;
        if (perceive) {
            perceived_step = step + 1;
            Py_XSETREF(perceived, shown_parts(present, who));
            return Py_XNewRef(perceived);
        }
        double right = from_left, drift = 0.0;
        const double distance = sumo.driven(agent) - start_m;
        if (lateral) {
            right -= sumo.aside(agent);
            drift = -sumo.aside_speed(agent);
        }
        return array_of(observed(present, row, others, distance, right, drift));
    }

    PyObject *shown_parts(const Scene &present, const Sight &who) const {
        Observation *whole = draft ? &observation_of(draft) : nullptr;
        const bool written = whole && whole->again(present, who.vehicles, who.row, lane, next.time_s);
        if (PyErr_Occurred()) {
            return nullptr;
        }
        if (written && !whole->rest) {
            return whole_type ? whole->take() : array_of(whole->take());
        }
        Columns *columns = new_columns(who.vehicles, std::vector<double>(next.values));
        if (written && columns) {
            whole->go_on(columns);
        }
        PyObject *made = columns ? PyObject_CallFunction(perceive, "Odns", columns, next.time_s,
                                                         static_cast<Py_ssize_t>(who.row), lane.c_str())
                                 : nullptr;
        Py_XDECREF(reinterpret_cast<PyObject *>(columns));
        return made;
    }

    // Makes an array of an observation that is bytes yet, because the agent receives its parts; false with an exception.
    bool show_array(PyObject *&place) const {
        if (place && PyBytes_CheckExact(place)) {
            place = array_of(place);
        }
        return place || !PyErr_Occurred();
    }

    // Bytes as an array of NumPy's; null with an exception, as they then are.
    PyObject *array_of(PyObject *bytes) const {
        PyObject *given[] = {shape, dtype, bytes};
        PyObject *found = bytes ? PyObject_Vectorcall(array, given, 3, nullptr) : nullptr;
        Py_XDECREF(bytes);
        return found;
    }

    // What the agent receives, which is as `restore` makes it; null with an exception.
    PyObject *received() const {
        if (!restore) {
            return Py_NewRef(observation);
        }
        if (!whole_type) {
            return PyObject_CallOneArg(restore, observation);
        }
        PyObject *none = PyTuple_New(0), *given[] = {none, whole_type, observation};
        PyObject *whole = none ? PyObject_Vectorcall(array, given, 3, nullptr) : nullptr;
        PyObject *parts = whole ? PyDict_New() : nullptr;
        for (Py_ssize_t number = 0; parts && number < PyTuple_GET_SIZE(part_names); number++) {
            PyObject *name = PyTuple_GET_ITEM(part_names, number), *part = PyObject_GetItem(whole, name);
            if (!part || PyDict_SetItem(parts, name, part) < 0) {
                Py_CLEAR(parts);
            }
            Py_XDECREF(part);
        }
        Py_XDECREF(whole);
        Py_XDECREF(none);
        return parts;
    }

    // Who is in sight, as Python says; false with an exception.
    bool set_sight(PyObject *vehicles, PyObject *ids, Py_ssize_t row, PyObject *controlled, PyObject *actors) {
        const Roster &roster = *reinterpret_cast<Vehicles *>(vehicles)->roster;
        const size_t size = roster.ids.size();
        const auto rows = [&](PyObject *tuple) { return static_cast<size_t>(PyTuple_GET_SIZE(tuple)); };
        if (roster.lengths.size() != size || rows(ids) != size || row < 0 || static_cast<size_t>(row) >= size ||
            rows(actors) != size) {
            PyErr_SetString(PyExc_ValueError, "these are not the vehicles of the scene");
            return false;
        }
        sight.actors.clear();
        for (size_t place = 0; place < size; place++) {
            PyObject *name = PyTuple_GET_ITEM(ids, static_cast<Py_ssize_t>(place));
            PyObject *actor = PyTuple_GET_ITEM(actors, static_cast<Py_ssize_t>(place));
            Met &one = met[roster.ids[place]];
            const int driven = PyDict_Contains(controlled, name);
            if (driven < 0) {
                return false;
            }
            one.id = roster.ids[place];
            one.controlled = driven;
            one.length = roster.lengths[place], one.width = roster.widths[place], one.reach = roster.reaches[place];
            keep(one.name, name);
            keep(one.actor, actor);
            sight.actors.push_back(&one);
        }
        keep(driven_by_agents, controlled);
        keep(sight.vehicles, vehicles);
        keep(sight.ids, ids);
        sight.recorded = false;
        sight.row = static_cast<size_t>(row);
        return true;
    }

    // Lets others than before be in sight; false where that is Python's to do.
    bool let_in() {
        // Most are where they were in the list.
        const std::vector<std::string> &were = sight.vehicles->roster->ids;
        size_t from = 0;
        for (size_t number : around.near) {
            long row_before = -1;
            for (size_t tried = 0; tried < were.size() && row_before < 0; tried++) {
                const size_t at = (from + tried) % were.size();
                if (were[at] == around.names[number]) {
                    row_before = static_cast<long>(at);
                    from = at + 1;
                }
            }
            earlier.push_back(row_before);
        }
        const bool known = recorded && know && meet_all();
        PyErr_Clear(); // it is said again
        return known;
    }

    // A vehicle that was not in sight; null where it is none that can be read here.
    Met *meet_one(const std::string &id) {
        Met &one = met[id];
        if (!one.name && !(one.name = text_of(id))) {
            return nullptr;
        }
        one.id = id;
        PyObject *known = PyDict_GetItemWithError(known_actors, one.name); // borrowed
        if (one.number >= 0 && (!known || known == one.actor)) {
            return &one;
        }
        const int driven = PyDict_Contains(driven_by_agents, one.name);
        PyObject *number = nullptr; // borrowed
        if (known) {
            number = one.copy(known) ? PyDict_GetItemWithError(recorded, known) : nullptr;
            if (one.actor != known) {
                return nullptr;
            }
        } else {
            one.kind = sumo.kind(id);
            one.length = sumo.length(id), one.width = sumo.width(id);
            one.parked = sumo.stop_state(id) & PARKED;
        }
        one.number = number ? PyLong_AsLongLong(number) : -1;
        one.controlled = driven > 0;
        return PyErr_Occurred() || !is_measured(one) ? nullptr : &one;
    }

    // Sets how far it reaches; false, with or without an exception, where it bends, and so is none that can be read here.
    bool is_measured(Met &one) {
        const auto found = measured.emplace(std::tuple(one.kind, one.length, one.width), -1);
        double &reach = found.first->second;
        if (found.second) {
            PyObject *value = PyObject_CallFunction(measure, "sdd", one.kind.c_str(), one.length, one.width);
            reach = value && value != Py_None ? PyFloat_AsDouble(value) : -1;
            Py_XDECREF(value);
        }
        one.reach = reach;
        return reach >= 0;
    }

    // Fills in who is in sight now: as before, who was, and otherwise as Python has met them.
    bool meet_all() {
        const size_t count = earlier.size();
        Py_XSETREF(entered.vehicles, reinterpret_cast<Vehicles *>(vehicles_type->tp_alloc(vehicles_type, 0)));
        Py_XSETREF(entered.ids, PyTuple_New(static_cast<Py_ssize_t>(count)));
        entered.recorded = false;
        entered.actors.clear();
        if (!entered.vehicles || !entered.ids) {
            return false;
        }
        Roster &roster = *(entered.vehicles->roster = new Roster());
        bool present = false;
        for (size_t row = 0; row < count; row++) {
            const long was = earlier[row];
            Met *one = was >= 0 ? sight.actors[was] : meet_one(around.names[around.near[row]]);
            if (!one) {
                return false;
            }
            PyTuple_SET_ITEM(entered.ids, static_cast<Py_ssize_t>(row), Py_NewRef(one->name));
            entered.actors.push_back(one);
            roster.ids.push_back(one->id);
            roster.lengths.push_back(one->length);
            roster.widths.push_back(one->width);
            roster.reaches.push_back(one->reach);
            if (was == static_cast<long>(sight.row)) {
                entered.row = row;
                present = true;
            }
        }
        return present;
    }

    // Records who is in sight now; negative with an exception, such as of a disk that is full, and REFUSED where it is
    // Python's to go on.
    int note_roster() {
        // Only where it makes a part of the observation, Python has to know them in this step.
        PyObject *roster = perceive ? adopt_entered() : nullptr;
        if (perceive && !roster) {
            PyErr_Clear();
            return REFUSED;
        }
        std::string actors;
        for (const Met *one : entered.actors) {
            if (one->number < 0 && !one->describe(actors)) {
                Py_XDECREF(roster);
                return REFUSED;
            }
        }
        for (Met *one : entered.actors) {
            if (one->number < 0) {
                one->number = PyDict_GET_SIZE(recorded) + static_cast<long long>(fresh.size());
                fresh.push_back(one);
            }
        }
        const int noted = note_sight(actors.empty() ? actors : actors.append("]"), roster);
        Py_XDECREF(roster);
        return noted;
    }

    // Records those who are in sight now, and before them the actors that have been numbered; as `note_roster`.
    int note_sight(const std::string &actors, PyObject *roster) {
        std::vector<uint32_t> present;
        for (const Met *one : entered.actors) {
            present.push_back(static_cast<uint32_t>(one->number));
        }
        const size_t size = 4 * present.size();
        if (offset + actors.size() + size + 64 > reserved) {
            PyObject *known = !roster ? adopt_entered() : adopt_all() ? Py_NewRef(roster) : nullptr;
            PyObject *done = known ? PyObject_CallFunction(record_roster, "((y#y#))", actors.data(),
                                                           static_cast<Py_ssize_t>(actors.size()),
                                                           reinterpret_cast<const char *>(present.data()),
                                                           static_cast<Py_ssize_t>(size))
                                   : nullptr;
            Py_XDECREF(known);
            Py_XDECREF(done);
            return !done ? -1 : able() ? DONE : REFUSED;
        }
        if (!actors.empty()) {
            record(5, actors.data(), actors.size(), SIMULATING);
        }
        record(4, present.data(), size, SIMULATING);
        begin_run(entered, roster);
        return DONE;
    }

    // Takes the numbers of actors from the payload of a record; false with an exception.
    static bool number(const std::vector<Met *> &actors, const char *bytes, Py_ssize_t length) {
        if (static_cast<size_t>(length) != 4 * actors.size()) {
            PyErr_SetString(PyExc_ValueError, "these are not the numbers of the actors");
            return false;
        }
        for (Met *one : actors) {
            uint32_t given;
            memcpy(&given, bytes, 4);
            bytes += 4;
            one->number = given;
        }
        return true;
    }

    // What has come of a step that has been simulated; negative with an exception. Everything is read before anything
    // is noted.
    int look() {
        earlier.clear();
        const int come = look_around();
        earlier.clear();
        return come == SIMULATED && !adopt_all() ? -1 : come;
    }

    int look_around() {
        const long long number = step + 1;
        PyObject *seen = nullptr;
        bool near = false;
        try {
            if (sumo.vanishing() || sumo.parking() || sumo.unparking() || sumo.on_foot() || sumo.emergencies() ||
                !sumo.collisions().empty()) {
                return SIMULATED;
            }
            if (number % every == 0 || sumo.departed() || sumo.arrived() || sumo.appearing()) {
                around.look(*eyes->roster, within);
                if (!around.same(*sight.vehicles->roster) && !let_in()) {
                    return SIMULATED;
                }
            }
            const bool others = !earlier.empty();
            const Sight &who = others ? entered : sight;
            const Roster &roster = *who.vehicles->roster;
            if (sumo.lane_index(agent) != lane_index || sumo.road(agent) != road) {
                return SIMULATED;
            }
            // A vehicle that goes is told of in the step in which it does, if it is one step that has been taken.
            next.time_s = sumo.time();
            const bool one_step = !sumo.arrived() && fabs(next.time_s - now.time_s - step_s) < step_s / 2;
            // An agent may go back to a state that it has saved: the same vehicles, and all of them made anew.
            const bool still = known && one_step && made == *sumo.made;
            known = false;
            read_into(roster, next.values, still && !others);
            known = true;
            made = *sumo.made;
            next.lanes.clear();
            const Scene present(next.values, &roster), last(now.values, sight.vehicles->roster);
            if ((number % LANES_EVERY == 0 && !note_lanes(next.lanes, roster)) ||
                (number % DIRECTION_EVERY == 0 && !is_going_along(present, last, who.row)) ||
                is_braking_hard(present, last, who)) {
                return SIMULATED;
            }
            next_follower = sumo.follower(agent, 0.0).first;
            if (overlaps) {
                near = !reach(present, last, who.row, next.time_s - now.time_s, hardest, reached, earlier) ||
                       !reached.empty();
            }
            if (others) {
                const int noted = note_roster();
                if (noted != DONE) {
                    return noted < 0 ? noted : SIMULATED;
                }
            }
            const size_t records = 8 * (2 + 1 + next.values.size()) + next.lanes.size() + 64;
            if (offset + records > reserved) {
                return SIMULATED;
            }
            std::vector<uint64_t> &places = runs.back().places;
            if (places.size() == places.capacity()) {
                places.reserve(2 * places.size() + 16); // where there is no memory, the step is Python's
            }
            seen = shown(present, who);
            if (!seen) {
                if (PyErr_Occurred() && !PyErr_ExceptionMatches(PyExc_Exception)) {
                    return -1; // such as Ctrl-C
                }
                PyErr_Clear(); // Python says it again
                return SIMULATED;
            }
            if (!stands_on(present.speeds[who.row])) {
                Py_DECREF(seen);
                return SIMULATED;
            }
        } catch (...) { // libsumo's own exceptions: its getters raise the same, as Python's
            Py_XDECREF(seen);
            return SIMULATED;
        }
        Py_XSETREF(observation, seen);
        if (before_vehicles != sight.vehicles) {
            keep(before_vehicles, reinterpret_cast<PyObject *>(sight.vehicles));
        }
        if (!earlier.empty()) {
            std::swap(sight, entered);
        }
        reward = next.values[3 * (next.values.size() / 4) + sight.row] * step_s;
        std::swap(before, now);
        std::swap(now, next);
        std::swap(follower, next_follower);
        write();
        return near || always_ask || step >= last || step % now_and_then == 0 ? ASK : DONE;
    }

    void write() {
        if (!now.lanes.empty()) {
            record(3, now.lanes.data(), now.lanes.size(), SIMULATING);
        }
        step++;
        Py_buffer buffer;
        if (PyObject_GetBuffer(tape, &buffer, PyBUF_WRITABLE) < 0) {
            PyErr_Clear(); // it had one a moment ago
            return;
        }
        char *start = static_cast<char *>(buffer.buf);
        char *rewards = put_step(start + offset, tags[2], step, now.time_s, 1, now.values);
        memcpy(rewards, &reward, 8);
        runs.back().places.push_back(offset + 32);
        offset += 32 + 8 * now.values.size();
        say_where(start, offset, step, SIMULATING, 0);
        PyBuffer_Release(&buffer);
    }

    PyObject *go_on(bool quiet) {
        simulating = true;
        try {
            known = known && !sumo.arrived(); // whom the agent itself has taken away is told of until the next step
        } catch (...) {
            known = false;
        }
        PyObject *done = PyObject_CallMethodNoArgs(libsumo, simulate);
        if (!done) {
            return nullptr;
        }
        Py_DECREF(done);
        const int come = quiet && able() ? look() : static_cast<int>(SIMULATED);
        return come < 0 ? nullptr : PyLong_FromLong(come);
    }
};

struct UsualSteps {
    PyObject_HEAD Steps *steps;
};

Steps &steps_of(PyObject *object) { return *reinterpret_cast<UsualSteps *>(object)->steps; }

// UsualSteps(agent, libsumo, (array, shape, dtype), others, step_s, lateral, takes, (eyes, every, within), start_m)
PyObject *usual_new(PyTypeObject *type, PyObject *arguments, PyObject *) {
    PyObject *name, *libsumo, *array, *shape, *dtype, *eyes;
    Py_ssize_t others;
    double step_s, within, start_m;
    int lateral, takes;
    long every;
    if (!PyArg_ParseTuple(arguments, "UO(OOO)ndpi(Old)d", &name, &libsumo, &array, &shape, &dtype, &others, &step_s,
                          &lateral, &takes, &eyes, &every, &within, &start_m) ||
        !vehicles_of(eyes)) {
        return nullptr;
    }
    if (others < 0 || every < 1) {
        PyErr_SetString(PyExc_ValueError, "it looks around every so many steps, and sees so many others");
        return nullptr;
    }
    std::string agent;
    UsualSteps *self = encode_name(name, agent) ? reinterpret_cast<UsualSteps *>(type->tp_alloc(type, 0)) : nullptr;
    if (!self) {
        return nullptr;
    }
    Steps &steps = *(self->steps = new Steps());
    steps.agent = agent;
    keep(steps.name, name);
    keep(steps.libsumo, libsumo);
    keep(steps.array, array);
    keep(steps.shape, shape);
    keep(steps.dtype, dtype);
    keep(steps.eyes, eyes);
    steps.others = static_cast<size_t>(others);
    steps.step_s = step_s;
    steps.lateral = lateral;
    steps.takes = takes;
    steps.every = every;
    steps.within = within;
    steps.start_m = start_m;
    steps.act = PyUnicode_InternFromString("act");
    steps.simulate = PyUnicode_InternFromString("simulationStep");
    if (!steps.act || !steps.simulate) {
        Py_DECREF(self);
        return nullptr;
    }
    return reinterpret_cast<PyObject *>(self);
}

// heed(limits, limit, stood, standstill): what SumoEvents counts
PyObject *usual_heed(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *limits, *stood;
    if (!PyArg_ParseTuple(arguments, "O!dO!l", &PyDict_Type, &limits, &steps.limit, &PyDict_Type, &stood,
                          &steps.standstill)) {
        return nullptr;
    }
    keep(steps.limits, limits);
    keep(steps.stood, stood);
    Py_RETURN_NONE;
}

// meet(known actors, know, measure, adopt): of whom is asked about vehicles that come into sight
PyObject *usual_meet(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *known, *know, *measure, *adopt;
    if (!PyArg_ParseTuple(arguments, "O!OOO", &PyDict_Type, &known, &know, &measure, &adopt)) {
        return nullptr;
    }
    keep(steps.known_actors, known);
    keep(steps.know, know);
    keep(steps.measure, measure);
    keep(steps.adopt, adopt);
    Py_RETURN_NONE;
}

// listen(numbers, record_roster): the numbers of the actors that are recorded, and who makes room for further ones
PyObject *usual_listen(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *numbers, *record_roster;
    if (!PyArg_ParseTuple(arguments, "O!O", &PyDict_Type, &numbers, &record_roster)) {
        return nullptr;
    }
    keep(steps.recorded, numbers);
    keep(steps.record_roster, record_roster);
    Py_RETURN_NONE;
}

// perceive(make, restore, draft | None, record, names): an observation is an array that the first makes where it cannot be
// written from the draft again, and the agent receives what the second returns: the values with these names, where the
// record is the type of all of them as one value
PyObject *usual_perceive(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *make, *restore, *draft, *record, *names;
    if (!PyArg_ParseTuple(arguments, "OOOOO!", &make, &restore, &draft, &record, &PyTuple_Type, &names)) {
        return nullptr;
    }
    if (draft != Py_None && Py_TYPE(draft) != draft_type) {
        return PyErr_Format(PyExc_TypeError, "this is no draft of the core");
    }
    keep(steps.perceive, make);
    keep(steps.restore, restore);
    if (record != Py_None) {
        keep(steps.whole_type, record);
        keep(steps.part_names, names);
    }
    if (draft != Py_None) {
        keep(steps.draft, draft);
    }
    Py_RETURN_NONE;
}

// perceived(step) -> what the agent would be shown after a step, if that has been made; None otherwise
PyObject *usual_perceived(PyObject *object, PyObject *number) {
    Steps &steps = steps_of(object);
    const long long step = PyLong_AsLongLong(number);
    if ((step == -1 && PyErr_Occurred()) || !steps.show_array(steps.perceived)) {
        return nullptr;
    }
    return Py_NewRef(steps.perceived && step == steps.perceived_step ? steps.perceived : Py_None);
}

// judge(overlaps, hardest, always_ask, last, now_and_then): when somebody has to be asked about a step
PyObject *usual_judge(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    if (!PyArg_ParseTuple(arguments, "pdpLL", &steps.overlaps, &steps.hardest, &steps.always_ask, &steps.last,
                          &steps.now_and_then)) {
        return nullptr;
    }
    steps.now_and_then = std::max(steps.now_and_then, 1LL);
    Py_RETURN_NONE;
}

// resume((vehicles, ids, row, controlled, actors), observation, columns, time_s, lanes, (road, lane_index, lane, from_left),
//        follower, step)
PyObject *usual_resume(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *vehicles, *ids, *controlled, *actors, *observation, *columns;
    Py_ssize_t row;
    const char *lanes, *road, *lane, *follower;
    double time_s, from_left;
    int lane_index;
    long long step;
    steps.ready = false;
    if (!PyArg_ParseTuple(arguments, "(OO!nO!O!)OOds(sisd)sL", &vehicles, &PyTuple_Type, &ids, &row, &PyDict_Type,
                          &controlled, &PyTuple_Type, &actors, &observation, &columns, &time_s, &lanes, &road,
                          &lane_index, &lane, &from_left, &follower, &step) ||
        !vehicles_of(vehicles) || !columns_of(columns)) {
        return nullptr;
    }
    const Scene scene(reinterpret_cast<Columns *>(columns));
    const Roster &roster = *reinterpret_cast<Vehicles *>(vehicles)->roster;
    if (!steps.limits || !steps.stood || roster.ids.size() != scene.size) {
        PyErr_SetString(PyExc_ValueError, "these are not the vehicles of the scene");
        return nullptr;
    }
    if (!steps.set_sight(vehicles, ids, row, controlled, actors)) {
        return nullptr;
    }
    keep(steps.before_vehicles, vehicles);
    keep(steps.observation, observation);
    steps.now.values = *reinterpret_cast<Columns *>(columns)->values;
    steps.now.time_s = time_s;
    steps.now.lanes = lanes;
    steps.road = road;
    steps.lane = lane;
    steps.lane_index = lane_index;
    steps.from_left = from_left;
    steps.follower = follower;
    steps.step = step;
    steps.known = false;
    steps.ready = true;
    Py_RETURN_NONE;
}

// borrow(map, offset, reserved, (tags of an observation, an action, a step, lanes, a roster, actors), roster, numbers): the
// roster is of those in sight, and has been recorded with these numbers
PyObject *usual_borrow(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    PyObject *tape, *roster;
    Py_ssize_t offset, reserved, length;
    const char *numbers;
    if (!PyArg_ParseTuple(arguments, "Onn(llllll)Oy#", &tape, &offset, &reserved, &steps.tags[0], &steps.tags[1],
                          &steps.tags[2], &steps.tags[3], &steps.tags[4], &steps.tags[5], &roster, &numbers, &length)) {
        return nullptr;
    }
    Py_buffer buffer;
    if (PyObject_GetBuffer(tape, &buffer, PyBUF_WRITABLE) < 0) {
        return nullptr;
    }
    const bool fits = offset >= 64 && offset <= buffer.len && reserved >= 0;
    steps.reserved = static_cast<size_t>(std::min(reserved, buffer.len));
    PyBuffer_Release(&buffer);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "nothing can be written there");
        return nullptr;
    }
    Steps::Sight &seen = steps.earlier.empty() ? steps.sight : steps.entered;
    if (!seen.vehicles || !Steps::number(seen.actors, numbers, length)) {
        return PyErr_Occurred() ? nullptr : PyErr_Format(PyExc_ValueError, "no vehicle is in sight");
    }
    keep(steps.tape, tape);
    steps.offset = static_cast<size_t>(offset);
    steps.clear_runs();
    steps.begin_run(seen, roster);
    Py_RETURN_NONE;
}

// give_back() -> (offset, step, the last roster, [(roster, where the numbers begin of each of its steps)])
PyObject *usual_give_back(PyObject *object, PyObject *) {
    Steps &steps = steps_of(object);
    PyObject *runs = steps.adopt_all() ? PyList_New(0) : nullptr;
    bool good = runs;
    for (const Steps::Run &run : steps.runs) {
        if (good && !run.places.empty()) {
            PyObject *pair = Py_BuildValue("(Oy#)", run.roster, reinterpret_cast<const char *>(run.places.data()),
                                           static_cast<Py_ssize_t>(8 * run.places.size()));
            good = pair && PyList_Append(runs, pair) == 0;
            Py_XDECREF(pair);
        }
    }
    PyObject *last = steps.runs.empty() ? Py_None : steps.runs.back().roster;
    PyObject *given = good ? Py_BuildValue("(nLOO)", static_cast<Py_ssize_t>(steps.offset), steps.step, last, runs)
                           : nullptr;
    Py_XDECREF(runs);
    if (given) {
        steps.clear_runs();
        Py_CLEAR(steps.tape);
    }
    return given;
}

// take(agents) -> what has come of it
PyObject *usual_take(PyObject *object, PyObject *agents) {
    Steps &steps = steps_of(object);
    steps.simulating = false;
    if (!steps.able() || !PyDict_CheckExact(agents)) {
        return PyLong_FromLong(REFUSED);
    }
    PyObject *agent = PyDict_GetItemWithError(agents, steps.name); // borrowed
    if (!agent || !steps.record_array(0, steps.observation, ACTING)) {
        return PyErr_Occurred() ? nullptr : PyLong_FromLong(REFUSED);
    }
    // Whatever the agent does, both stay what they are for as long as it does it.
    Py_INCREF(agent);
    PyObject *observation = steps.received();
    PyObject *answer = observation ? PyObject_CallMethodOneArg(agent, steps.act, observation) : nullptr;
    Py_DECREF(agent);
    Py_XDECREF(observation);
    if (!answer) {
        return nullptr;
    }
    Py_XSETREF(steps.answer, answer);
    if (!steps.able() || steps.takes == NEITHER || !PyTuple_CheckExact(answer) || PyTuple_GET_SIZE(answer) != 2) {
        return PyLong_FromLong(ANSWERED);
    }
    PyObject *value = PyTuple_GET_ITEM(answer, 0), *change = PyTuple_GET_ITEM(answer, 1);
    int overflow = 0;
    if (!PyFloat_CheckExact(value) || !PyLong_CheckExact(change) ||
        PyLong_AsLongAndOverflow(change, &overflow) != 0 || overflow) {
        return PyLong_FromLong(ANSWERED);
    }
    const double action[2] = {PyFloat_AS_DOUBLE(value), 0.0};
    const size_t end = steps.offset;
    if (!steps.takes_answer(action[0]) || !steps.record(1, action, sizeof action, SIMULATING)) {
        return PyLong_FromLong(ANSWERED);
    }
    try {
        steps.command(action[0]);
    } catch (...) { // Python's own way of saying it
        steps.forget(end);
        return PyLong_FromLong(ANSWERED);
    }
    return steps.go_on(true);
}

// note(action) -> whether it is recorded; next comes the simulator
PyObject *usual_note(PyObject *object, PyObject *action) {
    Steps &steps = steps_of(object);
    steps.simulating = true;
    return PyBool_FromLong(steps.able() && steps.record_array(1, action, SIMULATING));
}

PyObject *usual_go_on(PyObject *object, PyObject *quiet) { return steps_of(object).go_on(quiet == Py_True); }

PyObject *usual_pause(PyObject *object, PyObject *) {
    steps_of(object).ready = false;
    Py_RETURN_NONE;
}

PyObject *usual_stop(PyObject *object, PyObject *) {
    steps_of(object).stopped = true;
    Py_RETURN_NONE;
}

// told() -> (step, observation, reward, follower, (vehicles, time_s, lanes), the same of the step before)
PyObject *usual_told(PyObject *object, PyObject *) {
    Steps &steps = steps_of(object);
    if (!steps.ready) {
        Py_RETURN_NONE;
    }
    if (!steps.adopt_all() || !steps.show_array(steps.observation)) {
        return nullptr;
    }
    return Py_BuildValue("(LOdN(OdN)(OdN))", steps.step, steps.observation, steps.reward, text_of(steps.follower),
                         steps.sight.vehicles, steps.now.time_s, text_of(steps.now.lanes), steps.before_vehicles,
                         steps.before.time_s, text_of(steps.before.lanes));
}

// columns(back) -> Columns, of the step that is complete or, where it is true, of the one before
PyObject *usual_columns(PyObject *object, PyObject *back) {
    const Steps &steps = steps_of(object);
    const Moment &moment = back == Py_True ? steps.before : steps.now;
    Vehicles *vehicles = back == Py_True ? steps.before_vehicles : steps.sight.vehicles;
    if (!steps.ready || moment.values.size() != 4 * vehicles->roster->ids.size()) {
        Py_RETURN_NONE;
    }
    return reinterpret_cast<PyObject *>(new_columns(vehicles, std::vector<double>(moment.values)));
}

// state() -> (x, y, heading, speed) of the agent in the step that is complete
PyObject *usual_state(PyObject *object, PyObject *) {
    const Steps &steps = steps_of(object);
    const std::vector<double> &values = steps.now.values;
    const size_t count = values.size() / 4, row = steps.sight.row;
    if (!steps.ready || row >= count) {
        Py_RETURN_NONE;
    }
    return Py_BuildValue("(dddd)", values[2 * row], values[2 * row + 1], values[2 * count + row],
                         values[3 * count + row]);
}

// ahead() -> (name, gap, speed) of the vehicle ahead, as `_surroundings.nearest_ahead_of` returns them; there are no
// persons in a step that is complete here, so none of them can be ahead
PyObject *usual_ahead(PyObject *object, PyObject *) {
    const Steps &steps = steps_of(object);
    if (unbound()) {
        return nullptr;
    }
    try {
        const double look = std::max(LOOK_M, LOOK_S * std::max(0.0, sumo.speed(steps.agent)));
        const std::pair<std::string, double> found = sumo.leader(steps.agent, look);
        if (found.first.empty()) {
            return Py_BuildValue("(sdd)", "", HUGE_VAL, HUGE_VAL);
        }
        return Py_BuildValue("(Ndd)", text_of(found.first), found.second + sumo.min_gap(steps.agent),
                             std::max(0.0, sumo.speed(found.first)));
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// reads(vehicles) -> what libsumo says of them and of the agent, by the functions that are used here alone
PyObject *usual_reads(PyObject *object, PyObject *given) {
    const Steps &steps = steps_of(object);
    Vehicles *vehicles = vehicles_of(given);
    if (!vehicles || unbound()) {
        return nullptr;
    }
    try {
        const std::string lane = sumo.lane(steps.agent), kind = sumo.kind(steps.agent);
        const double along = sumo.along(steps.agent), angle = sumo.lane_angle(lane, along);
        std::string lanes;
        for (const std::string &id : vehicles->roster->ids) {
            lanes += sumo.lane(id) + '\n';
        }
        return Py_BuildValue("(NidddddddNNidisdd)", text_of(sumo.road(steps.agent)), sumo.lane_index(steps.agent),
                             sumo.driven(steps.agent), sumo.aside(steps.agent), sumo.aside_speed(steps.agent), along,
                             angle, sumo.speed_limit(lane), sumo.decel(steps.agent), text_of(lanes),
                             text_of(sumo.follower(steps.agent, 0.0).first), sumo.stop_state(steps.agent), sumo.time(),
                             sumo.emergencies(), kind.c_str(), sumo.length(steps.agent), sumo.width(steps.agent));
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// Handed over: it may be a view of what the agent goes on with, and is let go as soon as it has been read.
PyObject *usual_answer(PyObject *object, void *) {
    PyObject *answer = std::exchange(steps_of(object).answer, nullptr);
    return answer ? answer : Py_NewRef(Py_None);
}

PyObject *usual_step(PyObject *object, void *) { return PyLong_FromLongLong(steps_of(object).step); }

PyObject *usual_simulating(PyObject *object, void *) { return PyBool_FromLong(steps_of(object).simulating); }

PyMethodDef usual_methods[] = {
    {"take", usual_take, METH_O, "Take a step; return what has come of it."},
    {"note", usual_note, METH_O, "Record an action; return whether that could be done."},
    {"go_on", usual_go_on, METH_O, "Simulate, and look where nothing has happened yet; return what has come of it."},
    {"heed", usual_heed, METH_VARARGS, "Take what is counted of braking and of standing."},
    {"meet", usual_meet, METH_VARARGS, "Take who is asked about vehicles that come into sight."},
    {"listen", usual_listen, METH_VARARGS, "Take the numbers of recorded actors, and who makes room for others."},
    {"perceive", usual_perceive, METH_VARARGS, "Take what makes and restores observations that consist of parts."},
    {"perceived", usual_perceived, METH_O, "Return what has been made for a step; None if nothing has."},
    {"judge", usual_judge, METH_VARARGS, "Take when somebody has to be asked about a step."},
    {"resume", usual_resume, METH_VARARGS, "Go on from a step that is complete."},
    {"borrow", usual_borrow, METH_VARARGS, "Record into a buffer from now on."},
    {"give_back", usual_give_back, METH_NOARGS, "Record no more; return what has been recorded."},
    {"pause", usual_pause, METH_NOARGS, "Take no steps until it is resumed."},
    {"stop", usual_stop, METH_NOARGS, "Take no further steps."},
    {"told", usual_told, METH_NOARGS, "Return what is known about the step that is complete."},
    {"columns", usual_columns, METH_O, "Return where everybody is, or was a step before."},
    {"ahead", usual_ahead, METH_NOARGS, "Return name, gap and speed of the vehicle ahead."},
    {"state", usual_state, METH_NOARGS, "Return position, heading and speed of the agent."},
    {"reads", usual_reads, METH_O, "Return what is read here alone, to be compared."},
    {nullptr, nullptr, 0, nullptr},
};
PyGetSetDef usual_getters[] = {
    {"answer", usual_answer, nullptr, "What the agent answered last, once.", nullptr},
    {"step", usual_step, nullptr, "The number of the step that is complete.", nullptr},
    {"simulating", usual_simulating, nullptr, "Whether the last step had come to the simulator.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};
PyType_Slot usual_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(usual_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(free_object<UsualSteps, &UsualSteps::steps>)},
    {Py_tp_methods, usual_methods},
    {Py_tp_getset, usual_getters},
    {Py_tp_doc, const_cast<char *>("Steps of an episode in which nothing happens, each in one call.")},
    {0, nullptr},
};
PyType_Spec usual_spec = {"_crashhunt_core.UsualSteps", sizeof(UsualSteps), 0, Py_TPFLAGS_DEFAULT, usual_slots};
