// libsumo's functions and SUMO's own, looked up by name in the library that is loaded. A part of core.cpp.

// libsumo::TraCIPosition: a result with virtual functions, and three numbers.
struct Result {
    virtual ~Result() {}
};
struct Position : Result {
    double x, y, z;
};
static_assert(sizeof(Position) == 32, "a pointer and three numbers");

typedef Position (*PositionOf)(const std::string &, bool);
typedef double (*NumberOf)(const std::string &);
typedef int (*WholeOf)(const std::string &);
typedef std::string (*NameOf)(const std::string &);
typedef double (*NumberAt)(const std::string &, double);
typedef void (*Command)(const std::string &, double);
typedef std::pair<std::string, double> (*NeighborOf)(const std::string &, double);
typedef double (*Number)();
typedef int (*Count)();
typedef std::vector<std::string> (*Names)();

// libsumo::TraCICollision: only whether there is one is asked, but who is given one has to do away with it.
struct Collision {
    std::string collider, victim, collider_type, victim_type;
    double collider_speed, victim_speed;
    std::string type, lane;
    double position;
};
typedef std::vector<Collision> (*Collisions)();

// A vehicle itself, of SUMO's class MSVehicle: looked up once instead of by name for each of its values.
struct Place { // SUMO's Position, which has a destructor, and so is returned by way of memory
    double x, y, z;
    ~Place() {}
};
typedef const void *(*VehicleOf)(const std::string &);
typedef bool (*TruthOf)(const void *);
typedef Place (*PlaceOf)(const void *, double);
typedef double (*ValueOf)(const void *);
typedef double (*Conversion)(double);
typedef const void *(*Singleton)();

struct Sumo {
    PositionOf position;
    NumberOf angle, speed;
    NumberOf driven, aside, aside_speed, along, decel, acceleration, min_gap, speed_limit, length, width;
    WholeOf lane_index, stop_state, signals, route_index;
    NameOf road, lane, route, light, kind;
    NumberAt lane_angle;
    NeighborOf follower, leader;
    Command set_speed;
    Number time;
    Count departed, arrived, vanishing, appearing, parking, unparking, on_foot, emergencies;
    Collisions collisions;
    Names everybody;
    VehicleOf vehicle;
    TruthOf is_visible;
    PlaceOf place;
    ValueOf turned, drives;
    Conversion degrees;
    Singleton net;
    const long long *made; // how many vehicles SUMO has made
    const char *vehicle_table; // that of the virtual functions of MSVehicle, and of nothing derived from it
    bool bound;
};
Sumo sumo = {};

#define STRING "RKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"

template <typename Function> bool find(void *library, const char *name, Function &function) {
    function = reinterpret_cast<Function>(dlsym(library, name));
    if (!function) {
        PyErr_Format(PyExc_OSError, "libsumo has no %s", name);
    }
    return function != nullptr;
}

void bind(PyObject *path) {
    Ref encoded;
    if (!PyUnicode_FSConverter(path, &encoded.object)) {
        throw Raised();
    }
    void *library = dlopen(PyBytes_AS_STRING(encoded.object), RTLD_LAZY | RTLD_NOLOAD);
    if (!library) {
        raise(PyExc_OSError, "libsumo is not loaded");
    }
    Sumo found = {};
    bool whole = find(library, "_ZN7libsumo7Vehicle11getPositionE" STRING "b", found.position) &&
                 find(library, "_ZN7libsumo7Vehicle8getAngleE" STRING, found.angle) &&
                 find(library, "_ZN7libsumo7Vehicle8getSpeedE" STRING, found.speed) &&
                 find(library, "_ZN7libsumo7Vehicle9getIDListB5cxx11Ev", found.everybody) &&
                 find(library, "_ZN7libsumo10Simulation17getDepartedNumberEv", found.departed) &&
                 find(library, "_ZN7libsumo10Simulation16getArrivedNumberEv", found.arrived) &&
                 find(library, "_ZN7libsumo10Simulation25getStartingTeleportNumberEv", found.vanishing) &&
                 find(library, "_ZN7libsumo10Simulation32getParkingStartingVehiclesNumberEv", found.parking) &&
                 find(library, "_ZN7libsumo10Simulation30getParkingEndingVehiclesNumberEv", found.unparking) &&
                 find(library, "_ZN7libsumo6Person10getIDCountEv", found.on_foot) &&
                 find(library, "_ZN7libsumo10Simulation13getCollisionsEv", found.collisions) &&
                 find(library, "_ZN7libsumo10Simulation23getEndingTeleportNumberEv", found.appearing) &&
                 find(library, "_ZN7libsumo10Simulation34getEmergencyStoppingVehiclesNumberEv", found.emergencies) &&
                 find(library, "_ZN7libsumo10Simulation7getTimeEv", found.time) &&
                 find(library, "_ZN7libsumo7Vehicle11getDistanceE" STRING, found.driven) &&
                 find(library, "_ZN7libsumo7Vehicle22getLateralLanePositionE" STRING, found.aside) &&
                 find(library, "_ZN7libsumo7Vehicle15getLateralSpeedE" STRING, found.aside_speed) &&
                 find(library, "_ZN7libsumo7Vehicle15getLanePositionE" STRING, found.along) &&
                 find(library, "_ZN7libsumo7Vehicle8getDecelE" STRING, found.decel) &&
                 find(library, "_ZN7libsumo7Vehicle15getAccelerationE" STRING, found.acceleration) &&
                 find(library, "_ZN7libsumo7Vehicle10getSignalsE" STRING, found.signals) &&
                 find(library, "_ZN7libsumo7Vehicle12getLaneIndexE" STRING, found.lane_index) &&
                 find(library, "_ZN7libsumo7Vehicle13getRouteIndexE" STRING, found.route_index) &&
                 find(library, "_ZN7libsumo7Vehicle10getRouteIDE" STRING, found.route) &&
                 find(library, "_ZN7libsumo7Vehicle12getStopStateE" STRING, found.stop_state) &&
                 find(library, "_ZN7libsumo7Vehicle15getVehicleClassE" STRING, found.kind) &&
                 find(library, "_ZN7libsumo7Vehicle9getLengthE" STRING, found.length) &&
                 find(library, "_ZN7libsumo7Vehicle8getWidthE" STRING, found.width) &&
                 find(library, "_ZN7libsumo7Vehicle9getRoadIDE" STRING, found.road) &&
                 find(library, "_ZN7libsumo7Vehicle9getLaneIDE" STRING, found.lane) &&
                 find(library, "_ZN7libsumo7Vehicle11getFollowerE" STRING "d", found.follower) &&
                 find(library, "_ZN7libsumo7Vehicle9getLeaderE" STRING "d", found.leader) &&
                 find(library, "_ZN7libsumo7Vehicle9getMinGapE" STRING, found.min_gap) &&
                 find(library, "_ZN7libsumo7Vehicle8setSpeedE" STRING "d", found.set_speed) &&
                 find(library, "_ZN7libsumo12TrafficLight22getRedYellowGreenStateE" STRING, found.light) &&
                 find(library, "_ZN7libsumo4Lane11getMaxSpeedE" STRING, found.speed_limit) &&
                 find(library, "_ZN7libsumo4Lane8getAngleE" STRING "d", found.lane_angle) &&
                 find(library, "_ZN7libsumo6Helper10getVehicleE" STRING, found.vehicle) &&
                 find(library, "_ZN7libsumo7Vehicle9isVisibleEPK11SUMOVehicle", found.is_visible) &&
                 find(library, "_ZNK9MSVehicle11getPositionEd", found.place) &&
                 find(library, "_ZNK9MSVehicle8getAngleEv", found.turned) &&
                 find(library, "_ZNK9MSVehicle8getSpeedEv", found.drives) &&
                 find(library, "_ZN10GeomHelper10naviDegreeEd", found.degrees) &&
                 find(library, "_ZN5MSNet11getInstanceEv", found.net) &&
                 find(library, "_ZN13MSBaseVehicle23myCurrentNumericalIndexE", found.made) &&
                 find(library, "_ZTV9MSVehicle", found.vehicle_table);
    dlclose(library); // Python keeps it loaded
    if (!whole) {
        throw Raised();
    }
    found.bound = true;
    sumo = found;
}

void require_bound() {
    if (!sumo.bound) {
        raise(PyExc_RuntimeError, "bind has not been called");
    }
}

bool coming_or_going() {
    return sumo.departed() || sumo.arrived() || sumo.vanishing() || sumo.appearing() || sumo.parking() ||
           sumo.unparking();
}

bool is_coming_or_going() {
    require_bound();
    return coming_or_going();
}
