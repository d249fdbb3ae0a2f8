"""LLVM's intermediate text of a compiled kernel as C99, instruction by instruction.

Each instruction has one rule here, and what has none is refused: no number can differ without
notice. Values become local variables, blocks become labels; memory is read and written by
``memcpy``, so that no rule on aliasing or alignment is broken; whole numbers are unsigned, so that
none overflows."""

import re
import struct
from collections.abc import Callable, Iterator

from ehbench.vocabulary import EhbenchError, message

C_TYPES = {"double": "double", "ptr": "char *", "i1": "_Bool", "void": "void"}
C_TYPES |= {f"i{bits}": f"uint{max(8, 1 << (bits - 1).bit_length())}_t" for bits in range(2, 65)}
SIZES = {"double": 8, "ptr": 8, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}
BINARY = {"fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/", "add": "+", "sub": "-", "mul": "*"}
BINARY |= {"and": "&", "or": "|", "xor": "^", "shl": "<<", "lshr": ">>", "udiv": "/", "urem": "%"}
CONVERSIONS = ("sitofp", "uitofp", "fptosi", "zext", "sext", "trunc")
SIGNED = {"ashr": ">>", "sdiv": "/", "srem": "%"}
# an unordered comparison is true of what is not a number: the opposite one is false of it
COMPARED = {"eq": "==", "ne": "!=", "gt": ">", "ge": ">=", "lt": "<", "le": "<="}
OPPOSITE = {"gt": "<=", "ge": "<", "lt": ">=", "le": ">"}
MATH = {f"llvm.{name}.f64": name for name in ("sqrt", "fabs", "copysign", "exp", "pow", "sin")}
MATH |= {f"llvm.{name}.f64": name for name in ("cos", "floor", "ceil", "log", "trunc", "rint")}
MATH |= {"llvm.minnum.f64": "fmin", "llvm.maxnum.f64": "fmax"}
MATH |= {name: name for name in "sqrt exp expm1 log log1p log10 sin cos tan tanh sinh cosh".split()}
MATH |= {name: name for name in "asin acos atan atan2 pow fmod hypot erf cbrt floor ceil".split()}
HELPERS = """\
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("-ffp-contract=off")
#endif
"""
_NAME = r'(?:"[^"]*"|[-$._A-Za-z0-9]+)'
_WORDS = re.compile(
    r" ?\b(?:captures|range|dereferenceable(?:_or_null)?|memory)\([^()]*\)"
    r"| ?\binitializes\(\((?:[^()]*|\), \()*\)\)"
    r"|(?<= )(?:noundef|nonnull|nocapture|readonly|writeonly|readnone|noalias|returned|signext"
    r"|zeroext|immarg|inbounds|nuw|nusw|nsw|exact|nneg|samesign|disjoint|volatile|tail|musttail"
    r"|notail|fastcc|nnan|ninf|nsz|align \d+) "
)
_FUNCTION = re.compile(
    rf"^define [^\n]*?(\w+) @({_NAME})\((.*?)\)[^()\n]*\{{\n(.*?)^\}}", re.M | re.S
)


def refuse(what: str) -> EhbenchError:
    """The error of what has no rule."""
    return EhbenchError(message("export.untranslated", what=what[:200]))


def split(text: str) -> list[str]:
    """The parts of a list between its commas that no bracket encloses."""
    parts, depth, quoted = [""], 0, False
    for char in text:
        quoted ^= char == '"'
        depth += 0 if quoted else (char in "([{<") - (char in ")]}>")
        if char == "," and depth == 0 and not quoted:
            parts.append("")
        else:
            parts[-1] += char
    return [part.strip() for part in parts if part.strip()]


def typed(text: str) -> tuple[str, str]:
    """(type, value) of an operand such as ``i64 %x`` or ``[4 x i8] c"…"``."""
    if text[0] not in "[{":
        kind, _, value = text.partition(" ")
        return kind, value.strip()
    depth = 0
    for i, char in enumerate(text):
        depth += (char in "[{") - (char in "]}")
        if depth == 0:
            return text[: i + 1], text[i + 1 :].strip()
    raise refuse(text)


def size_of(kind: str) -> int:
    """Bytes of a type, those that fill a structure up among them."""
    if kind in SIZES:
        return SIZES[kind]
    if match := re.fullmatch(r"\[(\d+) x (.*)\]", kind):
        return int(match[1]) * size_of(match[2])
    if not kind.startswith("{"):
        raise refuse(kind)
    *_, (last, part) = fields_of(kind)
    return -(-(last + size_of(part)) // _alignment(kind)) * _alignment(kind)


def fields_of(kind: str) -> Iterator[tuple[int, str]]:
    """(offset [bytes], type) of the fields of a structure."""
    end = 0
    for part in split(kind[1:-1]):
        offset = -(-end // _alignment(part)) * _alignment(part)
        yield offset, part
        end = offset + size_of(part)


def _alignment(kind: str) -> int:
    if kind.startswith("["):
        return _alignment(kind[kind.index("x ") + 2 : -1])
    if kind.startswith("{"):
        return max(map(_alignment, split(kind[1:-1])))
    return size_of(kind)


def cut(kind: str, expression: str) -> str:
    """A whole number cut to the width of its type, which C may not have."""
    bits = int(kind[1:])
    if bits not in (8, 16, 32, 64):
        expression = f"({expression}) & {2**bits - 1}ull"
    return f"({C_TYPES[kind]})({expression})"


def number(text: str) -> str:
    """A number of type ``double``, exact in C99."""
    raw = struct.unpack(">d", bytes.fromhex(text[2:].zfill(16)))[0] if text[:2] == "0x" else text
    value = float(raw)
    if value != value:
        return "(double)NAN"
    if value in (float("inf"), -float("inf")):
        return "(double)INFINITY" if value > 0.0 else "-(double)INFINITY"
    return repr(value) if value >= 0.0 and repr(value)[0] != "-" else f"({value!r})"


def content(kind: str, value: str) -> bytes:
    """The bytes of a constant."""
    if value in ("zeroinitializer", "undef", "null"):
        return bytes(size_of(kind))
    if value.startswith('c"'):
        pieces = re.findall(r"\\([0-9A-Fa-f]{2})|(.)", value[2:-1], re.S)
        return bytes(int(code, 16) if code else ord(char) for code, char in pieces)
    if value[0] == "[":
        return b"".join(content(*typed(item)) for item in split(value[1:-1]))
    if kind == "double":
        return struct.pack(
            "<d", float.fromhex(number(value).strip("()")) if "x" in value else float(value)
        )
    return (int(value) % 2 ** (8 * size_of(kind))).to_bytes(size_of(kind), "little")


class Names:
    """Short names for LLVM's, numbered as they come."""

    def __init__(self, stem: str) -> None:
        self.stem = stem
        self.short: dict[str, str] = {}

    def of(self, name: str) -> str:
        """The short name."""
        return self.short.setdefault(name.strip('"'), f"{self.stem}{len(self.short)}")


class Translation:
    """A whole module of LLVM: its functions as C, all static, the ``entry`` called ``name``.

    Args:
        text: of LLVM.
        entry: part of the entry's name in it.
        name: of the entry in C."""

    def __init__(self, text: str, entry: str, name: str) -> None:
        self.text = _WORDS.sub("", _WORDS.sub("", text))
        self.functions, self.globals = Names(f"{name}_f"), Names(f"{name}_g")
        bodies = list(_FUNCTION.finditer(self.text))
        entries = [match[2] for match in bodies if entry in match[2].partition("B")[0]]
        if len(entries) != 1:
            raise refuse(f"{len(entries)} entries")
        self.functions.short[entries[0].strip('"')] = name
        self.parts = [Function(self, *match.groups()) for match in bodies]
        self.entry = next(part for part in self.parts if part.name == name)

    def source(self) -> str:
        """The C text of all functions."""
        bodies = [part.source() for part in self.parts]
        tables = [self._table(llvm, short) for llvm, short in self.globals.short.items()]
        heads = [f"static {part.head};" for part in self.parts]
        return "\n".join([*tables, *heads, *bodies])

    def _table(self, llvm: str, short: str) -> str:
        """A constant as a C array of its bytes."""
        match = re.search(
            rf'^@"?{re.escape(llvm)}"? = [^\n]*?\b(?:constant|global) ([^\n]*?)(?:, align \d+)?$',
            self.text,
            re.M,
        )
        if match is None:
            raise refuse(f"@{llvm}")
        data = ", ".join(map(str, content(*typed(match[1]))))
        return f"static const unsigned char {short}[] = {{{data}}};"


class Function:
    """One function of a module."""

    def __init__(
        self, module: Translation, result: str, name: str, parameters: str, body: str
    ) -> None:
        self.module, self.result, self.name = module, result, module.functions.of(name)
        self.locals = Names("v")
        self.parameters = [
            (kind, self.locals.of(v[1:])) for kind, v in map(typed, split(parameters))
        ]
        named = ", ".join(f"{C_TYPES[kind]} {v}" for kind, v in self.parameters)
        self.head = f"{C_TYPES[result]} {self.name}({named})"
        self.types: dict[str, str] = {}
        self.fields: dict[str, list[str]] = {}  # of structures that are put together
        self.buffers: list[str] = []
        self.blocks: dict[str, list[str]] = {}
        lines = re.sub(r"\n\s+(?=i\d+ -?\d+, label|\])", " ", body)
        block = self.blocks.setdefault("", [])
        for line in lines.split("\n"):
            line = re.sub(r"(?:, ![\w.]+(?: ![\w.]+)?)+$", "", re.sub(r"\s*;.*$", "", line)).strip()
            if match := re.match(rf"({_NAME}):$", line):
                block = self.blocks.setdefault(match[1].strip('"'), [])
            elif line:
                block.append(re.sub(r" #\d+$", "", line))
        self.labels = {label: f"b{i}" for i, label in enumerate(self.blocks)}
        # (variable, type, value by the block it comes from) of each phi, by its block
        self.phis: dict[str, list[tuple[str, str, dict[str, str]]]] = {}
        for label, items in self.blocks.items():
            phis = self.phis[label] = []
            for match in (re.match(rf"%({_NAME}) = phi (\w+) (\[.*)$", line) for line in items):
                if match:
                    pairs = [split(item[1:-1]) for item in split(match[3])]
                    values = {place.strip('%"'): value for value, place in pairs}
                    phis.append((self.locals.of(match[1]), match[2], values))

    def source(self) -> str:
        """Its C text."""
        lines = []
        for label, items in self.blocks.items():
            lines.append(f"{self.labels[label]}:;")
            for item in items:
                lines += self._line(item, label)
        text = "\n".join(lines)
        text = re.sub(
            r"^(b\d+):;\n", lambda m: m[0] if f"goto {m[1]};" in text else "", text, flags=re.M
        )
        uses: dict[str, int] = {}
        for name in re.findall(r"\bv\d+(?:_[01])?\b", text):
            uses[name] = uses.get(name, 0) + 1
        unused = {name for name in self.types if uses.get(name, 0) < 2}
        text = re.sub(r"^  (v\d+) = ", lambda m: "  " if m[1] in unused else m[0], text, flags=re.M)
        by_kind: dict[str, list[str]] = {}
        for name, kind in self.types.items():
            if name not in unused:
                by_kind.setdefault(kind, []).append(f"{'*' if kind == 'ptr' else ''}{name} = 0")
        declared = [
            f"  {C_TYPES[kind].removesuffix('*')} {', '.join(names)};"
            for kind, names in by_kind.items()
        ]
        ignored = [f"  (void){v};" for _, v in self.parameters if v not in uses]
        head = f"static {self.head}"
        return "\n".join([head, "{", *self.buffers, *declared, *ignored, text, "}", ""])

    def value(self, kind: str, text: str) -> str:
        """A value of a type as a C expression."""
        if text[0] == "%":
            return self.locals.of(text[1:])
        if text in ("undef", "poison", "null", "zeroinitializer", "false"):
            return "0"
        if text.startswith("@.const.picklebuf"):
            return "0"  # an error's words, which only Python reads
        if text == "true":
            return "1"
        if text[0] == "@":
            return f"(char *){self.module.globals.of(text[1:])}"
        if text.startswith("getelementptr"):
            return self._pointer(text[text.index("(") + 1 : -1])
        if kind == "double":
            return number(text)
        if kind not in C_TYPES or not re.fullmatch(r"-?\d+", text):
            raise refuse(f"{kind} {text}")
        bits = int(kind[1:])
        return f"{int(text) % 2**bits}{'u' if bits < 64 else 'ull'}"

    def signed(self, kind: str, text: str) -> str:
        """The same as a signed whole number."""
        if kind not in ("i8", "i16", "i32", "i64"):
            raise refuse(f"{kind} {text}")
        return f"(int{kind[1:]}_t){self.value(kind, text)}"

    def _pointer(self, text: str) -> str:
        kind, base, first, *others = split(text)
        address, step = self.value(*typed(base)), size_of(kind)
        terms = [(step, typed(first))]
        for item in others:
            if kind.startswith("{"):
                offset, kind = list(fields_of(kind))[int(typed(item)[1])]
                terms.append((offset, ("i64", "1")))
                continue
            if not (match := re.fullmatch(r"\[(\d+) x (.*)\]", kind)):
                raise refuse(text)
            kind = match[2]
            terms.append((size_of(kind), typed(item)))
        for size, (of, index) in terms:
            if index[0] == "%":
                address += f" + {self.signed(of, index)}" + (f" * {size}" if size != 1 else "")
            elif int(index):
                address += f" + {int(index) * size}"
        return f"({address})"

    def _jump(self, source: str, target: str) -> str:
        """Go to a block, its phis set to what they are from here; all at once where one of them
        needs another's old value."""
        target = target.strip('"')
        moves = [(v, k, self.value(k, by[source])) for v, k, by in self.phis[target]]
        names = {v for v, _, _ in moves}
        goto = f"goto {self.labels[target]};"
        if any(new in names and new != v for v, _, new in moves):
            first = " ".join(f"{C_TYPES[k]} t{i} = {new};" for i, (_, k, new) in enumerate(moves))
            return " ".join([first, *(f"{v} = t{i};" for i, (v, _, _) in enumerate(moves)), goto])
        return " ".join([*(f"{v} = {new};" for v, _, new in moves if v != new), goto])

    def _line(self, line: str, block: str) -> list[str]:
        match = re.match(rf"%({_NAME}) = (.*)$", line)
        result, text = (self.locals.of(match[1]), match[2]) if match else ("", line)
        text = re.sub(r"^(?:tail|musttail|notail) ", "", text)
        word, _, rest = text.partition(" ")
        rest = _WORDS.sub("", f" {rest}").strip()
        rule: Callable[..., tuple[str, str] | list[str]] | None = getattr(self, f"_do_{word}", None)
        if word in BINARY or word in SIGNED:
            first, other = split(rest)
            kind, text = typed(first)
            if word in SIGNED:
                a, b = self.signed(kind, text), self.signed(kind, other)
                expression = f"({C_TYPES[kind]})({a} {SIGNED[word]} {b})"
            else:
                expression = f"{self.value(kind, text)} {BINARY[word]} {self.value(kind, other)}"
                expression = expression if kind == "double" else cut(kind, expression)
        elif word in CONVERSIONS:
            kind, expression = self._converted(word, rest)
        elif rule is None:
            raise refuse(line)
        elif isinstance(done := rule(rest, result, block), list):
            return done
        else:
            kind, expression = done
        self.types[result] = kind
        return [f"  {result} = {expression};"]

    def _do_phi(self, rest: str, result: str, block: str) -> list[str]:
        self.types[result] = rest.partition(" ")[0]
        return []

    def _do_fneg(self, rest: str, result: str, block: str) -> tuple[str, str]:
        return "double", f"-{self.value(*typed(rest))}"

    def _do_freeze(self, rest: str, result: str, block: str) -> tuple[str, str]:
        kind, text = typed(rest)
        return kind, self.value(kind, text)

    def _do_icmp(self, rest: str, result: str, block: str) -> tuple[str, str]:
        how, _, operands = rest.partition(" ")
        first, other = split(operands)
        kind, text = typed(first)
        as_kind = self.signed if how[0] == "s" and kind != "ptr" else self.value
        a, b = as_kind(kind, text), as_kind(kind, other)
        return "i1", f"{a} {COMPARED[how if how in COMPARED else how[1:]]} {b}"

    def _do_fcmp(self, rest: str, result: str, block: str) -> tuple[str, str]:
        how, _, operands = rest.partition(" ")
        first, other = split(operands)
        a, b = self.value("double", typed(first)[1]), self.value("double", other)
        if how in ("uno", "ord"):
            sign, join = ("!=", "||") if how == "uno" else ("==", "&&")
            return "i1", f"{a} {sign} {a} {join} {b} {sign} {b}"
        if how in ("one", "ueq"):
            return "i1", f"{a} < {b} || {a} > {b}" if how == "one" else f"!({a} < {b} || {a} > {b})"
        if how in ("oeq", "une") or how[0] == "o":
            return "i1", f"{a} {COMPARED[how[1:]]} {b}"
        return "i1", f"!({a} {OPPOSITE[how[1:]]} {b})"

    def _do_select(self, rest: str, result: str, block: str) -> tuple[str, str]:
        condition, yes, no = map(typed, split(rest))
        return yes[0], f"{self.value(*condition)} ? {self.value(*yes)} : {self.value(*no)}"

    def _do_load(self, rest: str, result: str, block: str) -> list[str]:
        kind, place = split(rest)[:2]
        self.types[result] = kind
        return [f"  memcpy(&{result}, {self.value(*typed(place))}, {size_of(kind)});"]

    def _do_store(self, rest: str, result: str, block: str) -> list[str]:
        (kind, text), place = typed(split(rest)[0]), typed(split(rest)[1])
        if kind.startswith("{"):
            fields, where = self.fields[self.locals.of(text[1:])], place[1]
            return [
                line
                for (offset, part), value in zip(fields_of(kind), fields, strict=True)
                for line in self._stored(part, value, f"{self.value('ptr', where)} + {offset}")
            ]
        return self._stored(kind, self.value(kind, text), self.value(*place))

    def _stored(self, kind: str, value: str, place: str) -> list[str]:
        return [f"  {{ {C_TYPES[kind]} s = {value}; memcpy({place}, &s, {size_of(kind)}); }}"]

    def _do_insertvalue(self, rest: str, result: str, block: str) -> list[str]:
        whole, item, index = split(rest)
        kind, before = typed(whole)
        fields = ["0"] * len(split(kind[1:-1]))
        if before[0] == "%":
            fields = self.fields[self.locals.of(before[1:])].copy()
        fields[int(index)] = self.value(*typed(item))
        self.fields[result] = fields
        return []

    def _do_getelementptr(self, rest: str, result: str, block: str) -> tuple[str, str]:
        return "ptr", self._pointer(rest)

    def _do_alloca(self, rest: str, result: str, block: str) -> tuple[str, str]:
        self.buffers.append(f"  char {result}_data[{size_of(split(rest)[0])}] = {{0}};")
        return "ptr", f"{result}_data"

    def _converted(self, word: str, rest: str) -> tuple[str, str]:
        """(type, expression) of a number turned into another type."""
        before, after = rest.split(" to ")
        kind, text = typed(before)
        value = self.value(kind, text)
        if word == "trunc":
            return after, cut(after, value)
        if word == "fptosi":  # of what no whole number is, any will do
            whole = f"({C_TYPES[after]})(int64_t){value}"
            return after, f"{value} > -9.2e18 && {value} < 9.2e18 ? {whole} : 0"
        if word == "sitofp":
            value = self.signed(kind, text)
        elif word == "sext" and kind == "i1":
            value = f"(-(int64_t){value})"
        elif word == "sext":
            value = f"((int64_t)(int{kind[1:]}_t){value})"
        return after, f"({C_TYPES[after]}){value}"

    def _do_bitcast(self, rest: str, result: str, block: str) -> list[str]:
        before, after = rest.split(" to ")
        kind, text = typed(before)
        self.types[result] = after
        return self._stored(kind, self.value(kind, text), f"&{result}")

    def _do_extractvalue(self, rest: str, result: str, block: str) -> tuple[str, str]:
        pair, index = split(rest)
        name = f"{self.value('', typed(pair)[1])}_{index}"
        return ("i1" if index == "1" else "i64"), name

    def _do_call(self, rest: str, result: str, block: str) -> tuple[str, str] | list[str]:
        match = re.match(rf"(\{{[^}}]*\}}|\w+) @({_NAME})\((.*)\)", rest)
        if match is None:
            raise refuse(rest)
        kind, function = match[1], match[2].strip('"')
        given = [typed(item) for item in split(match[3])]
        values = [self.value(*item) for item in given if item[0] != "metadata"]
        if function in MATH:
            return kind, f"{MATH[function]}({', '.join(values)})"
        if not function.startswith("llvm."):
            call = f"{self.module.functions.of(function)}({', '.join(values)})"
            return [f"  {call};"] if kind == "void" else (kind, call)
        if re.match(r"llvm\.(lifetime|assume|experimental\.noalias)", function):
            return []
        if match := re.match(r"llvm\.(memset|memcpy|memmove)", function):
            return [f"  {match[1].replace('cpy', 'move')}({', '.join(values[:3])});"]
        if match := re.match(r"llvm\.(s|u)(max|min)\.", function):
            a, b = (self.signed(*item) if match[1] == "s" else self.value(*item) for item in given)
            return kind, f"{a} {'>' if match[2] == 'max' else '<'} {b} ? {values[0]} : {values[1]}"
        if function.startswith("llvm.abs."):
            return kind, f"{self.signed(*given[0])} < 0 ? 0 - {values[0]} : {values[0]}"
        if match := re.match(r"llvm\.u(add|sub)\.with\.overflow\.i64", function):
            sign, (a, b) = {"add": "+", "sub": "-"}[match[1]], values
            self.types |= {f"{result}_0": "i64", f"{result}_1": "i1"}
            over = f"{a} < {b}" if sign == "-" else f"{result}_0 < {a}"
            return [f"  {result}_0 = {a} {sign} {b};", f"  {result}_1 = {over};"]
        raise refuse(rest)

    def _do_br(self, rest: str, result: str, block: str) -> list[str]:
        condition, *targets = split(rest)
        jumps = [self._jump(block, item.split("%", 1)[1]) for item in targets]
        if not jumps:
            return ["  " + self._jump(block, condition.split("%", 1)[1])]
        return [f"  if ({self.value(*typed(condition))}) {{ {jumps[0]} }} else {{ {jumps[1]} }}"]

    def _do_switch(self, rest: str, result: str, block: str) -> list[str]:
        head, cases = rest.split(" [", 1)
        first, other = split(head)
        kind, text = typed(first)
        pairs = re.findall(rf"i\d+ (-?\d+), label %({_NAME})", cases)
        lines = [
            f"    case {self.value(kind, value)}: {self._jump(block, target)}"
            for value, target in pairs
        ]
        default = f"    default: {self._jump(block, other.split('%', 1)[1])}"
        return [f"  switch ({self.value(kind, text)}) {{", *lines, default, "  }"]

    def _do_ret(self, rest: str, result: str, block: str) -> list[str]:
        return ["  return;" if rest == "void" else f"  return {self.value(*typed(rest))};"]

    def _do_unreachable(self, rest: str, result: str, block: str) -> list[str]:
        return ["  for (;;) {}"]
