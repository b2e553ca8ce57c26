# SPDX-License-Identifier: MIT
"""Safe expressions that select nodes or elements by rest position, such as ``X < 0.01 and abs(Y - 1) <= 0.5``.

X, Y, Z are rest coordinates [m], before the pose; ``group("tumour")`` holds at what a group of the mesh has (`nodes`,
`elements`). The text is parsed with `ast`, checked against a whitelist and
evaluated over arrays; Python never executes it. `and` and `or` evaluate their right side only where the left side has
not decided yet, as in Python, so ``X > 0 and 1/X < 3`` is safe at X = 0.
"""

import ast
import json
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.errors import InputError

if TYPE_CHECKING:
    from sim_server.mesh import Mesh

ALLOWED = (
    "allowed: the rest coordinates X, Y, Z [m], numbers, + - * / **, comparisons (< <= > >= == !=, also chained), "
    "and, or, not, parentheses, abs(a), sqrt(a), min(a, b, ...), max(a, b, ...), "
    'group("NAME") of the mesh, true'
)
MAX_LENGTH = 1000  # characters
MAX_DEPTH = 40  # levels of the syntax tree; bounds the recursion here and in ast.unparse

Kind = Literal["number", "truth"]
Members = Callable[[str], NDArray[np.bool_]]  # which points are in a group, by its name; raises InputError
AXES = {"X": 0, "Y": 1, "Z": 2}
ARITHMETIC: dict[type[ast.AST], Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
COMPARISON: dict[type[ast.AST], Callable] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
UNARY: dict[str, Callable] = {"abs": np.abs, "sqrt": np.sqrt}
FOLDED: dict[str, Callable] = {"min": np.minimum, "max": np.maximum}


@dataclass(frozen=True)
class _Places:
    """Points (n, 3) [m] and their groups. rows: their numbers among those of `members`, None for all of these."""

    points: Float64
    members: Members | None = None
    rows: NDArray[np.integer] | None = None

    def some(self, chosen: NDArray[np.integer]) -> "_Places":
        return _Places(self.points[chosen], self.members, chosen if self.rows is None else self.rows[chosen])

    def within(self, group: str) -> NDArray[np.bool_]:
        if self.members is None:
            raise InputError(f"group({group!r}): there is no mesh with groups here")
        held = self.members(group)
        return held.copy() if self.rows is None else held[self.rows]


def nodes(expression: str, mesh: "Mesh") -> NDArray[np.bool_]:
    """Returns the nodes of a mesh that an expression chooses, (n,). Raises InputError as `mask` does."""
    return mask(expression, mesh.rest, mesh.nodes_of)


def elements(expression: str, mesh: "Mesh") -> NDArray[np.bool_]:
    """Returns the tetrahedra of a mesh that an expression chooses, (m,), by their centroids and groups of elements.

    Raises InputError as `mask` does.
    """
    return mask(expression, mesh.centroids, mesh.elements_of)


def of_group(name: str, expression: str | None = None) -> str:
    """Returns the expression that chooses a group, and of it what another expression chooses."""
    chosen = f"group({json.dumps(name, ensure_ascii=False)})"
    return chosen if expression is None else f"{chosen} and ({expression})"


def mask(expression: str, points: Float64, members: Members | None = None) -> NDArray[np.bool_]:
    """Evaluates `expression` at `points` (n, 3) [m]; returns bool (n,).

    members: of groups; without it there are none
    Raises InputError if the text is not allowed, or if a value in it is not finite at some point.
    """
    try:
        return _truth(parse(expression), _Places(np.asarray(points, dtype=np.float64), members))
    except InputError as error:
        raise InputError(f"where = {shortened(expression)}: {error}") from None


def values(expression: str, points: Float64) -> Float64:
    """Evaluates an `expression` for a number, such as ``X * (1 + Y)``, at `points` (n, 3) [m]; returns (n,).

    Raises InputError as `mask` does.
    """
    try:
        return _number(parse(expression, "number"), _Places(np.asarray(points, dtype=np.float64)))
    except InputError as error:
        raise InputError(f"{shortened(expression)}: {error}") from None


def parse(expression: str, kind: Kind = "truth") -> ast.expr:
    """Returns the checked syntax tree of `expression`; raises InputError that says what is wrong and allowed."""
    if len(expression) > MAX_LENGTH:
        raise InputError(f"longer than {MAX_LENGTH} characters; {ALLOWED}")
    try:
        tree = ast.parse(" ".join(expression.splitlines()).strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"cannot be read ({_reason(error)}); {ALLOWED}") from None
    if _depth(tree) > MAX_DEPTH:
        raise InputError(f"nested more than {MAX_DEPTH} levels deep; {ALLOWED}")
    try:
        _expect(tree, kind)
    except InputError as error:
        raise InputError(f"{error}; {ALLOWED}") from None
    return tree


def _depth(tree: ast.AST) -> int:
    level, depth = [tree], 0
    while level:
        level, depth = [child for node in level for child in ast.iter_child_nodes(node)], depth + 1
    return depth


def shortened(text: str, longest: int = 80) -> str:
    """Quotes `text` for a message, cut after `longest` characters."""
    return repr(text if len(text) <= longest else text[:longest] + "...")


def _reason(error: Exception) -> str:
    return error.msg if isinstance(error, SyntaxError) else (str(error) or type(error).__name__)


def _expect(node: ast.expr, kind: Kind) -> None:
    found = _kind(node)
    if found != kind:
        wanted = "a comparison, not a number" if kind == "truth" else "a number, not a comparison"
        raise InputError(f"'{ast.unparse(node)}' must be {wanted}")


def _kind(node: ast.expr) -> Kind:
    """Returns the kind of value of a whitelisted node; checks its children on the way."""
    match node:
        case ast.BoolOp(values=values):
            return _checked("truth", values, "truth")
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return _checked("truth", [operand], "truth")
        case ast.Compare(left=left, ops=ops, comparators=rest) if all(type(op) in COMPARISON for op in ops):
            return _checked("number", [left, *rest], "truth")
        case ast.BinOp(left=left, op=op, right=right) if type(op) in ARITHMETIC:
            return _checked("number", [left, right], "number")
        case ast.UnaryOp(op=op, operand=operand) if type(op) in ARITHMETIC:
            return _checked("number", [operand], "number")
        case ast.Call(func=ast.Name(id="group"), args=[ast.Constant(value=str())], keywords=[]):
            return "truth"
        case ast.Call(func=ast.Name(id="group")):
            raise InputError(f"'{ast.unparse(node)[:60]}': group takes one name in quotes")
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _check_call(name, len(arguments))
            return _checked("number", arguments, "number")
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            _check_number(value)
            return "number"
        case ast.Name(id=name):
            return _kind_of_name(name)
    raise InputError(f"'{ast.unparse(node)[:60]}' is not allowed")


def _checked(children: Kind, nodes: list[ast.expr], result: Kind) -> Kind:
    for node in nodes:
        _expect(node, children)
    return result


def _kind_of_name(name: str) -> Kind:
    if name in AXES:
        return "number"
    if name == "true":
        return "truth"
    hint = f" (write {name.upper()})" if name.upper() in AXES else ""
    raise InputError(f"unknown name '{name[:40]}'{hint}")


def _check_call(name: str, count: int) -> None:
    if name not in UNARY and name not in FOLDED:
        raise InputError(f"unknown function '{name[:40]}'")
    if name in UNARY and count != 1:
        raise InputError(f"{name} takes one value, not {count}")
    if name in FOLDED and count < 2:
        raise InputError(f"{name} takes two or more values, not {count}")


def _check_number(value: int | float) -> None:
    try:
        finite = math.isfinite(float(value))
    except OverflowError:
        finite = False
    if not finite:
        raise InputError("a number is too large for 64-bit floats")


def _truth(node: ast.expr, places: _Places) -> NDArray[np.bool_]:
    match node:
        case ast.BoolOp(op=op, values=[first, *rest]):
            held = _truth(first, places)
            for value in rest:
                undecided = np.flatnonzero(held if isinstance(op, ast.And) else ~held)
                held[undecided] = _truth(value, places.some(undecided))
            return held
        case ast.UnaryOp(operand=operand):
            return ~_truth(operand, places)
        case ast.Compare(left=left, ops=ops, comparators=rest):
            values = [_number(n, places) for n in (left, *rest)]
            pairs = zip(ops, values, values[1:], strict=False)
            return reduce(np.logical_and, [COMPARISON[type(op)](a, b) for op, a, b in pairs])
        case ast.Call(args=[ast.Constant(value=str() as group)]):
            return places.within(group)
    return np.ones(len(places.points), dtype=bool)  # true


def _number(node: ast.expr, places: _Places) -> Float64:
    match node:
        case ast.Name(id=name):
            return places.points[:, AXES[name]]
        case ast.Constant(value=value):
            return np.full(len(places.points), float(value))  # type: ignore[arg-type]  # parse() let only numbers through
    with np.errstate(all="ignore"):
        values = _computed(node, places)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        at = ", ".join(f"{c:.6g}" for c in places.points[bad[0]])
        raise InputError(f"'{ast.unparse(node)}' is not a finite number at the point ({at}); {ALLOWED}")
    return values


def _computed(node: ast.expr, places: _Places) -> Float64:
    match node:
        case ast.BinOp(left=left, op=op, right=right):
            return ARITHMETIC[type(op)](_number(left, places), _number(right, places))
        case ast.UnaryOp(op=op, operand=operand):
            return ARITHMETIC[type(op)](_number(operand, places))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            values = [_number(a, places) for a in arguments]
            return UNARY[name](values[0]) if name in UNARY else reduce(FOLDED[name], values)
    raise AssertionError(ast.dump(node))  # parse() refused everything else
