"""Import the package first: it fixes the number of BLAS threads before numpy is loaded."""

import ehbench  # noqa: F401
