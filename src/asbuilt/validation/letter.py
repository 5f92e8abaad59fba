"""A letter for how well a model predicts motion that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.errors import UsageError
from asbuilt.tables import format_share

NO_BETTER = "F"
"""The letter of a model that is no better than none."""


@dataclass(frozen=True, slots=True)
class LetterRule:
    """Relative torque error `|tau - tau_hat| / |tau|` below which a model has each letter.

    `A` is what is left on arms with joint torque sensors if the model has all that acts (LWR4+ on
    another motion: 2 to 3 %); each further letter up to `D` allows twice as much. Predicting no
    torque at all has an error of 1, so that `E` is better than that, and `F` no better.
    """

    limits: tuple[tuple[str, float], ...] = (
        ("A", 0.03),
        ("B", 0.06),
        ("C", 0.12),
        ("D", 0.25),
        ("E", 1.0),
    )

    def letter(self, error: float) -> str:
        """Return the letter of a relative torque error on motion that was not fitted.

        Raises
        ------
        UsageError
            If the error is no number of 0 or more.

        Examples
        --------
        >>> LETTERS.letter(0.023), LETTERS.letter(0.24), LETTERS.letter(1.3)
        ('A', 'D', 'F')
        """
        if not error >= 0.0:
            # The first limit that the error is below.
            raise UsageError(f"a relative torque error is 0 or more, got {error}", value=error)
        return next((name for name, limit in self.limits if error < limit), NO_BETTER)

    @property
    def text(self) -> str:
        """The rule in a sentence."""
        (first, least), *graded, (last, _) = self.limits
        more = ", ".join(f"{name} {format_share(limit, 0)}" for name, limit in graded)
        return (
            f"{first} within {format_share(least, 0)}, {more}, {last} better than no model,"
            f" {NO_BETTER} no"
            " better"
        )


LETTERS = LetterRule()
"""The rule of every letter that is printed."""
