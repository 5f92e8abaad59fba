"""Straight-line arithmetic in C: sums of products, numbers folded, each written once if used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Term:
    """Hold a number times a variable of the C function, or a plain number if `name` is empty."""

    factor: float
    name: str = ""

    def __neg__(self) -> Term:
        return Term(-self.factor, self.name)

    @property
    def is_zero(self) -> bool:
        """Whether the term is the number 0."""
        return self.factor == 0.0

    def written(self) -> str:
        """Return the C expression."""
        return _write_product(self.factor, self.name)


ZERO = Term(0.0)
ONE = Term(1.0)
Vector = tuple[Term, ...]


@dataclass
class StraightLine:
    """Collect definitions `const double x7 = ...;` in order, each sum of products once."""

    texts: dict[str, str] = field(default_factory=dict)
    needs: dict[str, tuple[str, ...]] = field(default_factory=dict)
    known: dict[object, Term] = field(default_factory=dict)

    def given(self, text: str, *needs: str) -> Term:
        """Define a variable by any C expression in the arguments of the function."""
        # Each expression is written once, however often it is used.
        if text not in self.known:
            self.known[text] = self._define(text, needs)
        return self.known[text]

    def total(self, *products: Sequence[Term]) -> Term:
        """Return the sum of products of at most two variables and any numbers.

        Like products are gathered, those with a zero dropped.
        """
        sums: dict[tuple[str, ...], float] = {}
        for product in products:
            factor = math.prod(term.factor for term in product)
            # Sorted, so that a b and b a are the same product.
            names = tuple(sorted(term.name for term in product if term.name))
            if factor != 0.0:
                sums[names] = sums.get(names, 0.0) + factor
        # Products that cancel are dropped.
        entries = tuple(sorted((names, factor) for names, factor in sums.items() if factor != 0.0))
        if not entries:
            return ZERO
        names, factor = entries[0]
        if len(entries) == 1 and len(names) <= 1:
            return Term(factor, "".join(names))
        # A product is defined without its number, and a sum with its first sign positive.
        # Signs and numbers are taken out, so that more sums are the same one.
        scale = factor if len(entries) == 1 else math.copysign(1.0, factor)
        entries = tuple((names, factor / scale) for names, factor in entries)
        return Term(scale, self._name_sum(entries).name)

    def sum(self, *terms: Term) -> Term:
        """Return the sum of terms."""
        return self.total(*[(term,) for term in terms])

    def used(self, answers: Sequence[Term]) -> list[str]:
        """Return the definitions that the answers need, in order."""
        wanted = {answer.name for answer in answers}
        # Backwards, as definitions need only earlier ones.
        for name in reversed(self.texts):
            if name in wanted:
                wanted.update(self.needs[name])
        return [
            f"const double {name} = {text};" for name, text in self.texts.items() if name in wanted
        ]

    def _name_sum(self, entries: tuple[tuple[tuple[str, ...], float], ...]) -> Term:
        if entries not in self.known:
            text = ""
            for names, factor in entries:
                sign = (" - " if text else "-") if factor < 0 else (" + " if text else "")
                text += sign + _write_product(abs(factor), *names)
            self.known[entries] = self._define(
                text, tuple(name for names, _ in entries for name in names)
            )
        return self.known[entries]

    def _define(self, text: str, needs: tuple[str, ...]) -> Term:
        name = f"x{len(self.texts)}"
        self.texts[name] = text
        self.needs[name] = needs
        return Term(1.0, name)


def _write_product(factor: float, *names: str) -> str:
    written = "*".join(name for name in names if name)
    if not written:
        return repr(float(factor))
    # A factor of one is not written.
    number = {1.0: "", -1.0: "-"}.get(factor, f"{float(factor)!r}*")
    return number + written
