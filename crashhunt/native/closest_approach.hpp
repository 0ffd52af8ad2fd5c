// Who may have a part in the closest approach of an episode. A part of core.cpp.

const double SLACK = 1e-6; // m, and relative: what NumPy rounds otherwise is far less
const double MOST_KNOWN = 1e9; // of numbers beyond, what is rounded otherwise may be more

// Successive scenes of one roster, of a Frame: (columns, row or -1, lengths, widths, numbers of the actors). Vehicles
// may stand for the lengths, and None for the widths then, and for numbers that are the rows.
struct Part {
    Buffer buffer;
    size_t scenes = 0, actors = 0;
    long own = -1;
    std::vector<double> lengths, widths;
    std::vector<int64_t> numbers;

    // False where it is not what the core knows; throws where it is nothing of the kind.
    bool read(PyObject *given) {
        const auto [columns, row, sizes, others, whose] =
            From<std::tuple<PyObject *, long, PyObject *, PyObject *, PyObject *>>::of(given);
        own = row;
        if (Py_TYPE(sizes) == vehicles_type) {
            lengths = reinterpret_cast<Vehicles *>(sizes)->roster->lengths;
            widths = reinterpret_cast<Vehicles *>(sizes)->roster->widths;
        } else if (!numbers_of(sizes, lengths) || !numbers_of(others, widths)) {
            return false;
        }
        actors = lengths.size();
        if (whose != Py_None && !PyList_CheckExact(whose)) {
            return false;
        }
        for (size_t number = 0; whose == Py_None && number < actors; number++) {
            numbers.push_back(static_cast<int64_t>(number));
        }
        if (whose != Py_None) {
            numbers = From<std::vector<int64_t>>::of(whose);
        }
        if (widths.size() != actors || numbers.size() != actors || own < -1 || own >= static_cast<long>(actors)) {
            return false;
        }
        if (!buffer.open(columns, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT)) {
            PyErr_Clear(); // such as one that is not in order
            return false;
        }
        const Py_buffer &view = buffer.view;
        scenes = view.ndim == 2 ? static_cast<size_t>(view.shape[0]) : 0; // also of scenes without actors
        return view.itemsize == 8 && view.format && strchr(view.format, 'd') && buffer.size() == scenes * 32 * actors &&
               known();
    }
    // Whether all of it are numbers as there are in traffic.
    bool known() const {
        const double *values = scene(0);
        size_t odd = 0;
        for (size_t place = 0; place < scenes * 4 * actors; place++) {
            odd += !(fabs(values[place]) <= MOST_KNOWN);
        }
        return !odd;
    }
    const double *scene(size_t number) const { return static_cast<const double *>(buffer.view.buf) + number * 4 * actors; }
};

// All parts of an episode; nothing where one is not what the core knows.
std::optional<std::vector<Part>> parts_of(List list) {
    std::vector<Part> parts;
    for (PyObject *given : From<std::vector<PyObject *>>::of(list)) {
        if (!parts.emplace_back().read(given)) {
            return {};
        }
    }
    return parts;
}

// Columns of numbers, one after another, as bytes.
template <typename Number> Ref bytes_of(const std::vector<std::vector<Number>> &columns) {
    const size_t size = columns[0].size() * sizeof(Number);
    PyObject *bytes = PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>(columns.size() * size));
    char *place = bytes ? PyBytes_AS_STRING(bytes) : nullptr;
    for (const std::vector<Number> &column : columns) {
        if (place && size) {
            memcpy(place, column.data(), size);
            place += size;
        }
    }
    return Ref(bytes);
}

typedef std::tuple<Ref, Ref> Bytes; // of numbers, and of whole numbers

// A pair of outlines as NumPy measures it in crashhunt/world/_geometry.py, up to what that rounds otherwise.
struct Pair {
    double x, y, vx, vy, c, s, one_l, one_w, two_l, two_w; // as seen from the first; c and s of the turn

    // As rectangle_gap.
    double gap() const {
        const double far = fabs(c), wide = fabs(s);
        const double apart = std::max(std::max(fabs(x) - one_l - two_l * far - two_w * wide,
                                               fabs(y) - one_w - two_l * wide - two_w * far),
                                      std::max(fabs(x * c + y * s) - two_l - one_l * far - one_w * wide,
                                               fabs(y * c - x * s) - two_w - one_l * wide - one_w * far));
        if (apart <= 0) {
            return 0;
        }
        const double back_x = -(x * c + y * s), back_y = x * s - y * c;
        double nearest = HUGE_VAL;
        const auto outside = [&](double px, double py, double length, double width) {
            const double dx = std::max(fabs(px) - length, 0.0), dy = std::max(fabs(py) - width, 0.0);
            nearest = std::min(nearest, dx * dx + dy * dy);
        };
        for (int corner = 0; corner < 4; corner++) {
            const double along = corner & 1 ? 1 : -1, across = corner & 2 ? 1 : -1;
            double px = along * two_l, py = across * two_w;
            outside(x + px * c - py * s, y + px * s + py * c, one_l, one_w);
            px = along * one_l, py = across * one_w;
            outside(back_x + px * c + py * s, back_y - px * s + py * c, two_l, two_w);
        }
        return sqrt(nearest);
    }

    // As time_to_contact: from when to when that may be, infinite where they surely never touch within a horizon; sure
    // is whether they do, and now whether they overlap already.
    void contact(double horizon, double &soonest, double &latest, bool &sure, bool &now) const {
        const double far = fabs(c), wide = fabs(s);
        const double axes[4][3] = {{1, 0, one_l + two_l * far + two_w * wide},
                                   {0, 1, one_w + two_l * wide + two_w * far},
                                   {c, s, two_l + one_l * far + one_w * wide},
                                   {-s, c, two_w + one_l * wide + one_w * far}};
        double enter = -HUGE_VAL, leave = HUGE_VAL, loose = SLACK;
        sure = true;
        now = false;
        soonest = latest = HUGE_VAL;
        for (const double(&axis)[3] : axes) {
            const double distance = x * axis[0] + y * axis[1], speed = vx * axis[0] + vy * axis[1], reach = axis[2];
            const double slack = SLACK * (1 + fabs(x) + fabs(y) + reach);
            if (fabs(speed) < SLACK) { // it hardly moves on this axis within the time that is looked at
                const double room = reach - fabs(distance), most = slack + SLACK * 4 * horizon;
                if (room < -most) {
                    sure = false;
                    return;
                }
                sure = sure && room > most;
                continue;
            }
            const double first = (-reach - distance) / speed, last = (reach - distance) / speed;
            loose = std::max(loose, slack * (1 + 1 / fabs(speed)) + 1e-9 * (fabs(first) + fabs(last)));
            enter = std::max(enter, std::min(first, last));
            leave = std::min(leave, std::max(first, last));
        }
        if (std::max(enter, 0.0) - loose > leave + loose || enter - loose > horizon) {
            sure = false;
            return;
        }
        now = sure && enter < -loose && leave > loose;
        enter = std::max(enter, 0.0);
        sure = sure && enter + loose < leave - loose && enter + loose < horizon;
        soonest = std::max(0.0, enter - loose);
        latest = enter + loose;
    }
};

// may_be_near(parts, gap, horizon, gap so far, time so far, braking so far, only the best) -> (numbers, places) | None
// The conditions of `approaches` in world/_closest_approach.py with some slack: who fulfils them there does so here.
// If only the best pair is asked for, pairs are left out for which another pair is certainly nearer in every measure.
std::optional<Bytes> may_be_near(List list, double gap, double horizon, double best_gap, double best_time,
                                 double best_braking, bool only_best) {
    const auto parts = parts_of(list);
    if (!parts) {
        return {};
    }
    struct Body {
        double x, y, vx, vy, c, s, reach, within, apart;
    };
    // Who may be near, with what is surely not exceeded: the least gap, the soonest contact, the hardest braking.
    struct Candidate {
        const Part *part;
        const double *line;
        int64_t step;
        size_t actor;
        double gap, time, braking;
    };
    std::vector<Body> bodies;
    std::vector<Candidate> candidates;
    // A pair that certainly does not touch has neither the shortest time nor the hardest braking.
    const auto beaten = [&](const Candidate &one) {
        return (one.gap > best_gap || one.gap == HUGE_VAL) && (one.time > best_time || one.time == HUGE_VAL) &&
               (one.braking < best_braking || one.braking == 0);
    };
    int64_t step = -1;
    bool touched = only_best && best_gap == 0 && best_time == 0; // those that overlap are all as near
    for (const Part &part : *parts) {
        const size_t actors = part.actors, own = static_cast<size_t>(part.own);
        bodies.resize(actors);
        for (size_t scene = 0; scene < part.scenes; scene++) {
            step++;
            if (part.own < 0) {
                continue;
            }
            const double *line = part.scene(scene);
            for (size_t actor = 0; actor < actors; actor++) {
                const double heading = line[2 * actors + actor], speed = line[3 * actors + actor];
                const double half = part.lengths[actor] / 2, wide = part.widths[actor] / 2;
                double c, s;
                sincos(heading, &s, &c);
                bodies[actor] = {line[2 * actor] - half * c, line[2 * actor + 1] - half * s, speed * c, speed * s, c, s,
                                 sqrt(half * half + wide * wide), std::min(half, wide), 0.0};
            }
            const Body me = bodies[own];
            double best = best_gap;
            for (size_t actor = 0; actor < actors; actor++) {
                Body &body = bodies[actor];
                const double dx = body.x - me.x, dy = body.y - me.y;
                body.apart = sqrt(dx * dx + dy * dy);
                if (actor != own && body.apart - me.reach - body.reach < gap - SLACK * (1 + body.apart)) {
                    best = std::min(best, body.apart - body.within - me.within);
                }
            }
            for (size_t actor = 0; actor < actors; actor++) {
                if (actor == own) {
                    continue;
                }
                const Body &body = bodies[actor];
                const double dx = body.x - me.x, dy = body.y - me.y, vx = body.vx - me.vx, vy = body.vy - me.vy;
                const double reach = me.reach + body.reach, bound = body.apart - reach;
                const double slack = SLACK * (1 + body.apart), speed = sqrt(vx * vx + vy * vy);
                const double scale = SLACK * (1 + body.apart) * (1 + speed);
                // Said in the negative: what is not a number is kept, and left to Python.
                const bool far = bound > gap + slack || bound > best + slack;
                const bool harmless = (-(dx * vx + dy * vy) < -scale && body.apart > reach + slack) ||
                                      fabs(dx * vy - dy * vx) > reach * speed + scale ||
                                      bound > horizon * speed + scale ||
                                      // As near as they come, it is no sooner and no harder than once before.
                                      (bound > slack && bound - slack > best_time * (speed + scale) &&
                                       (speed + scale) * (speed + scale) < 2 * (bound - slack) * best_braking);
                if (far && harmless) {
                    continue;
                }
                const auto stood = [&](size_t one) { // since the scene before, which has been looked at
                    const double *was = line - 4 * actors;
                    return scene && was[2 * one] == line[2 * one] && was[2 * one + 1] == line[2 * one + 1] &&
                           was[2 * actors + one] == line[2 * actors + one] &&
                           was[3 * actors + one] == line[3 * actors + one];
                };
                if (only_best && stood(actor) && stood(own)) {
                    continue;
                }
                Candidate found = {&part, line, step, actor, -HUGE_VAL, -HUGE_VAL, HUGE_VAL};
                if (only_best && std::isfinite(body.apart) && std::isfinite(speed)) {
                    const Pair pair = {dx * me.c + dy * me.s,
                                       dy * me.c - dx * me.s,
                                       vx * me.c + vy * me.s,
                                       vy * me.c - vx * me.s,
                                       body.c * me.c + body.s * me.s,
                                       body.s * me.c - body.c * me.s,
                                       part.lengths[own] / 2,
                                       part.widths[own] / 2,
                                       part.lengths[actor] / 2,
                                       part.widths[actor] / 2};
                    found.gap = far ? HUGE_VAL : pair.gap() - slack;
                    if (!far && bound < gap - slack) {
                        best_gap = std::min(best_gap, found.gap + 2 * slack);
                    }
                    found.time = HUGE_VAL;
                    found.braking = 0;
                    if (!harmless) {
                        double latest;
                        bool sure, now;
                        pair.contact(horizon, found.time, latest, sure, now);
                        if (now && bound < -slack && speed > scale) {
                            if (touched) {
                                continue;
                            }
                            touched = true;
                        }
                        // What NumPy leaves out for being far from a collision course counts for nothing here either.
                        sure = sure && -(dx * vx + dy * vy) > scale &&
                               fabs(dx * vy - dy * vx) < reach * speed - scale && bound < horizon * speed - scale;
                        found.braking = found.time > 0 ? (speed + scale) / (2 * found.time) : HUGE_VAL;
                        if (sure) {
                            best_time = std::min(best_time, latest);
                            best_braking = found.time > 0 ? std::max(best_braking, (speed - scale) / (2 * latest))
                                                          : best_braking;
                        }
                    }
                    if (beaten(found)) {
                        continue;
                    }
                }
                candidates.push_back(found);
            }
        }
    }
    std::vector<std::vector<double>> found(6); // x, y, heading, speed, half length, half width
    std::vector<std::vector<int64_t>> places(2); // the scene, and where the agent is among those found
    const auto keep = [&](const Candidate &one, size_t actor, int64_t agent) {
        const size_t actors = one.part->actors;
        const double values[] = {one.line[2 * actor],          one.line[2 * actor + 1],
                                 one.line[2 * actors + actor], one.line[3 * actors + actor],
                                 one.part->lengths[actor] / 2, one.part->widths[actor] / 2};
        for (size_t column = 0; column < 6; column++) {
            found[column].push_back(values[column]);
        }
        places[0].push_back(one.step);
        places[1].push_back(agent);
    };
    int64_t agent = 0, last = -1;
    for (const Candidate &one : candidates) {
        if (beaten(one)) {
            continue; // by a pair after it
        }
        if (one.step != last) {
            last = one.step;
            agent = static_cast<int64_t>(places[0].size());
            keep(one, static_cast<size_t>(one.part->own), agent);
        }
        keep(one, one.actor, agent);
    }
    return Bytes(bytes_of(found), bytes_of(places));
}
