"""The driver of ``programs.py`` as an FMU for co-simulation by FMI 2 and by FMI 3, from C and a description by hand."""

from __future__ import annotations

import inspect
import re
import zipfile
from typing import TYPE_CHECKING

from programs import COMPILER, build

if TYPE_CHECKING:
    from pathlib import Path

# Variables by their value references: 0 to 55 are the observation, 100 the speed, 101 the harm, 102 the seed.
IN_C = r"""
#include <math.h>
#include <stdlib.h>
#include <stddef.h>
#include <unistd.h>

typedef struct { double v[128]; } instance;
typedef unsigned int reference;

static int step(instance *c) {
    double nearest = HUGE_VAL;
    int i;
    for (i = 7; i < 56; i += 7)
        if (c->v[i] && c->v[i + 1] > 0 && fabs(c->v[i + 2]) < 1.5) nearest = fmin(nearest, c->v[i + 1]);
    c->v[110] = nearest < 12.0 ? 0.0 : c->v[100];
    c->v[111] = 0;
    if (c->v[101] == 1) return 3;
    if (c->v[101] == 2) c->v[110] = NAN;
    if (c->v[101] == 3) *(volatile int *)8 = 1;
    if (c->v[101] == 4) usleep(60000);
    if (c->v[101] == 5) c->v[110] = 12.0 - ++c->v[112] / 8;
    return 0;
}

#ifdef FMI2
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) {
    return calloc(1, sizeof(instance));
}
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int d, double t, double s, int e, double f) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2SetReal(void *c, const reference *r, size_t n, const double *v) {
    while (n--) ((instance *)c)->v[r[n]] = v[n];
    return 0;
}
int fmi2SetInteger(void *c, const reference *r, size_t n, const int *v) {
    while (n--) ((instance *)c)->v[r[n]] = v[n];
    return 0;
}
int fmi2GetReal(void *c, const reference *r, size_t n, double *v) {
    while (n--) v[n] = ((instance *)c)->v[r[n]];
    return 0;
}
int fmi2GetInteger(void *c, const reference *r, size_t n, int *v) {
    while (n--) v[n] = (int)((instance *)c)->v[r[n]];
    return 0;
}
int fmi2DoStep(void *c, double t, double h, int n) { return step(c); }
#ifdef STATE
int fmi2GetFMUstate(void *c, void **s) { *s = malloc(sizeof(instance)); *(instance *)*s = *(instance *)c; return 0; }
int fmi2SetFMUstate(void *c, void *s) { *(instance *)c = *(instance *)s; return 0; }
int fmi2FreeFMUstate(void *c, void **s) { free(*s); *s = NULL; return 0; }
#endif
#else
#include <stdbool.h>
#include <stdint.h>
void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l, bool e, bool f,
                                  const reference *q, size_t k, void *x, void *m, void *u) {
    return calloc(1, sizeof(instance));
}
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool d, double t, double s, bool e, double f) { return 0; }
int fmi3ExitInitializationMode(void *c) { return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3SetFloat64(void *c, const reference *r, size_t n, const double *v, size_t k) {
    for (size_t i = 0; i < k; i++) ((instance *)c)->v[(k > n ? 0 : r[i]) + (k > n ? i : 0)] = v[i];
    return 0;
}
int fmi3SetInt32(void *c, const reference *r, size_t n, const int32_t *v, size_t k) {
    while (n--) ((instance *)c)->v[r[n]] = v[n];
    return 0;
}
int fmi3GetFloat64(void *c, const reference *r, size_t n, double *v, size_t k) {
    while (n--) v[n] = ((instance *)c)->v[r[n]];
    return 0;
}
int fmi3GetInt32(void *c, const reference *r, size_t n, int32_t *v, size_t k) {
    while (n--) v[n] = (int32_t)((instance *)c)->v[r[n]];
    return 0;
}
int fmi3DoStep(void *c, double t, double h, bool p, bool *e, bool *s, bool *a, double *l) {
    *e = *a = false;
    *s = ((instance *)c)->v[101] == 6;
    *l = t + h;
    return step(c);
}
#ifdef STATE
int fmi3GetFMUState(void *c, void **s) { *s = malloc(sizeof(instance)); *(instance *)*s = *(instance *)c; return 0; }
int fmi3SetFMUState(void *c, void *s) { *(instance *)c = *(instance *)s; return 0; }
int fmi3FreeFMUState(void *c, void **s) { free(*s); *s = NULL; return 0; }
#endif
#endif
"""

COLUMNS = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")


def described_by_fmi_2(place: str, speed: str) -> str:
    """Return a description with an input for each value, named by a template of row and column."""
    inputs = [
        (place.format(row=row, column=column), row * 7 + number)
        for row in range(1, 8)
        for number, column in enumerate(COLUMNS)
    ]
    variables = [
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="input">'
        '<Real start="0"/></ScalarVariable>'
        for name, reference in inputs
    ]
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="planner" guid="{{1}}">
<CoSimulation modelIdentifier="planner"/>
<UnitDefinitions><Unit name="m/s"/></UnitDefinitions>
<TypeDefinitions><SimpleType name="Lane"><Enumeration><Item name="stay" value="0"/></Enumeration></SimpleType>
</TypeDefinitions>
<ModelVariables>
{"".join(variables)}
<ScalarVariable name="speed" valueReference="100" causality="parameter" variability="fixed">
<Real start="12.0" min="8.0" max="20.0" unit="m/s"/></ScalarVariable>
<ScalarVariable name="harm" valueReference="101" causality="parameter" variability="fixed">
<Integer start="0"/></ScalarVariable>
<ScalarVariable name="seed" valueReference="102" causality="parameter" variability="fixed">
<Integer start="0"/></ScalarVariable>
<ScalarVariable name="{speed}" valueReference="110" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="lane_change" valueReference="111" causality="output" variability="discrete">
<Enumeration declaredType="Lane"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="{len(inputs) + 4}"/><Unknown index="{len(inputs) + 5}"/></Outputs>
</ModelStructure>
</fmiModelDescription>
"""


DESCRIBED_BY_FMI_3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="planner" instantiationToken="{1}">
<CoSimulation modelIdentifier="planner"/>
<UnitDefinitions><Unit name="m/s"/></UnitDefinitions>
<ModelVariables>
<Float64 name="time" valueReference="120" causality="independent" variability="continuous"/>
<Float64 name="kinematics" valueReference="0" causality="input" start="0">
<Dimension start="8"/><Dimension start="7"/></Float64>
<Float64 name="speed" valueReference="100" causality="parameter" variability="fixed" start="12.0" min="8.0" max="20.0"
 unit="m/s"/>
<Int32 name="harm" valueReference="101" causality="parameter" variability="fixed" start="0"/>
<Float64 name="target_speed" valueReference="110" causality="output"/>
<Int32 name="lane_change" valueReference="111" causality="output" variability="discrete"/>
</ModelVariables>
<ModelStructure><Output valueReference="110"/><Output valueReference="111"/></ModelStructure>
</fmiModelDescription>
"""


def build_fmu(
    folder: Path, version: int, *, place: str = "kinematics[{row}].{column}", speed: str = "target_speed",
    description: str = "", machine: str = "", has_state: bool = False,
) -> Path:  # fmt: skip
    """Compile the FMU into a folder, and return its path; it may offer its state (`fmi3GetFMUState`)."""
    import fmpy
    from fmpy import fmi2, fmi3

    slave = fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave
    # FMPy calls a few functions, and refuses an FMU that lacks another one.
    names = [name for name, _ in inspect.getmembers(slave) if name.startswith(f"fmi{version}")]
    offered = IN_C if has_state else re.sub("#ifdef STATE.*?#endif", "", IN_C, flags=re.DOTALL)
    others = "".join(f"int {name}(void) {{ return 3; }}\n" for name in names if f"{name}(" not in offered)
    source = folder / "planner.c"
    source.write_text(offered + others, encoding="utf-8")
    words = ["-shared", "-fPIC", "-o", "planner.so", "planner.c", "-lm"]
    build(source, [str(COMPILER), "-w", f"-DFMI{version}", "-DSTATE", *words])
    made = described_by_fmi_2(place, speed) if version == 2 else DESCRIBED_BY_FMI_3
    if has_state:
        attribute = "canGetAndSetFMUstate" if version == 2 else "canGetAndSetFMUState"
        made = made.replace('modelIdentifier="planner"', f'modelIdentifier="planner" {attribute}="true"')
    machine = machine or (fmpy.platform if version == 2 else fmpy.platform_tuple)
    with zipfile.ZipFile(folder / "planner.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", description or made)
        archive.write(folder / "planner.so", f"binaries/{machine}/planner.so")
    return folder / "planner.fmu"
