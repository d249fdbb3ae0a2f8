"""Set before numpy is loaded: one BLAS thread, as the package's own runs have."""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("MPLBACKEND", "agg")
