"""A rig, its linear models, its mechanism and its controllers for other programs and targets.

A format is a row of `FORMATS`: a function that writes an `Export` into a folder and says what it
wrote. Its name is one of `ehbench.config.recipe.export.Format`."""

from collections.abc import Mapping
from functools import partial

from ehbench.export.c_code import write_c
from ehbench.export.content import Export, Writer, Written
from ehbench.export.fmu import write_fmu
from ehbench.export.mechanism import mjcf, urdf
from ehbench.export.tables import write_matlab, write_mechanism

__all__ = ["FORMATS", "Export", "Writer", "Written"]
FORMATS: Mapping[str, Writer] = {
    "c": write_c,
    "fmu2": partial(write_fmu, version=2),
    "fmu3": partial(write_fmu, version=3),
    "matlab": write_matlab,
    "urdf": partial(write_mechanism, ending="urdf", text=urdf),
    "mjcf": partial(write_mechanism, ending="xml", text=mjcf),
}
