/* The C interface of crashhunt's agents, version 1. For C99 and C++11 or later. You may copy this file.

   A shared library that defines the four functions below and one CRASHHUNT_AGENT(...) drives a vehicle:

       crashhunt run --scenario SCENARIO --agent lib:./libplanner.so

   crashhunt loads the library into the process of each trial. Per vehicle and trial, it calls `crashhunt_create` and
   `crashhunt_reset` once, `crashhunt_act` in each step and `crashhunt_destroy` at the end, always in the same thread.
   Three of the functions return NULL, or the reason of a failure as UTF-8 text. The text must remain valid until the
   next call. A failure ends the trial with the outcome agent_error. No C++ exception may leave these functions.

   What crashhunt passes by pointer belongs to crashhunt. The setup is valid until `crashhunt_destroy` returns. An
   observation and an action are valid during the call only. */

#ifndef CRASHHUNT_AGENT_H
#define CRASHHUNT_AGENT_H

#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
#define CRASHHUNT_EXPORT extern "C" __attribute__((visibility("default")))
#else
#define CRASHHUNT_EXPORT extern __attribute__((visibility("default")))
#endif

/* The version of this interface. */
#ifndef CRASHHUNT_PROTOCOL
#define CRASHHUNT_PROTOCOL "1"
#endif

/* An argument of the agent, such as one from --arg speed=12. */
struct crashhunt_argument {
    const char *name;
    const char *text; /* NULL for a number */
    double number;    /* true is 1, and false is 0; NaN for a text */
};

/* An array of numbers in C order: a part of an observation, or the description of an action. */
struct crashhunt_array {
    const char *name;           /* such as "kinematics"; in nested observations such as "camera/image" */
    int64_t dimensions;         /* 0 for a single number */
    const int64_t *shape;       /* the length of each dimension */
    int64_t size;               /* the number of values */
    int64_t column_count;       /* 0 if the columns have no names, otherwise the length of the last dimension */
    const char *const *columns; /* the names of the columns */
    const double *values;       /* the values; NULL for bytes, for an action, and in crashhunt_create */
    const uint8_t *bytes;       /* the values of images and grids; NULL for all others */
};

/* The facts about a vehicle that do not change during a trial. */
struct crashhunt_setup {
    const char *agent;    /* identifier of the vehicle */
    double step_length_s; /* time from one step to the next, in s */
    int64_t argument_count;
    const struct crashhunt_argument *arguments;
    int64_t part_count;
    const struct crashhunt_array *parts;   /* the parts of an observation */
    const struct crashhunt_array *action;  /* the names and the number of the values of an action */
    const char *map;      /* path of the road map as JSON; NULL without CRASHHUNT_MAP, or if the simulator has no map */
};

/* The observation of a step. */
struct crashhunt_observation {
    int64_t step;  /* 0 in the first step */
    double time_s; /* simulated time since the first step, in s */
    int64_t part_count;
    const struct crashhunt_array *parts; /* in the order of the setup */
};

/* Store a new agent in *agent: any pointer, which the other functions receive. */
CRASHHUNT_EXPORT const char *crashhunt_create(const struct crashhunt_setup *setup, void **agent);

/* Begin an episode. An agent that draws random numbers draws them from this seed only. */
CRASHHUNT_EXPORT const char *crashhunt_reset(void *agent, uint64_t seed);

/* Write all values of the action: setup->action->size numbers. crashhunt refuses NaN and values out of range. */
CRASHHUNT_EXPORT const char *crashhunt_act(void *agent, const struct crashhunt_observation *observation,
                                           double *action);

/* Release the agent. */
CRASHHUNT_EXPORT void crashhunt_destroy(void *agent);

/* Declares the version of this interface and the arguments of the agent. Write it once, outside of functions:

       CRASHHUNT_AGENT(CRASHHUNT_ARGUMENT("speed", "5.0:25.0", "m/s", 12.0) CRASHHUNT_ARGUMENT("mode", "a|b", "", "a"))

   A hunt varies the arguments within their ranges. CRASHHUNT_AGENT() declares none, and accepts any argument. It may
   also contain CRASHHUNT_OBSERVES, CRASHHUNT_ACTS and CRASHHUNT_MAP. */
#define CRASHHUNT_AGENT(...)                       \
    CRASHHUNT_EXPORT const char crashhunt_agent[]; \
    const char crashhunt_agent[] = "{\"protocol\": " CRASHHUNT_PROTOCOL ", \"arguments\": {" __VA_ARGS__ "\"\": null}}";

/* An argument: its name, its range as in --arg ("" for a fixed value), its unit, and its default, a number or a text. */
#define CRASHHUNT_ARGUMENT(name, range, unit, otherwise) \
    "\"" name "\": {\"range\": \"" range "\", \"unit\": \"" unit "\", \"default\": " #otherwise "}, "

/* The parts that the agent observes, such as "ego,actors:rows=8", and the form of its actions, such as "acceleration":
   see crashhunt list observations and crashhunt list actions. --observe, --action and the scenario take precedence. */
#define CRASHHUNT_OBSERVES(parts) "\"<observation>\": \"" parts "\", "
#define CRASHHUNT_ACTS(form) "\"<action>\": \"" form "\", "

/* Have crashhunt write the road map and the data of the vehicle to the file that setup->map names. */
#define CRASHHUNT_MAP "\"<map>\": true, "

/* Return the value of a numeric argument. */
static inline double crashhunt_number(const struct crashhunt_setup *setup, const char *name, double otherwise) {
    int64_t i;
    for (i = 0; i < setup->argument_count; i++)
        if (!setup->arguments[i].text && strcmp(setup->arguments[i].name, name) == 0) return setup->arguments[i].number;
    return otherwise;
}

/* Return the value of an argument that is a text. */
static inline const char *crashhunt_text(const struct crashhunt_setup *setup, const char *name, const char *otherwise) {
    int64_t i;
    for (i = 0; i < setup->argument_count; i++)
        if (setup->arguments[i].text && strcmp(setup->arguments[i].name, name) == 0) return setup->arguments[i].text;
    return otherwise;
}

/* Return the index of a part of observations, or -1. */
static inline int64_t crashhunt_part(const struct crashhunt_setup *setup, const char *name) {
    int64_t i;
    for (i = 0; i < setup->part_count; i++)
        if (strcmp(setup->parts[i].name, name) == 0) return i;
    return -1;
}

/* Return the index of a column, or -1. */
static inline int64_t crashhunt_column(const struct crashhunt_array *array, const char *name) {
    int64_t i;
    for (i = 0; i < array->column_count; i++)
        if (strcmp(array->columns[i], name) == 0) return i;
    return -1;
}

#endif
