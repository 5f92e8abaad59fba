"""Feasible intervals of the quantities of a result: what physically consistent bodies allow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtri

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.formats.xml import close_match
from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import join_names
from asbuilt.identification.bodies.body_bounds import bound_stated, bound_with_certainty
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.bodies.feasible_region import FeasibleRegion
from asbuilt.identification.effects.effect import FoundEffect
from asbuilt.identification.result.as_built_parameters import (
    as_built_parameters,
    find_estimable_root,
)
from asbuilt.identification.result.result import IdentificationResult, Identified
from asbuilt.statistics import USUAL_ALPHA
from asbuilt.tables import format_plus_minus, format_range, round_significant

Region = Literal["each", "joint"]
"""Whether an interval holds with 95 % by itself, or all intervals together do."""
NARROW = 0.1
"""Half width, relative to the chosen value, up to which a value is stated without its interval."""
CENTRES = ("cx", "cy", "cz")
BODIES = ("payload", "link_mass")
"""Effects whose size is a mass of a link beyond CAD's."""
RESOLUTION = 1e-8
"""Least standard error of a base parameter, in its size by CAD: the solver resolves no less."""


@dataclass(frozen=True, slots=True)
class FeasibleInterval:
    """Hold the least and greatest value of a quantity over bodies that the recordings allow.

    Parameters
    ----------
    quantity
        Such as `mass`, `mass:link_3`, `armature:joint_2`, `Ixx:link_4` or `cx:link_4`.
    unit
        Its unit.
    least, greatest
        Ends of the interval, of 95 %; infinite if nothing bounds them.
    chosen
        Value of the robot as built; None if there is none.
    cad
        Value by CAD, None if the description has none.
    estimate, std_error
        Value and standard error if the recordings determine the quantity by itself, else None.
    confounded_with
        Standard parameters that take its place unseen.
    without_effect
        Standard parameters of the quantity itself on which no torque depends.
    """

    quantity: str
    unit: str
    least: float
    greatest: float
    chosen: float | None
    cad: float | None
    estimate: float | None = None
    std_error: float | None = None
    confounded_with: tuple[str, ...] = ()
    without_effect: tuple[str, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the recordings determine the quantity by itself."""
        return self.std_error is not None

    @property
    def is_narrow(self) -> bool:
        """Whether its ends are within a tenth of the chosen value, so that one number says it."""
        if self.chosen is None:
            return False
        reach = max(self.greatest - self.chosen, self.chosen - self.least)
        return bool(reach <= NARROW * abs(self.chosen))

    @property
    def text(self) -> str:
        """The interval with its unit, such as `3.9 kg or more`."""
        return format_range(self.least, self.greatest, self.unit)

    @property
    def sentence(self) -> str:
        """The quantity with its interval, what was chosen in it, and what it is confounded with."""
        parts = [f"{self.quantity} {self.text}"]
        if self.chosen is not None:
            parts.append(_describe_chosen(self.chosen, self.least, self.greatest))
        if self.estimate is not None:
            parts.append(f"determined {format_plus_minus(self.estimate, self.std_error)}")
        else:
            parts.append(self.why)
        return ", ".join(parts)

    @property
    def why(self) -> str:
        """Why the recordings do not determine it; empty if they do."""
        if self.determined:
            return ""
        if not self.confounded_with and not self.without_effect:
            return "bounded by physical consistency"
        if not self.confounded_with:
            return f"no torque depends on {join_names(self.without_effect, 4)}"
        return f"confounded with {join_names(self.confounded_with, 4)}"

    def holds(self, value: float) -> bool:
        """Return whether a value is in the interval."""
        return self.least <= value <= self.greatest

    def as_dict(self) -> dict[str, Any]:
        """Return the interval as plain data, None for open ends."""
        document: dict[str, Any] = make_plain(
            {
                "quantity": self.quantity,
                "unit": self.unit,
                "cad": self.cad,
                "feasible": [self.least, self.greatest],
                "chosen": self.chosen,
                "confounded_with": list(self.confounded_with),
                "without_effect": list(self.without_effect),
            }
        )
        if self.determined:
            document |= {"estimate": self.estimate, "std_error": self.std_error}
        return document


@dataclass(frozen=True, slots=True, eq=False)
class _Quantity:
    """Describe a linear function of the standard parameters, over another if there is a divisor."""

    name: str
    unit: str
    value: Array
    divisor: Array | None = None

    def of(self, chi: Array) -> float | None:
        """Return its value at standard parameters; None if that is unknown."""
        own = np.flatnonzero(self.value)
        below = 1.0 if self.divisor is None else float(self.divisor @ np.nan_to_num(chi))
        found = float(self.value[own] @ chi[own])
        return found / below if np.isfinite(found) and below > 0.0 else None


def feasible_intervals(
    result: IdentificationResult | Identified,
    quantities: Sequence[str] = (),
    *,
    prior: Literal["cad"] | None = None,
    tolerance: float = 0.2,
    geometry: bool = False,
    region: Region = "each",
    explained: bool = True,
) -> tuple[FeasibleInterval, ...]:
    """Return the least and greatest values over the bodies that the recordings allow.

    Of all bodies whose pseudo-inertias are positive semidefinite, with passive drives, that have
    base parameters within the 95 % region of the estimate: convex programs, exact to the solver's
    tolerance. The region is that of the weighted least squares, not regularised toward CAD, with
    errors that include lack of fit and bias. The exported robot is one of these bodies.

    Parameters
    ----------
    result
        The result, or its study.
    quantities
        `mass` (of all links), `mass:LINK`, `mass:LINK+LINK`, `com:LINK` (three axes) or `cx:LINK`,
        `mx:LINK`, `Ixx:LINK` in axes of the link at its origin, and a drive term or one of its
        symbols, `armature:JOINT`; without `:PLACE` of all links or joints. By default all masses
        and armatures.
    prior
        `"cad"`: masses of links are within `tolerance` of CAD.
    tolerance
        Largest relative error of a CAD mass.
    geometry
        Links lie within the boxes around the shapes in the robot's description, no denser than
        steel.
    region
        Whether each interval holds with 95 %, or all of them together.
    explained
        Whether what takes the place of a quantity unseen is named, which is a program of its own.

    Returns
    -------
    tuple of FeasibleInterval
        One for each quantity.

    Raises
    ------
    UsageError
        If there is no such quantity, link or joint, or the tolerance is not positive.
    IdentifiabilityError
        If no bodies meet the bounds, or the solver fails.
    DescriptionError
        If the description has no shapes.
    """
    result = result.result
    found = [each for text in quantities or _default(result) for each in _parse(result, text)]
    allowed = _recall_region(result, region)
    stated = prior is not None or geometry
    if stated:
        near = None if prior is None else tolerance
        allowed = allowed.within(bound_stated(allowed.prior, result.model, near, geometry=geometry))
    chosen = _find_chosen(result)
    cad = _read_cad(result)

    def bound(quantity: _Quantity) -> FeasibleInterval:
        def find_ends() -> tuple[float, float]:
            return allowed.find_interval(quantity.value, quantity.divisor)

        key = region, quantity.name, quantity.value.tobytes()
        # Verdict, exported file and tables ask for the same masses.
        ends = find_ends() if stated else result.once(key, find_ends)
        return _explain_ends(quantity, ends, allowed, chosen, cad, explained=explained)

    return tuple(map(bound, found))


def evaluate_quantities(
    result: IdentificationResult, quantities: Iterable[str], parameters: Array
) -> dict[str, float]:
    """Return the value of each quantity at standard parameters (n_standard,), where it has one."""
    each_value = {
        each.name: each.of(np.asarray(parameters))
        for text in quantities
        for each in _parse(result, text)
    }
    return {name: value for name, value in each_value.items() if value is not None}


def feasible_interval(
    result: IdentificationResult, quantity: str, of: str | None = None, **stated: Any
) -> FeasibleInterval:
    """Return the interval of one quantity, as `feasible_intervals` does of several.

    Raises `UsageError` if the text names several.
    """
    text = quantity if of is None else f"{quantity}:{of}"
    names = [each.name for each in _parse(result, text)]
    if len(names) > 1:
        raise UsageError(
            f"{text!r} names {len(names)} quantities, expected one: {join_names(names, 8)}"
        )
    (found,) = feasible_intervals(result, (text,), **stated)
    return found


def bound_effects(
    result: IdentificationResult, effects: Iterable[FoundEffect]
) -> tuple[FoundEffect, ...]:
    """Return effects with feasible intervals in place of errors where a size is undetermined.

    Of drive terms in the model, and of bodies beyond CAD: a payload, and another mass of a link.
    Their size is the chosen one.
    """
    found = []
    for effect in effects:
        own = _name_quantity(result, effect)
        interval = None if own is None else feasible_interval(result, own[0])
        if own is None or interval is None or interval.determined:
            found.append(effect)
            continue
        least = interval.least - own[1]
        greatest = interval.greatest - own[1]
        if effect.effect == "payload":
            least = max(least, 0.0)  # what is added has a mass
        chosen = interval.chosen
        if effect.effect in BODIES:
            # The other masses by CAD: one of the robots that the log allows, too.
            chosen = effect.estimate
            least = min(least, chosen)
            greatest = max(greatest, chosen)
        before = f"{format_plus_minus(effect.estimate, effect.std_error)} {effect.unit}"
        size = format_range(least, greatest, effect.unit)
        if chosen is not None:
            size += f", {_describe_chosen(chosen, least, greatest)}"
        end = f": {effect.improvement}"
        found.append(
            replace(
                effect,
                estimate=effect.estimate if chosen is None else chosen,
                std_error=None,
                feasible=(least, greatest),
                confounded_with=interval.confounded_with or interval.without_effect,
                text=effect.text.replace(before, size).replace(end, f", {interval.why}{end}"),
            )
        )
    return tuple(found)


def list_open(
    result: IdentificationResult, effects: Iterable[FoundEffect]
) -> Iterator[FoundEffect]:
    """Yield effects in the model whose drive parameters may all be zero, as far as is determined.

    One that other parameters replace unseen is not among them: whether it is there is no question
    that the torques could answer, and it is told with what it is confounded with.
    """
    for effect in effects:
        known = {
            symbol: quantity
            for symbol, quantity in _find_parameters(result, effect).items()
            if quantity is not None
        }
        # Most are not zero by their estimate alone, without a program.
        if any(
            _recall_region(result, "each").excludes_zero(quantity.value)
            for quantity in known.values()
        ):
            continue
        intervals = [feasible_interval(result, symbol, effect.joint) for symbol in known]
        if intervals and all(each.holds(0.0) and not each.confounded_with for each in intervals):
            yield effect


def _find_parameters(
    result: IdentificationResult, effect: FoundEffect
) -> dict[str, _Quantity | None]:
    """Return drive parameters of an effect in the model by symbol, None if the joint lacks one."""
    joint = effect.joint
    if not effect.in_model or joint is None:
        return {}
    terms = [term for term in result.base.drive.terms if term.key == effect.effect]
    return {s: _of_joint(result, s, joint) for term in terms for s in term.symbols}


def _name_quantity(result: IdentificationResult, effect: FoundEffect) -> tuple[str, float] | None:
    """Return the quantity that has the size of an effect, and what CAD has of it; None if none."""
    model = result.model
    if effect.effect in BODIES:
        link = model.tool_link
        if effect.joint is not None:
            link = result.base.link_joints.index(model.joint_names.index(effect.joint))
        return f"mass:{model.link_names[link]}", float(model.links[link].inertia.mass)
    # The first parameter of a term is its size.
    symbol, quantity = next(iter(_find_parameters(result, effect).items()), ("", None))
    return None if quantity is None else (f"{symbol}:{effect.joint}", 0.0)


def _explain_ends(
    quantity: _Quantity,
    ends: tuple[float, float],
    region: FeasibleRegion,
    chosen: Array | None,
    cad: Array,
    *,
    explained: bool,
) -> FeasibleInterval:
    least, greatest = ends
    alone = region.find_estimate(quantity.value)
    undetermined = quantity.value
    if quantity.divisor is not None and alone is not None:
        alone = _divide(alone, region.find_estimate(quantity.divisor))
        undetermined = quantity.divisor
    asked = explained and alone is None
    others, own = region.find_confounded(undetermined) if asked else ((), ())
    # Where bodies are consistent only far from the estimate, they say more than it does.
    if alone is not None and not least <= alone[0] <= greatest:
        alone = None
    estimate, error = (None, None) if alone is None else alone
    return FeasibleInterval(
        quantity.name,
        quantity.unit,
        least,
        greatest,
        None if chosen is None else quantity.of(chosen),
        quantity.of(cad),
        estimate,
        error,
        others,
        () if others else own,
    )


def _divide(
    value: tuple[float, float], divisor: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return a ratio with its error to first order, the correlation at its worst."""
    if divisor is None or divisor[0] <= 0.0:
        return None
    ratio = value[0] / divisor[0]
    return ratio, (value[1] + abs(ratio) * divisor[1]) / divisor[0]


def _recall_region(result: IdentificationResult, region: Region) -> FeasibleRegion:
    """Return the region of a result, found once."""
    return result.once((_find_region, region), lambda: _find_region(result, region))


def _find_region(result: IdentificationResult, region: Region) -> FeasibleRegion:
    """Return the region of a result, with passive drives and masses that are known."""
    cad = build_cad_prior(result.model, result.base.drive)
    base = result.base
    free = result.free
    covariance = np.array(result.covariance if free is None else free.covariance)
    size = np.abs(base.regrouping) @ np.abs(cad.parameters)
    covariance[np.diag_indices_from(covariance)] += (RESOLUTION * size) ** 2
    root = find_estimable_root(result, covariance)
    return FeasibleRegion(
        cad,
        base,
        result.estimates if free is None else free.estimates,
        root,
        bound_with_certainty(cad),
        float(chdtri(1 if region == "each" else len(root), USUAL_ALPHA)),
        _find_chosen(result),
    )


def _describe_chosen(chosen: float, least: float, greatest: float) -> str:
    """Return the value of the exported robot, and whether stated bounds exclude it."""
    beyond = max(least - chosen, chosen - greatest)
    # Ends are bounds of a solver: a hundredth of the value is no contradiction.
    outside = ", which what is stated excludes" if beyond > 0.01 * abs(chosen) else ""
    return f"chosen {round_significant(chosen)}{outside}"


def _find_chosen(result: IdentificationResult) -> Array | None:
    """Return the standard parameters of the exported robot; None if there is none."""
    try:
        found = as_built_parameters(result)
    except IdentifiabilityError:
        return None
    return found.parameters if found.consistent else None


def _read_cad(result: IdentificationResult) -> Array:
    """Return the standard parameters by CAD, NaN where the description has none."""
    model = result.model
    base = result.base
    cad = np.array(parameter_values(model, base.drive))
    for k, link in enumerate(model.links):
        if not link.inertia_known:
            cad[10 * k : 10 * k + 10] = np.nan
    if not model.drives_by_design:
        cad[10 * model.n_links :] = np.nan
    return cad


def _default(result: IdentificationResult) -> tuple[str, ...]:
    armature = ("armature",) if "armature" in result.base.drive.keys else ()
    masses = (f"mass:{link.name}" for link in result.model.links if not link.negligible)
    return ("mass", *masses, *armature)


def _parse(result: IdentificationResult, text: str) -> tuple[_Quantity, ...]:
    """Return the quantities that a text names."""
    kind, colon, places = text.strip().partition(":")
    kind = "mass" if kind == "m" else kind
    symbols = {symbol: term.key for term in result.base.drive.terms for symbol in term.symbols}
    if kind == "mass" and not colon:
        return (_sum_of_links(result, "mass", "m", result.model.link_names),)
    if kind in ("mass", "com", *CENTRES, *PARAMETER_NAMES):
        names = [places] if colon else [link.name for link in result.model.links]
        return tuple(each for name in names for each in _of_link(result, kind, name))
    of_drive = [symbol for symbol, key in symbols.items() if kind in (symbol, key)]
    if of_drive:
        names = [places] if colon else list(result.model.joint_names)
        known = [_of_joint(result, symbol, name) for name in names for symbol in of_drive]
        found = tuple(each for each in known if each is not None)
        if found:
            return found
        raise UsageError(f"{kind} was not identified at {places}", value=text)
    choices = ["mass", "com", *CENTRES, *PARAMETER_NAMES[:9], *dict.fromkeys(symbols.values())]
    raise UsageError(
        f"the result of {result.robot} has no quantity {text!r}{close_match(kind, choices)};"
        f" quantities are {', '.join(choices)}, each with :LINK or :JOINT",
        value=text,
    )


def _of_link(result: IdentificationResult, kind: str, places: str) -> tuple[_Quantity, ...]:
    """Return a quantity of a link, or the sum of several; the three axes of a centre of mass."""
    names = [places] if places in result.model.link_names else places.split("+")
    if kind == "mass":
        return (_sum_of_links(result, f"mass:{places}", "m", names),)
    if kind in ("com", *CENTRES):
        axes = CENTRES if kind == "com" else (kind,)
        mass = _sum_of_links(result, "", "m", names).value
        moments = [_sum_of_links(result, f"{axis}:{places}", f"m{axis[1]}", names) for axis in axes]
        return tuple(_Quantity(moment.name, "m", moment.value, mass) for moment in moments)
    return (_sum_of_links(result, f"{kind}:{places}", kind, names),)


def _sum_of_links(
    result: IdentificationResult, name: str, symbol: str, links: Iterable[str]
) -> _Quantity:
    """Return the sum of one inertial parameter over links, those of no account left out."""
    model = result.model
    base = result.base
    value = np.zeros(base.n_standard)
    unit = ""
    for link in links:
        if link not in model.link_names:
            known = model.link_names
            raise UsageError(
                f"{model.name} has no moving link {link!r}{close_match(link, known)}; its links"
                f" are {', '.join(known)}",
                value=link,
            )
        k = model.link_names.index(link)
        place = 10 * k + PARAMETER_NAMES.index(symbol)
        unit = base.standard_units[place]
        value[place] = float(not model.links[k].negligible)
    return _Quantity(name, unit, value)


def _of_joint(result: IdentificationResult, symbol: str, joint: str) -> _Quantity | None:
    """Return a drive parameter of a joint; None if the joint does not have it."""
    model = result.model
    base = result.base
    if joint not in model.joint_names:
        known = model.joint_names
        raise UsageError(
            f"{model.name} has no joint {joint!r}{close_match(joint, known)}; its joints are"
            f" {', '.join(known)}",
            value=joint,
        )
    place = base.standard_names.index(f"{symbol}{model.joint_names.index(joint) + 1}")
    if not np.any(base.regrouping[:, place]):
        return None
    value = np.zeros(base.n_standard)
    value[place] = 1.0
    (key,) = (term.key for term in base.drive.terms if symbol in term.symbols)
    return _Quantity(f"{key}:{joint}", base.standard_units[place], value)
