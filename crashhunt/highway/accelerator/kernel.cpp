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
// kernel_observations.hpp, and kernel_snapshots.hpp (what must stay the same). This file has what Python calls, by way
// of python.hpp, the only header of another folder.

#include "kernel_observations.hpp"
#include "kernel_snapshots.hpp"

namespace {

// ---------------------------------------------------------------------------------------------------------------- Traffic

template <> struct From<Network *> {
    static Network *of(PyObject *given) {
        return Py_TYPE(given) == network_type ? reinterpret_cast<NetworkObject *>(given)->network
                                              : (raise(PyExc_TypeError, "this is no network of the kernel"), nullptr);
    }
};
struct TrafficObject {
    PyObject_HEAD Traffic *traffic;
};
template <> Traffic &self_of<Traffic>(PyObject *object) { return *reinterpret_cast<TrafficObject *>(object)->traffic; }
template <> Network &self_of<Network>(PyObject *object) { return *reinterpret_cast<NetworkObject *>(object)->network; }
typedef Exact<&PyFloat_Type> Float;

// After an error of highway-env: writes what is known, so that the caller sees the state at the moment of the error.
[[noreturn]] void fail(Traffic &self, bool moved) {
    PyObject *kind, *value, *trace;
    PyErr_Fetch(&kind, &value, &trace);
    if (!publish_all(&self, moved)) {
        PyErr_Clear();
    }
    PyErr_Restore(kind, value, trace);
    throw Raised();
}

void publish(Traffic &self, bool moved) {
    if (!publish_all(&self, moved)) {
        throw Raised();
    }
}

bool traffic_read(Traffic &self) { return read_all(&self); }

void traffic_act(Traffic &self) {
    if (!act_all(&self)) {
        fail(self, false);
    }
    publish(self, false);
}

bool traffic_step(Traffic &self, Float dt) {
    const double length = PyFloat_AS_DOUBLE(dt.object);
    const Moved moved = move_all(&self, length, dt);
    if (moved == FAILED || (moved == FINITE && !collide_all(&self, length, dt))) {
        fail(self, true);
    }
    publish(self, true);
    return moved == FINITE;
}

void traffic_collide(Traffic &self, Float dt) {
    if (!collide_all(&self, PyFloat_AS_DOUBLE(dt.object), dt)) {
        fail(self, false);
    }
    publish(self, false);
}

std::ptrdiff_t count_crashed(const Traffic &self) {
    return std::count_if(self.actors.begin(), self.actors.end(), [](const Actor &actor) { return actor.moves && actor.crashed; });
}

// run(count, dt, stops): several sub-steps; where it stops at crashes, the sub-step in which a vehicle crashes is the last.
std::tuple<int, bool> traffic_run(Traffic &self, int count, Float dt, bool stops) {
    const double length = PyFloat_AS_DOUBLE(dt.object);
    Moved moved = FINITE;
    const std::ptrdiff_t crashed = count_crashed(self);
    int &done = self.completed;
    for (done = 0; done < count && !(stops && count_crashed(self) > crashed); done++) {
        if (!act_all(&self)) {
            fail(self, done > 0);
        }
        moved = move_all(&self, length, dt);
        if (moved == NOT_FINITE) { // highway-env does the rest of a sub-step with numbers that are not finite
            break;
        }
        if (moved == FAILED || !collide_all(&self, length, dt)) {
            fail(self, true);
        }
    }
    publish(self, true);
    return {done, moved != FINITE};
}

// Traffic(network, actors, models, flags, parameters, road, fixed, examples): `fixed` has a frozenset for each actor, and
// `examples` pairs of an actor and the names of attributes.
std::unique_ptr<Traffic> make_traffic(PyObject *network, std::vector<PyObject *> actors, PyObject *models, PyObject *flags,
                                      PyObject *parameters, PyObject *road, std::vector<PyObject *> fixed,
                                      std::vector<std::tuple<PyObject *, Tuple>> examples) {
    const size_t count = actors.size();
    const Buffer model(models, PyBUF_SIMPLE), flag(flags, PyBUF_SIMPLE), numbers(parameters, PyBUF_SIMPLE);
    if (fixed.size() != count || model.size() != count || flag.size() != count ||
        numbers.size() != count * sizeof(Parameters)) {
        raise(PyExc_ValueError, "one model, flag and row of parameters is needed for each actor");
    }
    auto made = std::make_unique<Traffic>();
    made->network = From<Network *>::of(network);
    made->network_object = Ref(Py_NewRef(network));
    made->lanes = made->network->lanes.size();
    made->along.resize(count * made->lanes);
    made->across.resize(count * made->lanes);
    made->stamps.resize(count * made->lanes);
    made->queues.resize(made->lanes);
    made->road = Ref(Py_NewRef(road));
    for (size_t row = 0; row < count; row++) {
        Actor &actor = made->actors.emplace_back();
        actor.object = Py_NewRef(actors[row]);
        actor.model = model.bytes()[row];
        actor.moves = actor.model != OBJECT;
        actor.has_target = actor.model == CONTROLLED || actor.model == IDM || actor.model == LINEAR;
        actor.is_landmark = flag.bytes()[row] & 1; // see `_kernel_objects._flags_of`
        actor.slides = flag.bytes()[row] & 2;
        actor.changes_lanes = flag.bytes()[row] & 4;
        actor.is_obstacle = flag.bytes()[row] & 8;
        std::memcpy(&actor.parameters, numbers.bytes() + row * sizeof(Parameters), sizeof(Parameters));
        actor.gap_root = 2 * std::sqrt(-actor.parameters.comfort_acc_max * actor.parameters.comfort_acc_min);
        made->vehicles += actor.moves;
        made->watched.push_back({Ref(Py_NewRef(reinterpret_cast<PyObject *>(Py_TYPE(actors[row])))),
                                 Ref(Py_NewRef(fixed[row])), keys_of(actors[row])});
    }
    for (const auto &[object, names] : examples) {
        Ref values = values_of(object, names);
        if (!values) {
            throw Raised();
        }
        made->examples.push_back({Ref(Py_NewRef(object)), Ref(Py_NewRef(names.object)), std::move(values)});
    }
    return made;
}

// conflicts(): the pairs of vehicles whose predicted outlines touch, each with whether that is certain; None if
// highway-env must decide.
std::optional<std::vector<std::tuple<size_t, size_t, bool>>> traffic_conflicts(Traffic &self) {
    const std::vector<Path> paths = predict_all(&self);
    if (PyErr_Occurred()) {
        throw Raised();
    }
    if (paths.size() < self.vehicles) {
        return {};
    }
    std::vector<std::tuple<size_t, size_t, bool>> found;
    for (size_t row = 0; row < paths.size(); row++) {
        for (size_t other = row + 1; other < paths.size(); other++) {
            const Answer answer = is_conflict_possible(self.actors[row], paths[row], self.actors[other], paths[other]);
            if (answer != NO) {
                found.emplace_back(row, other, answer == YES);
            }
        }
    }
    return found;
}

// fill_times(grid, lanes, times, quantum, row, speeds, relations): fills the grid of a time-to-collision observation.
// `relations` has a byte for each lane of the network.
void traffic_fill_times(Traffic &self, PyObject *cells, Py_ssize_t lanes, Py_ssize_t times, double quantum, size_t row,
                        PyObject *of_observer, PyObject *of_lanes) {
    const Buffer buffer(cells, PyBUF_WRITABLE), speeds(of_observer, PyBUF_SIMPLE), relations(of_lanes, PyBUF_SIMPLE);
    const TimeGrid grid = {reinterpret_cast<double *>(buffer.bytes()), lanes, times, quantum};
    const Py_ssize_t count = speeds.view.len / static_cast<Py_ssize_t>(sizeof(double));
    bool fits = lanes >= 0 && times >= 0 && row < self.vehicles && relations.size() == self.lanes && quantum > 0 &&
                buffer.view.len == count * lanes * times * static_cast<Py_ssize_t>(sizeof(double));
    for (size_t lane = 0; fits && lane < self.lanes; lane++) {
        fits = relations.bytes()[lane] != SAME_LANES || self.network->lanes[lane].id < lanes;
    }
    if (!fits) {
        raise(PyExc_ValueError, "the grid has another size than its parts");
    }
    for (Py_ssize_t which = 0; which < count; which++) {
        double speed;
        std::memcpy(&speed, speeds.bytes() + which * static_cast<Py_ssize_t>(sizeof(double)), sizeof(double));
        for (size_t other = 0; other < self.vehicles; other++) {
            fill_times(&self, grid, row, other, which, speed, relations.bytes()[self.actors[other].lane]);
        }
    }
}

// The row of a vehicle or object; NO_ROW if the road does not have it.
size_t row_of(const Traffic &self, PyObject *object) {
    const std::vector<Actor> &actors = self.actors;
    const auto which = std::find_if(actors.begin(), actors.end(), [object](const Actor &actor) { return actor.object == object; });
    return which == actors.end() ? NO_ROW : static_cast<size_t>(which - actors.begin());
}

Ref object_at(const Traffic &self, size_t row) {
    return Ref(Py_NewRef(row == NO_ROW ? Py_None : self.actors[row].object));
}

// neighbour_vehicles(vehicle, lane): the objects ahead and behind; None if the road does not have the vehicle.
std::optional<std::tuple<Ref, Ref>> traffic_neighbour_vehicles(Traffic &self, PyObject *vehicle, size_t lane) {
    const size_t row = row_of(self, vehicle);
    if (lane >= self.lanes) {
        raise(PyExc_IndexError, "no such lane");
    }
    if (row == NO_ROW) {
        return {};
    }
    size_t front, rear;
    neighbour_vehicles(&self, row, static_cast<int>(lane), front, rear);
    return std::tuple(object_at(self, front), object_at(self, rear));
}

// close_objects_to(vehicle, distance, sees_behind, is_sorted, only_vehicles): a list; None if the road does not have the
// vehicle.
std::optional<std::vector<Ref>> traffic_close_objects_to(Traffic &self, PyObject *vehicle, double distance,
                                                         bool sees_behind, bool is_sorted, bool only_vehicles) {
    const size_t row = row_of(self, vehicle), count = only_vehicles ? self.vehicles : self.actors.size();
    if (row >= self.vehicles) {
        return {};
    }
    std::vector<Ref> found;
    for (size_t other : close_objects_to(&self, row, distance, sees_behind, is_sorted, count)) {
        found.push_back(object_at(self, other));
    }
    return found;
}

// describe(cells, objects, absolute, features, scales, clips): writes a row for each object into the cells, from the point
// of view of the first object but for a number of absolute rows; returns whether highway-env would describe all of them
// without an error. A feature is a byte, and its scale two floats: the lower end, and the length of the interval, which is
// 0 for no scale.
bool traffic_describe(Traffic &self, PyObject *table, std::vector<PyObject *> objects, size_t absolute, PyObject *features,
                      PyObject *numbers, bool clips) {
    const Buffer cells(table, PyBUF_WRITABLE), codes(features, PyBUF_SIMPLE), given(numbers, PyBUF_SIMPLE);
    const size_t columns = codes.size();
    std::vector<Scale> scales(columns);
    bool fits = given.size() == 2 * columns * sizeof(double) &&
                cells.size() >= objects.size() * columns * sizeof(double);
    for (size_t column = 0; fits && column < columns; column++) {
        double scale[2];
        std::memcpy(scale, given.bytes() + column * sizeof(scale), sizeof(scale));
        scales[column] = {scale[0], scale[1], scale[1] != 0};
        fits = codes.bytes()[column] >= 0 && codes.bytes()[column] < FEATURES;
    }
    if (!fits) {
        raise(PyExc_ValueError, "the cells have another size than their parts");
    }
    const Actor *observer = nullptr;
    double *out = reinterpret_cast<double *>(cells.bytes());
    for (size_t line = 0; line < objects.size(); line++, out += columns) {
        const size_t row = row_of(self, objects[line]);
        if (row == NO_ROW || !is_described(self.network, self.actors[row], codes.bytes(), columns)) {
            return false;
        }
        const Actor &actor = self.actors[row];
        observer = line ? observer : &actor;
        describe(actor, line < absolute ? nullptr : observer, codes.bytes(), scales.data(), columns, clips, out);
    }
    return true;
}

int traffic_completed(Traffic &self) { return self.completed; }

PyMethodDef traffic_methods[] = {
    {"read", METHOD(traffic_read), nullptr},
    {"is_current", METHOD(traffic_is_current), nullptr},
    {"act", METHOD(traffic_act), nullptr},
    {"step", METHOD(traffic_step), nullptr},
    {"collide", METHOD(traffic_collide), nullptr},
    {"completed", METHOD(traffic_completed), nullptr},
    {"run", METHOD(traffic_run), nullptr},
    {"conflicts", METHOD(traffic_conflicts), nullptr},
    {"neighbour_vehicles", METHOD(traffic_neighbour_vehicles), nullptr},
    {"close_objects_to", METHOD(traffic_close_objects_to), nullptr},
    {"describe", METHOD(traffic_describe), nullptr},
    {"fill_times", METHOD(traffic_fill_times), nullptr},
    {nullptr, nullptr, 0, nullptr},
};

// ---------------------------------------------------------------------------------------------------------------- Network

// Network(keys, lanes, index, table, connected): the table has a `LaneRow` for each lane.
std::unique_ptr<Network> make_network(List keys, List objects, Dict index, PyObject *table,
                                      std::vector<std::vector<std::tuple<int, double>>> connected) {
    const Buffer rows(table, PyBUF_SIMPLE);
    const size_t count = static_cast<size_t>(PyList_GET_SIZE(keys.object));
    if (rows.size() != count * sizeof(LaneRow) || static_cast<size_t>(PyList_GET_SIZE(objects.object)) != count) {
        raise(PyExc_ValueError, "one row of the table is needed for each lane");
    }
    auto made = std::make_unique<Network>();
    made->keys = Ref(Py_NewRef(keys.object));
    made->objects = Ref(Py_NewRef(objects.object));
    made->index = Ref(Py_NewRef(index.object));
    for (size_t number = 0; number < count; number++) {
        LaneRow row;
        std::memcpy(&row, rows.bytes() + number * sizeof(LaneRow), sizeof(LaneRow));
        PyObject *key = PyList_GET_ITEM(keys.object, static_cast<Py_ssize_t>(number));
        made->lanes.emplace_back(row, std::get<2>(From<std::tuple<PyObject *, PyObject *, int>>::of(key)));
    }
    for (const auto &pairs : connected) {
        Connections &lanes = made->connected.emplace_back();
        for (const auto &[other, offset] : pairs) {
            lanes.emplace_back(other, offset);
        }
    }
    return made;
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

typedef std::vector<std::tuple<size_t, double>> Unsure; // the numbers of lanes, and places on them

// Marks the cells of the points on one lane, and lists the points about which highway-env must decide.
void mark_lane(const Lane &lane, size_t number, const Grid &grid, char *marks, Unsure &unsure) {
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
            unsure.emplace_back(number, point);
        }
    }
}

// mark_cells(...): a byte for each cell that is 1 if a point of a lane is in it, and a list of lanes with points about
// which highway-env must decide.
std::tuple<Ref, Unsure> network_mark_cells(Network &self, std::tuple<double, double> position,
                                           std::tuple<double, double> direction, double reach, double spacing,
                                           std::tuple<double, double> low, std::tuple<double, double> step,
                                           std::tuple<Py_ssize_t, Py_ssize_t> cells, bool is_aligned) {
    Grid grid;
    std::tie(grid.x, grid.y) = position;
    std::tie(grid.cosine, grid.sine) = direction;
    std::tie(grid.low[0], grid.low[1]) = low;
    std::tie(grid.step[0], grid.step[1]) = step;
    std::tie(grid.cells[0], grid.cells[1]) = cells;
    grid.reach = reach;
    grid.spacing = spacing;
    grid.is_aligned = is_aligned;
    const Py_ssize_t most = 1000000;
    if (!(grid.spacing > 0 && grid.reach / grid.spacing < 1e6) || grid.cells[0] < 0 || grid.cells[1] < 0 ||
        grid.cells[0] > most || grid.cells[1] > most) {
        raise(PyExc_ValueError, "the grid is too large");
    }
    Ref marks(PyByteArray_FromStringAndSize(nullptr, grid.cells[0] * grid.cells[1]));
    if (!marks) {
        throw Raised();
    }
    char *first = PyByteArray_AS_STRING(marks.object);
    std::memset(first, 0, static_cast<size_t>(PyByteArray_GET_SIZE(marks.object)));
    Unsure unsure;
    for (size_t number = 0; number < self.lanes.size(); number++) {
        mark_lane(self.lanes[number], number, grid, first, unsure);
    }
    return {std::move(marks), std::move(unsure)};
}

PyMethodDef network_methods[] = {
    {"mark_cells", METHOD(network_mark_cells), nullptr},
    {nullptr, nullptr, 0, nullptr},
};

// ----------------------------------------------------------------------------------------------------------------- module

// bind(float64, int64, float32, ndarray, zeros, slide, [sin, cos, ...], fused, product_fused, exponent_step): NumPy's types and functions, and
// the function that moves a vehicle with the dynamic bicycle model.
void bind(PyObject *number, PyObject *whole, PyObject *short_number, PyObject *array, PyObject *zeros,
          PyObject *slide_function, std::vector<PyObject *> ufuncs, bool is_fused, bool is_product_fused, Py_ssize_t step) {
    if (ufuncs.size() != FUNCTIONS) {
        raise(PyExc_ValueError, "seven functions are needed");
    }
    for (int wanted = 0; wanted < FUNCTIONS; wanted++) {
        const UFunc *ufunc = reinterpret_cast<const UFunc *>(ufuncs[static_cast<size_t>(wanted)]);
        int arguments = wanted == ARCTAN2 || wanted == POWER ? 2 : 1, which = 0;
        if (ufunc->nin != arguments || ufunc->nout != 1 || ufunc->nargs != arguments + 1 || !ufunc->name ||
            std::strcmp(ufunc->name, NAMES[wanted])) {
            raise(PyExc_OSError, "NumPy's function %s has an unknown layout", NAMES[wanted]);
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
            raise(PyExc_OSError, "NumPy's function %s is not for float64", NAMES[wanted]);
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
}

// compute(name, *numbers): the result of one function, for the comparison with NumPy.
double compute(std::string name, std::vector<double> numbers) {
    numbers.resize(6);
    const double a = numbers[0], b = numbers[1], c = numbers[2], d = numbers[3];
    for (int number = 0; number < FUNCTIONS; number++) {
        if (name == NAMES[number]) {
            return number == ARCTAN2 || number == POWER ? call(number, a, b) : call(number, a);
        }
    }
    const std::pair<const char *, double> others[] = {
        {"dot", dot(a, b, c, d)}, {"product", product(a, b, c, d)}, {"turned", turned(a, b, c, d)},
        {"dot3", dot(&numbers[0], &numbers[3])}, {"square", square(a)}, {"remainder", remainder_of(a, b)},
    };
    for (const auto &[known, found] : others) {
        if (name == known) {
            return found;
        }
    }
    raise(PyExc_ValueError, "unknown function %s", name.c_str());
}

// mirrored_poses(objects, half_lengths): the points half a length ahead of objects, their headings and their speeds, with the
// y axis up; None if one of them has an unusual type. The cosine and the sine are those of Python's `math`.
std::optional<std::tuple<std::vector<std::tuple<double, double>>, std::vector<double>, std::vector<double>>>
mirrored_poses(std::vector<PyObject *> objects, std::vector<double> halves) {
    if (halves.size() != objects.size()) {
        raise(PyExc_ValueError, "one half of a length is needed for each object");
    }
    std::vector<std::tuple<double, double>> points;
    std::vector<double> headings, speeds;
    for (size_t at = 0; at < objects.size(); at++) {
        const Ref position = attribute(objects[at], s_position);
        Number heading, speed;
        Py_buffer view;
        if (!position || !open_floats(position.object, view, 2, 0)) {
            return {};
        }
        const double x = static_cast<double *>(view.buf)[0], y = static_cast<double *>(view.buf)[1];
        PyBuffer_Release(&view);
        if (!read_number(objects[at], s_heading, heading) || !read_number(objects[at], s_speed, speed) ||
            !std::isfinite(heading.value)) {
            return {};
        }
        const double c = std::cos(heading.value), s = std::sin(heading.value);
        points.emplace_back(x + halves[at] * c, 0.0 - (y + halves[at] * s));
        headings.push_back(0.0 - heading.value);
        speeds.push_back(speed.value);
    }
    return std::tuple(std::move(points), std::move(headings), std::move(speeds));
}

// bind_turn(rounds): how NumPy multiplies a matrix by a vector.
void bind_turn(int rounds) {
    if (rounds < UNKNOWN || rounds >= TURNS) {
        raise(PyExc_ValueError, "unknown way of rounding %d", rounds);
    }
    turn_rounds = rounds;
}

PyMethodDef methods[] = {
    {"bind", FUNCTION(bind), nullptr},
    {"bind_turn", FUNCTION(bind_turn), nullptr},
    {"mirrored_poses", FUNCTION(mirrored_poses), nullptr},
    {"compute", FUNCTION(compute), nullptr},
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
    Ref module(intern_names() ? PyModule_Create(&definition) : nullptr);
    if (!module || PyModule_AddIntConstant(module.object, "INTERFACE", CRASHHUNT_INTERFACE)) {
        return nullptr;
    }
    try {
        network_type = add_class<NetworkObject, &NetworkObject::network, make_network>(
            module.object, "_crashhunt_highway.Network", network_methods, no_getters, "The lanes of a road.");
        add_class<TrafficObject, &TrafficObject::traffic, make_traffic>(
            module.object, "_crashhunt_highway.Traffic", traffic_methods, no_getters, "The vehicles and objects of a road.");
        add_class<ContentsObject, &ContentsObject::contents, make_contents>(
            module.object, "_crashhunt_highway.Contents", contents_methods, no_getters,
            "The contents of containers at one time.");
    } catch (const Raised &) {
        return nullptr;
    }
    return module.give();
}
