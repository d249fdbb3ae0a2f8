"""The parts of a plant, a file each: the columns of their records, their kernels, what they are
packed from.

A part's numbers are one row of a table (`ehbench.runtime.compiled.table`), read by the names of its
fields in kernels and in Python. A law that comes in several kinds (friction, metering edge, valve
element) is a package: a file a law, and a tuple of them in its ``__init__``."""
