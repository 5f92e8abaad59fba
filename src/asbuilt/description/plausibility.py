"""Whether mass properties can be of a robot's size: densities, radii of gyration, units, copies.

A physically consistent link may still be absurd: inertias in kg mm^2, masses in grams, a digit too
many. Its size tells, without any log.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import stretched_length
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure, Finding, Severity, join_names, rank_findings


def find_inconsistencies(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per physically inconsistent link.

    Such as `"link 4: Ixx + Iyy < Izz by 0.0009 kg m^2 (about the centre of mass)"`.

    Links are numbered from 1; `LinkInertia.inconsistency` states the condition (Wensing, Kim
    and Slotine, 2018). A link whose mass properties the description does not give is passed over.
    """
    return tuple(
        f"link {number}: {reason}"
        for number, link in enumerate(model.links, start=1)
        if link.inertia_known and (reason := link.inertia.inconsistency()) is not None
    )


LIGHTEST = 100.0
"""Density [kg/m^3] of a hollow housing with thin walls; foam and balsa are lighter."""
HEAVIEST = 20000.0
"""Density [kg/m^3] above tungsten's, 19300."""
EQUAL = 1e-6
"""Relative difference below which two values count as copied."""
AIR = 1.2
"""Density of air [kg/m^3]; a ball of a link's mass and radius of gyration is hardly lighter."""
SHORTEST_REACH = 1.0
"""Length [m] that any robot may have, whatever its joints say: a gantry's joints have one place."""
LONGEST_REACH = 100.0
"""Length [m] from which lengths look like millimetres; the longest cranes are robots of 60 m."""
USUAL_DENSITY = 500.0
"""Density [kg/m^3] of a ball of a link's mass and radius of gyration: the median of 245 links of
published arms, hands and legs, nine tenths of which lie within a factor of ten."""
USUAL_GYRATION = 0.4
"""Median radius of gyration of the same links, in lengths of the link."""
SHORTEST_LINK = 0.02
"""Length [m] that counts for a link whose joints and centre of mass have one place."""
RARE = 0.3
"""Decades by which a unit that no CAD program exports by default must explain more; CAD programs
work in grams and millimetres, so that kg mm^2 and g are what a forgotten conversion leaves."""
USUAL_UNITS = ("g", "kg mm^2", "g and g mm^2")
DECISIVE = 1.0
"""Decades of density and radius of gyration that a unit must come nearer to usual ones."""
NEGLIGIBLE = 1e-3
"""Mass, in masses of the heaviest link, of links that are there for the sake of a joint alone."""
MASS_UNITS = {"kg": 1.0, "g": 1e3, "tonnes": 1e-3, "lb": 2.20462}
"""Masses in a unit are so many times those in kg."""
INERTIA_UNITS = {
    "kg m^2": 1.0,
    "g m^2": 1e3,
    "lb in^2": 3417.17,
    "kg cm^2": 1e4,
    "kg mm^2": 1e6,
    "g cm^2": 1e7,
    "g mm^2": 1e9,
}
"""Moments of inertia in a unit are so many times those in kg m^2."""
SLIPS = (10.0, 100.0, 1000.0, 0.1, 0.01, 0.001)
"""Factors of a decimal point in a wrong place."""


@dataclass(frozen=True, slots=True)
class _Misreading:
    """A way in which a file may be wrong: its masses and inertias are so many times the right ones.

    `unit` says in which unit they are written, and is empty for a slip of the decimal point.
    """

    mass: float
    inertia: float
    unit: str = ""

    @property
    def claim(self) -> str:
        """What is wrong, such as `inertia 1e+06 times too large, as in kg mm^2`."""
        parts = [
            f"{what} {_word_factor(factor)}"
            for what, factor in (("mass", self.mass), ("inertia", self.inertia))
            if factor != 1.0
        ]
        return " and ".join(parts) + (f", as in {self.unit}" if self.unit else "")


def _word_factor(factor: float) -> str:
    size = "large" if factor > 1.0 else "small"
    return f"{max(factor, 1.0 / factor):.4g} times too {size}"


def _list_unit_misreadings() -> tuple[_Misreading, ...]:
    """Return one wrong unit, or masses and inertias in units of one family."""
    masses = list(MASS_UNITS.items())[1:]
    inertias = list(INERTIA_UNITS.items())[1:]
    families = [
        _Misreading(m, i, f"{mass} and {inertia}")
        for (mass, m), (inertia, i) in itertools.product(masses, inertias)
        if inertia.startswith(f"{mass} ")
    ]
    alone = [_Misreading(m, 1.0, mass) for mass, m in masses]
    return (*alone, *(_Misreading(1.0, i, inertia) for inertia, i in inertias), *families)


UNITS = _list_unit_misreadings()
MASS_SLIPS = tuple(_Misreading(slip, 1.0) for slip in SLIPS)
INERTIA_SLIPS = tuple(_Misreading(1.0, slip) for slip in (*SLIPS, 1e6))


@dataclass(frozen=True, slots=True)
class _Build:
    """How a link is built: mass [kg], radius of gyration [m], length of the link [m]."""

    name: str
    mass: float
    gyration: float
    length: float

    @property
    def density(self) -> float:
        """Density [kg/m^3] of a ball with this mass and radius of gyration.

        Of all bodies of a given mass that are nowhere denser, the ball has the least radius of
        gyration: some part of the link is at least as dense.
        """
        radius = np.sqrt(5.0 / 3.0) * self.gyration
        return float(self.mass / (4.0 / 3.0 * np.pi * radius**3))

    @property
    def slenderness(self) -> float:
        """Radius of gyration in lengths of the link."""
        return self.gyration / max(self.length, SHORTEST_LINK)

    @property
    def is_too_dense(self) -> bool:
        """Whether no matter is so dense."""
        return self.density > HEAVIEST

    @property
    def is_too_wide(self) -> bool:
        """Whether a ball of the size is lighter than air, and wider than the link is known to be.

        A thin rod passes: it is as long as its link.
        """
        return self.density < AIR and self.gyration > self.length

    @property
    def is_implausible(self) -> bool:
        """Whether no link of a robot is so built."""
        return self.is_too_dense or self.is_too_wide

    def corrected(self, misreading: _Misreading) -> _Build:
        """Return the link with the values that a misread file means."""
        gyration = self.gyration * np.sqrt(misreading.mass / misreading.inertia)
        return _Build(self.name, self.mass / misreading.mass, float(gyration), self.length)


def check_plausibility(model: RobotModel) -> tuple[Finding, ...]:
    """Return what is implausible about the mass properties of a description, errors first.

    A link is held against its size: the density of a ball with its mass and its radius of gyration
    `sqrt(tr(I_com) / (2 m))`, and the lengths between its joints. Where one unit explains all
    links, or a factor one link, the finding names it.

    Examples
    --------
    >>> from asbuilt import load_robot
    >>> check_plausibility(load_robot("ur10e"))
    ()
    """
    length = stretched_length(model)
    findings = [
        *_check_length(model.name, length),
        *(
            finding
            for link in model.links
            if link.has_mass
            for finding in (
                *_check_slots(link.name, link.inertia),
                *_check_unit_inertia(link.name, link.inertia),
                *_check_centre(link.name, link.inertia, length),
            )
        ),
        *_check_sizes(_measure_links(model)),
        *_report_copies(model),
    ]
    return rank_findings(findings)


def explain_implausible_links(model: RobotModel) -> dict[str, str]:
    """Return by name why links are implausible; warnings and links without fault are left out."""
    reasons: dict[str, str] = {}
    for finding in check_plausibility(model):
        if finding.severity == "error":
            names = [finding.link] if finding.link else list(model.link_names)
            for name in names:
                prefix = f"link {name}: "
                reasons.setdefault(str(name), finding.message.removeprefix(prefix))
    return reasons


def find_wrong_units(model: RobotModel) -> Finding | None:
    """Return the finding that masses, inertias or lengths are in another unit, if they are."""
    found = (each for each in check_plausibility(model) if each.code == "description_units")
    return next(found, None)


def list_corrections(model: RobotModel) -> tuple[RobotModel, ...]:
    """Return the descriptions that an implausible one may mean; none if it is plausible.

    Of a link that cannot be, mass or inertia may be the wrong one: first the description with other
    masses, then the one with other inertias. Only a log can tell which of them is meant.
    """
    builds = _measure_links(model)
    unit = _find_common_unit(builds)
    if unit is not None:
        return (_correct_links(model, dict.fromkeys((build.name for build in builds), unit)),)
    slips = {name: found for name, found in _find_slips(builds).items() if found}
    corrected = []
    for k in range(max(map(len, slips.values()), default=0)):
        chosen = {name: found[min(k, len(found) - 1)] for name, found in slips.items()}
        corrected.append(_correct_links(model, chosen))
    return tuple(corrected)


def _correct_links(model: RobotModel, misread: Mapping[str, _Misreading]) -> RobotModel:
    """Return the robot with the masses and inertias that misread links mean."""
    bodies = []
    for link in model.links:
        body = link.inertia
        if link.name in misread:
            way = misread[link.name]
            tensor = body.inertia_about_com / way.inertia
            body = LinkInertia.from_com(body.mass / way.mass, body.com, tensor)
        bodies.append(body.parameters)
    return model.with_parameters(np.concatenate(bodies))


def _measure_links(model: RobotModel) -> list[_Build]:
    """Return how the links that carry some mass are built."""
    builds = [_measure_link(model, k) for k in range(model.n_links)]
    heaviest = max((link.inertia.mass for link in model.links), default=0.0)
    return [build for build in builds if build is not None and build.mass > NEGLIGIBLE * heaviest]


def _measure_link(model: RobotModel, index: int) -> _Build | None:
    """Return how a link is built, or None where its description is silent or inconsistent."""
    link = model.links[index]
    if not link.has_mass or not link.inertia.is_consistent:
        return None
    trace = float(np.trace(link.inertia.inertia_about_com))
    if not trace > 0.0:
        return None  # a point mass, which the table of links names
    joint = model.moving_joints[index]
    origin = -joint.after[:3, :3].T @ joint.after[:3, 3]
    points = [
        origin,
        link.inertia.com,
        *(joint.before[:3, 3] for joint in model.moving_joints if joint.parent == index),
        *(frame.placement[:3, 3] for frame in model.frames if frame.link == index),
    ]
    away = np.linalg.norm(np.array(points) - origin, axis=1)
    mass = link.inertia.mass
    return _Build(link.name, mass, float(np.sqrt(0.5 * trace / mass)), float(away.max()))


def _check_sizes(builds: Sequence[_Build]) -> list[Finding]:
    unit = _find_common_unit(builds)
    if unit is not None:
        return [_report_units(builds, unit)]
    slips = _find_slips(builds)
    return [_report_link(build, slips[build.name]) for build in builds if build.name in slips]


def _find_common_unit(builds: Sequence[_Build]) -> _Misreading | None:
    """Return the unit that explains most links, None if most are plausible or none does."""
    wrong = [build for build in builds if build.is_implausible]
    return _find_misreading(builds, UNITS, USUAL_DENSITY) if 2 * len(wrong) > len(builds) else None


def _find_slips(builds: Sequence[_Build]) -> dict[str, list[_Misreading]]:
    """Return by implausible link the factors of its mass, and of its inertia, that explain it."""
    right = [build.density for build in builds if not build.is_implausible]
    usual = float(np.median(right)) if right else USUAL_DENSITY
    return {
        build.name: [
            slip
            for possible in (MASS_SLIPS, INERTIA_SLIPS)
            if (slip := _find_misreading([build], possible, usual)) is not None
        ]
        for build in builds
        if build.is_implausible
    }


def _find_misreading(
    builds: Sequence[_Build], possible: Sequence[_Misreading], usual: float
) -> _Misreading | None:
    """Return the misreading without which the links are of usual size, or None where none is."""

    def score(misreading: _Misreading) -> float:
        corrected = [build.corrected(misreading) for build in builds]
        density = np.median([each.density for each in corrected]) / usual
        width = np.median([each.slenderness for each in corrected]) / USUAL_GYRATION
        rare = RARE if misreading.unit and misreading.unit not in USUAL_UNITS else 0.0
        return float(abs(np.log10(density)) + abs(np.log10(width))) + rare

    def mends(misreading: _Misreading) -> bool:
        corrected = [build.corrected(misreading) for build in builds]
        sound = [not each.is_implausible for each in corrected]
        return 2 * sum(sound) > len(sound)

    best = min(filter(mends, possible), key=score, default=None)
    as_read = score(_Misreading(1.0, 1.0))
    # A link that cannot be needs an explanation; a unit of all links needs a good one.
    margin = DECISIVE if len(builds) > 1 else 0.0
    return best if best is not None and score(best) < as_read - margin else None


def _report_units(builds: Sequence[_Build], unit: _Misreading) -> Finding:
    worst = max(builds, key=lambda each: abs(np.log10(each.density / USUAL_DENSITY)))
    right = worst.corrected(unit)
    return Finding(
        "description_units",
        "error",
        f"links {join_names([build.name for build in builds])}: {unit.claim}: {worst.name} has"
        f" {_describe_build(worst)}; in SI units it has {_describe_build(right)}",
        Cure("write masses in kg and moments of inertia in kg m^2 in the description"),
    )


def _report_link(build: _Build, slips: Sequence[_Misreading]) -> Finding:
    """Return the finding on one link; mass and inertia alone do not tell which of them is wrong."""
    dense = build.is_too_dense
    bound = f"more than any matter has ({HEAVIEST:g})" if dense else f"less than air ({AIR:g})"
    message = f"{_describe_build(build)}: {bound}"
    if slips:
        message += f"; its {' or its '.join(slip.claim for slip in slips)}"
    cure = Cure("correct it in the description, or compute masses from shapes", call="link_masses")
    if dense:
        return make_link_finding("implausible_density", "error", build.name, message, cure)
    return make_link_finding("inertia_too_large", "error", build.name, message, cure)


def _describe_build(build: _Build) -> str:
    """Return mass, radius of gyration, length and density of a link."""
    size = f" on {build.length:.3g} m of link" if build.length > 0.0 else ""
    return (
        f"{build.mass:.4g} kg with a radius of gyration of {build.gyration:.3g} m{size} (a"
        f" ball of {build.density:.3g} kg/m^3)"
    )


def _check_length(robot: str, length: float) -> Iterator[Finding]:
    """Yield a finding where a robot is too long when it is stretched [m]."""
    if length > LONGEST_REACH:
        yield Finding(
            "description_units",
            "error",
            f"{robot} is {length:.4g} m long when it is stretched: lengths 1000 times too large, as"
            f" in mm, make it {1e-3 * length:.3g} m",
            Cure("write lengths in metres in the description"),
        )


def _check_centre(name: str, body: LinkInertia, length: float) -> Iterator[Finding]:
    """Yield a finding where a centre of mass is farther away than a robot of this length [m]."""
    away = float(np.linalg.norm(body.com))
    if away > max(length, SHORTEST_REACH):
        yield make_link_finding(
            "com_outside",
            "error",
            name,
            f"its centre of mass lies {away:.4g} m from its frame, and the whole robot is"
            f" {length:.3g} m long; 1000 times too large, as in mm, it would be"
            f" {1e-3 * away:.3g} m",
            Cure("write the centre of mass in metres, from the frame of the link"),
        )


def _check_slots(name: str, body: LinkInertia) -> Iterator[Finding]:
    """Yield a finding where a product of inertia repeats a moment: a value in a wrong slot."""
    tensor = body.inertia_about_com
    products = {"Ixy": tensor[0, 1], "Ixz": tensor[0, 2], "Iyz": tensor[1, 2]}
    moments = dict(zip(("Ixx", "Iyy", "Izz"), np.diag(tensor), strict=True))
    # The sum about the origin takes digits from a tensor about a distant centre of mass.
    slack = 1e-9 * float(np.abs(body.inertia).max())
    pairs = (
        (moment, product)
        for moment, m in moments.items()
        for product, p in products.items()
        if m > 0.0 and abs(m - abs(p)) <= slack and m > 10.0 * slack
    )
    for moment, product in itertools.islice(pairs, 1):
        yield make_link_finding(
            "inertia_slots",
            "error",
            name,
            f"{moment} and {product} about its centre of mass are both {moments[moment]:.4g} kg"
            " m^2: one value stands in two places of the tensor",
            Cure("write ixx ixy ixz iyy iyz izz in their places"),
        )


def _check_unit_inertia(name: str, body: LinkInertia) -> Iterator[Finding]:
    """Yield a finding where an inertia is the 1 kg m^2 that editors write by default."""
    if body.mass > 0.0 and np.allclose(body.principal_moments, 1.0, rtol=EQUAL):
        message = "its inertia is 1 kg m^2 about every axis"
        yield make_link_finding("unit_inertia", "error", name, message)


def check_in_shape(
    name: str, body: LinkInertia, volume: float, corners: Array
) -> Iterator[Finding]:
    """Yield what is implausible about a body of a shape.

    Parameters
    ----------
    name, body
        The link and its mass properties.
    volume
        Volume of the shape [m^3], NaN if it is not known.
    corners
        Lower and upper corner of the box around it along the link axes [m], shape (2, 3), NaN if
        they are not known: then nothing is found.
    """
    lower, upper = corners
    density = body.mass / volume
    if np.isfinite(density) and not LIGHTEST <= density <= HEAVIEST:
        yield make_link_finding(
            "implausible_density",
            "error",
            name,
            f"{body.mass:.4g} kg in {1e3 * volume:.4g} litres is {density:.3g} kg/m^3, outside"
            f" {LIGHTEST:g} to {HEAVIEST:g}",
        )
    moments = np.diag(body.inertia_about_com)
    half = (upper - lower) / 2.0
    largest = body.mass * (np.sum(half**2) - half**2)
    if np.any(moments > (1.0 + EQUAL) * largest):
        with np.errstate(divide="ignore", invalid="ignore"):
            axis = int(np.argmax(moments / largest))
        yield make_link_finding(
            "inertia_too_large",
            "error",
            name,
            f"I{'xyz'[axis] * 2} about the centre of mass is {moments[axis]:.3g} kg m^2; within its"
            f" box {body.mass:.4g} kg have at most {largest[axis]:.3g}",
        )
    outside = np.maximum(lower - body.com, body.com - upper).max()
    if body.mass > 0.0 and outside > EQUAL * half.max():
        yield make_link_finding(
            "com_outside",
            "warning",
            name,
            f"its centre of mass lies {1e3 * outside:.3g} mm outside the box of its geometry",
        )


def _report_copies(model: RobotModel) -> Iterator[Finding]:
    """Yield a finding per link whose inertia about the centre of mass equals another link's.

    Only links of one chain count: legs, fingers and arms have equals.
    """
    bodies = {k: link.inertia for k, link in enumerate(model.links) if link.has_mass}
    tensors = {k: body.inertia_about_com for k, body in bodies.items()}
    chains = {k: set(model.ancestors(k)) for k in bodies}
    for k, tensor in tensors.items():
        same = [
            model.links[j].name
            for j, other in tensors.items()
            if j != k
            and (j in chains[k] or k in chains[j])
            and np.isclose(bodies[k].mass, bodies[j].mass, rtol=EQUAL, atol=0.0)
            and np.abs(tensor - other).max() <= EQUAL * np.abs(tensor).max()
        ]
        if same:
            name = model.links[k].name
            message = f"same mass and inertia as {join_names(same)}"
            yield make_link_finding("copied_inertia", "warning", name, message)


def make_link_finding(
    code: str,
    severity: Severity,
    link: str,
    message: str,
    cure: Cure | None = None,
) -> Finding:
    """Return a finding whose message begins with the link."""
    return Finding(code, severity, f"link {link}: {message}", cure, link=link)


def add_plausibility(model: RobotModel, findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings with those of the description that say something new of a link."""
    said = {(finding.code, finding.link) for finding in findings}
    new = [each for each in check_plausibility(model) if (each.code, each.link) not in said]
    return rank_findings([*new, *findings])
