// Lanes, and the network that they form. A part of kernel.cpp.

#pragma once

#include "kernel_numbers.hpp"

#include <utility>
#include <vector>

namespace {

enum { STRAIGHT, SINE, CIRCULAR };

// A row of the table that `_network._table` makes, in its order.
struct LaneRow {
    double kind, x, y, along_x, along_y, across_x, across_y, length, width, heading, limit, forbidden;
    double amplitude, pulsation, phase, radius, start_phase, direction, left, right, road;
};

struct Lane {
    int kind;
    double x, y;               // start, or centre of a circle
    double along_x, along_y;   // direction
    double across_x, across_y; // direction_lateral
    double length, width, heading;
    double limit; // of speeds, in m/s; NaN for none
    bool forbidden;
    double amplitude, pulsation, phase;     // of a sine
    double radius, start_phase, direction; // of a circle
    int left, right;                       // the neighbouring lanes of the same road; -1 for none
    int road;                              // the same for all lanes between two nodes
    int id;                                // the last part of the key

    Lane(const LaneRow &row, int number_on_road)
        : kind(static_cast<int>(row.kind)), x(row.x), y(row.y), along_x(row.along_x), along_y(row.along_y),
          across_x(row.across_x), across_y(row.across_y), length(row.length), width(row.width), heading(row.heading),
          limit(row.limit), forbidden(row.forbidden != 0), amplitude(row.amplitude), pulsation(row.pulsation),
          phase(row.phase), radius(row.radius), start_phase(row.start_phase), direction(row.direction),
          left(static_cast<int>(row.left)), right(static_cast<int>(row.right)), road(static_cast<int>(row.road)),
          id(number_on_road) {}

    void local_coordinates(double px, double py, double &s, double &r) const {
        double dx = px - x, dy = py - y;
        if (kind == CIRCULAR) {
            double phi = start_phase + wrap_to_pi(call(ARCTAN2, dy, dx) - start_phase);
            double distance = std::sqrt(dot(dx, dy, dx, dy));
            s = direction * (phi - start_phase) * radius;
            r = direction * (radius - distance);
            return;
        }
        s = dot(dx, dy, along_x, along_y);
        r = dot(dx, dy, across_x, across_y);
        if (kind == SINE) {
            r = r - amplitude * call(SIN, pulsation * s + phase);
        }
    }

    // The position of a point on the centre line; the last bits may differ from highway-env's.
    void position(double s, double &px, double &py) const {
        if (kind == CIRCULAR) {
            double phi = direction * s / radius + start_phase;
            px = x + radius * call(COS, phi);
            py = y + radius * call(SIN, phi);
            return;
        }
        double swing = kind == SINE ? amplitude * call(SIN, pulsation * s + phase) : 0;
        px = x + s * along_x + swing * across_x;
        py = y + s * along_y + swing * across_y;
    }

    double heading_at(double s) const {
        if (kind == STRAIGHT) {
            return heading;
        }
        if (kind == SINE) {
            return heading + call(ARCTAN, amplitude * pulsation * call(COS, pulsation * s + phase));
        }
        return (direction * s / radius + start_phase) + PI / 2 * direction;
    }

    bool on_lane(double s, double r, double margin) const {
        return std::fabs(r) <= width / 2 + margin && -5 <= s && s < length + 5;
    }

    bool is_reachable_from(double s, double r) const {
        return !forbidden && std::fabs(r) <= 2 * width && 0 <= s && s < length + 5;
    }
};

typedef std::vector<std::pair<int, double>> Connections; // lanes, each with the offset of its coordinates in m

struct Network {
    std::vector<Lane> lanes;
    std::vector<Connections> connected; // by lane; empty if the road does not search connected lanes
    Ref keys;    // the list of keys
    Ref objects; // the list of highway-env's lanes
    Ref index;   // from a key to the number of its lane

    const Lane &lane(int number) const { return lanes[static_cast<size_t>(number)]; }
};
struct NetworkObject {
    PyObject_HEAD Network *network;
};
PyTypeObject *network_type = nullptr;

} // namespace
