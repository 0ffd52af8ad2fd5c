// Sub-steps of highway-env's roads, compiled: decisions, movement and the search for lanes, with the bits of highway-env.
//
// - Each function computes what the method of highway-env with the same name computes, vehicle after vehicle in
//   highway-env's order. Every expression stands as it does there, in the same order of operations.
// - It is compiled without contraction, because a fused multiply-add rounds once instead of twice.
// - Sine, cosine and their like are the inner loops of NumPy's own functions, because NumPy has several versions of them
//   for different processors. crashhunt/highway/accelerator/_kernel.py compares all of them with NumPy when a process starts.
// - What the kernel does not know, it refuses: `read` returns False, and highway-env does the work. For two events it
//   calls highway-env's own methods: the end of a lane, and a movement by the dynamic bicycle model to numbers that are
//   not finite.
//
// Its parts are kernel_numbers.hpp (arithmetic), kernel_lanes.hpp, kernel_actors.hpp (state), kernel_neighbours.hpp,
// kernel_policies.hpp (decisions), kernel_movement.hpp, kernel_collisions.hpp, kernel_predictions.hpp,
// kernel_observations.hpp, and kernel_snapshots.hpp (what must stay the same). This file has what Python calls.

#include "kernel_observations.hpp"
#include "kernel_snapshots.hpp"

namespace {

// ---------------------------------------------------------------------------------------------------------------- Traffic

// After an error of highway-env: writes what is known, so that the caller sees the state at the moment of the error.
PyObject *fail(Traffic *self, bool moved) {
    PyObject *kind, *value, *trace;
    PyErr_Fetch(&kind, &value, &trace);
    if (!publish_all(self, moved)) {
        PyErr_Clear();
    }
    PyErr_Restore(kind, value, trace);
    return nullptr;
}

PyObject *traffic_read(Traffic *self, PyObject *) { return PyBool_FromLong(read_all(self)); }

// is_current(road): whether the road has the same vehicles and objects, and everything about them that must stay the same.
PyObject *traffic_is_current(Traffic *self, PyObject *road) {
    const int found = is_current(self, road);
    return found < 0 ? nullptr : PyBool_FromLong(found);
}

PyObject *traffic_act(Traffic *self, PyObject *) {
    if (!act_all(self)) {
        return fail(self, false);
    }
    if (!publish_all(self, false)) {
        return nullptr;
    }
    Py_RETURN_NONE;
}

PyObject *traffic_step(Traffic *self, PyObject *dt) {
    if (!PyFloat_CheckExact(dt)) {
        return PyErr_Format(PyExc_TypeError, "the length of a sub-step must be a float");
    }
    double length = PyFloat_AS_DOUBLE(dt);
    Moved moved = move_all(self, length, dt);
    if (moved == FAILED || (moved == FINITE && !collide_all(self, length, dt))) {
        return fail(self, true);
    }
    return publish_all(self, true) ? PyBool_FromLong(moved == FINITE) : nullptr;
}

PyObject *traffic_collide(Traffic *self, PyObject *dt) {
    if (!PyFloat_CheckExact(dt)) {
        return PyErr_Format(PyExc_TypeError, "the length of a sub-step must be a float");
    }
    if (!collide_all(self, PyFloat_AS_DOUBLE(dt), dt)) {
        return fail(self, false);
    }
    if (!publish_all(self, false)) {
        return nullptr;
    }
    Py_RETURN_NONE;
}

std::ptrdiff_t count_crashed(const Traffic *self) {
    return std::count_if(self->actors->begin(), self->actors->end(), [](const Actor &actor) { return actor.moves && actor.crashed; });
}

// run(count, dt, stops): several sub-steps; where it stops at crashes, the sub-step in which a vehicle crashes is the last.
PyObject *traffic_run(Traffic *self, PyObject *args) {
    int count, stops;
    PyObject *dt;
    if (!PyArg_ParseTuple(args, "iO!p", &count, &PyFloat_Type, &dt, &stops)) {
        return nullptr;
    }
    double length = PyFloat_AS_DOUBLE(dt);
    Moved moved = FINITE;
    const std::ptrdiff_t crashed = count_crashed(self);
    int &done = self->completed;
    for (done = 0; done < count && !(stops && count_crashed(self) > crashed); done++) {
        if (!act_all(self)) {
            return fail(self, done > 0);
        }
        moved = move_all(self, length, dt);
        if (moved == NOT_FINITE) { // highway-env does the rest of a sub-step with numbers that are not finite
            break;
        }
        if (moved == FAILED || !collide_all(self, length, dt)) {
            return fail(self, true);
        }
    }
    return publish_all(self, true) ? Py_BuildValue("iO", done, moved == FINITE ? Py_False : Py_True) : nullptr;
}

void traffic_dealloc(Traffic *self) {
    if (self->actors) {
        for (Actor &actor : *self->actors) {
            if (actor.is_open) {
                PyBuffer_Release(&actor.position);
            }
            Py_XDECREF(actor.object);
        }
    }
    if (self->watched) {
        for (Watched &watched : *self->watched) {
            Py_XDECREF(reinterpret_cast<PyObject *>(watched.type));
            Py_XDECREF(watched.fixed);
            for (PyObject *key : watched.keys) {
                Py_DECREF(key);
            }
        }
    }
    if (self->examples) {
        for (Example &example : *self->examples) {
            Py_XDECREF(example.object);
            Py_XDECREF(example.names);
            Py_XDECREF(example.values);
        }
    }
    Py_XDECREF(self->road);
    delete self->watched;
    delete self->examples;
    delete self->actors;
    delete self->along;
    delete self->across;
    delete self->stamps;
    delete self->queues;
    Py_XDECREF(reinterpret_cast<PyObject *>(self->network));
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

PyTypeObject *network_type = nullptr;

// Traffic(network, actors, models, flags, parameters, road, fixed, examples): `fixed` has a frozenset for each actor, and
// `examples` pairs of an actor and the names of attributes.
PyObject *traffic_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *network, *actors, *road, *fixed, *examples;
    Py_buffer models, flags, parameters;
    if (!PyArg_ParseTuple(args, "O!O!y*y*y*OO!O!", network_type, &network, &PyList_Type, &actors, &models, &flags,
                          &parameters, &road, &PyList_Type, &fixed, &PyList_Type, &examples)) {
        return nullptr;
    }
    size_t count = static_cast<size_t>(PyList_GET_SIZE(actors));
    Traffic *self = nullptr;
    if (static_cast<size_t>(PyList_GET_SIZE(fixed)) != count || static_cast<size_t>(models.len) != count || static_cast<size_t>(flags.len) != count ||
        static_cast<size_t>(parameters.len) != count * sizeof(Parameters)) {
        PyErr_SetString(PyExc_ValueError, "one model, flag and row of parameters is needed for each actor");
    } else {
        self = reinterpret_cast<Traffic *>(type->tp_alloc(type, 0));
    }
    if (self) {
        Py_INCREF(network);
        self->network = reinterpret_cast<Network *>(network);
        self->lanes = self->network->lanes->size();
        self->now = 0;
        self->completed = 0;
        self->actors = new std::vector<Actor>(count);
        self->along = new std::vector<double>(count * self->lanes);
        self->across = new std::vector<double>(count * self->lanes);
        self->stamps = new std::vector<uint64_t>(count * self->lanes, 0);
        self->queues = new std::vector<Queue>(self->lanes);
        self->vehicles = 0;
        for (size_t row = 0; row < count; row++) {
            Actor &actor = (*self->actors)[row];
            actor = Actor();
            actor.object = PyList_GET_ITEM(actors, static_cast<Py_ssize_t>(row));
            Py_INCREF(actor.object);
            const int flag = static_cast<const char *>(flags.buf)[row]; // see `_kernel_objects._flags_of`
            actor.model = static_cast<const char *>(models.buf)[row];
            actor.moves = actor.model != OBJECT;
            actor.has_target = actor.model == CONTROLLED || actor.model == IDM || actor.model == LINEAR;
            actor.is_landmark = flag & 1;
            actor.slides = flag & 2;
            actor.changes_lanes = flag & 4;
            actor.is_obstacle = flag & 8;
            const char *numbers = static_cast<const char *>(parameters.buf) + row * sizeof(Parameters);
            std::memcpy(&actor.parameters, numbers, sizeof(Parameters));
            actor.gap_root = 2 * std::sqrt(-actor.parameters.comfort_acc_max * actor.parameters.comfort_acc_min);
            self->vehicles += actor.moves;
        }
        self->road = Py_NewRef(road);
        self->watched = new std::vector<Watched>();
        self->examples = new std::vector<Example>();
        if (!watch_all(self, fixed, examples)) {
            Py_CLEAR(self);
        }
    }
    PyBuffer_Release(&models);
    PyBuffer_Release(&flags);
    PyBuffer_Release(&parameters);
    return reinterpret_cast<PyObject *>(self);
}

// conflicts(): the pairs of vehicles whose predicted outlines touch, each with whether that is certain; None if
// highway-env must decide.
PyObject *traffic_conflicts(Traffic *self, PyObject *) {
    const std::vector<Path> paths = predict_all(self);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    if (paths.size() < self->vehicles) {
        Py_RETURN_NONE;
    }
    PyObject *found = PyList_New(0);
    for (size_t row = 0; found && row < paths.size(); row++) {
        for (size_t other = row + 1; found && other < paths.size(); other++) {
            const Answer answer = is_conflict_possible((*self->actors)[row], paths[row], (*self->actors)[other], paths[other]);
            if (answer == NO) {
                continue;
            }
            PyObject *pair = Py_BuildValue("nnO", row, other, answer == YES ? Py_True : Py_False);
            if (!pair || PyList_Append(found, pair)) {
                Py_CLEAR(found);
            }
            Py_XDECREF(pair);
        }
    }
    return found;
}

// fill_times(grid, lanes, times, quantum, row, speeds, relations): fills the grid of a time-to-collision observation.
// `relations` has a byte for each lane of the network.
PyObject *traffic_fill_times(Traffic *self, PyObject *args) {
    Py_buffer cells, speeds, relations;
    TimeGrid grid;
    Py_ssize_t row;
    if (!PyArg_ParseTuple(args, "w*nndny*y*", &cells, &grid.lanes, &grid.times, &grid.quantum, &row, &speeds, &relations)) {
        return nullptr;
    }
    const Py_ssize_t count = speeds.len / static_cast<Py_ssize_t>(sizeof(double)), width = grid.lanes * grid.times;
    bool fits = grid.lanes >= 0 && grid.times >= 0 && 0 <= row && row < static_cast<Py_ssize_t>(self->vehicles) &&
                cells.len == count * width * static_cast<Py_ssize_t>(sizeof(double)) &&
                relations.len == static_cast<Py_ssize_t>(self->lanes) && grid.quantum > 0;
    const char *relation_of = static_cast<const char *>(relations.buf);
    for (size_t lane = 0; fits && lane < self->lanes; lane++) {
        fits = relation_of[lane] != SAME_LANES || (*self->network->lanes)[lane].id < grid.lanes;
    }
    grid.cells = static_cast<double *>(cells.buf);
    for (Py_ssize_t which = 0; fits && which < count; which++) {
        double speed;
        std::memcpy(&speed, static_cast<const char *>(speeds.buf) + which * static_cast<Py_ssize_t>(sizeof(double)), sizeof(double));
        for (size_t other = 0; other < self->vehicles; other++) {
            const int lane = (*self->actors)[other].lane;
            fill_times(self, grid, static_cast<size_t>(row), other, which, speed, relation_of[lane]);
        }
    }
    PyBuffer_Release(&cells);
    PyBuffer_Release(&speeds);
    PyBuffer_Release(&relations);
    if (!fits) {
        return PyErr_Format(PyExc_ValueError, "the grid has another size than its parts");
    }
    Py_RETURN_NONE;
}

// The row of a vehicle or object; NO_ROW if the road does not have it.
size_t row_of(const Traffic *self, PyObject *object) {
    const std::vector<Actor> &actors = *self->actors;
    const auto which = std::find_if(actors.begin(), actors.end(), [object](const Actor &actor) { return actor.object == object; });
    return which == actors.end() ? NO_ROW : static_cast<size_t>(which - actors.begin());
}

PyObject *object_at(const Traffic *self, size_t row) { return row == NO_ROW ? Py_None : (*self->actors)[row].object; }

// neighbour_vehicles(vehicle, lane): the objects ahead and behind; None if the road does not have the vehicle.
PyObject *traffic_neighbour_vehicles(Traffic *self, PyObject *args) {
    PyObject *vehicle;
    int lane;
    if (!PyArg_ParseTuple(args, "Oi", &vehicle, &lane)) {
        return nullptr;
    }
    const size_t row = row_of(self, vehicle);
    if (lane < 0 || static_cast<size_t>(lane) >= self->lanes) {
        return PyErr_Format(PyExc_IndexError, "no such lane");
    }
    if (row == NO_ROW) {
        Py_RETURN_NONE;
    }
    size_t front, rear;
    neighbour_vehicles(self, row, lane, front, rear);
    return PyTuple_Pack(2, object_at(self, front), object_at(self, rear));
}

// close_objects_to(vehicle, distance, sees_behind, is_sorted, only_vehicles): a list; None if the road does not have the
// vehicle.
PyObject *traffic_close_objects_to(Traffic *self, PyObject *args) {
    PyObject *vehicle;
    double distance;
    int sees_behind, is_sorted, only_vehicles;
    if (!PyArg_ParseTuple(args, "Odppp", &vehicle, &distance, &sees_behind, &is_sorted, &only_vehicles)) {
        return nullptr;
    }
    const size_t row = row_of(self, vehicle), count = only_vehicles ? self->vehicles : self->actors->size();
    if (row >= self->vehicles) {
        Py_RETURN_NONE;
    }
    PyObject *found = PyList_New(0);
    for (size_t other : close_objects_to(self, row, distance, sees_behind, is_sorted, count)) {
        if (found && PyList_Append(found, object_at(self, other))) {
            Py_CLEAR(found);
        }
    }
    return found;
}

// describe(cells, observer, objects, features, scales, clips): writes a row for each object into the cells, from the
// point of view of the observer, unless it is None; returns whether highway-env would describe all of them without an
// error. A feature is a byte, and its scale two floats: the lower end, and the length of the interval, which is 0 for no
// scale.
PyObject *traffic_describe(Traffic *self, PyObject *args) {
    Py_buffer cells, features, numbers;
    PyObject *observer, *objects;
    int clips;
    if (!PyArg_ParseTuple(args, "w*OO!y*y*p", &cells, &observer, &PyList_Type, &objects, &features, &numbers, &clips)) {
        return nullptr;
    }
    const size_t columns = static_cast<size_t>(features.len), lines = static_cast<size_t>(PyList_GET_SIZE(objects));
    const char *codes = static_cast<const char *>(features.buf);
    std::vector<Scale> scales(columns);
    bool fits = static_cast<size_t>(numbers.len) == 2 * columns * sizeof(double) &&
                static_cast<size_t>(cells.len) >= lines * columns * sizeof(double);
    for (size_t column = 0; fits && column < columns; column++) {
        double given[2];
        std::memcpy(given, static_cast<const char *>(numbers.buf) + column * sizeof(given), sizeof(given));
        scales[column] = {given[0], given[1], given[1] != 0};
        fits = codes[column] >= 0 && codes[column] < FEATURES;
    }
    const size_t from = row_of(self, observer);
    bool all = observer == Py_None || from != NO_ROW;
    for (size_t line = 0; fits && all && line < lines; line++) {
        const size_t row = row_of(self, PyList_GET_ITEM(objects, static_cast<Py_ssize_t>(line)));
        all = row != NO_ROW && is_described(self->network, (*self->actors)[row], codes, columns);
        if (all) {
            describe((*self->actors)[row], from == NO_ROW ? nullptr : &(*self->actors)[from], codes, scales.data(), columns,
                     clips, static_cast<double *>(cells.buf) + line * columns);
        }
    }
    PyBuffer_Release(&cells);
    PyBuffer_Release(&features);
    PyBuffer_Release(&numbers);
    if (!fits) {
        return PyErr_Format(PyExc_ValueError, "the cells have another size than their parts");
    }
    return PyErr_Occurred() ? nullptr : PyBool_FromLong(all);
}

PyObject *traffic_completed(Traffic *self, PyObject *) { return PyLong_FromLong(self->completed); }

PyMethodDef traffic_methods[] = {
    {"read", reinterpret_cast<PyCFunction>(traffic_read), METH_NOARGS, nullptr},
    {"is_current", reinterpret_cast<PyCFunction>(traffic_is_current), METH_O, nullptr},
    {"act", reinterpret_cast<PyCFunction>(traffic_act), METH_NOARGS, nullptr},
    {"step", reinterpret_cast<PyCFunction>(traffic_step), METH_O, nullptr},
    {"collide", reinterpret_cast<PyCFunction>(traffic_collide), METH_O, nullptr},
    {"completed", reinterpret_cast<PyCFunction>(traffic_completed), METH_NOARGS, nullptr},
    {"run", reinterpret_cast<PyCFunction>(traffic_run), METH_VARARGS, nullptr},
    {"conflicts", reinterpret_cast<PyCFunction>(traffic_conflicts), METH_NOARGS, nullptr},
    {"neighbour_vehicles", reinterpret_cast<PyCFunction>(traffic_neighbour_vehicles), METH_VARARGS, nullptr},
    {"close_objects_to", reinterpret_cast<PyCFunction>(traffic_close_objects_to), METH_VARARGS, nullptr},
    {"describe", reinterpret_cast<PyCFunction>(traffic_describe), METH_VARARGS, nullptr},
    {"fill_times", reinterpret_cast<PyCFunction>(traffic_fill_times), METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyType_Slot traffic_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(traffic_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(traffic_dealloc)},
    {Py_tp_methods, traffic_methods},
    {Py_tp_doc, const_cast<char *>("The vehicles and objects of a road.")},
    {0, nullptr},
};
PyType_Spec traffic_spec = {"_crashhunt_highway.Traffic", sizeof(Traffic), 0, Py_TPFLAGS_DEFAULT, traffic_slots};

// ---------------------------------------------------------------------------------------------------------------- Network

void network_dealloc(Network *self) {
    delete self->lanes;
    delete self->connected;
    Py_XDECREF(self->keys);
    Py_XDECREF(self->objects);
    Py_XDECREF(self->index);
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(reinterpret_cast<PyObject *>(self));
    Py_DECREF(type);
}

// Network(keys, lanes, index, table, connected): the table has a `LaneRow` for each lane.
PyObject *network_new(PyTypeObject *type, PyObject *args, PyObject *) {
    PyObject *keys, *found, *index, *connected;
    Py_buffer table;
    if (!PyArg_ParseTuple(args, "O!O!O!y*O!", &PyList_Type, &keys, &PyList_Type, &found, &PyDict_Type, &index, &table,
                          &PyList_Type, &connected)) {
        return nullptr;
    }
    const size_t count = static_cast<size_t>(PyList_GET_SIZE(keys));
    Network *self = nullptr;
    if (static_cast<size_t>(table.len) != count * sizeof(LaneRow) ||
        static_cast<size_t>(PyList_GET_SIZE(found)) != count) {
        PyErr_SetString(PyExc_ValueError, "one row of the table is needed for each lane");
    } else {
        self = reinterpret_cast<Network *>(type->tp_alloc(type, 0));
    }
    if (self) {
        self->lanes = new std::vector<Lane>();
        self->connected = new std::vector<Connections>();
        self->keys = keys;
        self->objects = found;
        self->index = index;
        Py_INCREF(keys);
        Py_INCREF(found);
        Py_INCREF(index);
        for (size_t number = 0; number < count && !PyErr_Occurred(); number++) {
            LaneRow row;
            std::memcpy(&row, static_cast<const char *>(table.buf) + number * sizeof(LaneRow), sizeof(LaneRow));
            PyObject *key = PyList_GET_ITEM(keys, static_cast<Py_ssize_t>(number));
            PyObject *last = PyTuple_GetItem(key, 2);
            self->lanes->emplace_back(row, last ? static_cast<int>(PyLong_AsLong(last)) : 0);
        }
        for (Py_ssize_t number = 0; number < PyList_GET_SIZE(connected) && !PyErr_Occurred(); number++) {
            Connections row;
            PyObject *pairs = PyList_GET_ITEM(connected, number);
            for (Py_ssize_t at = 0; at < PyList_Size(pairs); at++) {
                int other;
                double offset;
                if (!PyArg_ParseTuple(PyList_GET_ITEM(pairs, at), "id", &other, &offset)) {
                    break;
                }
                row.emplace_back(other, offset);
            }
            self->connected->push_back(row);
        }
        if (PyErr_Occurred()) {
            Py_CLEAR(self);
        }
    }
    PyBuffer_Release(&table);
    return reinterpret_cast<PyObject *>(self);
}

// The grid of an occupancy grid observation, in m: its axes are those of the observer, or those of the world.
struct Grid {
    double x, y, cosine, sine; // the position and the direction of the observer
    double reach, spacing;     // how far lanes are followed, and the distance of points on them
    double low[2], step[2];
    Py_ssize_t cells[2];
    int is_aligned;

    // Marks the cell of a position. False: the position is so near to the border of a cell that rounding matters.
    bool mark(double px, double py, char *marks) const {
        double dx = px - x, dy = py - y;
        double offset[2] = {is_aligned ? dx * cosine + dy * sine : dx, is_aligned ? dy * cosine - dx * sine : dy};
        Py_ssize_t cell[2];
        bool is_sure = true, is_inside = true;
        for (int axis : {0, 1}) {
            double place = (offset[axis] - low[axis]) / step[axis];
            if (!(place > -1 && place < static_cast<double>(cells[axis]) + 1)) {
                return true;
            }
            is_sure = is_sure && std::fabs(place - std::rint(place)) > 1e-6;
            cell[axis] = static_cast<Py_ssize_t>(std::floor(place));
            is_inside = is_inside && 0 <= cell[axis] && cell[axis] < cells[axis];
        }
        if (is_sure && is_inside) {
            marks[cell[0] * cells[1] + cell[1]] = 1;
        }
        return is_sure;
    }
};

// Marks the cells of the points on one lane, and lists the points about which highway-env must decide. False: an error.
bool mark_lane(const Lane &lane, Py_ssize_t number, const Grid &grid, char *marks, PyObject *unsure) {
    double origin, lateral, last = NAN;
    lane.local_coordinates(grid.x, grid.y, origin, lateral);
    // The points are those of np.arange, which adds multiples of the first difference.
    double start = origin - grid.reach, stop = origin + grid.reach;
    double difference = start + grid.spacing - start, count = std::ceil((stop - start) / grid.spacing);
    for (double at = 0; at < count; at++) {
        double point = clip(start + at * difference, 0, lane.length), px, py;
        if (point == last) {
            continue;
        }
        last = point;
        lane.position(point, px, py);
        if (!grid.mark(px, py, marks)) {
            PyObject *pair = Py_BuildValue("nd", number, point);
            bool listed = pair && PyList_Append(unsure, pair) == 0;
            Py_XDECREF(pair);
            if (!listed) {
                return false;
            }
        }
    }
    return true;
}

// mark_cells(...): a byte for each cell that is 1 if a point of a lane is in it, and a list of lanes with points about
// which highway-env must decide.
PyObject *network_mark_cells(Network *self, PyObject *args) {
    Grid grid;
    if (!PyArg_ParseTuple(args, "(dd)(dd)dd(dd)(dd)(nn)p", &grid.x, &grid.y, &grid.cosine, &grid.sine, &grid.reach,
                          &grid.spacing, &grid.low[0], &grid.low[1], &grid.step[0], &grid.step[1], &grid.cells[0],
                          &grid.cells[1], &grid.is_aligned)) {
        return nullptr;
    }
    const Py_ssize_t most = 1000000;
    if (!(grid.spacing > 0 && grid.reach / grid.spacing < 1e6) || grid.cells[0] < 0 || grid.cells[1] < 0 ||
        grid.cells[0] > most || grid.cells[1] > most) {
        return PyErr_Format(PyExc_ValueError, "the grid is too large");
    }
    PyObject *marks = PyByteArray_FromStringAndSize(nullptr, grid.cells[0] * grid.cells[1]);
    PyObject *unsure = PyList_New(0), *both = nullptr;
    if (marks && unsure) {
        char *first = PyByteArray_AS_STRING(marks);
        std::memset(first, 0, static_cast<size_t>(PyByteArray_GET_SIZE(marks)));
        bool done = true;
        for (size_t number = 0; done && number < self->lanes->size(); number++) {
            done = mark_lane((*self->lanes)[number], static_cast<Py_ssize_t>(number), grid, first, unsure);
        }
        both = done ? PyTuple_Pack(2, marks, unsure) : nullptr;
    }
    Py_XDECREF(marks);
    Py_XDECREF(unsure);
    return both;
}

PyMethodDef network_methods[] = {
    {"mark_cells", reinterpret_cast<PyCFunction>(network_mark_cells), METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyType_Slot network_slots[] = {
    {Py_tp_new, reinterpret_cast<void *>(network_new)},
    {Py_tp_dealloc, reinterpret_cast<void *>(network_dealloc)},
    {Py_tp_methods, network_methods},
    {Py_tp_doc, const_cast<char *>("The lanes of a road.")},
    {0, nullptr},
};
PyType_Spec network_spec = {"_crashhunt_highway.Network", sizeof(Network), 0, Py_TPFLAGS_DEFAULT, network_slots};

// ----------------------------------------------------------------------------------------------------------------- module

// bind(float64, int64, float32, ndarray, zeros, slide, [sin, cos, ...], fused, product_fused, exponent_step): NumPy's types and functions, and
// the function that moves a vehicle with the dynamic bicycle model.
PyObject *bind(PyObject *, PyObject *args) {
    PyObject *number, *whole, *short_number, *array, *zeros, *slide_function, *ufuncs;
    int is_fused, is_product_fused;
    Py_ssize_t step;
    if (!PyArg_ParseTuple(args, "OOOOOOO!ppn", &number, &whole, &short_number, &array, &zeros, &slide_function,
                          &PyList_Type, &ufuncs, &is_fused, &is_product_fused, &step)) {
        return nullptr;
    }
    if (PyList_GET_SIZE(ufuncs) != FUNCTIONS) {
        return PyErr_Format(PyExc_ValueError, "seven functions are needed");
    }
    for (int wanted = 0; wanted < FUNCTIONS; wanted++) {
        const UFunc *ufunc = reinterpret_cast<const UFunc *>(PyList_GET_ITEM(ufuncs, wanted));
        int arguments = wanted == ARCTAN2 || wanted == POWER ? 2 : 1, which = 0;
        if (ufunc->nin != arguments || ufunc->nout != 1 || ufunc->nargs != arguments + 1 || !ufunc->name ||
            std::strcmp(ufunc->name, NAMES[wanted])) {
            return PyErr_Format(PyExc_OSError, "NumPy's function %s has an unknown layout", NAMES[wanted]);
        }
        for (; which < ufunc->ntypes; which++) {
            const char *types = ufunc->types + which * ufunc->nargs;
            bool all = true;
            for (int argument = 0; argument < ufunc->nargs; argument++) {
                all = all && types[argument] == DOUBLE;
            }
            if (all) {
                break;
            }
        }
        if (which == ufunc->ntypes || !ufunc->functions[which]) {
            return PyErr_Format(PyExc_OSError, "NumPy's function %s is not for float64", NAMES[wanted]);
        }
        functions[wanted] = {ufunc->functions[which], ufunc->data ? ufunc->data[which] : nullptr};
    }
    Py_XSETREF(numpy_float, Py_NewRef(number));
    Py_XSETREF(numpy_int, Py_NewRef(whole));
    Py_XSETREF(numpy_short, Py_NewRef(short_number));
    Py_XSETREF(numpy_array, Py_NewRef(array));
    Py_XSETREF(make_array, Py_NewRef(zeros));
    Py_XSETREF(slide, Py_NewRef(slide_function));
    fused = is_fused;
    product_fused = is_product_fused;
    exponent_step = step;
    Py_RETURN_NONE;
}

// compute(name, *numbers): the result of one function, for the comparison with NumPy.
PyObject *compute(PyObject *, PyObject *args) {
    const char *name;
    double a, b = 0, c = 0, d = 0, e = 0, f = 0;
    if (!PyArg_ParseTuple(args, "sd|ddddd", &name, &a, &b, &c, &d, &e, &f)) {
        return nullptr;
    }
    for (int number = 0; number < FUNCTIONS; number++) {
        if (!std::strcmp(name, NAMES[number])) {
            return PyFloat_FromDouble(number == ARCTAN2 || number == POWER ? call(number, a, b) : call(number, a));
        }
    }
    if (!std::strcmp(name, "dot")) {
        return PyFloat_FromDouble(dot(a, b, c, d));
    }
    if (!std::strcmp(name, "product")) {
        return PyFloat_FromDouble(product(a, b, c, d));
    }
    if (!std::strcmp(name, "dot3")) {
        const double one[3] = {a, b, c}, two[3] = {d, e, f};
        return PyFloat_FromDouble(dot(one, two));
    }
    if (!std::strcmp(name, "turned")) {
        return PyFloat_FromDouble(turned(a, b, c, d));
    }
    if (!std::strcmp(name, "square")) {
        return PyFloat_FromDouble(square(a));
    }
    if (!std::strcmp(name, "remainder")) {
        return PyFloat_FromDouble(remainder_of(a, b));
    }
    return PyErr_Format(PyExc_ValueError, "unknown function %s", name);
}

// mirrored_poses(objects, half_lengths): the points half a length ahead of objects, their headings and their speeds, with the
// y axis up; None if one of them has an unusual type. The cosine and the sine are those of Python's `math`.
PyObject *mirrored_poses(PyObject *, PyObject *args) {
    PyObject *objects, *halves;
    if (!PyArg_ParseTuple(args, "O!O!", &PyList_Type, &objects, &PyList_Type, &halves)) {
        return nullptr;
    }
    const Py_ssize_t count = PyList_GET_SIZE(objects);
    if (PyList_GET_SIZE(halves) != count) {
        return PyErr_Format(PyExc_ValueError, "one half of a length is needed for each object");
    }
    PyObject *points = PyList_New(count), *headings = PyList_New(count), *speeds = PyList_New(count), *all = nullptr;
    bool known = points && headings && speeds;
    for (Py_ssize_t at = 0; known && at < count; at++) {
        PyObject *object = PyList_GET_ITEM(objects, at), *position = attribute(object, s_position);
        Number heading, speed;
        Py_buffer view;
        known = position && open_floats(position, view, 2, 0);
        if (known) {
            const double *place = static_cast<const double *>(view.buf);
            const double x = place[0], y = place[1], half = PyFloat_AsDouble(PyList_GET_ITEM(halves, at));
            PyBuffer_Release(&view);
            known = read_number(object, s_heading, heading) && read_number(object, s_speed, speed) &&
                    std::isfinite(heading.value) && !PyErr_Occurred();
            if (known) {
                const double c = std::cos(heading.value), s = std::sin(heading.value);
                PyList_SET_ITEM(points, at, Py_BuildValue("(dd)", x + half * c, 0.0 - (y + half * s)));
                PyList_SET_ITEM(headings, at, PyFloat_FromDouble(0.0 - heading.value));
                PyList_SET_ITEM(speeds, at, PyFloat_FromDouble(speed.value));
                known = !PyErr_Occurred();
            }
        }
        Py_XDECREF(position);
    }
    if (known) {
        all = PyTuple_Pack(3, points, headings, speeds);
    } else if (!PyErr_Occurred()) {
        all = Py_NewRef(Py_None);
    }
    Py_XDECREF(points);
    Py_XDECREF(headings);
    Py_XDECREF(speeds);
    return all;
}

// bind_turn(rounds): how NumPy multiplies a matrix by a vector.
PyObject *bind_turn(PyObject *, PyObject *number) {
    const long rounds = PyLong_AsLong(number);
    if (rounds < UNKNOWN || rounds >= TURNS) {
        if (!PyErr_Occurred()) {
            PyErr_Format(PyExc_ValueError, "unknown way of rounding %ld", rounds);
        }
        return nullptr;
    }
    turn_rounds = static_cast<int>(rounds);
    Py_RETURN_NONE;
}

PyMethodDef methods[] = {
    {"bind", bind, METH_VARARGS, nullptr},
    {"bind_turn", bind_turn, METH_O, nullptr},
    {"mirrored_poses", mirrored_poses, METH_VARARGS, nullptr},
    {"compute", compute, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_crashhunt_highway", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

bool intern_names() {
#define NAME(name) {&s_##name, #name},
#define CONSTANT(name, text) {&s_##name, #text},
    const struct {
        PyObject **place;
        const char *text;
    } names[] = {NAMES_OF_ATTRIBUTES(NAME, CONSTANT)};
    for (const auto &name : names) {
        *name.place = PyUnicode_InternFromString(name.text);
        if (!*name.place) {
            return false;
        }
    }
    return true;
}

} // namespace

PyMODINIT_FUNC PyInit__crashhunt_highway() {
    PyObject *module = intern_names() ? PyModule_Create(&definition) : nullptr;
    const struct {
        const char *name;
        PyType_Spec *spec;
    } types[] = {{"Network", &network_spec}, {"Traffic", &traffic_spec}, {"Contents", &contents_spec}};
    for (const auto &type : types) {
        PyObject *made = module ? PyType_FromSpec(type.spec) : nullptr;
        if (!made || PyModule_AddObjectRef(module, type.name, made)) {
            Py_CLEAR(module);
        } else if (type.spec == &network_spec) {
            network_type = reinterpret_cast<PyTypeObject *>(Py_NewRef(made));
        }
        Py_XDECREF(made);
    }
    if (module && PyModule_AddIntConstant(module, "INTERFACE", CRASHHUNT_INTERFACE)) {
        Py_CLEAR(module);
    }
    return module;
}
