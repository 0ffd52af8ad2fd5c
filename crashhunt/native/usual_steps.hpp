// The object with which Python has steps taken at once. A part of core.cpp.

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
        return PyErr_Format(PyExc_ValueError, "it looks around every so many steps, and sees so many others");
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

// perceive(make, restore, draft | None, record, names): an observation is an array that the first makes where it cannot
// be written from the draft again, and the agent receives what the second returns: the values with these names, where
// the record is the type of all of them as one value
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

// judge(overlaps, hardest, always_ask, last, now_and_then): when the oracles have to be asked about a step
PyObject *usual_judge(PyObject *object, PyObject *arguments) {
    Steps &steps = steps_of(object);
    if (!PyArg_ParseTuple(arguments, "pdpLL", &steps.overlaps, &steps.hardest, &steps.always_ask, &steps.last,
                          &steps.now_and_then)) {
        return nullptr;
    }
    steps.now_and_then = std::max(steps.now_and_then, 1LL);
    Py_RETURN_NONE;
}

// resume((vehicles, ids, row, controlled, actors), observation, columns, time_s, lanes,
//        (road, lane_index, lane, from_left), follower, step)
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
        return PyErr_Format(PyExc_ValueError, "these are not the vehicles of the scene");
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

// borrow(map, offset, reserved, (tags of an observation, an action, a step, lanes, a roster, actors), roster, numbers):
// the roster is of those in sight, and has been recorded with these numbers
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
        return PyErr_Format(PyExc_ValueError, "nothing can be written there");
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
    {"judge", usual_judge, METH_VARARGS, "Take when the oracles have to be asked about a step."},
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
