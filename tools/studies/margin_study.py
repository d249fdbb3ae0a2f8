"""Margins of random stable loops against brute force: dense sweeps, and poles made to cross.

python -m tools.studies.margin_study 1000"""

import sys

from tests.unit.test_stability import late_differences, rig_differences


def main() -> None:
    count = (int(sys.argv[1]) if len(sys.argv) > 1 else 1000) // 2
    for kind, differences in (("late", late_differences), ("of rigs", rig_differences)):
        off = differences(count)
        print(f"{len(off)} of {count} loops {kind} differ", *off, sep="\n", flush=True)


if __name__ == "__main__":
    main()
