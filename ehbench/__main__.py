"""``python -m ehbench`` is the command ``ehbench``."""

from ehbench.cli import main

if __name__ == "__main__":
    main()
