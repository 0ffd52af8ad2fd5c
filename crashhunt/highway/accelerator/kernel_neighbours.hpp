// Neighbours: the vehicles ahead and behind on a lane, as highway-env's `neighbour_vehicles` finds them. A part of kernel.cpp.

#pragma once

#include "kernel_actors.hpp"

#include <tuple>

namespace {

void coordinates(Traffic *self, size_t row, int lane, double &s, double &r) {
    size_t at = row * self->lanes + static_cast<size_t>(lane);
    if (self->stamps[at] != self->now) {
        const Actor &actor = self->actors[row];
        self->network->lane(lane).local_coordinates(actor.x, actor.y, self->along[at], self->across[at]);
        self->stamps[at] = self->now;
    }
    s = self->along[at];
    r = self->across[at];
}

double lane_distance(Traffic *self, size_t row, size_t other) {
    int lane = self->actors[row].lane;
    double s, other_s, r;
    coordinates(self, other, lane, other_s, r);
    coordinates(self, row, lane, s, r);
    return other_s - s;
}

// The actors that highway-env's `neighbour_vehicles` compares on a lane, in order. Positions stay while vehicles decide.
const std::vector<std::pair<double, size_t>> &queue_of(Traffic *self, int number) {
    Queue &queue = self->queues[static_cast<size_t>(number)];
    if (queue.instant == self->now) {
        return queue.places;
    }
    queue.instant = self->now;
    queue.places.clear();
    const Connections only = {{number, 0.0}};
    const auto &all = self->network->connected;
    const Connections &searched = all.empty() ? only : all[static_cast<size_t>(number)];
    for (size_t row = 0; row < self->actors.size(); row++) {
        if (self->actors[row].is_landmark) {
            continue;
        }
        for (const auto &[lane, offset] : searched) {
            double s, r;
            coordinates(self, row, lane, s, r);
            if (self->network->lane(lane).on_lane(s, r, 1)) {
                queue.places.emplace_back(s + offset, row);
                break; // the first lane of an actor decides
            }
        }
    }
    std::sort(queue.places.begin(), queue.places.end());
    return queue.places;
}

// Of several actors at the same place, highway-env finds the last one ahead and the first one behind.
void neighbour_vehicles(Traffic *self, size_t row, int number, size_t &front, size_t &rear) {
    front = rear = NO_ROW;
    double s, r;
    coordinates(self, row, number, s, r);
    if (std::isnan(s)) {
        return;
    }
    const auto &places = queue_of(self, number);
    const size_t first = static_cast<size_t>(
        std::lower_bound(places.begin(), places.end(), std::make_pair(s, size_t(0))) - places.begin());
    double found = s;
    for (size_t at = first; at < places.size() && (front == NO_ROW || places[at].first == found); at++) {
        if (places[at].second != row) {
            std::tie(found, front) = places[at];
        }
    }
    for (size_t at = first; at-- > 0 && (rear == NO_ROW || places[at].first == found);) {
        if (places[at].second != row) {
            std::tie(found, rear) = places[at];
        }
    }
}

} // namespace
