"""Whether a log's stroke and joint angle agree with the pins of the rig file."""

from collections.abc import Iterator, Sequence

from ehbench.diagnosis.cases import Case
from ehbench.preprocessing.plausibility import off_pins
from ehbench.vocabulary import from_si, quantity

_KEYS = {
    "pins": ("phase", "retracted_length", "l_a", "l_b"),
    "rack": ("radius", "retracted_angle"),
}


def disagreements(cases: Sequence[Case]) -> Iterator[tuple[str, str, str, float]]:
    """(cylinder, sentence, remedy, error [m]) of each that disagrees, the worst log of each."""
    worst: dict[str, tuple[float, Case]] = {}
    for case in cases:
        for name, apart in off_pins(case.record, case.model).items():
            if name not in worst or abs(apart) > abs(worst[name][0]):
                worst[name] = (apart, case)
    for name, (off, case) in worst.items():
        rig = case.model.rig
        unit = rig.unit_of("x")
        shown = f"{from_si(abs(off), unit, quantity('x')):.3g} {unit}"
        by = rig.cylinder_named(name).linkage_word
        yield (
            name,
            f"{name}.x and {name}.q of {case.name} disagree with the {by} by {shown}",
            f"check the {by} of {name} ({', '.join(_KEYS[by])}) and the offset and sign "
            f"of {name}.x and {name}.q",
            off,
        )
