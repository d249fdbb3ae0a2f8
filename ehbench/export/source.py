"""A part as C99: a header that names its variables, a source file without allocation or input and
output, and a check against a trial."""

import math
import re
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig.names import ascii_words
from ehbench.export import c99
from ehbench.export.component import Component, Leaf, distinct
from ehbench.export.kernels import NAME, Kernels
from ehbench.runtime.disk import write_text

TYPES = {np.dtype(float): "double", np.dtype(np.int64): "int64_t", np.dtype(bool): "uint8_t"}
TEMPLATES = Path(__file__).with_name("templates")
HEAD = """\
/* {about}
   Written by ehbench {version}. SI units. One step is 1/{rate:g} s.
   The numbers are those of ehbench where the mathematical library is the same and no multiplication
   and addition are contracted into one operation; see the check beside this file. */
"""


def number(value: float) -> str:
    """A number as C has it, exact."""
    if math.isnan(value):
        return "NAN"
    return repr(value) if math.isfinite(value) else "-INFINITY" if value < 0.0 else "INFINITY"


class Layouts:
    """The structures of a header, one for each layout of records."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.names: dict[np.dtype, str] = {}
        self.lines: list[str] = []

    def of(self, layout: np.dtype, name: str) -> str:
        """The C type of a layout."""
        if layout in TYPES:
            return TYPES[layout]
        if layout not in self.names:
            fields = []
            for field in layout.names or ():
                inner, shape = layout[field].subdtype or (layout[field], ())
                fields.append(f"  {self.of(inner, field)} {field}{sizes(shape)};")
            unique = f"struct {self.prefix}_{name}"
            unique += f"_{len(self.names)}" * (unique in self.names.values())
            self.names[layout] = unique
            self.lines += [unique + " {", *fields, "};"]
        return self.names[layout]


def sizes(shape: Sequence[int]) -> str:
    """The sizes of an array in C, which has none of size 0."""
    return "".join(f"[{max(1, size)}]" for size in shape)


def image(value: Any) -> str:
    """A value as C writes it at the start of an instance."""
    if isinstance(value, np.ndarray):
        full = value if value.size else np.zeros([max(1, n) for n in value.shape], value.dtype)
        return "{" + ", ".join(map(image, full)) + "}"
    if isinstance(value, np.void):
        return "{" + ", ".join(image(value[field]) for field in value.dtype.names or ()) + "}"
    return number(float(value)) if isinstance(value, float) else str(int(value))


def arguments_of(leaf: Leaf) -> Iterator[tuple[str, str]]:
    """(type of LLVM, text in C) of what compiled code takes of a leaf: of an array also who owns
    it, its size, shape and strides."""
    value = leaf.value
    if value is None:
        yield "ptr", "0"
    elif isinstance(value, np.void):
        yield "ptr", f"(char *)&self->{leaf.name}"
    elif isinstance(value, np.ndarray):
        yield from (("ptr", "0"), ("ptr", "0"))
        yield from (("i64", str(value.size)), ("i64", str(value.itemsize)))
        yield "ptr", f"(char *)self->{leaf.name}"
        yield from (("i64", str(size)) for size in (*value.shape, *value.strides))
    elif isinstance(value, float):
        yield "double", "self->time" if leaf.name == "t" else number(value)
    else:
        yield "i64", str(int(value))


def template(file: str, name: str) -> str:
    """A file of C that is the same for every part but for the part's name."""
    text, words = (TEMPLATES / file).read_text(), {"NAME": name, "UPPER": name.upper()}
    return re.sub("NAME|UPPER", lambda match: words[match[0]], text)


def comment(text: str) -> str:
    """A text as a comment of C may have it."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def header(part: Component) -> str:
    """``NAME.h``."""
    name, layouts = part.name, Layouts(part.name)
    fields = []
    for leaf in part.memory:
        fields.append(f"  {layouts.of(leaf.value.dtype, leaf.name)} {leaf.name}"
                      f"{sizes(leaf.value.shape)};")  # fmt: skip
    rows, before = [], ""
    words = distinct(f"{name}_{ascii_words(item.name)}".upper() for item in part.variables)
    for i, (word, item) in enumerate(zip(words, part.variables, strict=True)):
        if item.role != before:
            rows.append(f"  /* {item.role}s */")
            before = item.role
        unit = item.unit or "1"
        about = f" {comment(item.about)}" if item.about else ""
        rows.append(f"  {word} = {i}, /* [{unit}] {number(item.lower)} to "
                    f"{number(item.upper)}, at first {number(item.start)}.{about} */")  # fmt: skip
    counts = [len(part.role(role)) for role in ("input", "output", "parameter")]
    sums = dict(zip(("INPUTS", "OUTPUTS", "PARAMETERS"), counts, strict=True))
    return "\n".join([
        HEAD.format(about=comment(part.about), version=metadata.version("ehbench"), rate=part.rate),
        f"#ifndef {name.upper()}_H", f"#define {name.upper()}_H", "#include <stdint.h>",
        "#ifdef __cplusplus", 'extern "C" {', "#endif",
        "/* variables: unit, range, value after init, meaning */", "enum {", *rows, "};",
        *(f"#define {name.upper()}_{key} {size}" for key, size in sums.items()),
        f"#define {name.upper()}_RATE {number(part.rate)} /* steps a second */", *layouts.lines,
        "/* an instance: all its memory */", "typedef struct {", "  double time; /* [s] */",
        "  int64_t steps;", *fields, f"}} {name};",
        f"void {name}_init({name} *self);",
        "/* one step from the inputs that are set to the outputs */",
        f"void {name}_step({name} *self);",
        "/* the value of a variable; not a number where there is none */",
        f"double {name}_get(const {name} *self, int variable);",
        "/* set an input or a parameter: 0 done; nothing changed: 1 no such, 2 not finite or",
        "   out of its range */",
        f"int {name}_set({name} *self, int variable, double value);",
        "#ifdef __cplusplus", "}", "#endif", "#endif", "",
    ])  # fmt: skip


def body(part: Component, kernel: Kernels) -> str:
    """``NAME.c``."""
    name, given = part.name, [item for leaf in part.leaves for item in arguments_of(leaf)]
    kinds = [kind for kind, _ in given]
    if kinds != list(kernel.kinds[2:]):
        raise c99.refuse(f"{name}: {kinds} for {kernel.kinds}")
    places = [place for item in part.variables for place in item.places]
    first = np.cumsum([0, *(len(item.places) for item in part.variables)]).tolist()
    bounds = [f"  {{{number(item.lower)}, {number(item.upper)}}}," for item in part.variables]
    return "\n".join([
        f'#include "{name}.h"', "#include <stddef.h>", c99.HELPERS, kernel.source,
        f"static const {name} start = {{", "  0.0, 0,",
        *(f"  {image(leaf.value)}," for leaf in part.memory), "};",
        "/* where the numbers of the variables stand, several of some parameters */",
        "static const size_t place[] = {",
        *(f"  offsetof({name}, {place})," for place in places), "};",
        f"static const int first[] = {{{', '.join(map(str, first))}}};",
        "static const double bounds[][2] = {", *bounds, "};", "",
        f"void {name}_init({name} *self) {{ *self = start; }}", "",
        f"void {name}_step({name} *self) {{",
        "  char result[64], problem[64];",
        f"  {NAME}(result, problem, {', '.join(text for _, text in given)});",
        "  self->steps += 1;",
        f"  self->time = (double)self->steps / {name.upper()}_RATE;", "}", "",
        template("access.c", name),
    ])  # fmt: skip


def check_csv(part: Component) -> str:
    """``check.csv``: inputs and outputs of each step of a trial."""
    names = [item.name for item in part.variables if item.role != "parameter"]
    rows = (",".join(map(repr, row)) for row in part.rows.tolist())
    return "\n".join([",".join(names), *rows, ""])


def write_sources(part: Component, kernel: Kernels, folder: Path) -> None:
    """Write header, source and check of a part."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {f"{part.name}.h": header(part), f"{part.name}.c": body(part, kernel)}
    files |= {"check.c": template("check.c", part.name), "check.csv": check_csv(part)}
    for file, text in files.items():
        write_text(folder / file, text)
