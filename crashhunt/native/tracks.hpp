// The way of an agent in an episode, and who is near it. A part of core.cpp.

// The way of an agent as _Way of crashhunt/world/_danger.py has it, up to what NumPy rounds otherwise: enough to rule
// out that others touch it.
struct Way {
    struct Outline { // of another actor: the middle, the direction, half sizes, and how far the corners are
        double x, y, c, s, length, width, reach;
    };
    std::vector<double> x, y, heading, along, half_length, half_width, reach;
    double end = 0, spacing = 0;
    bool known = true;

    void add(const double *line, size_t actors, size_t row, double length, double width) {
        const double angle = line[2 * actors + row];
        x.push_back(line[2 * row] - length / 2 * cos(angle));
        y.push_back(line[2 * row + 1] - length / 2 * sin(angle));
        const double turn = heading.empty() ? 0.0 : remainder(angle - heading.back(), TAU);
        known = known && fabs(turn) < 3.0; // NumPy unwraps half a turn to one side or the other
        heading.push_back(heading.empty() ? angle : heading.back() + turn);
        half_length.push_back(length / 2);
        half_width.push_back(width / 2);
        reach.push_back(sqrt(length * length + width * width) / 2);
    }

    void finish(double unknown) {
        double driven = 0;
        for (size_t sample = 0; sample < x.size(); sample++) {
            driven += sample ? std::hypot(x[sample] - x[sample - 1], y[sample] - y[sample - 1]) : 0;
            along.push_back(driven + 1e-9 * static_cast<double>(sample));
        }
        if (x.empty()) {
            return;
        }
        const double last = heading.back();
        x.push_back(x.back() + unknown * cos(last));
        y.push_back(y.back() + unknown * sin(last));
        heading.push_back(last);
        along.push_back(along.back() + unknown);
        end = along.back();
        known = known && std::isfinite(end);
        spacing = std::min(std::max(1.6 * *std::min_element(half_length.begin(), half_length.end()), 1.0), 4.0);
    }

    // How far two outlines are apart, on the axis where that is most.
    double apart(size_t sample, double angle, double dx, double dy, const Outline &other) const {
        double c, s;
        sincos(angle, &s, &c);
        const double turn_c = other.c * c + other.s * s, turn_s = other.s * c - other.c * s;
        const double along_x = dx * c + dy * s, across = dy * c - dx * s, far = fabs(turn_c), wide = fabs(turn_s);
        const double own_l = half_length[sample], own_w = half_width[sample];
        const double length = other.length, width = other.width;
        double found = fabs(along_x) - own_l - length * far - width * wide;
        found = std::max(found, fabs(across) - own_w - length * wide - width * far);
        found = std::max(found, fabs(along_x * turn_c + across * turn_s) - length - own_l * far - own_w * wide);
        return std::max(found, fabs(across * turn_c - along_x * turn_s) - width - own_l * wide - own_w * far);
    }

    // Whether an actor may be touched on one of the places that are looked at, ahead of a sample (or behind it, with a
    // negative spacing). What is not a number may.
    bool touches(size_t sample, double gap, double far, const Outline &other) const {
        const double around = reach[sample] + other.reach, slack = SLACK * (1 + fabs(other.x) + fabs(other.y) + end);
        const long places = 3 * (static_cast<long>(far / (3 * fabs(gap))) + 1);
        size_t segment = std::min(sample, along.size() - 2);
        for (long place = 0; place < places;) {
            const double at = along[sample] + gap * static_cast<double>(place);
            if (at > end + slack || at < along[0] - slack) {
                return false;
            }
            while (segment + 2 < along.size() && along[segment + 1] < at) {
                segment++;
            }
            while (segment > 0 && along[segment] > at) {
                segment--;
            }
            const double share = (at - along[segment]) / (along[segment + 1] - along[segment]);
            const double dx = other.x - (x[segment] + share * (x[segment + 1] - x[segment]));
            const double dy = other.y - (y[segment] + share * (y[segment + 1] - y[segment]));
            const double room = sqrt(dx * dx + dy * dy) - around;
            if (room > 2 * far + 100) {
                return false;
            }
            if (room > slack) { // no actor gets there in less time
                place += std::max(1L, static_cast<long>((room - slack) / fabs(gap)));
                continue;
            }
            const double own = heading[segment] + share * (heading[segment + 1] - heading[segment]);
            if (!(apart(sample, own, dx, dy, other) > slack)) {
                return true;
            }
            place++;
        }
        return false;
    }
};

// tracks(parts, every, within, ahead, behind, unknown) -> (numbers, places) | None, each a pair for the agent and the
// others. As `_straight` of crashhunt/world/_tracks.py, of every so many scenes. Where a distance ahead is given, those
// are left out whom the agent would not touch so far ahead of it and behind it, on its way and as much further straight
// on.
std::optional<std::tuple<Bytes, Bytes>> tracks(List list, long long every, double within, double ahead, double behind,
                                               double unknown) {
    const auto parts = parts_of(list);
    if (!parts || every < 1) {
        return {};
    }
    std::vector<std::vector<double>> own(5), others(5); // x, y, heading, half length, half width
    std::vector<std::vector<int64_t>> steps(1), pairs(2); // the scene; the sample and whose
    int64_t step = -1, sample = -1;
    Way way;
    if (ahead > 0) {
        for (const Part &part : *parts) {
            const size_t row = static_cast<size_t>(part.own);
            for (size_t scene = 0; scene < part.scenes; scene++) {
                step++;
                if (part.own >= 0 && step % every == 0) {
                    way.add(part.scene(scene), part.actors, row, part.lengths[row], part.widths[row]);
                }
            }
        }
        way.finish(unknown);
        step = -1;
    }
    const bool chosen = ahead > 0 && way.known;
    for (const Part &part : *parts) {
        const size_t actors = part.actors, row = static_cast<size_t>(part.own);
        for (size_t scene = 0; scene < part.scenes; scene++) {
            step++;
            if (part.own < 0 || step % every) {
                continue;
            }
            sample++;
            const double *line = part.scene(scene);
            const auto put = [&](std::vector<std::vector<double>> &columns, size_t actor) {
                columns[0].push_back(line[2 * actor]);
                columns[1].push_back(line[2 * actor + 1]);
                columns[2].push_back(line[2 * actors + actor]);
                columns[3].push_back(part.lengths[actor] / 2);
                columns[4].push_back(part.widths[actor] / 2);
            };
            put(own, row);
            steps[0].push_back(step);
            for (size_t actor = 0; actor < actors; actor++) {
                const double dx = line[2 * actor] - line[2 * row], dy = line[2 * actor + 1] - line[2 * row + 1];
                const double reach = within + 2 * (part.lengths[actor] / 2) + 2 * (part.lengths[row] / 2);
                if (actor != row && dx * dx + dy * dy < reach * reach) {
                    if (chosen) {
                        const size_t number = static_cast<size_t>(sample);
                        const double half = part.lengths[actor] / 2, wide = part.widths[actor] / 2;
                        double c, s;
                        sincos(line[2 * actors + actor], &s, &c);
                        const Way::Outline other = {line[2 * actor] - half * c, line[2 * actor + 1] - half * s, c, s,
                                                    half, wide, sqrt(half * half + wide * wide)};
                        if (!way.touches(number, way.spacing, ahead, other) &&
                            !way.touches(number, -way.spacing, behind, other)) {
                            continue;
                        }
                    }
                    put(others, actor);
                    pairs[0].push_back(sample);
                    pairs[1].push_back(part.numbers[actor]);
                }
            }
        }
    }
    return std::tuple(Bytes(bytes_of(own), bytes_of(steps)), Bytes(bytes_of(others), bytes_of(pairs)));
}
