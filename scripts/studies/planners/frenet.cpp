// frenet.cpp: the planner of erdos-project, as a library for crashhunt
#include "crashhunt_agent.h"
#include "FrenetOptimalTrajectory.h"

CRASHHUNT_AGENT(
    CRASHHUNT_OBSERVES("ego,actors:rows=8,route") CRASHHUNT_ACTS("target_pose")
    CRASHHUNT_ARGUMENT("target_speed", "6.0:14.0", "m/s", 10.0) CRASHHUNT_ARGUMENT("clearance", "0.2:1.5", "m", 0.5))

extern "C" {
void run_fot(FrenetInitialConditions*, FrenetHyperparameters*, FrenetReturnValues*);
void to_frenet_initial_conditions(double, double, double, double, double, double, double*, double*, int, double*);
}

namespace {
struct Planner {
    double target_speed, clearance;
    int64_t ego, actors, route;
    int64_t columns[3][6];
};
const char* const names[3][6] = {{"x", "y", "heading", "speed", "length", "width"},
                                 {"x", "y", "heading", "length", "width", "present"},
                                 {"x", "y", "heading", "present", "present", "present"}};
const double time_s = 0.4;  // of the pose on the path
}  // namespace

const char* crashhunt_create(const crashhunt_setup* setup, void** agent) {
    auto* made = new Planner{crashhunt_number(setup, "target_speed", 10), crashhunt_number(setup, "clearance", 0.5),
                             crashhunt_part(setup, "ego"), crashhunt_part(setup, "actors"),
                             crashhunt_part(setup, "route"), {}};
    const int64_t parts[] = {made->ego, made->actors, made->route};
    for (int part = 0; part < 3; part++)
        for (int column = 0; column < 6; column++)
            made->columns[part][column] = crashhunt_column(&setup->parts[parts[part]], names[part][column]);
    *agent = made;
    return nullptr;
}

const char* crashhunt_reset(void*, uint64_t) { return nullptr; }

const char* crashhunt_act(void* agent, const crashhunt_observation* seen, double* action) {
    auto& self = *static_cast<Planner*>(agent);
    const auto value = [&](int part, const crashhunt_array& array, int64_t row, int column) {
        return array.values[row * (part ? array.shape[1] : 0) + self.columns[part][column]];
    };
    const auto &ego = seen->parts[self.ego], &actors = seen->parts[self.actors], &route = seen->parts[self.route];
    const double x = value(0, ego, 0, 0), y = value(0, ego, 0, 1), yaw = value(0, ego, 0, 2), v = value(0, ego, 0, 3);
    vector<double> wx, wy, llx, lly, urx, ury;
    for (int64_t row = 0; row < route.shape[0] && value(2, route, row, 3); row += 2) {
        const double px = value(2, route, row, 0), py = value(2, route, row, 1), heading = value(2, route, row, 2);
        if (!row)  // a point behind the vehicle
            wx.push_back(px - 8 * cos(heading)), wy.push_back(py - 8 * sin(heading));
        wx.push_back(px), wy.push_back(py);
    }
    for (int64_t row = 0; row < actors.shape[0] && value(1, actors, row, 5); row++) {
        const double c = fabs(cos(value(1, actors, row, 2))), s = fabs(sin(value(1, actors, row, 2)));
        const double length = value(1, actors, row, 3), width = value(1, actors, row, 4);
        const double dx = (length * c + width * s) / 2, dy = (length * s + width * c) / 2;
        llx.push_back(value(1, actors, row, 0) - dx), urx.push_back(value(1, actors, row, 0) + dx);
        lly.push_back(value(1, actors, row, 1) - dy), ury.push_back(value(1, actors, row, 1) + dy);
    }
    action[0] = x + cos(yaw) * max(0.0, v * time_s - 3 * time_s * time_s);  // without a path: brake
    action[1] = y + sin(yaw) * max(0.0, v * time_s - 3 * time_s * time_s);
    action[2] = yaw, action[3] = time_s;
    if (wx.size() < 4) return nullptr;
    double start[5];
    to_frenet_initial_conditions(8, x, y, v * cos(yaw), v * sin(yaw), v, wx.data(), wy.data(), int(wx.size()), start);
    FrenetInitialConditions conditions{start[0], start[1], start[2], start[3], start[4], self.target_speed, wx.data(),
                                       wy.data(), int(wx.size()), llx.data(), lly.data(), urx.data(), ury.data(),
                                       int(llx.size())};
    FrenetHyperparameters parameters{25, 8, 1, 2, 2, 0.5, 0.2, 5, 2, 0.5, 2, self.clearance,
                                     1, 0.1, 0.1, 0.1, 0.1, 0.1, 1, 1, 0};
    FrenetReturnValues path{};
    run_fot(&conditions, &parameters, &path);
    if (!path.success || path.path_length < 3) return nullptr;
    action[0] = path.x_path[2], action[1] = path.y_path[2];
    action[2] = atan2(path.y_path[2] - path.y_path[1], path.x_path[2] - path.x_path[1]);
    return nullptr;
}

void crashhunt_destroy(void* agent) { delete static_cast<Planner*>(agent); }
