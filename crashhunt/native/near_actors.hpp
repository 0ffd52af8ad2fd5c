// Actors near to each other: the default observation, pairs that may touch, hard braking. A part of core.cpp.

// -------------------------------------------------------------------------------------------- those near to each other

typedef std::pair<double, size_t> Near; // squared distance of front bumpers, row; sorted as Python sorts such tuples
std::vector<Near> nearest;

// As Scene.neighbors, of those below a limit, and sorted up to a number of them.
bool find_nearest(const Scene &scene, size_t row, double below, size_t wanted) {
    nearest.clear();
    const double x = scene.x(row), y = scene.y(row);
    for (size_t other = 0; other < scene.size; other++) {
        const double dx = scene.x(other) - x, dy = scene.y(other) - y;
        const double squared = dx * dx + dy * dy;
        if (!std::isfinite(squared)) {
            return false; // Python sorts what is not a number somehow, and what is too far away it cannot pack
        }
        if (other != row && squared < below) {
            nearest.emplace_back(squared, other);
        }
    }
    wanted = std::min(wanted, nearest.size());
    std::partial_sort(nearest.begin(), nearest.begin() + static_cast<std::ptrdiff_t>(wanted), nearest.end());
    return true;
}

// --------------------------------------------------------------------------------------------------- the observation

// As Kinematics.observe in its usual form; null without an exception if Python has to do it.
PyObject *observed(const Scene &present, size_t row, size_t shown, double distance, double from_left,
                   double lateral_speed) {
    const std::vector<double> &lengths = present.roster->lengths;
    if (!find_nearest(present, row, HUGE_VAL, shown)) {
        return nullptr;
    }
    const double heading = present.headings[row], speed = present.speeds[row];
    const size_t seen = std::min(shown, nearest.size());
    bool whole = std::isfinite(heading); // else Python's sine raises
    for (size_t number = 0; number < seen; number++) {
        whole = whole && std::isfinite(present.headings[nearest[number].second]);
    }
    if (!whole) {
        return nullptr;
    }
    const double own_cos = cos(heading), own_sin = sin(heading), half = lengths[row] / 2;
    const double center_x = present.x(row) - half * own_cos, center_y = present.y(row) - half * own_sin;
    const double own_vx = speed * own_cos, own_vy = speed * own_sin;
    PyObject *bytes = PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>((shown + 1) * 7 * sizeof(float)));
    if (!bytes) {
        return nullptr;
    }
    char *place = PyBytes_AS_STRING(bytes);
    bool small = true;
    const auto put = [&](const double (&values)[7]) {
        for (double value : values) {
            const float single = static_cast<float>(value);
            small = small && (std::isfinite(single) || !std::isfinite(value)); // struct.pack raises
            memcpy(place, &single, sizeof single);
            place += sizeof single;
        }
    };
    put({1.0, distance, from_left, speed, lateral_speed, own_cos, -own_sin});
    for (size_t number = 0; number < seen; number++) {
        const size_t other = nearest[number].second;
        const double c = cos(present.headings[other]), s = sin(present.headings[other]);
        const double other_half = lengths[other] / 2, other_speed = present.speeds[other];
        const double dx = present.x(other) - other_half * c - center_x;
        const double dy = present.y(other) - other_half * s - center_y;
        const double vx = other_speed * c - own_vx, vy = other_speed * s - own_vy;
        put({1.0, dx * own_cos + dy * own_sin, dx * own_sin - dy * own_cos, vx * own_cos + vy * own_sin,
             vx * own_sin - vy * own_cos, c * own_cos + s * own_sin, c * own_sin - s * own_cos});
    }
    memset(place, 0, (shown - seen) * 7 * sizeof(float));
    if (!small) {
        Py_CLEAR(bytes);
    }
    return bytes;
}

// observe(columns, row, others, distance, from_left, lateral_speed) -> bytes | None
PyObject *observe(Columns *columns, long row, long others, double distance, double from_left, double lateral_speed) {
    const Scene present(columns);
    if (!present.sized() || row < 0 || others < 0 || static_cast<size_t>(row) >= present.size) {
        return Py_NewRef(Py_None);
    }
    PyObject *bytes = observed(present, static_cast<size_t>(row), static_cast<size_t>(others), distance, from_left,
                               lateral_speed);
    return bytes || PyErr_Occurred() ? bytes : Py_NewRef(Py_None);
}

// ------------------------------------------------------------------------------------------------ pairs that may touch

const double TAU = 6.283185307179586;
const double TOUCH = 1e-9;

struct Rectangle {
    double x, y, heading, length, width;
};

// As outlines_overlap of crashhunt/world/_geometry.py.
bool overlap(const Rectangle &one, const Rectangle &two, double margin) {
    const double c1 = cos(one.heading), s1 = sin(one.heading), c2 = cos(two.heading), s2 = sin(two.heading);
    const double l1 = one.length, w1 = one.width, l2 = two.length, w2 = two.width;
    const double dx = (two.x - l2 / 2 * c2) - (one.x - l1 / 2 * c1);
    const double dy = (two.y - l2 / 2 * s2) - (one.y - l1 / 2 * s1);
    const double along = fabs(c1 * c2 + s1 * s2), across = fabs(c1 * s2 - s1 * c2);
    if (fabs(-dx * s1 + dy * c1) >= (w1 + l2 * across + w2 * along) / 2 - TOUCH + margin) {
        return false;
    }
    if (fabs(dx * c1 + dy * s1) >= (l1 + l2 * along + w2 * across) / 2 - TOUCH + margin) {
        return false;
    }
    if (fabs(-dx * s2 + dy * c2) >= (w2 + l1 * across + w1 * along) / 2 - TOUCH + margin) {
        return false;
    }
    return fabs(dx * c2 + dy * s2) < (l2 + l1 * along + w1 * across) / 2 - TOUCH + margin;
}

Rectangle outline(const Scene &scene, size_t row) {
    const Roster &roster = *scene.roster;
    return {scene.x(row), scene.y(row), scene.headings[row], roster.lengths[row], roster.widths[row]};
}

struct Moved {
    double x, y, aside;
};

long earlier_row(const Earlier &earlier, size_t row) { return earlier.empty() ? static_cast<long>(row) : earlier[row]; }

// As _moved of oracles/_included_oracles.py.
Moved moved(const Scene &previous, const Scene &present, size_t row, const Earlier &earlier) {
    const long found = earlier_row(earlier, row);
    if (found < 0) {
        return {0.0, 0.0, 0.0};
    }
    const size_t was = static_cast<size_t>(found);
    const double heading = previous.headings[was];
    const double dx = present.x(row) - previous.x(was), dy = present.y(row) - previous.y(was);
    double aside = 2 * fabs(dy * cos(heading) - dx * sin(heading));
    const double turn = present.headings[row] - heading;
    if (turn != 0.0) {
        aside += fabs(remainder(turn, TAU)) * (present.roster->reaches[row] + fabs(dx) + fabs(dy));
    }
    return {dx, dy, aside};
}

// As _within_reach of oracles/_included_oracles.py, of two scenes; false if Python has to do it.
bool reach(const Scene &present, const Scene &previous, size_t row, double step_s, double hardest,
           std::vector<size_t> &found, const Earlier &earlier = Earlier()) {
    const std::vector<double> &reaches = present.roster->reaches;
    const double further = 2 * (1.5 * (fastest(present) + hardest * step_s) * step_s + 1.0); // as reachable_m has it
    const double most = 2 * *std::max_element(reaches.begin(), reaches.end()) + further;
    found.clear();
    if (!std::isfinite(most * most) || !find_nearest(present, row, most * most, present.size)) {
        return false;
    }
    if (nearest.empty()) {
        return true;
    }
    const Moved mine = moved(previous, present, row, earlier);
    const long was = earlier_row(earlier, row);
    const Rectangle own = outline(present, row);
    const Rectangle own_before = was < 0 ? own : outline(previous, static_cast<size_t>(was));
    for (const Near &near : nearest) {
        const size_t other = near.second;
        const double reach = reaches[row] + reaches[other];
        if (near.first >= (reach + further) * (reach + further)) {
            continue;
        }
        const Moved theirs = moved(previous, present, other, earlier);
        const double rx = mine.x - theirs.x, ry = mine.y - theirs.y;
        const double margin = sqrt(rx * rx + ry * ry) + mine.aside + theirs.aside;
        if (!std::isfinite(margin)) {
            return false; // such as where a heading is infinite, of which Python's cosine raises
        }
        if (!(near.first < (reach + margin) * (reach + margin))) {
            continue;
        }
        const Rectangle two = outline(present, other);
        const long before = earlier_row(earlier, other);
        if (overlap(own, two, margin) &&
            (overlap(own, two, margin / 2) || was < 0 || before < 0 ||
             overlap(own_before, outline(previous, static_cast<size_t>(before)), margin / 2))) {
            found.push_back(other);
        }
    }
    return true;
}

std::vector<size_t> reached; // used again

// The earlier row of each row, or -1, of a list.
Earlier earlier_rows_of(PyObject *list, size_t rows, size_t earlier_rows) {
    Earlier found = From<Earlier>::of(From<List>::of(list));
    if (found.size() != rows) {
        raise(PyExc_TypeError, "earlier rows are a list with a row, or -1, for each row");
    }
    for (long was : found) {
        if (was < -1 || was >= static_cast<long>(earlier_rows)) {
            raise(PyExc_IndexError, "there is no such earlier row");
        }
    }
    return found;
}

// within_reach(columns, earlier columns, row, step_s, hardest, earlier rows | None) -> list of rows | None
std::optional<std::vector<size_t>> within_reach(Columns *columns, Columns *earlier, long asked, double step_s,
                                                double hardest, PyObject *earlier_rows) {
    const Scene present(columns), previous(earlier);
    const bool same = earlier_rows == Py_None;
    const size_t row = static_cast<size_t>(asked);
    const Earlier rows = same ? Earlier() : earlier_rows_of(earlier_rows, present.size, previous.size);
    if ((same && previous.size != present.size) || !present.sized() || !previous.sized() || asked < 0 ||
        row >= present.size || !reach(present, previous, row, step_s, hardest, reached, rows)) {
        return {};
    }
    return reached;
}

// The least change of speed; 0 if there is no actor, and NaN if Python has to compute it.
double least_of(const Scene &earlier, const Scene &later) {
    double least = later.size ? HUGE_VAL : 0.0;
    for (size_t row = 0; row < later.size; row++) {
        const double change = later.speeds[row] - earlier.speeds[row];
        if (std::isnan(change)) {
            return change;
        }
        least = std::min(least, change);
    }
    return least;
}

// least_change(earlier, later) -> float | None: the least change of speed; 0 if there is no actor
std::optional<double> least_change(Columns *was, Columns *is) {
    const Scene earlier(was), later(is);
    const double least = earlier.size == later.size ? least_of(earlier, later) : NAN;
    return std::isnan(least) ? std::nullopt : std::optional(least);
}
