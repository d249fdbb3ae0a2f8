"""Kernels compiled a second time, for lanes: the same source, its branches turned into masks.

A branch whose condition may differ from lane to lane is taken by the lanes that it holds for: both
sides are gone through, each under a mask, and one that no lane is in is left out. What is assigned
under a mask keeps its value in the other lanes, also in arrays; a return takes its lanes out of
what follows; a loop runs until no lane is in it. Whether a condition differs is known by its type
when the kernel is compiled (`ehbench.plant.lanes.vectors`): one on the integers of a layout is a
plain truth, and its branch stays one.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ehbench.plant.build import Plant
from ehbench.plant.lanes import vectors
from ehbench.runtime.compiled import Kernel

_HELPERS = {
    f"lane_{name}": getattr(vectors, name)
    for name in (
        *("enters", "enters_not", "within", "without", "both", "either", "negated", "chosen"),
        *("picked", "larger", "smaller", "square", "whole", "most", "taken", "put", "power"),
    )
}
_CHEAP = (ast.Name, ast.Constant, ast.Attribute, ast.UnaryOp, ast.Compare, ast.BinOp)


class Unconverted(NotImplementedError):
    """A kernel says something that there is no form for in lanes."""


@dataclass(frozen=True, eq=False)
class _Mask:
    """A mask in the code: the name of its variable; the mask that it lies within, and by what: a
    helper and the variable of a condition.
    """

    name: str
    parent: _Mask | None = None
    helper: str = ""
    condition: str = ""

    @property
    def line(self) -> list[_Mask]:
        """The masks that it lies within, from the outermost to itself."""
        return [*(self.parent.line if self.parent else []), self]


def _apart(mask: _Mask, others: Sequence[_Mask]) -> ast.expr | None:
    """A mask among the lanes of the innermost one that others lie within too; None where that is
    itself. What lies outside has no value that must be kept.
    """
    shared = mask.line
    for other in others:
        shared = [item for item in shared if item in other.line]
    if shared[-1] is mask:
        return None
    built: ast.expr = ast.Constant(True)
    for item in mask.line[len(shared) :]:
        built = _call(item.helper, built, item.condition)
    return built


class LaneKernel:
    """A kernel's second form, whose first argument is the mask of the lanes that it is for."""

    def __init__(self, function: Callable, options: Mapping[str, Any]) -> None:
        self._function, self._options, self._made = function, options, None

    @property
    def _numba_type_(self) -> Any:
        if self._made is None:  # only a compiler asks
            self._made = Kernel(converted(self._function), self._options, kept=False)
        return self._made._numba_type_


_KNOWN: dict[int, Any] = {}


def of(thing: Any) -> Any:
    """The second form of a kernel, or of a choice among kernels."""
    if id(thing) not in _KNOWN:
        _KNOWN[id(thing)] = thing, _second(thing)
    return _KNOWN[id(thing)][1]


def _second(thing: Any) -> Any:
    if hasattr(thing, "generic"):
        return of(thing.generic.kernels[Plant])
    if not hasattr(thing, "__code__") and not isinstance(thing, Kernel):
        raise Unconverted(f"{thing} is no kernel")
    # a plain function where nothing is compiled
    function, options = thing.made_of if hasattr(thing, "made_of") else (thing, {})
    return LaneKernel(function, options)


def converted(function: Callable) -> Callable:
    """A kernel's function in its second form."""
    source = getattr(function, "text", None) or textwrap.dedent(inspect.getsource(function))
    tree: Any = ast.parse(source).body[0]
    enclosed = inspect.getclosurevars(function).nonlocals
    space = {**function.__globals__, **enclosed, **_HELPERS}
    built = _Converter(tree, space).definition()
    module = ast.fix_missing_locations(ast.Module([built], []))
    exec(
        compile(ast.unparse(module), f"<lanes of {function.__module__}.{tree.name}>", "exec"), space
    )
    return space[built.name]


def _name(name: str, store: bool = False) -> ast.Name:
    return ast.Name(name, ast.Store() if store else ast.Load())


def _call(name: str, *args: ast.expr | str) -> ast.Call:
    return ast.Call(_name(name), [_name(a) if isinstance(a, str) else a for a in args], [])


def _set(name: str, value: ast.expr) -> ast.Assign:
    return ast.Assign([_name(name, True)], value)


def _leaves(statements: Sequence[ast.stmt], kind: type) -> bool:
    """Whether a statement of this kind is among these, of this loop where it leaves one."""
    for statement in statements:
        if isinstance(statement, kind):
            return True
        if isinstance(statement, ast.If) and (
            _leaves(statement.body, kind) or _leaves(statement.orelse, kind)
        ):
            return True
        if kind is ast.Return and isinstance(statement, (ast.For, ast.While)):
            if _leaves(statement.body, kind):
                return True
    return False


def _ends(statements: Sequence[ast.stmt]) -> bool:
    """Whether every way through these returns."""
    if not statements:
        return False
    last = statements[-1]
    if isinstance(last, ast.If):
        return _ends(last.body) and _ends(last.orelse)
    return isinstance(last, ast.Return)


def _nested(statements: list[ast.stmt]) -> list[ast.stmt]:
    """The same, what follows a branch that returns as its other side."""
    for i, statement in enumerate(statements):
        rest = statements[i + 1 :]
        if isinstance(statement, ast.If):
            body, other = statement.body, statement.orelse
            if rest and _ends(body):
                body, other, rest, statements = body, [*other, *rest], [], statements[: i + 1]
            elif rest and other and _ends(other):
                body, rest, statements = [*body, *rest], [], statements[: i + 1]
            new = ast.If(statement.test, _nested(body), _nested(other))
            return [*statements[:i], new, *_nested(rest)]
    return statements


class _Converter:
    """One function on its way into lanes."""

    def __init__(self, tree: ast.FunctionDef, space: dict[str, Any]) -> None:
        self.tree, self.space, self.count = tree, space, 0
        arguments = tree.args.args
        self.local = {a.arg for a in arguments}
        for node in ast.walk(tree):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                self.local.add(node.id)
        self.root = _Mask("lane_mask")
        self.assigned: dict[str, list[_Mask]] = {a.arg: [self.root] for a in arguments}
        self.results = 0
        self.gone = False
        self.left: str | None = None

    def fresh(self, stem: str) -> str:
        """A name that nothing has yet."""
        self.count += 1
        return f"lane_{stem}_{self.count}"

    def inner(self, mask: _Mask, helper: str, condition: str) -> tuple[_Mask, list[ast.stmt]]:
        """(a mask within another, the statements under it, of which the first makes it)."""
        built = _Mask(self.fresh("mask"), mask, helper, condition)
        return built, [_set(built.name, _call(helper, mask.name, condition))]

    def definition(self) -> ast.FunctionDef:
        """The function in lanes."""
        body = [item for item in self.tree.body if not _is_text(item)]
        returned = [item for item in ast.walk(self.tree) if isinstance(item, ast.Return)]
        values = [item.value for item in returned if item.value is not None]
        self.results = max((len(v.elts) for v in values if isinstance(v, ast.Tuple)), default=0)
        direct = not returned or (len(returned) == 1 and body[-1] is returned[0])
        out: list[ast.stmt] = []
        if direct:
            self.block(body, self.root, out, True)
        else:
            body = _nested(body)
            out.append(_set("lane_gone", ast.Constant(False)))
            self.gone = True
            self.block(body, self.root, out, True)
            if values:
                out.append(ast.Return(self.result()))
        if not out:
            out.append(ast.Pass())
        given = [ast.arg(self.root.name), *(ast.arg(a.arg) for a in self.tree.args.args)]
        args = ast.arguments([], given, None, [], [], None, self.tree.args.defaults)
        return ast.FunctionDef(
            name=f"lanes_{self.tree.name}", args=args, body=out, decorator_list=[]
        )

    def result(self) -> ast.expr:
        """What the function returns, of its parts."""
        if not self.results:
            return _name("lane_result")
        parts = [_name(f"lane_result_{i}") for i in range(self.results)]
        return ast.Tuple(list(parts), ast.Load())

    # statements

    def block(
        self, statements: Sequence[ast.stmt], mask: _Mask, out: list[ast.stmt], tail: bool
    ) -> None:
        """Statements under a mask; ``tail`` where nothing follows them in the function."""
        for i, statement in enumerate(statements):
            last = i + 1 == len(statements)
            self.statement(statement, mask, out, tail and last)
            if last:
                return
            gone = self._taken_out(statement)
            if gone:
                condition = self.fresh("condition")
                out.append(_set(condition, _name(gone)))
                inner, body = self.inner(mask, "lane_without", condition)
                self.block(statements[i + 1 :], inner, body, tail)
                out.append(ast.If(_call("lane_enters_not", mask.name, condition), body, []))
                return

    def _taken_out(self, item: ast.stmt) -> str | None:
        """The variable of the lanes that a statement may have taken out of what follows."""
        if isinstance(item, ast.If) and _leaves([item], ast.Break):
            return self.left
        return "lane_gone" if self.gone and _leaves([item], ast.Return) else None

    def statement(self, item: ast.stmt, mask: _Mask, out: list[ast.stmt], tail: bool) -> None:
        """One of them."""
        if isinstance(item, ast.Assign):
            self.assign(item, mask, out)
        elif isinstance(item, ast.AugAssign):
            old: Any = ast.parse(ast.unparse(item.target), mode="eval").body
            value = self.value(ast.BinOp(old, item.op, item.value), mask, out)
            self.store(item.target, value, mask, out)
        elif isinstance(item, ast.If):
            self.branch(item, mask, out, tail)
        elif isinstance(item, ast.For):
            self.loop(item, mask, out)
        elif isinstance(item, ast.While):
            self.while_loop(item, mask, out)
        elif isinstance(item, ast.Return):
            self.leave(item, mask, out, tail)
        elif isinstance(item, ast.Break):
            out.append(_set(self.left or "", _call("lane_either", self.left or "", mask.name)))
        elif isinstance(item, ast.Expr):
            if not _is_text(item):
                out.append(ast.Expr(self.value(item.value, mask, out)))
        elif not isinstance(item, ast.Pass):
            raise Unconverted(f"{self.tree.name}: {ast.unparse(item)}")

    def assign(self, item: ast.Assign, mask: _Mask, out: list[ast.stmt]) -> None:
        """``a = …``, ``a, b = …`` and ``a = b = …``."""
        first = item.targets[0]
        if isinstance(first, ast.Tuple):
            self.unpack(first, item.value, mask, out)
            return
        value = self.value(item.value, mask, out)
        if len(item.targets) > 1 or not isinstance(first, ast.Name):
            retained = self.fresh("value")
            out.append(_set(retained, value))
            value = _name(retained)
        for target in item.targets:
            self.store(target, value, mask, out)

    def unpack(self, target: ast.Tuple, value: ast.expr, mask: _Mask, out: list[ast.stmt]) -> None:
        parts: list[ast.expr] = []
        if isinstance(value, ast.Tuple):
            for each in value.elts:
                retained = self.fresh("value")
                out.append(_set(retained, self.value(each, mask, out)))
                parts.append(_name(retained))
        else:
            retained = self.fresh("value")
            out.append(_set(retained, self.value(value, mask, out)))
            for i in range(len(target.elts)):
                parts.append(ast.Subscript(_name(retained), ast.Constant(i), ast.Load()))
        for each, part in zip(target.elts, parts, strict=True):
            if not (isinstance(each, ast.Name) and each.id == "_"):
                self.store(each, part, mask, out)

    def store(self, target: ast.expr, value: ast.expr, mask: _Mask, out: list[ast.stmt]) -> None:
        """Give a variable, or a place of an array, a value under a mask."""
        if isinstance(target, ast.Subscript):
            array, index = self.value(target.value, mask, out), self.index(target, mask, out)
            out.append(ast.Expr(_call("lane_put", mask.name, array, index, value)))
        elif isinstance(target, ast.Name):
            before = self.assigned.setdefault(target.id, [])
            apart = _apart(mask, before)
            if apart is not None:
                value = _call("lane_chosen", apart, value, target.id)
            before.append(mask)
            out.append(_set(target.id, value))
        else:
            raise Unconverted(f"{self.tree.name}: {ast.unparse(target)} = …")

    def branch(self, item: ast.If, mask: _Mask, out: list[ast.stmt], tail: bool) -> None:
        """Both sides of an ``if``, each for its lanes."""
        condition = self.fresh("condition")
        out.append(_set(condition, self.value(item.test, mask, out)))
        for side, enters, narrowed in (
            (item.body, "lane_enters", "lane_within"),
            (item.orelse, "lane_enters_not", "lane_without"),
        ):
            if side:
                inner, body = self.inner(mask, narrowed, condition)
                self.block(side, inner, body, tail)
                out.append(ast.If(_call(enters, mask.name, condition), body, []))

    def loop(self, item: ast.For, mask: _Mask, out: list[ast.stmt]) -> None:
        """A loop over a range; one whose end differs is gone through by each lane to its own."""
        head: Any = item.iter
        if not (isinstance(head, ast.Call) and isinstance(head.func, ast.Name)) or item.orelse:
            raise Unconverted(f"{self.tree.name}: for {ast.unparse(head)}")
        if _leaves(item.body, ast.Return) or _leaves(item.body, ast.Continue):
            raise Unconverted(f"{self.tree.name}: a way out of a loop")
        ends = [self.value(each, mask, out) for each in head.args]
        differs = len(ends) == 1 and isinstance(ends[0], ast.Name) and ends[0].id in self.local
        end = ends[0]
        if differs:
            ends = [_call("lane_most", end)]
        assert isinstance(item.target, ast.Name)
        before, body, inner = self.left, [], mask
        conditions: list[ast.expr] = []
        if differs:
            conditions.append(ast.Compare(_name(item.target.id), [ast.Lt()], [end]))
        if _leaves(item.body, ast.Break):
            self.left = self.fresh("left")
            out.append(_set(self.left, ast.Constant(False)))
            conditions.append(_call("lane_negated", self.left))
        self.guarded(item.body, conditions, inner, body)
        self.left = before
        target = _name(item.target.id, True)
        out.append(ast.For(target, _call("range", *ends), body, []))

    def guarded(
        self,
        statements: Sequence[ast.stmt],
        conditions: Sequence[ast.expr],
        mask: _Mask,
        out: list[ast.stmt],
    ) -> None:
        """Statements for the lanes of a mask for which all these hold."""
        if not conditions:
            self.block(statements, mask, out, False)
            return
        condition = self.fresh("condition")
        out.append(_set(condition, conditions[0]))
        inner, body = self.inner(mask, "lane_within", condition)
        self.guarded(statements, conditions[1:], inner, body)
        out.append(ast.If(_call("lane_enters", mask.name, condition), body, []))

    def while_loop(self, item: ast.While, mask: _Mask, out: list[ast.stmt]) -> None:
        """A loop that lanes leave one after the other."""
        if _leaves(item.body, ast.Return) or _leaves(item.body, ast.Continue) or item.orelse:
            raise Unconverted(f"{self.tree.name}: a way out of a loop")
        condition, still = self.fresh("condition"), self.fresh("still")
        inner = _Mask(self.fresh("mask"), mask, "lane_within", still)
        out += [_set(inner.name, _name(mask.name)), _set(still, ast.Constant(True))]
        before, self.left = self.left, None
        if _leaves(item.body, ast.Break):
            self.left = self.fresh("left")
            out.append(_set(self.left, ast.Constant(False)))
        body: list[ast.stmt] = []
        body.append(_set(condition, self.value(item.test, inner, body)))
        self.narrow(inner, still, "lane_enters", "lane_within", condition, body)
        self.block(item.body, inner, body, False)
        if self.left:
            self.narrow(inner, still, "lane_enters_not", "lane_without", self.left, body)
        self.left = before
        out.append(ast.While(ast.Constant(True), body, []))

    def narrow(
        self, mask: _Mask, still: str, enters: str, helper: str, condition: str, out: list[ast.stmt]
    ) -> None:
        """Keep the lanes of a loop that a condition leaves in it, and go on if there are any."""
        stop = ast.UnaryOp(ast.Not(), _call(enters, mask.name, condition))
        out.append(ast.If(stop, [ast.Break()], []))
        out.append(_set(mask.name, _call(helper, mask.name, condition)))
        out.append(_set(still, _call(helper, still, condition)))

    def leave(self, item: ast.Return, mask: _Mask, out: list[ast.stmt], tail: bool) -> None:
        """A return: of the function where it is the only one, else of the lanes here."""
        if not self.gone:
            out.append(
                ast.Return(None if item.value is None else self.value(item.value, mask, out))
            )
            return
        if item.value is not None and self.results:
            target = ast.Tuple(
                [_name(f"lane_result_{i}", True) for i in range(self.results)], ast.Store()
            )
            self.unpack(target, item.value, mask, out)
        elif item.value is not None:
            value = self.value(item.value, mask, out)
            self.store(_name("lane_result", True), value, mask, out)
        if not tail:
            out.append(_set("lane_gone", _call("lane_either", "lane_gone", mask.name)))

    # expressions; what has to be done before goes to ``out``

    def value(self, item: ast.expr, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        """An expression in lanes."""
        built = getattr(self, f"_{type(item).__name__.lower()}", None)
        if built is None:
            raise Unconverted(f"{self.tree.name}: {ast.unparse(item)}")
        return built(item, mask, out)

    def _constant(self, item: ast.Constant, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        return item

    def _name(self, item: ast.Name, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        return _name(item.id)

    def _tuple(self, item: ast.Tuple, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        return ast.Tuple([self.value(each, mask, out) for each in item.elts], ast.Load())

    def _starred(self, item: ast.Starred, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        return ast.Starred(self.value(item.value, mask, out), ast.Load())

    def _attribute(self, item: ast.Attribute, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        if isinstance(item.value, ast.Name) and item.value.id not in self.local:
            return item
        helper = f"lane_field_{item.attr}"
        self.space[helper] = vectors.field(item.attr)
        return _call(helper, self.value(item.value, mask, out))

    def index(self, item: ast.Subscript, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        """What stands in the brackets."""
        if isinstance(item.slice, ast.Slice):
            low, high = (
                None if end is None else self.value(end, mask, out)
                for end in (item.slice.lower, item.slice.upper)
            )
            return ast.Slice(low, high)
        return self.value(item.slice, mask, out)

    def _subscript(self, item: ast.Subscript, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        array, index = self.value(item.value, mask, out), self.index(item, mask, out)
        if isinstance(index, (ast.Slice, ast.Constant)) and not isinstance(item.value, ast.Name):
            return ast.Subscript(array, index, ast.Load())
        if isinstance(index, ast.Slice):
            return ast.Subscript(array, index, ast.Load())
        return _call("lane_taken", mask.name, array, index)

    def _unaryop(self, item: ast.UnaryOp, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        operand = self.value(item.operand, mask, out)
        if isinstance(item.op, ast.Not):
            return _call("lane_negated", operand)
        return ast.UnaryOp(item.op, operand)

    def _binop(self, item: ast.BinOp, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        left = self.value(item.left, mask, out)
        if isinstance(item.op, ast.Pow):
            if isinstance(item.right, ast.Constant) and item.right.value == 2:
                return _call("lane_square", left)
            return _call("lane_power", left, self.value(item.right, mask, out))
        return ast.BinOp(left, item.op, self.value(item.right, mask, out))

    def _compare(self, item: ast.Compare, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        ends = [self.value(each, mask, out) for each in (item.left, *item.comparators)]
        pairs = [
            ast.Compare(a, [op], [b]) for a, op, b in zip(ends, item.ops, ends[1:], strict=False)
        ]
        built: ast.expr = pairs[0]
        for each in pairs[1:]:
            built = _call("lane_both", built, each)
        return built

    def _boolop(self, item: ast.BoolOp, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        """``and`` and ``or``; what is not cheap is found for the lanes only that ask for it."""
        every = isinstance(item.op, ast.And)
        joined = "lane_both" if every else "lane_either"
        built = self.value(item.values[0], mask, out)
        for each in item.values[1:]:
            if _is_cheap(each):
                built = _call(joined, built, self.value(each, mask, out))
                continue
            retained = self.fresh("truth")
            out.append(_set(retained, built))
            enters = "lane_enters" if every else "lane_enters_not"
            inner, body = self.inner(mask, "lane_within" if every else "lane_without", retained)
            value = self.value(each, inner, body)
            body.append(_set(retained, _call(joined, retained, value)))
            out.append(ast.If(_call(enters, mask.name, retained), body, []))
            built = _name(retained)
        return built

    def _ifexp(self, item: ast.IfExp, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        condition = self.fresh("condition")
        out.append(_set(condition, self.value(item.test, mask, out)))
        if _is_cheap(item.body) and _is_cheap(item.orelse):
            sides = (self.value(each, mask, out) for each in (item.body, item.orelse))
            return _call("lane_picked", condition, *sides)
        retained = self.fresh("value")
        both = [(item.body, "lane_enters", "lane_within")]
        both.append((item.orelse, "lane_enters_not", "lane_without"))
        for side, enters, narrowed in both:
            inner, body = self.inner(mask, narrowed, condition)
            self.store(_name(retained, True), self.value(side, inner, body), inner, body)
            out.append(ast.If(_call(enters, mask.name, condition), body, []))
        return _name(retained)

    def _call(self, item: ast.Call, mask: _Mask, out: list[ast.stmt]) -> ast.expr:
        args = [self.value(each, mask, out) for each in item.args]
        if isinstance(item.func, ast.Attribute) and isinstance(item.func.value, ast.Name):
            function: Any = getattr(self.space[item.func.value.id], item.func.attr)
        elif isinstance(item.func, ast.Name):
            function = self.space.get(item.func.id, getattr(builtins, item.func.id, None))
        else:
            raise Unconverted(f"{self.tree.name}: {ast.unparse(item)}")
        if function in (max, min):
            built = args[0]
            for each in args[1:]:
                built = _call("lane_larger" if function is max else "lane_smaller", built, each)
            return built
        if function is int:
            return _call("lane_whole", *args)
        if function is len:
            return _call("len", *args)
        if function in vectors.FUNCTIONS:
            helper = f"lane_{function.__name__}"
            self.space[helper] = vectors.FUNCTIONS[function]
            return _call(helper, *args)
        helper = f"lanes_{ast.unparse(item.func)}"
        self.space[helper] = of(function)
        return _call(helper, mask.name, *args)


def _is_text(item: ast.stmt) -> bool:
    return isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant)


def _is_cheap(item: ast.expr) -> bool:
    """Whether it does no harm, and costs little, to find a value that may not be asked for."""
    cheap = (*_CHEAP, ast.expr_context, ast.operator, ast.cmpop, ast.unaryop)
    return all(isinstance(node, cheap) for node in ast.walk(item))
