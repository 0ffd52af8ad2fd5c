// The object with which Python has steps taken at once. A part of core.cpp.

struct UsualSteps {
    PyObject_HEAD Steps *steps;
};

template <> Steps &self_of<Steps>(PyObject *object) { return *reinterpret_cast<UsualSteps *>(object)->steps; }

// UsualSteps(agent, libsumo, (array, shape, dtype), others, step_s, lateral, takes, (eyes, every, within), start_m)
std::unique_ptr<Steps> make_steps(PyObject *name, PyObject *libsumo, std::tuple<PyObject *, PyObject *, PyObject *> array,
                                  size_t others, double step_s, bool lateral, int takes,
                                  std::tuple<Vehicles *, long, double> sight, double start_m) {
    auto steps = std::make_unique<Steps>();
    steps->agent = From<std::string>::of(name);
    keep(steps->name, name);
    keep(steps->libsumo, libsumo);
    keep(steps->array, std::get<0>(array));
    keep(steps->shape, std::get<1>(array));
    keep(steps->dtype, std::get<2>(array));
    steps->others = others;
    steps->step_s = step_s;
    steps->lateral = lateral;
    steps->takes = takes;
    keep(steps->eyes, reinterpret_cast<PyObject *>(std::get<0>(sight)));
    steps->every = std::get<1>(sight);
    steps->within = std::get<2>(sight);
    steps->start_m = start_m;
    steps->act = PyUnicode_InternFromString("act");
    steps->simulate = PyUnicode_InternFromString("simulationStep");
    if (!steps->act || !steps->simulate) {
        throw Raised();
    }
    if (steps->every < 1) {
        raise(PyExc_ValueError, "it looks around every so many steps");
    }
    return steps;
}

// heed(limits, limit, stood, standstill): what SumoEvents counts
void usual_heed(Steps &steps, Dict limits, double limit, Dict stood, long standstill) {
    keep(steps.limits, limits);
    keep(steps.stood, stood);
    steps.limit = limit;
    steps.standstill = standstill;
}

// meet(known actors, know, measure, adopt): of whom is asked about vehicles that come into sight
void usual_meet(Steps &steps, Dict known, PyObject *know, PyObject *measure, PyObject *adopt) {
    keep(steps.known_actors, known);
    keep(steps.know, know);
    keep(steps.measure, measure);
    keep(steps.adopt, adopt);
}

// listen(numbers, record_roster): the numbers of the actors that are recorded, and who makes room for further ones
void usual_listen(Steps &steps, Dict numbers, PyObject *record_roster) {
    keep(steps.recorded, numbers);
    keep(steps.record_roster, record_roster);
}

// perceive(make, restore, draft | None, record, names): an observation is an array that the first makes where it cannot
// be written from the draft again, and the agent receives what the second returns: the values with these names, where
// the record is the type of all of them as one value
void usual_perceive(Steps &steps, PyObject *make, PyObject *restore, PyObject *draft, PyObject *record, Tuple names) {
    if (draft != Py_None && Py_TYPE(draft) != draft_type) {
        raise(PyExc_TypeError, "this is no draft of the core");
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
}

// perceived(step) -> what the agent would be shown after a step, if that has been made; None otherwise
PyObject *usual_perceived(Steps &steps, long long step) {
    if (!steps.show_array(steps.perceived)) {
        return nullptr;
    }
    return Py_NewRef(steps.perceived && step == steps.perceived_step ? steps.perceived : Py_None);
}

// judge(overlaps, hardest, always_ask, last, now_and_then): when the oracles have to be asked about a step
void usual_judge(Steps &steps, bool overlaps, double hardest, bool always_ask, long long last, long long now_and_then) {
    steps.overlaps = overlaps;
    steps.hardest = hardest;
    steps.always_ask = always_ask;
    steps.last = last;
    steps.now_and_then = std::max(now_and_then, 1LL);
}

// resume((vehicles, ids, row, controlled, actors), observation, columns, time_s, lanes,
//        (road, lane_index, lane, from_left), follower, step)
void usual_resume(Steps &steps, std::tuple<Vehicles *, Tuple, Py_ssize_t, Dict, Tuple> who, PyObject *observation,
                  Columns *columns, double time_s, std::string lanes,
                  std::tuple<std::string, int, std::string, double> where, std::string follower, long long step) {
    const auto &[vehicles, ids, row, controlled, actors] = who;
    steps.ready = false;
    if (!steps.limits || !steps.stood || vehicles->roster->ids.size() != Scene(columns).size) {
        raise(PyExc_ValueError, "these are not the vehicles of the scene");
    }
    PyObject *present = reinterpret_cast<PyObject *>(vehicles);
    if (!steps.set_sight(present, ids, row, controlled, actors)) {
        throw Raised();
    }
    keep(steps.before_vehicles, present);
    keep(steps.observation, observation);
    steps.now.values = *columns->values;
    steps.now.time_s = time_s;
    steps.now.lanes = lanes;
    std::tie(steps.road, steps.lane_index, steps.lane, steps.from_left) = where;
    steps.follower = follower;
    steps.step = step;
    steps.known = false;
    steps.ready = true;
}

// borrow(map, offset, reserved, (tags of an observation, an action, a step, lanes, a roster, actors), roster, numbers):
// the roster is of those in sight, and has been recorded with these numbers
void usual_borrow(Steps &steps, PyObject *tape, Py_ssize_t offset, Py_ssize_t reserved, std::vector<long> tags,
                  PyObject *roster, PyObject *numbers) {
    const Buffer buffer(tape, PyBUF_WRITABLE), given(numbers, PyBUF_SIMPLE);
    if (offset < 64 || offset > buffer.view.len || reserved < 0 || tags.size() != std::size(steps.tags)) {
        raise(PyExc_ValueError, "nothing can be written there");
    }
    Steps::Sight &seen = steps.earlier.empty() ? steps.sight : steps.entered;
    if (!seen.vehicles) {
        raise(PyExc_ValueError, "no vehicle is in sight");
    }
    if (!Steps::number(seen.actors, given.bytes(), given.view.len)) {
        throw Raised();
    }
    keep(steps.tape, tape);
    std::copy(tags.begin(), tags.end(), steps.tags);
    steps.reserved = std::min(static_cast<size_t>(reserved), buffer.size());
    steps.offset = static_cast<size_t>(offset);
    steps.clear_runs();
    steps.begin_run(seen, roster);
}

// give_back() -> (offset, step, the last roster, [(roster, where the numbers begin of each of its steps)])
std::tuple<size_t, long long, Ref, std::vector<std::tuple<Ref, Ref>>> usual_give_back(Steps &steps) {
    if (!steps.adopt_all()) {
        throw Raised();
    }
    std::vector<std::tuple<Ref, Ref>> runs;
    for (const Steps::Run &run : steps.runs) {
        if (!run.places.empty()) {
            const char *places = reinterpret_cast<const char *>(run.places.data());
            PyObject *bytes = PyBytes_FromStringAndSize(places, static_cast<Py_ssize_t>(8 * run.places.size()));
            runs.emplace_back(Ref(Py_NewRef(run.roster)), Ref(bytes));
        }
    }
    Ref last(Py_NewRef(steps.runs.empty() ? Py_None : steps.runs.back().roster));
    steps.clear_runs();
    Py_CLEAR(steps.tape);
    return {steps.offset, steps.step, std::move(last), std::move(runs)};
}

// take(agents) -> what has come of it
PyObject *usual_take(Steps &steps, PyObject *agents) {
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
bool usual_note(Steps &steps, PyObject *action) {
    steps.simulating = true;
    return steps.able() && steps.record_array(1, action, SIMULATING);
}

PyObject *usual_go_on(Steps &steps, bool quiet) { return steps.go_on(quiet); }

void usual_pause(Steps &steps) { steps.ready = false; }

void usual_stop(Steps &steps) { steps.stopped = true; }

// told() -> (step, observation, reward, follower, (vehicles, time_s, lanes), the same of the step before)
PyObject *usual_told(Steps &steps) {
    if (!steps.ready) {
        return Py_NewRef(Py_None);
    }
    if (!steps.adopt_all() || !steps.show_array(steps.observation)) {
        return nullptr;
    }
    return Py_BuildValue("(LOdN(OdN)(OdN))", steps.step, steps.observation, steps.reward, text_of(steps.follower),
                         steps.sight.vehicles, steps.now.time_s, text_of(steps.now.lanes), steps.before_vehicles,
                         steps.before.time_s, text_of(steps.before.lanes));
}

// columns(back) -> Columns, of the step that is complete or, where it is true, of the one before
std::optional<Columns *> usual_columns(Steps &steps, bool back) {
    const Moment &moment = back ? steps.before : steps.now;
    Vehicles *vehicles = back ? steps.before_vehicles : steps.sight.vehicles;
    if (!steps.ready || moment.values.size() != 4 * vehicles->roster->ids.size()) {
        return {};
    }
    return new_columns(vehicles, std::vector<double>(moment.values));
}

// state() -> (x, y, heading, speed) of the agent in the step that is complete
std::optional<std::tuple<double, double, double, double>> usual_state(Steps &steps) {
    const Scene scene(steps.now.values, nullptr);
    const size_t row = steps.sight.row;
    if (!steps.ready || row >= scene.size) {
        return {};
    }
    return std::tuple(scene.x(row), scene.y(row), scene.headings[row], scene.speeds[row]);
}

// ahead() -> (name, gap, speed) of the vehicle ahead, as `_surroundings.nearest_ahead_of` returns them; there are no
// persons in a step that is complete here, so none of them can be ahead
std::tuple<std::string, double, double> usual_ahead(Steps &steps) {
    require_bound();
    const double look = std::max(LOOK_M, LOOK_S * std::max(0.0, sumo.speed(steps.agent)));
    const std::pair<std::string, double> found = sumo.leader(steps.agent, look);
    if (found.first.empty()) {
        return {"", HUGE_VAL, HUGE_VAL};
    }
    return {found.first, found.second + sumo.min_gap(steps.agent), std::max(0.0, sumo.speed(found.first))};
}

// reads(vehicles) -> what libsumo says of them and of the agent, by the functions that are used here alone
PyObject *usual_reads(Steps &steps, Vehicles *vehicles) {
    require_bound();
    const std::string lane = sumo.lane(steps.agent);
    const double along = sumo.along(steps.agent);
    std::string lanes;
    for (const std::string &id : vehicles->roster->ids) {
        lanes += sumo.lane(id) + '\n';
    }
    return to_python(std::tuple(sumo.road(steps.agent), sumo.lane_index(steps.agent), sumo.driven(steps.agent),
                                sumo.aside(steps.agent), sumo.aside_speed(steps.agent), along,
                                sumo.lane_angle(lane, along), sumo.speed_limit(lane), sumo.decel(steps.agent), lanes,
                                sumo.follower(steps.agent, 0.0).first, sumo.stop_state(steps.agent), sumo.time(),
                                sumo.emergencies(), sumo.kind(steps.agent), sumo.length(steps.agent),
                                sumo.width(steps.agent)));
}

// Handed over: it may be a view of what the agent goes on with, and is let go as soon as it has been read.
PyObject *usual_answer(PyObject *object, void *) {
    PyObject *answer = std::exchange(self_of<Steps>(object).answer, nullptr);
    return answer ? answer : Py_NewRef(Py_None);
}

PyObject *usual_step(PyObject *object, void *) { return to_python(self_of<Steps>(object).step); }

PyObject *usual_simulating(PyObject *object, void *) { return to_python(self_of<Steps>(object).simulating); }

PyMethodDef usual_methods[] = {
    {"take", METHOD(usual_take), "Take a step; return what has come of it."},
    {"note", METHOD(usual_note), "Record an action; return whether that could be done."},
    {"go_on", METHOD(usual_go_on), "Simulate, and look where nothing has happened yet; return what has come of it."},
    {"heed", METHOD(usual_heed), "Take what is counted of braking and of standing."},
    {"meet", METHOD(usual_meet), "Take who is asked about vehicles that come into sight."},
    {"listen", METHOD(usual_listen), "Take the numbers of recorded actors, and who makes room for others."},
    {"perceive", METHOD(usual_perceive), "Take what makes and restores observations that consist of parts."},
    {"perceived", METHOD(usual_perceived), "Return what has been made for a step; None if nothing has."},
    {"judge", METHOD(usual_judge), "Take when the oracles have to be asked about a step."},
    {"resume", METHOD(usual_resume), "Go on from a step that is complete."},
    {"borrow", METHOD(usual_borrow), "Record into a buffer from now on."},
    {"give_back", METHOD(usual_give_back), "Record no more; return what has been recorded."},
    {"pause", METHOD(usual_pause), "Take no steps until it is resumed."},
    {"stop", METHOD(usual_stop), "Take no further steps."},
    {"told", METHOD(usual_told), "Return what is known about the step that is complete."},
    {"columns", METHOD(usual_columns), "Return where everybody is, or was a step before."},
    {"ahead", METHOD(usual_ahead), "Return name, gap and speed of the vehicle ahead."},
    {"state", METHOD(usual_state), "Return position, heading and speed of the agent."},
    {"reads", METHOD(usual_reads), "Return what is read here alone, to be compared."},
    {nullptr, nullptr, 0, nullptr},
};
PyGetSetDef usual_getters[] = {
    {"answer", usual_answer, nullptr, "What the agent answered last, once.", nullptr},
    {"step", usual_step, nullptr, "The number of the step that is complete.", nullptr},
    {"simulating", usual_simulating, nullptr, "Whether the last step had come to the simulator.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};
