// Which vehicles and objects touch, and what a collision does to them. A part of kernel.cpp.

#pragma once

#include "kernel_movement.hpp"

#include <limits>

namespace {

struct Point {
    double x, y;
};

const int CORNERS = 4;

// `RoadObject.polygon`: the corners of an outline; the first one is repeated at the end.
void outline(const Actor &actor, Point *corners) {
    const double length = actor.parameters.length / 2, width = actor.parameters.width / 2;
    const double points[CORNERS][2] = {{-length, -width}, {-length, width}, {length, width}, {length, -width}};
    for (int number = 0; number < CORNERS; number++) {
        const auto &[along, across] = points[number];
        corners[number] = {product(actor.cosine, -actor.sine, along, across) + actor.x,
                           product(actor.sine, actor.cosine, along, across) + actor.y};
    }
    corners[CORNERS] = corners[0];
}

struct Interval {
    double low, high;

    // Negative if the intervals overlap.
    double distance(const Interval &other) const { return low < other.low ? other.low - high : low - other.high; }
};

// `utils.project_polygon`
Interval project(const Point *corners, const Point &axis) {
    Interval found = {0, 0};
    for (int number = 0; number <= CORNERS; number++) {
        double place = dot(corners[number].x, corners[number].y, axis.x, axis.y);
        found.low = number == 0 || place < found.low ? place : found.low;
        found.high = number == 0 || place > found.high ? place : found.high;
    }
    return found;
}

// The centre of an outline, as NumPy's mean computes it.
Point centre(const Point *corners) {
    return {(corners[0].x + corners[1].x + corners[2].x + corners[3].x) / CORNERS,
            (corners[0].y + corners[1].y + corners[2].y + corners[3].y) / CORNERS};
}

struct Contact {
    bool is_known;                      // otherwise highway-env must decide, because a number is not finite
    bool intersects, will_intersect;    // now, and at the end of the sub-step
    Point transition;                   // how far the first actor must move, if they will intersect
};

// `utils.are_polygons_intersecting` for the outlines of two actors
Contact contact_of(const Actor &one, const Actor &two, double dt) {
    Point a[CORNERS + 1], b[CORNERS + 1];
    outline(one, a);
    outline(two, b);
    const double moved_x = one.speed.value * one.cosine * dt - two.speed.value * two.cosine * dt;
    const double moved_y = one.speed.value * one.sine * dt - two.speed.value * two.sine * dt;
    const Point from = centre(a), to = centre(b);
    Contact found = {true, true, true, {0, 0}};
    double least = std::numeric_limits<double>::infinity();
    Point direction = {NAN, NAN};
    for (const Point *corners : {a, b}) {
        for (int number = 0; number < CORNERS; number++) {
            const Point &first = corners[number], &second = corners[number + 1];
            Point normal = {-second.y + first.y, second.x - first.x};
            const double norm = std::sqrt(dot(normal.x, normal.y, normal.x, normal.y));
            normal = {normal.x / norm, normal.y / norm};
            if (!std::isfinite(normal.x) || !std::isfinite(normal.y)) { // an outline without length or width
                return {false, false, false, {0, 0}};
            }
            Interval here = project(a, normal), there = project(b, normal);
            found.intersects = found.intersects && !(here.distance(there) > 0);
            const double towards = dot(normal.x, normal.y, moved_x, moved_y);
            (towards < 0 ? here.low : here.high) += towards;
            const double distance = here.distance(there);
            found.will_intersect = found.will_intersect && !(distance > 0);
            if (!found.intersects && !found.will_intersect) {
                return found;
            }
            if (std::fabs(distance) < least) {
                least = std::fabs(distance);
                const bool is_away = dot(from.x - to.x, from.y - to.y, normal.x, normal.y) > 0;
                direction = is_away ? normal : Point{-normal.x, -normal.y};
            }
        }
    }
    found.transition = {least * direction.x, least * direction.y};
    found.is_known = std::isfinite(found.transition.x) && std::isfinite(found.transition.y);
    return found;
}

bool may_touch(const Actor &one, const Actor &two, double dt) {
    if (!(one.checks || two.checks) || !(one.collides && two.collides)) {
        return false;
    }
    const double dx = two.x - one.x, dy = two.y - one.y;
    return !(std::sqrt(dot(dx, dy, dx, dy)) > (one.radius + two.radius) + one.speed.value * dt);
}

void push(Actor &actor, double x, double y) {
    actor.impact_x = x;
    actor.impact_y = y;
    actor.has_impact = actor.new_impact = true;
}

// `RoadObject.handle_collisions` for two actors that touch, or will touch
void collide(Actor &one, Actor &two, const Contact &contact) {
    const auto &[x, y] = contact.transition;
    if (contact.will_intersect && one.is_solid && two.is_solid) {
        if (two.is_obstacle) {
            push(one, x, y);
        } else if (one.is_obstacle) {
            push(two, x, y);
        } else {
            push(one, x / 2, y / 2);
            push(two, -x / 2, -y / 2);
        }
    }
    if (contact.intersects) {
        if (one.is_solid && two.is_solid) {
            one.crashed = one.new_crash = two.crashed = two.new_crash = true;
        }
        one.new_hit = one.new_hit || !one.is_solid;
        two.new_hit = two.new_hit || !two.is_solid;
    }
}

// Lets highway-env check a pair. False: it has raised an error, or set something unusual.
bool handle_collision(Traffic *self, Actor &one, Actor &two, PyObject *dt) {
    for (Actor *actor : {&one, &two}) {
        if (!publish_contact(*actor) ||
            (actor->moves && (!publish_decision(self, *actor) || !publish_movement(self, *actor)))) {
            return false;
        }
    }
    const Ref done(PyObject_CallMethodObjArgs(one.object, s_handle_collisions, two.object, dt, nullptr));
    if (!done) {
        return false;
    }
    for (Actor *actor : {&one, &two}) {
        if (actor->moves && (!read_bool(actor->object, s_crashed, actor->crashed) || !read_impact(*actor))) {
            PyErr_SetString(PyExc_RuntimeError, "highway-env's handle_collisions set an unknown value");
            return false;
        }
    }
    return true;
}

// Finds the pairs that may touch, in the order in which highway-env checks them. Only pairs near each other along x are
// compared: the search sorts by x.
std::vector<std::pair<size_t, size_t>> find_pairs(Traffic *self, double dt) {
    const std::vector<Actor> &actors = self->actors;
    std::vector<std::pair<double, size_t>> sorted;
    double radius = 0, speed = 0;
    for (size_t row = 0; row < actors.size(); row++) {
        sorted.emplace_back(actors[row].x, row);
        radius = std::max(radius, actors[row].radius);
        speed = std::max(speed, std::fabs(actors[row].speed.value));
    }
    std::sort(sorted.begin(), sorted.end());
    const double reach = 2 * radius + speed * std::fabs(dt) + 1e-5;
    std::vector<std::pair<size_t, size_t>> pairs;
    for (size_t first = 0; first < sorted.size(); first++) {
        for (size_t second = first + 1; second < sorted.size(); second++) {
            if (sorted[second].first - sorted[first].first > reach) {
                break;
            }
            size_t row = std::min(sorted[first].second, sorted[second].second);
            size_t other = std::max(sorted[first].second, sorted[second].second);
            if (row < self->vehicles && may_touch(actors[row], actors[other], dt)) {
                pairs.emplace_back(row, other);
            }
        }
    }
    std::sort(pairs.begin(), pairs.end());
    return pairs;
}

// The part of `Road.step` after the movement. False: an error.
bool collide_all(Traffic *self, double dt, PyObject *as_object) {
    for (const auto &[row, other] : find_pairs(self, dt)) { // a collision changes no position and no speed
        Actor &one = self->actors[row], &two = self->actors[other];
        const Contact contact = contact_of(one, two, dt);
        if (contact.is_known) {
            collide(one, two, contact);
        } else if (!handle_collision(self, one, two, as_object)) {
            return false;
        }
    }
    return true;
}

} // namespace
