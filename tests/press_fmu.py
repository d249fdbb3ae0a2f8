"""A press as an FMU 2.0, from C that shares nothing with the package, and the same by SciPy."""

import math
import shutil
import subprocess
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from scipy.integrate import solve_ivp

GAIN, SUPPLY, TANK = 4.0e-8, 14e6, 2e5  # m³/(s·V·√Pa), Pa
BORE, ROD, MASS = 0.05, 0.028, 250.0
A1, A2 = 0.25 * math.pi * BORE**2, 0.25 * math.pi * (BORE**2 - ROD**2)
V1, V2 = 150e-6, 700e-6
VARIABLES = {  # value reference by name: parameters, first values, command, outputs
    **{"beta": 0, "drag": 1, "x0": 2, "pA0": 3, "pB0": 4},
    **{"u": 5, "x": 6, "v": 7, "pA": 8, "pB": 9},
}
SOURCE = (
    r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>
typedef struct { double r[10]; } M;
static double root(double d) { return d < 0 ? -sqrt(-d) : sqrt(d); }
static void rates(const M *m, const double *y, double *f) {
  const double *r = m->r, u = r[5], ps = 14e6, pt = 2e5, g = 4e-8;
  const double A1 = AREA1, A2 = AREA2;
  double q1 = u > 0 ? g * u * root(ps - y[2]) : g * u * root(y[2] - pt);
  double q2 = u > 0 ? -g * u * root(y[3] - pt) : -g * u * root(ps - y[3]);
  f[0] = y[1];
  f[1] = (A1 * y[2] - A2 * y[3] - r[1] * y[1]) / 250.0;
  f[2] = r[0] / (150e-6 + A1 * y[0]) * (q1 - A1 * y[1]);
  f[3] = r[0] / (700e-6 - A2 * y[0]) * (q2 + A2 * y[1]);
}
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *c, int v,
                      int l) { M *m = calloc(1, sizeof *m); m->r[0] = 9e8; m->r[1] = 800;
                               m->r[2] = 0.1; m->r[3] = 70; m->r[4] = 102; return m; }
void fmi2FreeInstance(void *m) { free(m); }
int fmi2SetupExperiment(void *m, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(void *m) { return 0; }
int fmi2ExitInitializationMode(void *p) { M *m = p; double *r = m->r;
  r[6] = r[2]; r[7] = 0; r[8] = r[3]; r[9] = r[4]; return 0; }
int fmi2Terminate(void *m) { return 0; }
int fmi2SetReal(void *m, const unsigned *k, size_t n, const double *v) {
  for (size_t i = 0; i < n; i++) ((M *)m)->r[k[i]] = v[i]; return 0; }
int fmi2GetReal(void *m, const unsigned *k, size_t n, double *v) {
  for (size_t i = 0; i < n; i++) v[i] = ((M *)m)->r[k[i]]; return 0; }
int fmi2DoStep(void *p, double t, double h, int s) {
  M *m = p; double *r = m->r, y[4] = {r[6], r[7], r[8] * 1e5, r[9] * 1e5};
#ifdef CRASH
  abort();
#endif
#ifdef HANG
  for (volatile int i = 0;; i++) ;
#endif
#ifdef REFUSE
  return 3;
#endif
  int n = (int)ceil(h / 1e-4 - 1e-9); double d = h / n, k[4][4], z[4];
  for (int j = 0; j < n; j++) {
    rates(m, y, k[0]);
    for (int i = 0; i < 4; i++) z[i] = y[i] + d / 2 * k[0][i];
    rates(m, z, k[1]);
    for (int i = 0; i < 4; i++) z[i] = y[i] + d / 2 * k[1][i];
    rates(m, z, k[2]);
    for (int i = 0; i < 4; i++) z[i] = y[i] + d * k[2][i];
    rates(m, z, k[3]);
    for (int i = 0; i < 4; i++) y[i] += d / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
  }
  r[6] = y[0]; r[7] = y[1]; r[8] = y[2] / 1e5; r[9] = y[3] / 1e5;
#ifdef NANS
  if (t > 0.05) r[8] = nan("");
#endif
  return 0;
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
""".replace("AREA1", repr(A1)).replace("AREA2", repr(A2))
    + "".join(
        f"int fmi2{name}(void) {{ return 3; }}\n"
        for name in """SetDebugLogging Reset GetInteger GetBoolean GetString SetInteger SetBoolean
    SetString GetFMUstate SetFMUstate FreeFMUstate SerializedFMUstateSize SerializeFMUstate
    DeSerializeFMUstate GetDirectionalDerivative SetRealInputDerivatives GetRealOutputDerivatives
    CancelStep GetStatus GetRealStatus GetIntegerStatus GetBooleanStatus GetStringStatus""".split()
    )
)
UNITS = {"beta": "Pa", "drag": "N.s/m", "x0": "m", "x": "m", "v": "m/s", "u": "V"}


def press_fmu(path: Path, fault: str = "", platform: str = "linux64") -> Path:
    """The FMU, its pressures in bar; ``fault`` is CRASH, HANG, REFUSE or NANS.

    Skips where there is no C compiler."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to build an FMU with")
    rows = []
    for name, reference in VARIABLES.items():
        kind = "input" if name == "u" else "output" if reference > 5 else "parameter"
        initial = {"input": "", "output": 'initial="exact"'}.get(kind, 'variability="fixed"')
        unit = UNITS.get(name, "bar")
        start = "" if kind == "output" and initial == "" else ' start="0"'
        rows.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{kind}" '
            f'{initial}><Real unit="{unit}"{start}/></ScalarVariable>'
        )
    bar = '<Unit name="bar"><BaseUnit kg="1" m="-1" s="-2" factor="1e5"/></Unit>'
    xml = (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="press" guid="press">'
        '<CoSimulation modelIdentifier="press" canHandleVariableCommunicationStepSize="true"/>'
        f"<UnitDefinitions>{bar}</UnitDefinitions><ModelVariables>{''.join(rows)}</ModelVariables>"
        "<ModelStructure/></fmiModelDescription>"
    )
    source, library = path.with_suffix(".c"), path.with_suffix(".so")
    source.write_text(SOURCE)
    flags = ["-O2", "-shared", "-fPIC", "-w", *([f"-D{fault}"] if fault else [])]
    subprocess.run(["gcc", *flags, str(source), "-o", str(library), "-lm"], check=True)
    with ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.write(library, f"binaries/{platform}/press{'.so' if 'lin' in platform else '.dll'}")
    return path


def press(t: np.ndarray, u: np.ndarray, beta: float, drag: float, y0: np.ndarray) -> np.ndarray:
    """States x [m], v [m/s], p_head, p_rod [Pa]: each command acts from its sample on."""

    def root(d: float) -> float:
        return math.copysign(math.sqrt(abs(d)), d)

    def rates(_: float, y: np.ndarray, volts: float) -> list[float]:
        x, v, pa, pb = y
        if volts > 0:
            q1, q2 = GAIN * volts * root(SUPPLY - pa), -GAIN * volts * root(pb - TANK)
        else:
            q1, q2 = GAIN * volts * root(pa - TANK), -GAIN * volts * root(SUPPLY - pb)
        return [
            v,
            (A1 * pa - A2 * pb - drag * v) / MASS,
            beta / (V1 + A1 * x) * (q1 - A1 * v),
            beta / (V2 - A2 * x) * (q2 + A2 * v),
        ]

    rows, y, first = [], np.asarray(y0, dtype=float), 0
    for last in [*(np.flatnonzero(np.diff(u)) + 1), len(t) - 1]:
        span = t[first : last + 1]
        done = solve_ivp(
            rates, (span[0], span[-1]), y, "Radau", span, args=(u[first],), rtol=1e-8, atol=1e-8
        )
        rows.append(done.y.T[:-1])
        y, first = done.y[:, -1], last
    return np.vstack([*rows, y])
