"""The driver of ``programs.py`` as a shared library in C and C++; the library also does harm when told."""

from __future__ import annotations

from typing import TYPE_CHECKING

from programs import COMPILER, COMPILER_CXX, HEADER, build

if TYPE_CHECKING:
    from pathlib import Path

# The arguments `harm` and `at` name the harm, and the step in which it is done.
IN_C = r"""
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#include "crashhunt_agent.h"

#ifdef NEEDED
extern double needed(void);
#else
static double needed(void) { return 0.0; }
#endif

#ifdef HARMLESS
CRASHHUNT_AGENT(CRASHHUNT_ARGUMENT("speed", "8.0:20.0", "m/s", 12.0))
#else
CRASHHUNT_AGENT(
    CRASHHUNT_ARGUMENT("speed", "8.0:20.0", "m/s", 12.0)
    CRASHHUNT_ARGUMENT("harm", "", "", "none")
    CRASHHUNT_ARGUMENT("at", "", "", 3))
#endif

struct driver {
    double speed, at;
    const char *harm;
    uint64_t seed;
    int64_t kinematics, present, x, y;
};

static const char *harm(const char *kind, double *action) {
    if (strcmp(kind, "fails") == 0) return "no path \xe2\x82\xac\n";
    if (strcmp(kind, "NaN") == 0) action[0] = NAN;
    if (strcmp(kind, "part") == 0) action[1] = 0.5;
    if (strcmp(kind, "shape") == 0) action[2] = 5.0;
    if (strcmp(kind, "SIGSEGV") == 0) *(volatile int *)8 = 1;
    if (strcmp(kind, "abort") == 0) { fprintf(stderr, "the plan is inconsistent\n"); abort(); }
    if (strcmp(kind, "exit") == 0) exit(0);
    if (strcmp(kind, "deadlock") == 0) for (;;) pause();
    if (strcmp(kind, "slow") == 0) usleep(60000);
    return NULL;
}

CRASHHUNT_EXPORT const char *crashhunt_create(const struct crashhunt_setup *setup, void **agent) {
    struct driver *made = (struct driver *)malloc(sizeof *made);
    const struct crashhunt_array *part;
    made->speed = crashhunt_number(setup, "speed", 0.0) + needed();
    made->at = crashhunt_number(setup, "at", 0.0);
    made->harm = crashhunt_text(setup, "harm", "");
    made->kinematics = crashhunt_part(setup, "kinematics");
    if (made->kinematics < 0) return "it needs the observation kinematics";
    if (strcmp(made->harm, "create") == 0) return "";
    part = &setup->parts[made->kinematics];
    made->present = crashhunt_column(part, "presence");
    made->x = crashhunt_column(part, "x");
    made->y = crashhunt_column(part, "y");
    *agent = made;
    return NULL;
}

CRASHHUNT_EXPORT const char *crashhunt_reset(void *agent, uint64_t seed) {
    struct driver *self = (struct driver *)agent;
    self->seed = seed;
    return strcmp(self->harm, "reset") == 0 ? "no map" : NULL;
}

CRASHHUNT_EXPORT const char *crashhunt_act(void *agent, const struct crashhunt_observation *seen, double *action) {
    struct driver *self = (struct driver *)agent;
    const struct crashhunt_array *part = &seen->parts[self->kinematics];
    double nearest = HUGE_VAL;
    int64_t i;
    int is_due;
    for (i = 1; i < part->shape[0]; i++) {  /* the first row is the vehicle itself */
        const double *row = part->values + i * part->shape[1];
        if (row[self->present] && row[self->x] > 0 && fabs(row[self->y]) < 1.5) nearest = fmin(nearest, row[self->x]);
    }
    is_due = seen->step == (int64_t)self->at;
    if (is_due && strcmp(self->harm, "unset") == 0) return NULL;
    action[0] = nearest < 12.0 ? 0.0 : self->speed;
    action[1] = 0.0;
    return is_due ? harm(self->harm, action) : NULL;
}

CRASHHUNT_EXPORT void crashhunt_destroy(void *agent) {
    free(agent);
}
"""


def compile_library(
    folder: Path, name: str = "libplanner.so", source: str = IN_C, words: tuple[str, ...] = (), *, in_cpp: bool = False
) -> Path:
    """Compile the library into a folder, and return its path."""
    file = folder / (f"{name}.cpp" if in_cpp else f"{name}.c")
    file.write_text(source, encoding="utf-8")
    compiler = [str(COMPILER_CXX), "-std=c++17"] if in_cpp else [str(COMPILER), "-std=c99"]
    command = [*compiler, "-D_GNU_SOURCE", "-g", "-O1", "-Wall", "-Werror", "-fvisibility=hidden"]
    command += ["-shared", "-fPIC", f"-I{HEADER.parent}", "-o", name, file.name, *words, "-lm"]
    return build(file, command)
