"""Studies: their samples, what keys mean, where samples run, what they say together."""
