"""Choice among combinations of causes, and the shares of those chosen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.validation.attribution.cause_fits import CauseFits, CauseModel
from asbuilt.validation.attribution.causes import BEFORE, CAUSES


@dataclass(frozen=True, slots=True)
class ChoiceThresholds:
    """Limits by which combinations of causes are compared."""

    likely: float = 6.0
    """Difference of scores, as of deviances, up to which two combinations are about as likely (Kass
    and Raftery, J. Am. Stat. Assoc. 90, 1995: not strong evidence)."""
    share: float = 0.05
    """Smallest share of the error of causes that are compared with each other; own choice."""
    left: float = 0.5
    """Largest share of the error left by a combination that explains most of it; own choice."""
    own: float = 0.5
    """Largest part of the shares of two correlated causes that is lost without one; own choice."""


LIMITS = ChoiceThresholds()


class CauseChoice:
    """Choose the combination with the fewest causes among those about as likely as the best."""

    def __init__(self, fits: CauseFits) -> None:
        self.fits = fits

    @cached_property
    def rivals(self) -> tuple[CauseModel, ...]:
        """All possible combinations, the best first.

        A payload adds nothing to free links, so no combination has both.
        """
        fits = self.fits
        every = (
            frozenset(some)
            for size in range(len(fits.causes) + 1)
            for some in combinations(fits.causes, size)
        )
        models = [fits.fit(some) for some in every if not {"payload", "links"} <= some]
        return tuple(
            sorted(
                (model for model in models if model.possible),
                key=lambda model: (round(model.score, 6), len(model.causes)),
            )
        )

    @cached_property
    def chosen(self) -> CauseModel:
        """The combination chosen."""
        likely = [fit for fit in self.rivals if fit.score <= self.rivals[0].score + LIMITS.likely]
        return min(likely, key=lambda fit: len(fit.causes))

    @cached_property
    def rival(self) -> CauseModel | None:
        """The best other combination that is about as likely and lacks a cause chosen, or None."""
        return next(
            (
                fit
                for fit in self.rivals
                if self.chosen.causes - fit.causes
                and fit.score <= self.chosen.score + LIMITS.likely
            ),
            None,
        )

    @cached_property
    def undecided(self) -> CauseModel | None:
        """The combination that explains most of the error if too few samples let one be chosen."""
        if self.chosen.causes:
            return None

        def left(fit: CauseModel) -> float:
            return float(self.fits.weights**2 @ fit.rms**2)

        best = min(self.rivals, key=left)
        return best if left(best) < LIMITS.left * left(self.chosen) else None

    @property
    def has_payload(self) -> bool:
        """Whether the mass of a payload changes the torque of this robot at all."""
        return bool(self.fits.present[self.fits.columns["payload"][9]])

    @cached_property
    def possible_payload(self) -> tuple[CauseModel, float, float, Array]:
        """The fit with a payload instead of free links, its mass and error [kg], its centre [m]."""
        fit = self.fits.fit((self.chosen.causes - {"links"}) | {"payload"})
        places = self.fits.columns["payload"]
        body, error = fit.values[places], float(fit.std_errors[places][9])
        centre = body[6:9] / body[9] if body[9] else np.full(3, np.inf)
        return fit, float(body[9]), error, centre

    @cached_property
    def weighed(self) -> tuple[str, ...]:
        """The causes chosen, and a payload if it explains part of what changed links explain."""
        causes = self.chosen.causes
        if "links" in causes and "payload" in self.fits.causes:
            fit, *_ = self.possible_payload
            without = self.fits.fit(causes - {"links"})
            if fit.possible and fit.score < without.score:
                causes = causes | {"payload"}
        return tuple(cause for cause in CAUSES if cause in causes)

    @cached_property
    def sizes(self) -> dict[str, Array]:
        """The parameters of each cause weighed, (columns,).

        A general cause has what remains beside the special one that it contains: richer friction
        beside the nearest plain friction, joint by joint, and links beside the payload.
        """
        fits, weighed = self.fits, self.weighed
        inside = {
            cause: np.isin(np.arange(len(fits.names)), fits.columns[cause]) for cause in weighed
        }
        found = {cause: np.where(inside[cause], self.chosen.values, 0.0) for cause in weighed}
        if {"payload", "links"} <= set(weighed):
            found["payload"] = np.where(inside["payload"], self.possible_payload[0].values, 0.0)
            found["links"] = found["links"] - found["payload"]
        if {"friction", "richer friction"} <= set(weighed):
            for rows in fits.fitted:
                plain, rich = (
                    np.flatnonzero(inside[cause] & (np.abs(rows[:, :-1]) > 0).any(axis=0))
                    for cause in ("friction", "richer friction")
                )
                if plain.size and rich.size:
                    moved = np.linalg.lstsq(
                        rows[:, plain], rows[:, rich] @ self.chosen.values[rich], rcond=None
                    )[0]
                    found["friction"][plain] += moved
                    found["richer friction"][plain] -= moved
        return found

    def parts(self) -> dict[str, Array]:
        """Divide the drop of every joint's mean squared error among the causes weighed.

        With the torques y_i of the causes, e = tau - tau_CAD and r = e - sum y, the Shapley value
        of the drop |e|^2 - |e - sum_S y|^2 is y_i . (e + r).
        """
        data = self.fits.cause_data
        found = {cause: np.zeros(data.n_joints) for cause in self.weighed}
        for k, rows in enumerate(self.fits.judged):
            torque = {cause: rows[:, :-1] @ size for cause, size in self.sizes.items()}
            e = rows[:, -1]
            both = 2.0 * e - np.sum(list(torque.values()), axis=0) if torque else e
            for cause, y in torque.items():
                found[cause][k] = float(y @ both) / data.n_judged
        return found

    def correlated(self, shares: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
        """Return pairs of causes of which either explains what the other does, over all joints."""
        fits = self.fits
        size = fits.weights**2 * fits.fit(frozenset()).rms ** 2
        total = {cause: float(size @ share) for cause, share in shares.items()}
        causes = frozenset(total)

        def lost(*without: str) -> float:
            errors = (fits.fit(some).rms ** 2 for some in (causes - set(without), causes))
            return float(fits.weights**2 @ np.subtract(*errors))

        return tuple(
            (one, two)
            for one, two in combinations(total, 2)
            if BEFORE.get(two) != one
            and BEFORE.get(one) != two
            and min(total[one], total[two]) >= LIMITS.share * sum(size)
            and lost(one) < LIMITS.own * total[one]
            and lost(two) < LIMITS.own * total[two]
            and lost(one, two) > 2.0 * (lost(one) + lost(two))
        )
