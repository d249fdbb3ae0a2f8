"""Functional mock-up units for co-simulation: the C of a part with its source, a description of its
variables, and a binary for each target that a compiler is there for."""

import hashlib
import math
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID
from xml.etree import ElementTree
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from ehbench.export.c_code import checked
from ehbench.export.compiler import HERE, TARGETS, build, compiler
from ehbench.export.component import Component
from ehbench.export.content import Export, Written
from ehbench.export.kernels import Kernels
from ehbench.export.source import template, write_sources
from ehbench.runtime.disk import replacing, write_text
from ehbench.vocabulary import message
from ehbench.vocabulary.units import exponents

SOURCES = ("fmi.c", "{name}.c")


def write_fmu(export: Export, folder: Path, version: int) -> list[Written]:
    """Write each part as FMU of a version of the standard into ``fmu<version>``."""
    targets = export.recipe.targets or ((HERE,) if compiler() else ())
    folder, written = folder / f"fmu{version}", []
    folder.mkdir()
    for part, kernel in zip(export.components, export.kernels, strict=True):
        with TemporaryDirectory() as scratch:
            place = Path(scratch)
            check = _content(part, kernel, version, targets, place)
            files = sorted(path for path in place.rglob("*") if path.is_file())
            with replacing(folder / f"{part.name}.fmu") as path, ZipFile(path, "w") as unit:
                for file in files:
                    about = ZipInfo(file.relative_to(place).as_posix())  # of 1980: the same bytes
                    unit.writestr(about, file.read_bytes(), ZIP_DEFLATED)
        note = "" if targets else message("export.source_only", name=part.name)
        about = f"{part.about}; " + (", ".join(targets) or message("export.no_binary"))
        written.append(Written(f"{folder.name}/{part.name}.fmu", about, check, note))
    return written


def _content(
    part: Component, kernel: Kernels, version: int, targets: tuple[str, ...], place: Path
) -> str:
    """Write what a unit holds; what its check says on this machine."""
    sources, name = place / "sources", part.name
    write_sources(part, kernel, sources)
    check = checked(sources, name)
    (sources / "check.csv").unlink()
    (sources / "check.c").unlink()
    digest = hashlib.sha256((sources / f"{name}.c").read_bytes()).digest()
    token = f"{{{UUID(bytes=digest[:16])}}}"
    head = f'#define FMI {version}\n#define TOKEN "{token}"\n'
    write_text(sources / "fmi.c", head + template("fmi.c", name))
    for target in targets:
        command, of = compiler(target), TARGETS[target]
        assert command is not None  # the stage sees to it
        library = place / "binaries" / of.folders[version - 2] / f"{name}{of.ending}"
        library.parent.mkdir(parents=True)
        files = [sources / file.format(name=name) for file in SOURCES]
        shared = ("-shared", *(() if target == "win64" else ("-fPIC", "-fvisibility=hidden")))
        build(command, files, library, *shared)
        for file in library.parent.iterdir():  # a linker's notes
            if file != library:
                file.unlink()
    _write_xml(place / "modelDescription.xml", described(part, token, version))
    if version == 3:
        root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
        files = ElementTree.SubElement(
            ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=name),
            "SourceFileSet",
            language="C99",
        )
        for file in SOURCES:
            ElementTree.SubElement(files, "SourceFile", name=file.format(name=name))
        _write_xml(sources / "buildDescription.xml", root)
    return check


def _write_xml(path: Path, root: ElementTree.Element) -> None:
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + text + "\n")


def _units(part: Component, root: ElementTree.Element) -> None:
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in sorted({"s", *(item.unit for item in part.variables if _unit_key(item.unit))}):
        definition = ElementTree.SubElement(units, "Unit", name=unit)
        if powers := {name: str(power) for name, power in exponents(unit).items()}:
            ElementTree.SubElement(definition, "BaseUnit", powers)


def _unit_key(unit: str) -> dict[str, str]:
    return {} if unit in ("", "dimensionless") else {"unit": unit}


_KINDS = {
    "input": {"variability": "continuous"},
    "output": {"variability": "continuous", "initial": "exact"},
    "parameter": {"variability": "tunable", "initial": "exact"},
}


def described(part: Component, token: str, version: int) -> ElementTree.Element:
    """``modelDescription.xml`` of a version of the standard."""
    third, step, add = version == 3, repr(1.0 / part.rate), ElementTree.SubElement
    about = {"fmiVersion": f"{version}.0", "modelName": part.name, "description": part.about}
    about |= {"generationTool": f"ehbench {metadata.version('ehbench')}"}
    about |= {"variableNamingConvention": "flat"}
    about["instantiationToken" if third else "guid"] = token
    root = ElementTree.Element("fmiModelDescription", about)
    about = {"modelIdentifier": part.name, "canHandleVariableCommunicationStepSize": "true"}
    about |= {"fixedInternalStepSize": step} if third else {}
    for word in ("canGetAndSetFMU", "canSerializeFMU"):
        about[word + ("State" if third else "state")] = "true"
    files = add(root, "CoSimulation", about)
    if not third:
        files = add(files, "SourceFiles")
        for file in SOURCES:
            add(files, "File", name=file.format(name=part.name))
    _units(part, root)
    add(root, "DefaultExperiment", stepSize=step)
    variables = add(root, "ModelVariables")
    for number, item in enumerate(part.variables):
        about = {"name": item.name, "valueReference": str(number), "causality": item.role}
        about |= _KINDS[item.role] | {"description": item.about}
        values = _unit_key(item.unit) | {"start": repr(item.start)}
        if item.role != "output":
            bounds = {"min": item.lower, "max": item.upper}
            values |= {key: repr(end) for key, end in bounds.items() if math.isfinite(end)}
        if third:
            add(variables, "Float64", about | values)
        else:
            add(add(variables, "ScalarVariable", about), "Real", values)
    if third:
        time = {"name": "time", "valueReference": str(len(part.variables)), "unit": "s"}
        time |= {"causality": "independent", "variability": "continuous"}
        add(variables, "Float64", time)
    structure = add(root, "ModelStructure")
    structure = structure if third else add(structure, "Outputs")
    for number, item in enumerate(part.variables):
        if item.role == "output" and third:
            add(structure, "Output", valueReference=str(number))
        elif item.role == "output":
            add(structure, "Unknown", index=str(number + 1))
    return root
