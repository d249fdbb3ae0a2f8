"""``python -m ehbench`` is the command ``ehbench``."""

from ehbench.app.cli import main

if __name__ == "__main__":
    main()
