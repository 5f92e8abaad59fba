"""Polynomials in symbols for lengths, and joint frames placed so that few lengths remain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import prod

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import shift_matrix
from asbuilt.description.lengths import add_symbols, evaluate_lengths, rotate_symbols
from asbuilt.description.model import RobotModel, Symbols
from asbuilt.description.rotation import placement
from asbuilt.dynamics.base.regrouping_relations import (
    LENGTH_EXPONENTS,
    SHIFT_LINEAR,
    SHIFT_SQUARE,
    RegroupingRelations,
    characteristic_length,
)

NUMBER = ""
"""The symbol that stands for 1, so that a plain length is a sum of symbols, too."""

ROBOTS_KEPT = 4
"""Robots whose slid frames are remembered, since many drives are asked of one."""
LENGTH_TOLERANCE = 1e-12
"""Symbols must stand for the lengths of a placement to this [m]."""


Monomial = tuple[str, ...]
"""The symbols of a product, sorted; a square has its symbol twice, the empty product is 1."""
COEFFICIENT_TOLERANCE = 1e-12
"""A coefficient below this is rounding; coefficients are plain numbers such as 1, 2 or a cosine."""


def symbolic_translation(
    transform: Array, symbols: Symbols | None, lengths: Mapping[str, float]
) -> Symbols:
    """Return the symbols of a placement's translation, or its numbers.

    The latter where it has no symbols or their values differ.
    """
    translation = transform[:3, 3]
    if (
        symbols is not None
        and np.abs(evaluate_lengths(symbols, {**lengths, NUMBER: 1.0}) - translation).max()
        < LENGTH_TOLERANCE
    ):
        return symbols
    return tuple(((float(value), NUMBER),) if value else () for value in translation)


@lru_cache(maxsize=ROBOTS_KEPT)
def slide_joint_frames(model: RobotModel) -> RobotModel:
    """Return the same robot with every joint frame slid along its axis.

    Each goes to the point nearest the origin of the parent link.

    The motion commutes with a translation along its axis: `before (1, z d) motion(q) after = before
    motion(q) (1, z d) after`.
    """
    values = {**model.lengths, NUMBER: 1.0}
    joints = []
    for joint in model.joints:
        z = joint.before[:3, 2]
        before = symbolic_translation(joint.before, joint.before_symbols, model.lengths)
        after = symbolic_translation(joint.after, joint.after_symbols, model.lengths)
        before_slid = add_symbols(before, rotate_symbols(-np.outer(z, z), before))
        after_slid = add_symbols(after, rotate_symbols(np.vstack([np.zeros((2, 3)), z]), before))
        joints.append(
            replace(
                joint,
                before=placement(joint.before[:3, :3], evaluate_lengths(before_slid, values)),
                after=placement(joint.after[:3, :3], evaluate_lengths(after_slid, values)),
                before_symbols=before_slid,
                after_symbols=after_slid,
            )
        )
    return replace(model, joints=tuple(joints))


def replace_lengths(model: RobotModel, lengths: Mapping[str, float]) -> RobotModel:
    """Return the robot with other values for the symbols of its joints."""
    values = {**lengths, NUMBER: 1.0}
    joints = []
    for joint in model.joints:
        before, after = (
            placement(
                transform[:3, :3],
                evaluate_lengths(symbolic_translation(transform, symbols, model.lengths), values),
            )
            for transform, symbols in (
                (joint.before, joint.before_symbols),
                (joint.after, joint.after_symbols),
            )
        )
        joints.append(replace(joint, before=before, after=after))
    return replace(model, joints=tuple(joints), lengths=dict(lengths))


class Polynomial:
    """Hold a polynomial in symbols: a factor for each product of symbols.

    >>> b3 = Polynomial({("b3",): 1.0})
    >>> (b3 + Polynomial.number(2.0)) * b3
    b3**2 + 2*b3
    """

    __slots__ = ("terms",)

    def __init__(self, terms: Mapping[Monomial, float]) -> None:
        self.terms = {
            monomial: factor
            for monomial, factor in terms.items()
            if abs(factor) > COEFFICIENT_TOLERANCE
        }

    @classmethod
    def number(cls, value: float) -> Polynomial:
        """Return a constant."""
        return cls({(): value})

    def __bool__(self) -> bool:
        return bool(self.terms)

    def __add__(self, other: Polynomial) -> Polynomial:
        total = dict(self.terms)
        for monomial, factor in other.terms.items():
            total[monomial] = total.get(monomial, 0.0) + factor
        return Polynomial(total)

    def __mul__(self, other: Polynomial) -> Polynomial:
        product: dict[Monomial, float] = {}
        for left, a in self.terms.items():
            for right, b in other.terms.items():
                monomial = tuple(sorted(left + right)) if left and right else left or right
                product[monomial] = product.get(monomial, 0.0) + a * b
        return Polynomial(product)

    def times(self, number: float) -> Polynomial:
        """Return the polynomial multiplied by a number."""
        return Polynomial({monomial: number * factor for monomial, factor in self.terms.items()})

    @property
    def constant(self) -> float | None:
        """The value of a polynomial without symbols, None where there are symbols."""
        return None if any(self.terms) else self.terms.get((), 0.0)

    def value(self, lengths: Mapping[str, float]) -> float:
        """Return the value at given lengths."""
        return sum(
            factor * prod(lengths[symbol] for symbol in monomial)
            for monomial, factor in self.terms.items()
        )

    def __repr__(self) -> str:
        return format_sum([("", self)]) or "0"


Row = dict[int, Polynomial]
"""A sparse vector over standard parameters."""


def null_rows(model: RobotModel, directions: Sequence[RegroupingRelations]) -> list[Row]:
    """Return the link parameters of all directions, in turn, with symbols for lengths."""
    physical = characteristic_length(model) ** LENGTH_EXPONENTS
    rows: list[Row] = []
    for found in directions:
        joint = model.joints[found.link]
        R = joint.after[:3, :3]
        back = rotate_symbols(
            -R.T, symbolic_translation(joint.after, joint.after_symbols, model.lengths)
        )
        there = symbolic_translation(joint.before, joint.before_symbols, model.lengths)
        for k in range(len(found.child)):
            row = _shift_parameters(found.child[k] * physical, R.T, back, 10 * found.link)
            if joint.parent >= 0:
                row |= _shift_parameters(
                    -found.onto_parent[k] * physical, joint.before[:3, :3], there, 10 * joint.parent
                )
            rows.append({column: entry for column, entry in row.items() if entry})
    return rows


def _shift_parameters(parameters: Array, rotation: Array, symbols: Symbols, first: int) -> Row:
    """Return the ten parameters after a turn and a shift by symbols, in columns `first` .

    `first + 9`.
    """
    turned = shift_matrix(placement(rotation)) @ parameters
    along = [
        Polynomial({() if symbol == NUMBER else (symbol,): factor for factor, symbol in axis})
        for axis in symbols
    ]
    total = [Polynomial.number(value) for value in turned]

    def gather(weight: Polynomial, vector: Array) -> None:
        for i in np.flatnonzero(vector):
            total[i] = total[i] + weight.times(float(vector[i]))

    for a in range(3):
        if along[a]:
            gather(along[a], SHIFT_LINEAR[a] @ turned)
            for b in range(3):
                if along[b]:
                    gather(along[a] * along[b], SHIFT_SQUARE[a, b] @ turned)
    return {first + i: entry for i, entry in enumerate(total) if entry}


def express_dependent_columns(rows: Sequence[Row], pivots: Sequence[int]) -> dict[int, Row] | None:
    """Return each dependent column as a sum of base columns.

    `column_j = sum_b result[j][b] column_b`, by elimination from the last pivot.

    None where this takes a division by symbols, or where the pivots are only right for special
    lengths.
    """
    waiting = [dict(row) for row in rows]
    done: dict[int, Row] = {}
    for pivot in sorted(pivots, reverse=True):
        candidates = [
            (row, constant) for row in waiting if pivot in row and (constant := row[pivot].constant)
        ]
        if not candidates:
            return None
        chosen, divisor = min(candidates, key=lambda item: (-round(abs(item[1]), 6), len(item[0])))
        waiting = [row for row in waiting if row is not chosen]
        unit = {column: entry.times(1.0 / divisor) for column, entry in chosen.items()}
        unit[pivot] = Polynomial.number(1.0)
        for row in (*waiting, *done.values()):
            if pivot in row:
                factor = row.pop(pivot).times(-1.0)
                for column, entry in unit.items():
                    if column != pivot:
                        total = row.get(column, Polynomial({})) + factor * entry
                        if total:
                            row[column] = total
                        else:
                            row.pop(column, None)
        done[pivot] = unit
    if any(max(row) != pivot for pivot, row in done.items()):
        return None
    return {
        pivot: {column: entry.times(-1.0) for column, entry in row.items() if column != pivot}
        for pivot, row in done.items()
    }


def format_coefficient(value: float) -> str:
    """Write a coefficient to ten digits, without the rounding noise of the last ones.

    >>> format_coefficient(0.16000000000000003)
    '0.16'
    """
    return f"{value:.10g}"


def _format_product(monomial: Monomial) -> str:
    powers = Counter(monomial)
    return "*".join(
        symbol if power == 1 else f"{symbol}**{power}" for symbol, power in powers.items()
    )


def format_sum(terms: Sequence[tuple[str, Polynomial]]) -> str:
    """Write a sum of (name, factor).

    Numbers first, then by falling degree in symbols, equal factors gathered.

    >>> b3 = Polynomial({("b3",): 1.0})
    >>> one, square = Polynomial.number(1.0), b3 * b3
    >>> format_sum([("Ixx2", one), ("my3", b3.times(-2.0)), ("m3", square), ("m4", square)])
    'Ixx2 + b3**2*(m3 + m4) - 2*b3*my3'
    """
    groups: dict[tuple[int, Monomial, str, str], list[tuple[bool, str]]] = {}
    for name, factor in terms:
        for monomial, value in factor.terms.items():
            key = (
                -len(monomial),
                monomial,
                format_coefficient(abs(value)),
                "" if monomial and name else name,
            )
            groups.setdefault(key, []).append((value < 0, name))
    constants = [key for key in groups if not key[1]]
    symbolic = sorted((key for key in groups if key[1]), key=lambda key: (key[0], key[1]))
    text = ""
    for key in (*constants, *symbolic):
        members = groups[key]
        negative = members[0][0]
        size = key[2]
        symbols = _format_product(key[1])
        names = members[0][1]
        if len(members) > 1:
            rest = "".join(
                f" {'-' if sign != negative else '+'} {name}" for sign, name in members[1:]
            )
            names = f"({names}{rest})"
        factors = [part for part in ("" if size == "1" else size, symbols, names) if part]
        product = "*".join(factors) or "1"
        text += (
            f" {'-' if negative else '+'} {product}"
            if text
            else f"{'-' if negative else ''}{product}"
        )
    return text
