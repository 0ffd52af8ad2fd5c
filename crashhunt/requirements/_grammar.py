"""The language of requirements: the text of a formula is parsed with lark, and errors point at their place."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, cast

from lark import Lark, Token, Transformer, UnexpectedInput, UnexpectedToken

from crashhunt.base.errors import FormulaError
from crashhunt.base.text import did_you_mean, visible
from crashhunt.requirements._formula import (
    Apply,
    Compare,
    Join,
    Not,
    Number,
    Proposition,
    Signal,
    Temporal,
    Truth,
    Until,
    Window,
    children,
)
from crashhunt.requirements._requirement import Requirement

if TYPE_CHECKING:
    from crashhunt.requirements._formula import BinaryTemporal, Comparison, Formula, Node, Span, Term, UnaryTemporal

MAX_LENGTH = 10_000
"""Characters of the longest formula."""

MAX_DEPTH = 200
"""Nested operators and parentheses of the deepest formula."""

FUNCTIONS = {"abs": (1, 1), "sqrt": (1, 1), "min": (2, 99), "max": (2, 99)}
"""The functions, and their least and greatest number of arguments."""

_WORDS = (
    "and", "or", "not", "implies", "until", "since", "always", "eventually", "historically", "once", "true", "false",
)  # fmt: skip

# One grammar for terms and formulas, because both may stand in parentheses; the transformer distinguishes them.
_GRAMMAR = r"""
start: implication
?implication: disjunction (("->" | "implies") implication)?
?disjunction: conjunction ("or" conjunction)*
?conjunction: until ("and" until)*
?until: unary (UNTIL window? unary)?
?unary: NOT unary -> negation
      | TEMPORAL window? unary -> temporal
      | comparison
?comparison: addition (COMPARE addition)*
?addition: product (ADD product)*
?product: factor (MULTIPLY factor)*
?factor: ADD factor -> signed
       | atom
?atom: NUMBER -> number
     | TRUTH -> truth
     | NAME BEGIN [implication ("," implication)*] END -> call
     | NAME -> signal
     | BEGIN implication END -> group
window: "[" bound ":" bound "]"
bound: ADD? (NUMBER | INF)
INF: "inf"
NOT: "not"
BEGIN: "("
END: ")"
UNTIL.2: /(until|since)(?![\w.])/
TEMPORAL.2: /(always|eventually|historically|once)(?![\w.])/
TRUTH.2: /(true|false)(?![\w.])/
COMPARE: "<=" | ">=" | "==" | "!=" | "<" | ">"
ADD: "+" | "-"
MULTIPLY: "*" | "/"
NUMBER: /(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?(?![\w.])/
NAME: /[^\W\d]\w*(\.\w+|\[\d+\])*/
%ignore /\s+/
"""


def parse(text: str) -> Requirement:
    """Return the requirement that a formula states.

    Args:
        text: the formula, such as ``always (cut_in -> eventually[0:5] (headway_s >= 2))``.

    Raises:
        FormulaError: the text is no formula; the error shows the place.
    """
    if not isinstance(text, str):
        raise FormulaError(f"a requirement is {type(text).__name__}, not text", fix="give the formula as text")
    if not text.strip():
        raise FormulaError("the requirement is empty", fix='give a formula, such as "always (gap_m > 1)"')
    if len(text) > MAX_LENGTH:
        fix = f"give a formula of at most {MAX_LENGTH} characters"
        raise FormulaError(f"the requirement has {len(text)} characters", fix=fix)
    try:
        formula = cast("Formula", _parser().parse(text))
        _refuse_deep(formula)
    except UnexpectedInput as error:
        raise _pointed(text, _at_unexpected(text, error)) from None
    except _At as error:
        raise _pointed(text, error) from None
    return Requirement(text, formula)


class _At(Exception):  # noqa: N818 - becomes a FormulaError as soon as the text is known
    """A mistake, at a place in the text."""

    def __init__(self, span: Span, message: str, fix: str) -> None:
        super().__init__(message)
        self.span, self.message, self.fix = span, message, fix


def _pointed(text: str, error: _At) -> FormulaError:
    """Return the error with the part of the text around its place, and a caret under the place."""
    begin, end = error.span
    return FormulaError(error.message, fix=error.fix, text=text, begin=begin, end=end)


@cache
def _parser() -> Lark:
    return Lark(_GRAMMAR, parser="lalr", maybe_placeholders=False, transformer=_Nodes())


def _refuse_deep(formula: Formula) -> None:
    """Refuse a formula with more nested operators than Python's functions may call each other."""
    waiting: list[tuple[Node, int]] = [(formula, 1)]
    while waiting:
        node, depth = waiting.pop()
        if depth > MAX_DEPTH:
            fix = "split the formula into several requirements"
            raise _At(node.span, f"the requirement has more than {MAX_DEPTH} nested operators", fix)
        waiting += [(child, depth + 1) for child in children(node)]


def _at_unexpected(text: str, error: UnexpectedInput) -> _At:
    """Return the mistake behind a character or word that the grammar does not allow."""
    begin = error.pos_in_stream
    if begin is None or begin < 0 or (isinstance(error, UnexpectedToken) and error.token.type == "$END"):
        return _At((len(text), len(text)), "the requirement ends too early", _missing(text))
    if isinstance(error, UnexpectedToken):
        word, end = str(error.token), begin + len(error.token)
    else:
        found = re.match(r"[\d.]+[\w.]+|\w+|.", text[begin:], re.DOTALL)
        word = found[0] if found else text[begin]
        end = begin + len(word)
    before = text[:begin]
    last = re.search(r"([A-Za-z_][\w.]*)\s*$", before)
    opened = before.rfind("[")
    if opened > before.rfind("]"):
        return _At((begin, end), f"'{visible(word)}' is not a bound of a window", _WINDOW_FIX)
    if word == "=":
        return _At((begin, end), "'=' is not an operator", "write == to compare")
    if last is not None and (similar := did_you_mean(last[1], _WORDS)) and last[1] not in _WORDS:
        return _At((begin - len(last[0]), begin - len(last[0]) + len(last[1])), f"{last[1]!r} is unknown", similar)
    if word == "[" and last is not None and last[1] not in _WORDS:
        place = begin - len(last[0]), len(text) if (closed := text.find("]", begin)) < 0 else closed + 1
        fix = "give the number that crashhunt signals lists, such as observation[3]"
        return _At(place, "the index in brackets is not a number", fix)
    similar = did_you_mean(word, _WORDS) if word.isidentifier() and word not in _WORDS else ""
    operators = "a comparison, and, or, implies, ->, until or since"
    fix = (
        similar or f"join two formulas by an operator: {operators}" * word.isidentifier() or "correct the formula there"
    )
    return _At((begin, end), f"'{visible(word)}' is not expected here", fix)


_WINDOW_FIX = "write a window as [begin:end] in seconds, such as [0:5] or [2:inf]"


def _missing(text: str) -> str:
    opened = text.count("(") - text.count(")")
    return "close the parenthesis" if opened > 0 else "add what is missing at the end"


def _term(node: Node) -> Term:
    if not isinstance(node, Number | Signal | Apply):
        raise _At(node.span, "this is a condition, not a number", "compare or compute with numbers and signals only")
    return node


def _formula(node: Node) -> Formula:
    if isinstance(node, Number):
        raise _At(node.span, "this is a number, not a condition", "compare it, such as speed > 5")
    return Proposition(node.span, node) if isinstance(node, Signal | Apply) else node


def _span(first: Node | Token, last: Node | Token) -> Span:
    return _ends(first)[0], _ends(last)[1]


def _ends(part: Node | Token) -> Span:
    if isinstance(part, Token):
        assert part.start_pos is not None
        assert part.end_pos is not None
        return part.start_pos, part.end_pos
    return part.span


class _Nodes(Transformer[Token, "Node"]):
    """Makes the nodes while lark parses, and distinguishes terms from formulas."""

    def start(self, parts: list[Node]) -> Formula:
        return _formula(parts[0])

    def group(self, parts: list[Node | Token]) -> Node:
        begin, node, end = parts
        return replace(cast("Node", node), span=_span(begin, end))  # to show the part with its parentheses

    def implication(self, parts: list[Node]) -> Formula:
        left, right = map(_formula, parts)
        return Join(_span(left, right), "or", (Not(left.span, left), right))

    def disjunction(self, parts: list[Node]) -> Formula:
        return Join(_span(parts[0], parts[-1]), "or", tuple(map(_formula, parts)))

    def conjunction(self, parts: list[Node]) -> Formula:
        return Join(_span(parts[0], parts[-1]), "and", tuple(map(_formula, parts)))

    def until(self, parts: list[Node | Token | Window]) -> Formula:
        left, right = _formula(cast("Node", parts[0])), _formula(cast("Node", parts[-1]))
        return Until(
            span=_span(left, right), operator=cast("BinaryTemporal", str(parts[1])), window=_window_of(parts),
            left=left, right=right,
        )  # fmt: skip

    def negation(self, parts: list[Node | Token]) -> Formula:
        return Not(_span(parts[0], parts[1]), _formula(cast("Node", parts[1])))

    def temporal(self, parts: list[Node | Token | Window]) -> Formula:
        operator, formula = cast("Token", parts[0]), _formula(cast("Node", parts[-1]))
        return Temporal(
            span=_span(operator, formula), operator=cast("UnaryTemporal", str(operator)), window=_window_of(parts),
            formula=formula,
        )  # fmt: skip

    def comparison(self, parts: list[Node | Token]) -> Formula:
        terms = [_term(cast("Node", part)) for part in parts[::2]]
        signs = [cast("Comparison", str(part)) for part in parts[1::2]]
        pairs = zip(terms, signs, terms[1:], strict=False)
        made = tuple(
            Compare(span=_span(left, right), operator=sign, left=left, right=right) for left, sign, right in pairs
        )
        return made[0] if len(made) == 1 else Join(_span(terms[0], terms[-1]), "and", made)

    def addition(self, parts: list[Node | Token]) -> Term:
        made = _term(cast("Node", parts[0]))
        for sign, part in zip(parts[1::2], parts[2::2], strict=True):
            term = _term(cast("Node", part))
            made = Apply(_span(made, term), str(sign), (made, term))
        return made

    product = addition

    def signed(self, parts: list[Node | Token]) -> Term:
        sign, term = parts[0], _term(cast("Node", parts[1]))
        if sign == "+":
            return term
        if isinstance(term, Number):
            return Number(_span(sign, term), -term.value)
        return Apply(_span(sign, term), "neg", (term,))

    def number(self, parts: list[Token]) -> Term:
        return Number(_ends(parts[0]), _number(parts[0]))

    def truth(self, parts: list[Token]) -> Formula:
        return Truth(_ends(parts[0]), parts[0] == "true")

    def signal(self, parts: list[Token]) -> Term:
        if parts[0] in _WORDS:
            raise _At(_ends(parts[0]), f"{str(parts[0])!r} has no operand before it", "add the operand")
        return Signal(_ends(parts[0]), str(parts[0]))

    def call(self, parts: list[Node | Token]) -> Term:
        name, terms = cast("Token", parts[0]), parts[2:-1]
        if name not in FUNCTIONS:
            known = [*FUNCTIONS, *_WORDS]
            fix = did_you_mean(name, known) or f"the functions are {', '.join(FUNCTIONS)}"
            raise _At(_ends(name), f"'{visible(name)}' is not a function", fix)
        least, most = FUNCTIONS[name]
        if not least <= len(terms) <= most:
            wanted = f"{least} argument" if least == most else f"{least} or more arguments"
            raise _At(_ends(name), f"{name} has {len(terms)} arguments", f"give it {wanted}")
        return Apply(_span(name, parts[-1]), str(name), tuple(_term(cast("Node", part)) for part in terms))

    def window(self, parts: list[tuple[Span, float]]) -> Window:
        (first, begin), (last, end) = parts
        span = first[0] - 1, last[1] + 1
        if begin < 0 or end < 0:
            raise _At(span, "a window begins before 0 s", "use once, historically or since to look back")
        if math.isinf(begin):
            raise _At(span, "a window cannot begin at infinity", _WINDOW_FIX)
        if end < begin:
            raise _At(span, f"a window ends at {end:g} s, before it begins at {begin:g} s", "swap its bounds")
        return Window(begin, None if math.isinf(end) else end, span)

    def bound(self, parts: list[Token]) -> tuple[Span, float]:
        *sign, last = parts
        value = math.inf if last == "inf" else _number(last)
        return _span(parts[0], last), -value if sign == ["-"] else value


def _number(token: Token) -> float:
    value = float(token)
    if math.isinf(value):
        raise _At(_ends(token), "this number is too large", "give a number below 1.8e308")
    return value


def _window_of(parts: list[Node | Token | Window]) -> Window:
    return next((part for part in parts if isinstance(part, Window)), Window())
