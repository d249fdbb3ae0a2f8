/* NAME as a functional mock-up unit for co-simulation, by the version FMI of the standard (2 or 3).
   A step is a whole number of ticks. A value reference is the number of a variable in NAME.h. */
#include "NAME.h"
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
enum { OK = 0, ERROR = 3 };
enum { TIME = UPPER_INPUTS + UPPER_OUTPUTS + UPPER_PARAMETERS };
/* what the standard has and this unit never does */
#define REFUSED(name) EXPORT int name(void) { return ERROR; }
#define IGNORED(name) EXPORT int name(void) { return OK; }

typedef struct { NAME part; double begin; } Unit;

static Unit *create(const char *token) {
  Unit *unit = token && strcmp(token, TOKEN) == 0 ? malloc(sizeof *unit) : NULL;
  if (unit) { NAME_init(&unit->part); unit->begin = 0.0; }
  return unit;
}

static int get(const Unit *unit, const uint32_t *which, size_t count, double *values) {
  for (size_t i = 0; i < count; i++) {
    if (which[i] > TIME) return ERROR;
    values[i] = which[i] == TIME ? unit->begin + unit->part.time : NAME_get(&unit->part, (int)which[i]);
  }
  return OK;
}

static int set(Unit *unit, const uint32_t *which, size_t count, const double *values) {
  for (size_t i = 0; i < count; i++)
    if (which[i] >= TIME || NAME_set(&unit->part, (int)which[i], values[i])) return ERROR;
  return OK;
}

static int steps(Unit *unit, double seconds) {
  const double ticks = seconds * UPPER_RATE, whole = floor(ticks + 0.5);
  if (!(whole >= 1.0 && fabs(ticks - whole) < 1e-6)) return ERROR;
  for (double i = 0.0; i < whole; i++) NAME_step(&unit->part);
  return OK;
}

static int save(const Unit *unit, void **state) {
  if (!*state) *state = malloc(sizeof *unit);
  if (!*state) return ERROR;
  memcpy(*state, unit, sizeof *unit);
  return OK;
}

#if FMI == 2
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *functions, int visible, int logging) {
  (void)name, (void)resources, (void)functions, (void)visible, (void)logging;
  return type == 1 ? create(token) : NULL;
}
EXPORT int fmi2SetupExperiment(Unit *unit, int tolerant, double tolerance, double begin, int ends, double end) {
  (void)tolerant, (void)tolerance, (void)ends, (void)end;
  unit->begin = begin;
  return OK;
}
EXPORT int fmi2DoStep(Unit *unit, double now, double length, int final) {
  (void)now, (void)final;
  return steps(unit, length);
}
EXPORT int fmi2GetReal(const Unit *unit, const uint32_t which[], size_t count, double values[]) {
  return get(unit, which, count, values);
}
EXPORT int fmi2SetReal(Unit *unit, const uint32_t which[], size_t count, const double values[]) {
  return set(unit, which, count, values);
}
#define STATE(name) fmi2##name##FMUstate
#define SERIALIZE fmi2SerializeFMUstate
#define DESERIALIZE fmi2DeSerializeFMUstate
EXPORT int fmi2SerializedFMUstateSize(Unit *unit, void *state, size_t *size) {
  (void)unit, (void)state, *size = sizeof *unit;
  return OK;
}
EXPORT void fmi2FreeInstance(Unit *unit) { free(unit); }
EXPORT int fmi2Reset(Unit *unit) { NAME_init(&unit->part); return OK; }
IGNORED(fmi2SetDebugLogging) IGNORED(fmi2EnterInitializationMode) IGNORED(fmi2ExitInitializationMode)
IGNORED(fmi2Terminate) REFUSED(fmi2CancelStep) REFUSED(fmi2GetDirectionalDerivative)
REFUSED(fmi2GetInteger) REFUSED(fmi2GetBoolean) REFUSED(fmi2GetString) REFUSED(fmi2SetInteger)
REFUSED(fmi2SetBoolean) REFUSED(fmi2SetString) REFUSED(fmi2SetRealInputDerivatives)
REFUSED(fmi2GetRealOutputDerivatives) REFUSED(fmi2GetStatus) REFUSED(fmi2GetRealStatus)
REFUSED(fmi2GetIntegerStatus) REFUSED(fmi2GetBooleanStatus) REFUSED(fmi2GetStringStatus)
#else
#define STATE(name) fmi3##name##FMUState
#define SERIALIZE fmi3SerializeFMUState
#define DESERIALIZE fmi3DeserializeFMUState
EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
EXPORT void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool events, bool early, const uint32_t wanted[], size_t count, void *environment,
    void *log, void *update) {
  (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
  (void)wanted, (void)count, (void)environment, (void)log, (void)update;
  return create(token);
}
EXPORT int fmi3EnterInitializationMode(Unit *unit, bool tolerant, double tolerance, double begin,
                                bool ends, double end) {
  (void)tolerant, (void)tolerance, (void)ends, (void)end;
  unit->begin = begin;
  return OK;
}
EXPORT int fmi3DoStep(Unit *unit, double now, double length, bool final, bool *event, bool *end,
               bool *early, double *last) {
  (void)now, (void)final;
  *event = *end = *early = false;
  const int status = steps(unit, length);
  *last = unit->begin + unit->part.time;
  return status;
}
EXPORT int fmi3GetFloat64(const Unit *unit, const uint32_t which[], size_t count, double values[],
                   size_t size) {
  return size == count ? get(unit, which, count, values) : ERROR;
}
EXPORT int fmi3SetFloat64(Unit *unit, const uint32_t which[], size_t count, const double values[],
                   size_t size) {
  return size == count ? set(unit, which, count, values) : ERROR;
}
EXPORT int fmi3SerializedFMUStateSize(Unit *unit, void *state, size_t *size) {
  (void)unit, (void)state, *size = sizeof *unit;
  return OK;
}
EXPORT void fmi3FreeInstance(Unit *unit) { free(unit); }
EXPORT int fmi3Reset(Unit *unit) { NAME_init(&unit->part); return OK; }
EXPORT void *fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution(void) { return NULL; }
IGNORED(fmi3SetDebugLogging) IGNORED(fmi3ExitInitializationMode) IGNORED(fmi3Terminate)
IGNORED(fmi3EnterConfigurationMode) IGNORED(fmi3ExitConfigurationMode)
#define KIND(kind) REFUSED(fmi3Get##kind) REFUSED(fmi3Set##kind)
KIND(Float32) KIND(Int8) KIND(UInt8) KIND(Int16) KIND(UInt16) KIND(Int32) KIND(UInt32) KIND(Int64)
KIND(UInt64) KIND(Boolean) KIND(String) KIND(Binary) KIND(Clock) KIND(IntervalDecimal)
KIND(IntervalFraction) KIND(ShiftDecimal) KIND(ShiftFraction)
REFUSED(fmi3GetNumberOfVariableDependencies) REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3GetDirectionalDerivative) REFUSED(fmi3GetAdjointDerivative) REFUSED(fmi3EnterEventMode)
REFUSED(fmi3EvaluateDiscreteStates) REFUSED(fmi3UpdateDiscreteStates) REFUSED(fmi3EnterStepMode)
REFUSED(fmi3EnterContinuousTimeMode) REFUSED(fmi3CompletedIntegratorStep) REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates) REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators) REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates) REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates) REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
#endif

EXPORT int STATE(Get)(const Unit *unit, void **state) { return save(unit, state); }
EXPORT int STATE(Set)(Unit *unit, const void *state) { memcpy(unit, state, sizeof *unit); return OK; }
EXPORT int STATE(Free)(Unit *unit, void **state) { (void)unit; free(*state); *state = NULL; return OK; }
EXPORT int SERIALIZE(Unit *unit, const void *state, unsigned char bytes[], size_t size) {
  if (size < sizeof *unit) return ERROR;
  memcpy(bytes, state, sizeof *unit);
  return OK;
}
EXPORT int DESERIALIZE(Unit *unit, const unsigned char bytes[], size_t size, void **state) {
  if (size != sizeof *unit) return ERROR;
  *state = NULL;
  const int status = save(unit, state);
  if (status == OK) memcpy(*state, bytes, size);
  return status;
}
