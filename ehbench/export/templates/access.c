double NAME_get(const NAME *self, int variable) {
  if (variable < 0 || variable >= (int)(sizeof first / sizeof *first) - 1) return NAN;
  double value;
  memcpy(&value, (const char *)self + place[first[variable]], sizeof value);
  return value;
}

int NAME_set(NAME *self, int variable, double value) {
  const int count = (int)(sizeof first / sizeof *first) - 1;
  if (variable < 0 || variable >= count) return 1;
  if (variable >= UPPER_INPUTS && variable < UPPER_INPUTS + UPPER_OUTPUTS) return 1;
  if (!isfinite(value) || value < bounds[variable][0] || value > bounds[variable][1]) return 2;
  for (int i = first[variable]; i < first[variable + 1]; i++)
    memcpy((char *)self + place[i], &value, sizeof value);
  return 0;
}
