"""Studies: which samples there are, what their keys mean, where they run, how their results are
stored, and what these say together."""
