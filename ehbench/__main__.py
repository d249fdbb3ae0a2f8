"""``python -m ehbench`` is the command ``ehbench``."""

from ehbench.cli import main

main()
