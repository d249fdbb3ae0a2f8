"""Lanes: so many numbers side by side in one register of the processor, as a type of numba's, and
what kernels do with them.

A vector of floats, of integers or of truths (a mask) goes wherever a number does; together with a
number it makes a vector. Every operation is that of numbers, lane by lane, in the same order and
rounded alike: no lane knows of its neighbours. What is told `by mask` is done in its lanes only; a
mask may also be a plain truth, which is true wherever it stands, for a block that no lane is in is
not entered.
"""

from __future__ import annotations

import builtins
import math
import operator
from collections.abc import Callable
from functools import cache
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.datamodel.registry import register_default
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, builtin_registry, signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

LANES = 8  # a register of AVX-512, two of AVX2


class Lanes(types.Type):
    """The type of so many numbers of one type, ``of``."""

    def __init__(self, of: Any) -> None:
        self.of = of
        super().__init__(f"{LANES} lanes of {of}")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """A number, or lanes of a narrower type, stands for lanes."""
        given = other.of if isinstance(other, Lanes) else types.unliteral(other)
        if not isinstance(given, (types.Float, types.Integer, types.Boolean)):
            return None
        if _rank(given) > _rank(self.of):
            return None
        return Conversion.promote

    def unify(self, typingctx: Any, other: Any) -> Any:
        """The wider of both."""
        given = other.of if isinstance(other, Lanes) else types.unliteral(other)
        if not isinstance(given, (types.Float, types.Integer, types.Boolean)):
            return None
        return self if _rank(given) <= _rank(self.of) else _OF[_rank(given)]


def _rank(of: Any) -> int:
    if isinstance(of, types.Boolean):
        return 0
    return 1 if isinstance(of, types.Integer) else 2


MASK, WHOLE, REAL = Lanes(types.boolean), Lanes(types.int64), Lanes(types.float64)
_OF = (MASK, WHOLE, REAL)
_ELEMENT = {MASK: ir.IntType(1), WHOLE: ir.IntType(64), REAL: ir.DoubleType()}
_VECTOR = {lanes: ir.VectorType(element, LANES) for lanes, element in _ELEMENT.items()}
_MINE = ir.IntType(32)
_TEMPLATES: Any = builtin_registry


@register_default(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR[fe_type])


def _splat(builder: Any, value: Any) -> Any:
    vector = ir.VectorType(value.type, LANES)
    item = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(_MINE, 0))
    zeros = ir.Constant(ir.VectorType(_MINE, LANES), [0] * LANES)
    return builder.shuffle_vector(item, ir.Constant(vector, ir.Undefined), zeros)


@lower_cast(types.Number, Lanes)
@lower_cast(types.Boolean, Lanes)
def _from_number(context: Any, builder: Any, have: Any, want: Any, value: Any) -> Any:
    value = context.cast(builder, value, have, want.of)
    if want is MASK:
        value = builder.trunc(value, ir.IntType(1)) if value.type != ir.IntType(1) else value
    return _splat(builder, value)


@lower_cast(Lanes, Lanes)
def _from_lanes(context: Any, builder: Any, have: Any, want: Any, value: Any) -> Any:
    if have == want:
        return value
    if want == REAL and have == WHOLE:
        return builder.sitofp(value, _VECTOR[REAL])
    if want == REAL:
        return builder.uitofp(value, _VECTOR[REAL])
    return builder.zext(value, _VECTOR[WHOLE])


def _wide(*args: Any) -> Any:
    """The type in which lanes and numbers meet; None where there are no lanes among them."""
    if not any(isinstance(arg, Lanes) for arg in args):
        return None
    ranks = [_rank(arg.of if isinstance(arg, Lanes) else types.unliteral(arg)) for arg in args]
    return _OF[max(ranks)]


def _operator(op: Any, code: Callable, result: Any = None, least: Any = None) -> None:
    """Teach numba an operator on lanes: ``code(builder, real, a, b)``."""

    @_TEMPLATES.register_global(op)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) not in (1, 2) or not any(isinstance(arg, Lanes) for arg in args):
                return None
            wide = _wide(*args, *([least] if least else []))
            return signature(result or wide, *([wide] * len(args)))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return code(builder, sig.args[0] == REAL, *args)

    lower_builtin(op, Lanes)(lower)
    lower_builtin(op, Lanes, Lanes)(lower)


def _arithmetic(real: str, whole: str) -> Callable:
    return lambda b, is_real, *args: getattr(b, real if is_real else whole)(*args)


def _comparison(sign: str) -> Callable:
    def code(b: Any, is_real: bool, item: Any, other: Any) -> Any:
        if not is_real:
            return b.icmp_signed(sign, item, other)
        compare = b.fcmp_unordered if sign == "!=" else b.fcmp_ordered
        return compare(sign, item, other)

    return code


for _ops, _real, _whole in (
    ((operator.add, operator.iadd), "fadd", "add"),
    ((operator.sub, operator.isub), "fsub", "sub"),
    ((operator.mul, operator.imul), "fmul", "mul"),
):
    for _op in _ops:
        _operator(_op, _arithmetic(_real, _whole), least=WHOLE)
for _op in (operator.truediv, operator.itruediv):
    _operator(_op, lambda b, is_real, *args: b.fdiv(*args), least=REAL)
_operator(operator.neg, lambda b, is_real, x: b.fneg(x) if is_real else b.neg(x), least=WHOLE)
_operator(operator.rshift, lambda b, is_real, *args: b.ashr(*args), least=WHOLE)
for _op, _sign in (
    *((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">")),
    *((operator.ge, ">="), (operator.eq, "=="), (operator.ne, "!=")),
):
    _operator(_op, _comparison(_sign), MASK, least=WHOLE)


def _number(typingctx: Any, function: Any, args: tuple[Any, ...]) -> tuple[Any, Callable]:
    """(signature, code) of a function of numbers that numba knows."""
    known = typingctx.resolve_value_type(function)
    sig = typingctx.resolve_function_type(known, args, {})

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        cast = [context.cast(builder, *item) for item in zip(values, args, sig.args, strict=True)]
        return context.get_function(known, sig)(builder, cast)

    return signature(sig.return_type, *args), code


def _each_lane(typingctx: Any, function: Any, args: tuple[Any, ...]) -> tuple[Any, Callable]:
    """(signature, code) of a function of numbers, called for one lane after the other."""
    known = typingctx.resolve_value_type(function)
    sig = typingctx.resolve_function_type(known, (types.float64,) * len(args), {})

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        wide = [
            context.cast(builder, value, arg, REAL) for value, arg in zip(values, args, strict=True)
        ]
        call, out = context.get_function(known, sig), ir.Constant(_VECTOR[REAL], ir.Undefined)
        for lane in range(LANES):
            place = ir.Constant(_MINE, lane)
            item = call(builder, [builder.extract_element(value, place) for value in wide])
            out = builder.insert_element(out, item, place)
        return out

    return signature(REAL, *args), code


def _llvm(name: str, result: Any = REAL) -> Callable:
    """Code of a function that LLVM has for vectors."""

    def made(typingctx: Any, function: Any, args: tuple[Any, ...]) -> tuple[Any, Callable]:
        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            wide = [
                context.cast(builder, value, arg, REAL)
                for value, arg in zip(values, args, strict=True)
            ]
            vector = _VECTOR[REAL]
            kind = ir.FunctionType(vector, [vector] * len(wide))
            full = f"llvm.{name}.v{LANES}f64"
            out = builder.call(cgutils.get_or_insert_function(builder.module, kind, full), wide)
            return builder.fptosi(out, _VECTOR[WHOLE]) if result == WHOLE else out

        return signature(result, *args), code

    return made


def _function(function: Any, built: Callable) -> Any:
    """A function of numbers or of lanes."""
    count = 2 if function in (math.copysign, operator.pow) else 1

    def typed(typingctx: Any, args: tuple[Any, ...]) -> tuple[Any, Callable]:
        lanes = any(isinstance(arg, Lanes) for arg in args)
        return (built if lanes else _number)(typingctx, function, args)

    if count == 2:
        return intrinsic(lambda typingctx, x, y: typed(typingctx, (x, y)))
    return intrinsic(lambda typingctx, x: typed(typingctx, (x,)))


sqrt = _function(math.sqrt, _llvm("sqrt"))
floor = _function(math.floor, _llvm("floor", WHOLE))
ceil = _function(math.ceil, _llvm("ceil", WHOLE))
copysign = _function(math.copysign, _llvm("copysign"))
power = _function(operator.pow, _each_lane)
absolute = _function(builtins.abs, _llvm("fabs"))
FUNCTIONS = {
    math.sqrt: sqrt,
    math.floor: floor,
    math.ceil: ceil,
    math.copysign: copysign,
    builtins.abs: absolute,
    **{
        f: _function(f, _each_lane)
        for f in (math.sin, math.cos, math.tan, math.exp, math.expm1, math.log, math.tanh)
    },
}


def _truth(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """A plain truth as one bit."""
    return value if value.type == ir.IntType(1) else builder.trunc(value, ir.IntType(1))


def _any(builder: Any, mask: Any) -> Any:
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


def _masks(context: Any, builder: Any, kinds: Any, values: Any) -> list[Any]:
    return [context.cast(builder, *item, MASK) for item in zip(values, kinds, strict=True)]


def _entering(negated: bool) -> Any:
    """Whether any lane of a mask is one where a condition holds, or does not."""

    def typed(typingctx: Any, mask: Any, condition: Any) -> Any:
        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            if not isinstance(condition, Lanes):
                plain = _truth(context, builder, condition, values[1])
                return builder.not_(plain) if negated else plain
            required = builder.not_(values[1]) if negated else values[1]
            if isinstance(mask, Lanes):
                required = builder.and_(values[0], required)
            return _any(builder, required)

        return signature(types.boolean, mask, condition), code

    return intrinsic(typed)


def _narrowed(negated: bool) -> Any:
    """A mask where a condition holds too, or does not; entered, so that a plain one does."""

    def typed(typingctx: Any, mask: Any, condition: Any) -> Any:
        wide = isinstance(mask, Lanes) or isinstance(condition, Lanes)

        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            if not isinstance(condition, Lanes):
                return values[0]
            required = builder.not_(values[1]) if negated else values[1]
            return builder.and_(values[0], required) if isinstance(mask, Lanes) else required

        return signature(MASK if wide else mask, mask, condition), code

    return intrinsic(typed)


enters, enters_not = _entering(False), _entering(True)
within, without = _narrowed(False), _narrowed(True)


def _logic(name: str) -> Any:
    def typed(typingctx: Any, item: Any, other: Any) -> Any:
        wide = isinstance(item, Lanes) or isinstance(other, Lanes)

        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            if wide:
                return getattr(builder, name)(*_masks(context, builder, (item, other), values))
            bits = [_truth(context, builder, None, value) for value in values]
            return getattr(builder, name)(*bits)

        return signature(MASK if wide else types.boolean, item, other), code

    return intrinsic(typed)


both, either = _logic("and_"), _logic("or_")


@intrinsic
def negated(typingctx: Any, condition: Any) -> Any:
    """What is not so."""

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        if isinstance(condition, Lanes):
            return builder.not_(values[0])
        return builder.not_(_truth(context, builder, condition, values[0]))

    return signature(MASK if isinstance(condition, Lanes) else types.boolean, condition), code


@intrinsic
def chosen(typingctx: Any, mask: Any, new: Any, old: Any) -> Any:
    """``new`` in the lanes of a mask, ``old`` in the others."""
    if not isinstance(mask, Lanes):
        return signature(new, mask, new, old), lambda context, builder, _, values: values[1]
    wide = _wide(mask, new, old) if not (_is_truth(new) and _is_truth(old)) else MASK
    return signature(wide, mask, new, old), _choosing(wide)


def _is_truth(kind: Any) -> bool:
    return kind is MASK or isinstance(types.unliteral(kind), types.Boolean)


def _choosing(wide: Any) -> Callable:
    def code(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        new, old = (
            context.cast(builder, value, kind, wide)
            for value, kind in zip(values[1:], sig.args[1:], strict=True)
        )
        return builder.select(values[0], new, old)

    return code


@intrinsic
def picked(typingctx: Any, condition: Any, first: Any, second: Any) -> Any:
    """``first if condition else second``, both of them known."""
    if isinstance(condition, Lanes):
        wide = MASK if _is_truth(first) and _is_truth(second) else _wide(condition, first, second)
        return signature(wide, condition, first, second), _choosing(wide)
    meet = typingctx.unify_types(types.unliteral(first), types.unliteral(second))

    def code(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        item = context.cast(builder, values[1], first, meet)
        other = context.cast(builder, values[2], second, meet)
        return builder.select(_truth(context, builder, condition, values[0]), item, other)

    return signature(meet, condition, first, second), code


def _extreme(sign: str) -> Any:
    """`max` or `min` of two, as numba has them for numbers."""

    def typed(typingctx: Any, first: Any, second: Any) -> Any:
        wide = _wide(first, second)
        if wide is None:
            return _number(typingctx, max if sign == ">" else min, (first, second))

        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            item = context.cast(builder, values[0], first, wide)
            other = context.cast(builder, values[1], second, wide)
            beyond = _comparison(sign)(builder, wide == REAL, other, item)
            return builder.select(beyond, other, item)

        return signature(wide, first, second), code

    return intrinsic(typed)


larger, smaller = _extreme(">"), _extreme("<")


@intrinsic
def square(typingctx: Any, x: Any) -> Any:
    """``x**2``"""

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        real = _ELEMENT[REAL] in (values[0].type, getattr(values[0].type, "element", None))
        return (builder.fmul if real else builder.mul)(values[0], values[0])

    return signature(x, x), code


@intrinsic
def whole(typingctx: Any, x: Any) -> Any:
    """``int(x)``"""
    if not isinstance(x, Lanes):
        return _number(typingctx, int, (x,))

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        return values[0] if x == WHOLE else builder.fptosi(values[0], _VECTOR[WHOLE])

    return signature(WHOLE, x), code


@intrinsic
def most(typingctx: Any, count: Any) -> Any:
    """The largest number of any lane."""
    if not isinstance(count, Lanes):
        return signature(count, count), lambda context, builder, _, values: values[0]

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(64), [_VECTOR[WHOLE]])
        name = f"llvm.vector.reduce.smax.v{LANES}i64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)

    return signature(types.int64, count), code


@cache
def field(name: str) -> Any:
    """The function that reads ``x.name``: lanes from a record that has an array of them."""

    def typed(typingctx: Any, x: Any) -> Any:
        kind = typingctx.resolve_getattr(x, name)
        if kind is None:
            return None
        wide = isinstance(x, types.Record) and isinstance(kind, types.Array)

        def code(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            if not wide:
                return context.get_getattr(x, name)(context, builder, x, values[0], name)
            place = cgutils.get_record_member(builder, values[0], x.offset(name), _VECTOR[REAL])
            return builder.load(place, align=8)

        return signature(REAL if wide else kind, x), code

    typed.__name__ = typed.__qualname__ = f"field_{name}"
    return intrinsic(typed)


def _floor_mod(builder: Any, real: bool, item: Any, other: Any) -> Any:
    """The remainder of the sign of the divisor, as Python has it."""
    left = builder.srem(item, other)
    wrong = builder.icmp_signed("<", builder.xor(left, other), ir.Constant(left.type, [0] * LANES))
    off = builder.icmp_signed("!=", left, ir.Constant(left.type, [0] * LANES))
    return builder.select(builder.and_(wrong, off), builder.add(left, other), left)


_operator(operator.mod, _floor_mod, least=WHOLE)


def _indices(index: Any) -> int:
    return len(index) if isinstance(index, types.BaseTuple) else 1


def _has_lanes(array: Any, index: Any) -> bool:
    """Whether an array has lanes at an index: its last axis."""
    real = isinstance(array, types.Array) and array.dtype == types.float64
    return real and array.ndim == _indices(index) + 1


def _place(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Where the lanes of an array begin at an index."""
    array, index = kinds
    parts = cgutils.unpack_tuple(builder, values[1]) if _is_tuple(index) else [values[1]]
    of = list(index) if _is_tuple(index) else [index]
    parts = [
        context.cast(builder, part, kind, types.intp) for part, kind in zip(parts, of, strict=True)
    ]
    built = make_array(array)(context, builder, values[0])
    at = cgutils.get_item_pointer(
        context, builder, array, built, [*parts, ir.Constant(ir.IntType(64), 0)], wraparound=False
    )
    return builder.bitcast(at, _VECTOR[REAL].as_pointer())


def _is_tuple(kind: Any) -> bool:
    return isinstance(kind, types.BaseTuple)


@intrinsic
def taken(typingctx: Any, mask: Any, array: Any, index: Any) -> Any:
    """``array[index]``: lanes where the array has them; each its own where the index has lanes."""
    if WHOLE in (index, *(index if _is_tuple(index) else ())):
        return signature(REAL, mask, array, index), _gathered(array, index, mask)
    if _has_lanes(array, index) and not isinstance(index, types.SliceType):

        def load(context: Any, builder: Any, _: Any, values: Any) -> Any:
            return builder.load(_place(context, builder, (array, index), values[1:]), align=8)

        return signature(REAL, mask, array, index), load
    known = typingctx.resolve_value_type(operator.getitem)
    sig = typingctx.resolve_function_type(known, (array, index), {})

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        cast = [
            context.cast(builder, *item)
            for item in zip(values[1:], (array, index), sig.args, strict=True)
        ]
        return context.get_function(known, sig)(builder, cast)

    return signature(sig.return_type, mask, array, index), code


def _gathered(array: Any, index: Any, mask: Any) -> Callable:
    """Each lane from its own place; lanes that the mask has not from the first."""
    kinds = list(index) if _is_tuple(index) else [index]

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        built = make_array(array)(context, builder, values[1])
        parts = cgutils.unpack_tuple(builder, values[2]) if _is_tuple(index) else [values[2]]
        wide = [context.cast(builder, *item, WHOLE) for item in zip(parts, kinds, strict=True)]
        if isinstance(mask, Lanes):
            none = ir.Constant(_VECTOR[WHOLE], [0] * LANES)
            wide = [builder.select(values[0], part, none) for part in wide]
        out = ir.Constant(_VECTOR[REAL], ir.Undefined)
        for lane in range(LANES):
            place = ir.Constant(_MINE, lane)
            at = [builder.extract_element(part, place) for part in wide]
            if array.ndim == len(at) + 1:
                at.append(ir.Constant(ir.IntType(64), lane))
            where = cgutils.get_item_pointer(context, builder, array, built, at, wraparound=False)
            out = builder.insert_element(out, builder.load(where), place)
        return out

    return code


@intrinsic
def put(typingctx: Any, mask: Any, array: Any, index: Any, value: Any) -> Any:
    """``array[index] = value`` by mask."""
    if not _has_lanes(array, index):
        known = typingctx.resolve_value_type(operator.setitem)
        sig = typingctx.resolve_function_type(known, (array, index, value), {})

        def plain(context: Any, builder: Any, _: Any, values: Any) -> Any:
            cast = [
                context.cast(builder, *item)
                for item in zip(values[1:], (array, index, value), sig.args, strict=True)
            ]
            context.get_function(known, sig)(builder, cast)
            return context.get_dummy_value()

        return signature(types.none, mask, array, index, value), plain

    def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
        place = _place(context, builder, (array, index), values[1:3])
        new = context.cast(builder, values[3], value, REAL)
        if isinstance(mask, Lanes):
            new = builder.select(values[0], new, builder.load(place, align=8))
        builder.store(new, place, align=8)
        return context.get_dummy_value()

    return signature(types.none, mask, array, index, value), code
