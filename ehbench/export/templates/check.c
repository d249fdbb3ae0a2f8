/* Compares NAME on this machine with ehbench's numbers of a trial, and times its steps.
     cc -std=c11 -O2 -ffp-contract=off check.c NAME.c -lm && ./a.out
   Fails where a value differs by more than 1e-9 of its channel's largest in the trial. */
#include "NAME.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static double seconds(void) {
#ifdef TIME_UTC
  struct timespec now;
  if (timespec_get(&now, TIME_UTC) == TIME_UTC) return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
#endif
  return (double)clock() / CLOCKS_PER_SEC;
}

/* the numbers of the next line; 0 at the end of the file */
static int row_of(FILE *file, double *values, int count) {
  for (int i = 0; i < count; i++)
    if (fscanf(file, i ? ",%lf" : "%lf", values + i) != 1) return 0;
  return 1;
}

int main(int argc, char **argv) {
  static NAME self;
  enum { IN = UPPER_INPUTS, OUT = UPPER_OUTPUTS };
  static double row[IN + OUT], largest[OUT], apart[OUT];
  double longest = 0.0, sum = 0.0, worst = 0.0;
  long steps = 0, values = 0, differ = 0;
  int name;
  FILE *file = fopen(argc > 1 ? argv[1] : "check.csv", "r");
  if (!file) { fprintf(stderr, "no check.csv\n"); return 2; }
  while ((name = fgetc(file)) != '\n' && name != EOF) {}
  NAME_init(&self);
  while (row_of(file, row, IN + OUT)) {
    for (int i = 0; i < IN; i++) NAME_set(&self, i, row[i]);
    const double before = seconds();
    NAME_step(&self);
    const double step = seconds() - before;
    longest = fmax(longest, step), sum += step, steps++;
    for (int i = 0; i < OUT; i++) {
      const double value = NAME_get(&self, IN + i), expected = row[IN + i];
      values++;
      largest[i] = fmax(largest[i], fabs(expected));
      if (value == expected || (isnan(value) && isnan(expected))) continue;
      differ++;
      apart[i] = isnan(value - expected) ? INFINITY : fmax(apart[i], fabs(value - expected));
    }
  }
  fclose(file);
  for (int i = 0; i < OUT; i++)
    if (apart[i] > 0.0) worst = fmax(worst, apart[i] / largest[i]);
  printf("%ld of %ld differ", differ, values);
  if (differ) printf(", the largest relative error is %.3g", worst);
  printf("; a step took %.3g us, the longest %.3g us\n", 1e6 * sum / (double)steps, 1e6 * longest);
  return steps == 0 || worst > 1e-9;
}
