"""Conversion formulas of measurement files, worked out without running anything of the file.

A formula is parsed by Python's own grammar and walked: whatever is not a number, the variable, an
operator or a function of the tables here is refused. ``^`` is a power, as ASAM writes it."""

import ast
import operator
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from ehbench.vocabulary import LogError, message

_FORMULA_LIMIT = 400  # characters; every step of a formula costs a pass over all samples
_VARIABLES = ("X", "X1")  # the readings
_TOKEN = re.compile(r"[A-Za-z]\w*|(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?!\w)|[-+*/^(), ]", re.ASCII)
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
# name: function, arguments; "log" is none of them: it means ln here and log10 there
_FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    **{name: (getattr(np, name), 1) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: (getattr(np, name), 1) for name in ("exp", "log10", "sqrt", "abs")},
    **{f"a{name}": (getattr(np, f"arc{name}"), 1) for name in ("sin", "cos", "tan")},
    **{f"arc{name}": (getattr(np, f"arc{name}"), 1) for name in ("sin", "cos", "tan")},
    "ln": (np.log, 1),
    "pow": (np.power, 2),
}


def evaluate(text: str, values: np.ndarray) -> np.ndarray:
    """What a formula such as ``25*(X1-0.4)`` makes of readings, NaN where that is no finite number.

    Raises:
        LogError: the formula has anything else in it than numbers, operators and functions.
    """
    calls = set(re.findall(r"[a-z]+(?=\s*\()", text.lower()[:_FORMULA_LIMIT]))
    key = "log" if "log" in calls else "condition" if calls & {"if", "iif"} else "not_understood"
    refusal = LogError(message(f"data.formula_{key}", formula=text))
    if len(text) > _FORMULA_LIMIT or _TOKEN.sub("", text):
        raise refusal
    readings = values.astype(float)

    def value_of(node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number)
            case ast.Name() if node.id in _VARIABLES:
                return readings
            case ast.UnaryOp() if type(node.op) in _OPERATORS:
                return _OPERATORS[type(node.op)](value_of(node.operand))
            case ast.BinOp() if type(node.op) in _OPERATORS:
                return _OPERATORS[type(node.op)](value_of(node.left), value_of(node.right))
            case ast.Call(func=ast.Name(id=name), keywords=[]) if name.lower() in _FUNCTIONS:
                function, count = _FUNCTIONS[name.lower()]
                if len(node.args) == count:
                    return function(*map(value_of, node.args))
        raise refusal

    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval")
        with np.errstate(all="ignore"):
            result = np.broadcast_to(value_of(tree.body), readings.shape).astype(float)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError):
        raise refusal from None
    return np.where(np.isfinite(result), result, np.nan)
