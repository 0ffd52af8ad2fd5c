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
const double ALONG = -0.4; // a cosine; Python judges values nearer to the -0.5 of SumoEvents
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

    // Its properties as Python has them; false, with or without an exception, where these are none that can be
    // recorded.
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

    // Adds it to the payload of a record as `encode_actors` does; false if Python has to do it.
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
            char *digits = PyOS_double_to_string(size, 'r', 0, Py_DTSF_ADD_DOT_0, nullptr);
            if (!digits || !std::isfinite(size)) {
                PyMem_Free(digits);
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
    // The actors that the simulator knows, by id, and the numbers of those that are recorded. Called with a vehicle
    // that it does not know, with the properties of one for its reach, with all that are in sight, and to make room for
    // them.
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
    std::map<std::tuple<std::string, double, double>, double> measured; // -1 where `measure` has returned None

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

    // Whether `command` carries out an answer; Python handles all others.
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

    // Writes a record and where the process is; false if Python has to do it.
    bool record(int kind, const void *data, size_t length, Phase phase) {
        Buffer buffer;
        if (offset + length + 16 > reserved || length > UINT32_MAX) {
            return false;
        }
        if (!buffer.open(tape, PyBUF_WRITABLE)) {
            PyErr_Clear();
            return false;
        }
        offset = put_record(buffer.bytes(), offset, tags[kind], data, length);
        say_where(buffer.bytes(), offset, step, phase);
        return true;
    }

    bool record_array(int kind, PyObject *given, Phase phase) {
        Buffer array;
        if (!array.open(given, PyBUF_C_CONTIGUOUS)) {
            PyErr_Clear();
            return false;
        }
        return record(kind, array.bytes(), array.size(), phase);
    }

    // Takes the last record back, which has not been read.
    void forget(size_t end) {
        Buffer buffer;
        if (!buffer.open(tape, PyBUF_WRITABLE)) {
            PyErr_Clear();
            return;
        }
        offset = end;
        say_where(buffer.bytes(), offset, step, ACTING);
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

    // Whether a vehicle braked harder than its limit; -1 if Python has to decide.
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

    // Counts a step in which it stands; false if that is an event, or if Python has to decide. It is asked last.
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

    // The lanes of all actors, as a record has them; false if one is not plain text, or if no actor is on a lane.
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
        Observation *whole = draft ? &self_of<Observation>(draft) : nullptr;
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

    // Makes an array of an observation that is bytes yet, because the agent receives its parts; false with an
    // exception.
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

    // Lets others than before be in sight; false if Python has to do it.
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

    // Sets how far it reaches; false, with or without an exception, where it bends, and so is none that can be read
    // here.
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
                PyErr_Clear();
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
                places.reserve(2 * places.size() + 16); // if there is no memory, Python does the step
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
        Buffer buffer;
        if (!buffer.open(tape, PyBUF_WRITABLE)) {
            PyErr_Clear(); // it had one a moment ago
            return;
        }
        runs.back().places.push_back(offset + 32);
        offset = put_step(buffer.bytes(), offset, tags[2], step, now.time_s, reward, now.values);
        say_where(buffer.bytes(), offset, step, SIMULATING);
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
