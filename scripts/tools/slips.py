"""The plausible slips that can be made in a source file: one small change each, found in its syntax tree."""

from __future__ import annotations

import ast
import difflib
import re
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_NEGATED = {
    "<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "==",
    "is": "is not", "is not": "is", "in": "not in", "not in": "in",
}  # fmt: skip
_BOUNDARY = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}
_COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in",
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"), ast.Pow: ("**", "*"), ast.LShift: ("<<", ">>"), ast.RShift: (">>", "<<"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
_TWINS = {
    "min": "max", "minimum": "maximum", "any": "all", "sin": "cos", "ceil": "floor", "startswith": "endswith",
}  # fmt: skip
_TWINS |= {twin: name for name, twin in _TWINS.items()}
_ORDER_DOES_NOT_MATTER = {
    "min", "max", "minimum", "maximum", "hypot", "isinstance", "startswith", "endswith", "suppress",
}  # fmt: skip
_TYPES = {"bool", "int", "float", "str", "bytes", "dict", "list", "tuple", "set", "type"}
_TYPES |= {"Callable", "Literal", "Mapping", "Optional", "Sequence", "Union"}  # of aliases; nothing runs by their order
_TINY = 1e-3  # a tolerance; twice as much of it is no slip, a thousand times is


@dataclass(frozen=True, slots=True)
class Slip:
    """One change of a source file.

    Args:
        line: where it is.
        span: the first and the last line of the statement; of a compound one, of its head.
        what: in words.
        start: of the text that is replaced.
        end: of it.
        text: what comes instead.
    """

    line: int
    span: tuple[int, int]
    what: str
    start: int
    end: int
    text: str

    def apply(self, source: str) -> str:
        """Return the source with the slip."""
        return source[: self.start] + self.text + source[self.end :]

    def lines(self, source: str) -> list[str]:
        """Return the lines of the source that the slip changes.

        A diff of elements that are swapped on neighbouring lines may remove any of these lines.
        """
        return lines_of(source)[self.line - 1 : source.count("\n", 0, self.end) + 1]

    def diff(self, source: str) -> str:
        """Return the lines before and after, as a diff without its head."""
        lines = difflib.unified_diff(source.splitlines(), self.apply(source).splitlines(), n=0, lineterm="")
        return "\n".join(line for line in list(lines)[2:] if not line.startswith("@@"))


@lru_cache(maxsize=1)  # each of hundreds of slips of a module asks for them
def lines_of(source: str) -> list[str]:
    """Return the lines of a module."""
    return source.splitlines()


def find_slips(source: str) -> list[Slip]:
    """Return all slips that are known for a module, in the order of its lines.

    Left out is what no test should notice: annotations, decorators, docstrings, messages of errors, asserts, and what
    is imported for types.
    """
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    unique = {(slip.start, slip.end, slip.text): slip for slip in finder.slips}
    return sorted(unique.values(), key=lambda slip: (slip.start, slip.end, slip.text))


class _Finder(ast.NodeVisitor):
    def __init__(self, source: str) -> None:
        self.slips: list[Slip] = []
        self._source = source
        self._lines = source.splitlines(keepends=True)
        self._starts = [0, *accumulate(map(len, self._lines))]
        self._span = (1, 1)

    def visit(self, node: ast.AST) -> None:
        """Note which statement this is in, and look for slips."""
        outer = self._span
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            last = body[0].lineno - 1 if body else node.end_lineno or node.lineno
            self._span = (node.lineno, max(node.lineno, last))
        super().visit(node)
        self._span = outer

    # What is left out.

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Python 3.11 does not say where something is within an f-string."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """It is for the type checker."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Look at the value only."""
        if node.value is not None:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        """An argument has nothing but an annotation."""

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        """Look at the body only."""
        self._each(node.body)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Look at the body only."""
        self._each(node.body)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Look at defaults and body."""
        self._each([*node.args.defaults, *(default for default in node.args.kw_defaults if default), *node.body])

    # Statements.

    def visit_Raise(self, node: ast.Raise) -> None:
        """Do not raise."""
        self._put(node, "pass", "an error is not raised")

    def visit_Expr(self, node: ast.Expr) -> None:
        """Leave out a call."""
        if isinstance(node.value, ast.Call):
            self._put(node, "pass", "a call is left out")
            self.generic_visit(node)
        elif not isinstance(node.value, ast.Constant):
            self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        """Leave out setting an attribute or an element."""
        names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        if "__all__" in names or "__slots__" in names:
            return
        if isinstance(node.targets[0], ast.Attribute | ast.Subscript):
            self._put(node, "pass", "an assignment is left out")
        self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Leave out, or do the opposite."""
        self._put(node, "pass", "an assignment is left out")
        self._operator(node.op, node.target, node.value)
        self.visit(node.value)

    def visit_Delete(self, node: ast.Delete) -> None:
        """Leave out."""
        self._put(node, "pass", "a deletion is left out")

    def visit_Continue(self, node: ast.Continue) -> None:
        """Go on with the body."""
        self._put(node, "pass", "continue is left out")

    def visit_Break(self, node: ast.Break) -> None:
        """Go on with the loop."""
        self._put(node, "pass", "break is left out")

    def visit_Return(self, node: ast.Return) -> None:
        """Return nothing."""
        if node.value is not None:
            # None is as false as False, and callers ask whether it is true.
            if not (isinstance(node.value, ast.Constant) and (node.value.value is None or node.value.value is False)):
                self._put(node.value, "None", "None is returned")
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        """Do it in the other case."""
        if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
            self._condition(node.test)
            self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        """Loop in the other case."""
        self._condition(node.test)
        self.generic_visit(node)

    # Expressions.

    def visit_comprehension(self, node: ast.comprehension) -> None:
        """Take the others."""
        for test in node.ifs:
            self._condition(test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        """Swap both values."""
        test, body, other = map(self._text, (node.test, node.body, node.orelse))
        self._put(node, f"{other} if {test} else {body}", "both values of a condition are swapped")
        if isinstance(node.test, ast.Compare):  # to negate it would be the same slip
            self._compare(node.test, negate=False)
        else:
            self.visit(node.test)
        self._each([node.body, node.orelse])

    def visit_Compare(self, node: ast.Compare) -> None:
        """Compare otherwise."""
        self._compare(node, negate=len(node.ops) == 1)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """And for or, and the other way round."""
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in list(pairwise(node.values))[:1]:
            self._between(left, right, rf"\b{old}\b", new, f"{old} becomes {new}")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Leave out minus and not."""
        if isinstance(node.op, ast.Not | ast.USub):
            sign = "not" if isinstance(node.op, ast.Not) else "minus"
            self._put(node, self._text(node.operand), f"{sign} is left out")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Calculate otherwise."""
        if not any(map(_is_text_or_type, (node.left, node.right))):
            self._operator(node.op, node.left, node.right)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Another number."""
        value = node.value
        if isinstance(value, bool):
            self._put(node, str(not value), f"{value} becomes {not value}")
        elif isinstance(value, int | float):
            other = value + 1 if isinstance(value, int) else value * (1000 if value < _TINY else 2) or 1.0
            self._put(node, repr(other), f"{value} becomes {other}")

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """Leave types alone."""
        if not (isinstance(node.value, ast.Name) and node.value.id in _TYPES):
            self.generic_visit(node)

    def visit_Tuple(self, node: ast.Tuple) -> None:
        """Swap neighbours."""
        if isinstance(node.ctx, ast.Load):
            self._swap(node.elts, "elements")
            self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        """Swap arguments, or call its twin."""
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if name in _TWINS:
            end = self._at(node.func.end_lineno, node.func.end_col_offset)
            self._add(node.func, end - len(name), end, _TWINS[name], f"{name} becomes {_TWINS[name]}")
        if name not in _ORDER_DOES_NOT_MATTER:
            self._swap(node.args, "arguments")
        self.visit(node.func)
        for argument in node.args if name not in _ORDER_DOES_NOT_MATTER - set(_TWINS) else node.args[:1]:
            if name in _ORDER_DOES_NOT_MATTER and isinstance(argument, ast.Tuple):  # as of the ends of a text
                self._each(argument.elts)
            else:
                self.visit(argument)
        # `strict` guards against a mistake of our own, which is not there; by its `indent` JSON says the same.
        self._each([keyword.value for keyword in node.keywords if keyword.arg not in ("strict", "indent")])

    # How they are made.

    def _each(self, nodes: Sequence[ast.AST]) -> None:
        for node in nodes:
            self.visit(node)

    def _condition(self, test: ast.expr) -> None:
        if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp) or _is_chain(test):
            self._put(test, f"not ({self._text(test)})", "a condition is negated")

    def _compare(self, node: ast.Compare, *, negate: bool) -> None:
        operands = [node.left, *node.comparators]
        for op, (left, right) in zip(node.ops, pairwise(operands), strict=True):
            old = _COMPARISONS[type(op)]
            pattern = r"\s+".join(map(re.escape, old.split()))
            for new in (_NEGATED[old] if negate else "", _BOUNDARY.get(old, "")):
                if new:
                    self._between(left, right, pattern, new, f"{old} becomes {new}")
        among = any(isinstance(op, ast.In | ast.NotIn) for op in node.ops)
        for operand in operands:  # the order of those among whom something is looked for does not matter
            self._each(operand.elts if among and isinstance(operand, ast.Tuple) else [operand])

    def _operator(self, op: ast.operator, left: ast.expr, right: ast.expr) -> None:
        if type(op) in _OPERATORS:
            old, new = _OPERATORS[type(op)]
            self._between(left, right, re.escape(old), new, f"{old} becomes {new}")

    def _swap(self, nodes: Sequence[ast.expr], what: str) -> None:
        pairs = [pair for pair in pairwise(nodes) if not any(isinstance(node, ast.Starred) for node in pair)]
        pairs = [pair for pair in pairs if self._text(pair[0]) != self._text(pair[1])]
        for left, right in pairs if len(pairs) < 3 else (pairs[0], pairs[-1]):
            start, end = self._range(left)[0], self._range(right)[1]
            comma = self._source[self._range(left)[1] : self._range(right)[0]]
            self._add(left, start, end, self._text(right) + comma + self._text(left), f"two {what} are swapped")

    def _between(self, left: ast.expr, right: ast.expr, pattern: str, new: str, what: str) -> None:
        start, end = self._range(left)[1], self._range(right)[0]
        found = re.search(pattern, self._source[start:end])
        if found is not None:
            self._add(left, start + found.start(), start + found.end(), new, what)

    def _put(self, node: ast.expr | ast.stmt, text: str, what: str) -> None:
        self._add(node, *self._range(node), text, what)

    def _add(self, node: ast.expr | ast.stmt, start: int, end: int, text: str, what: str) -> None:
        line = self._source.count("\n", 0, start) + 1
        span = (min(self._span[0], line), max(self._span[1], node.lineno if isinstance(node, ast.expr) else line))
        self.slips.append(Slip(line=line, span=span, what=what, start=start, end=end, text=text))

    def _text(self, node: ast.expr) -> str:
        return self._source[slice(*self._range(node))]

    def _range(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        return self._at(node.lineno, node.col_offset), self._at(node.end_lineno, node.end_col_offset)

    def _at(self, line: int | None, column: int | None) -> int:
        text, start = self._lines[(line or 1) - 1], self._starts[(line or 1) - 1]
        # Columns are counted in bytes.
        return start + (column or 0 if text.isascii() else len(text.encode()[: column or 0].decode()))


def _is_chain(node: ast.expr) -> bool:
    return isinstance(node, ast.Compare) and len(node.ops) > 1


def _is_text_or_type(node: ast.expr) -> bool:
    """Whether arithmetic with it is no arithmetic."""
    if isinstance(node, ast.Constant):
        return node.value is None or isinstance(node.value, str | bytes)
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Name) and node.id in _TYPES)
