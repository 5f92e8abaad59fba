"""Options of workflows: every default is stated here, once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike

from asbuilt.description.model import RobotModel
from asbuilt.description.sibling import Sibling, read_sibling
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.errors import UsageError
from asbuilt.identification.bodies.known_masses import (
    link_masses_from_text,
    total_mass_from_text,
    with_known_masses,
)
from asbuilt.identification.effects.effect import EffectsWanted
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.uncertainty.error_kinds import ERROR_KINDS, ErrorKind
from asbuilt.ranges import Range, option, switch

if TYPE_CHECKING:
    from asbuilt.experiment.signal.signal_chain import SignalChain
else:
    SignalChain = Any

BLOCKS = "blocks:5s:3"
"""The usual rule of what to hold out."""
AUTOMATIC = "auto"
"""Hold out for the verdict, by the usual rule, and fit the final values to everything."""


def _parse_drive(text: str) -> DriveSet | str:
    # "auto" among terms is chosen on the data, which are not here.
    automatic = "auto" in [part.strip().lower() for part in text.split(",")]
    return text if automatic else DriveSet.parse(text)


HORIZONS = Range(1e-4, 3600.0, "s")
"""Lengths of simulated windows."""


def parse_horizons(text: str) -> tuple[float, ...]:
    """Return the lengths of rollouts [s] that a text lists, such as "0.1,0.5,2".

    Raises
    ------
    UsageError
        If one is not a positive number.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (0.0,)
    if not all(HORIZONS.holds(value) for value in values):
        raise UsageError(
            f"lengths of rollouts are numbers {HORIZONS}, such as 0.1,0.5,2, got {text[:80]!r}",
            value=text,
        )
    # Each length once, in the order given.
    return tuple(dict.fromkeys(values))


def hold_out_rule(text: str) -> str | None:
    """Return a rule of `hold_out`, or `AUTOMATIC`, that a text names; None for "none"."""
    return None if text.strip().lower() == "none" else text.strip()


def _check_rule(rule: str | None) -> None:
    if rule not in (None, AUTOMATIC):
        # The parser imports the signal chain, which the command line loads only if needed.
        from asbuilt.experiment.signal.samples import parse_rule  # noqa: PLC0415 (heavy)

        parse_rule(rule)


CHECKED = {"help": "use the recordings whatever their checks find"}
ROLLOUT = {
    "metavar": "LIST",
    "help": (
        "simulate held-out windows of these lengths [s] from the measured state, such as 0.1,0.5,2"
    ),
    "parse": parse_horizons,
}
HOLDOUT = {
    "metavar": "RULE",
    "help": "hold out for validation: blocks:5s:3 (every third 5 s block), last:0.3, auto, or none",
    "parse": hold_out_rule,
}
HOLDOUT_AND_REFIT = HOLDOUT | {
    "help": (
        "hold out for validation: auto (recordings in turn, or a third of one; the final fit is to"
        " everything; nothing if other recordings validate), none, blocks:5s:3 (every third 5 s"
        " block) or last:0.3"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Configure `identify`.

    Parameters
    ----------
    drive
        Drive terms; None: those usual for the torque source; "auto" (or "auto,spring:joints=2"):
        chosen on held-out blocks.
    method
        The estimator, a key of `methods`.
    chain
        The signal chain; what it leaves open is chosen from the recordings.
    sweep_cutoff
        Choose the cutoff of the low-pass by held-out error.
    holdout
        "auto" leaves out whole recordings in turn for the verdict, of one recording a third, below
        6 s its second half, and fits the final values to everything; with other recordings to
        validate on it holds nothing out. A rule of
        `hold_out`, such as "blocks:5s:3", takes the part out of the result too; None holds nothing
        out.
    undetermined
        Directions that no motion excites stay at CAD and are named, or are refused.
    effects
        What the recordings show and the description lacks is put into the model ("auto"), named
        ("find"), not searched for ("none"), or taken from a list such as "spring:joints=2,tilt".
    mounting
        Gravity points as described, or its direction is identified too: the effect `tilt`.
    total_mass
        Limits of the mass of all moving links [kg], or text such as "18.6+-0.1" or
        "24.2+-0.1,root=5.6"; fit and export keep them.
    link_mass
        Limits of the masses of single moving links [kg] by name, or text such as
        "hand=0.7+-0.05,link_1<=4"; fit and export keep them.
    siblings
        A robot of the same type as built, or the JSON file of its page: its links and drives
        replace the description's as the prior.
    errors
        Standard errors from time blocks by formula, by drawing the blocks, or by the textbook.
    block_seconds
        Length of the time blocks [s]; None: 5 s, less in short recordings.
    rollout
        Lengths [s] of windows that are simulated, of what is held out.
    refine
        Continue the fit by trajectories ("rollout"), simulated windows of the training data.
    same_servos
        Whether all unknown stiffnesses of position servos are one.
    checked
        Refuse recordings in which `check_recording` finds errors.
    threads
        Threads of the kernels; None: all cores if that pays.

    Raises
    ------
    UsageError
        If the rule cannot be read.
    """

    drive: DriveSet | str | None = option(
        None,
        "LIST",
        "drive terms such as armature,viscous,coulomb,stribeck:velocity=0.1 (see asbuilt drives),"
        " none, or auto: chosen on held-out blocks (auto,spring: with a spring)",
        parse=_parse_drive,
    )
    method: str = option(
        "auto",
        "NAME",
        "estimator; auto chooses one, an unknown name lists all",
        parse=lambda text: methods.find(text).name,
        names=lambda: list(methods),
    )
    chain: SignalChain | None = None
    sweep_cutoff: bool = False
    holdout: str | None = field(default=AUTOMATIC, metadata=HOLDOUT_AND_REFIT)
    undetermined: Literal["toward_prior", "refuse"] = option(
        "toward_prior",
        "HOW",
        "what no motion excites: cad (keep at CAD, named) or refuse",
        choices={"cad": "toward_prior", "refuse": "refuse"},
        also=("--prior",),
    )
    effects: EffectsWanted | str = option(
        EffectsWanted(),
        "HOW",
        "effects that the description lacks: auto (into the model), find (named), none, or a list"
        " such as spring:joints=2,tilt",
        parse=EffectsWanted.parse,
    )
    mounting: Literal["as_described", "estimate"] = option(
        "as_described",
        "HOW",
        "direction of gravity: cad (as described) or estimate",
        choices={"cad": "as_described", "estimate": "estimate"},
    )
    total_mass: tuple[float, float] | str | None = option(
        None,
        "KG+-KG[,root=KG]",
        "mass of all moving links, from a scale; with root=KG less the root link's",
        parse=total_mass_from_text,
    )
    link_mass: Mapping[str, tuple[float, float]] | str | None = option(
        None,
        "NAME=KG+-KG,...",
        "known masses of moving links: NAME=KG+-KG, NAME<=KG or NAME>=KG",
        parse=link_masses_from_text,
    )
    siblings: Sibling | str | Path | None = option(
        None,
        "FILE",
        "numbers of a robot of the type as built (the JSON of its page) as prior in place of CAD",
        parse=read_sibling,
    )
    errors: ErrorKind = option(
        "blocks",
        "KIND",
        "standard errors: blocks (time blocks, by formula), bootstrap (time blocks drawn with"
        " replacement) or textbook (independent residuals)",
        choices=ERROR_KINDS,
    )
    block_seconds: float | None = None
    rollout: tuple[float, ...] = field(default=(), metadata=ROLLOUT)
    refine: Literal["rollout"] | None = option(
        None,
        "HOW",
        "continue the fit: rollout (by simulated trajectories)",
        choices=("rollout",),
    )
    same_servos: bool = switch(
        False, "position servos are alike: one unknown stiffness for all joints"
    )
    checked: bool = field(default=True, metadata=CHECKED)
    threads: int | None = None

    def __post_init__(self) -> None:
        _check_rule(self.holdout)
        for name in ("effects", "drive", "total_mass", "link_mass", "siblings"):
            # Text is parsed here too, so that Python and command line mean the same by it.
            given = getattr(self, name)
            parse = self.__dataclass_fields__[name].metadata["parse"]
            if isinstance(given, str | Path):
                object.__setattr__(self, name, parse(given))

    @property
    def wanted_effects(self) -> EffectsWanted:
        """The effects, parsed."""
        return EffectsWanted.parse(self.effects) if isinstance(self.effects, str) else self.effects

    def with_prior(self, model: RobotModel) -> RobotModel:
        """Return a robot with the numbers of its sibling, if one is given, and the known masses.

        Raises
        ------
        UsageError
            If it has no such links.
        DescriptionError
            If the sibling is of another type.
        """
        if isinstance(self.siblings, Sibling):
            model = self.siblings.applied(model)
        total = self.total_mass
        links = self.link_mass or {}
        if isinstance(total, str) or isinstance(links, str):  # parsed in `__post_init__`
            return model
        return with_known_masses(model, total, links)


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationOptions:
    """Configure `validate`.

    Parameters
    ----------
    chain
        The signal chain; None: the result's, or else chosen for each recording.
    cad
        Another description of the robot with the same geometry, in place of the result's.
    rollout
        Lengths [s] of windows that are simulated.
    checked
        Refuse recordings in which `check_recording` finds errors.
    """

    chain: SignalChain | None = None
    cad: RobotModel | str | Path | None = None
    rollout: tuple[float, ...] = field(default=(), metadata=ROLLOUT)
    checked: bool = field(default=True, metadata=CHECKED)


@dataclass(frozen=True, slots=True, kw_only=True)
class PayloadOptions:
    """Configure `identify_payload`.

    Parameters
    ----------
    frame
        Link or frame that carries the payload; None: the flange.
    arm
        The arm is refined with the payload, held by the result, or frozen.
    gain_uncertainty
        Relative error of the torque per ampere, for all joints or each; None: 7 % for currents, 5 %
        for motor torques whose gravity torques agree with CAD's, else 10 % and more, 0 for sensors.
    chain
        The signal chain; what it leaves open is chosen from the loaded recordings.
    holdout
        A rule of `hold_out`; None holds nothing out.
    checked
        Refuse recordings in which a check finds errors.

    Raises
    ------
    UsageError
        If the rule cannot be read.
    """

    frame: str | None = option(
        None, "NAME", "link or frame that carries the payload (default: the flange)"
    )
    arm: Literal["refined", "frozen"] = option(
        "refined",
        "HOW",
        "refined (with the payload, held by the result) or frozen",
        choices=("refined", "frozen"),
    )
    gain_uncertainty: ArrayLike | None = None
    chain: SignalChain | None = None
    holdout: str | None = field(default=None, metadata=HOLDOUT)
    checked: bool = field(default=True, metadata=CHECKED)

    def __post_init__(self) -> None:
        _check_rule(self.holdout)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerOptions:
    """Configure `compare_controller`.

    Parameters
    ----------
    holdout
        What of the recording the models are validated on.
    chain
        The signal chain; what it leaves open is chosen from the recording.
    checked
        Refuse a recording in which `check_recording` finds errors.
    """

    holdout: str = BLOCKS
    chain: SignalChain | None = None
    checked: bool = True

    def __post_init__(self) -> None:
        _check_rule(self.holdout)


@dataclass(frozen=True, slots=True, kw_only=True)
class GainOptions:
    """Configure `find_gains`.

    Parameters
    ----------
    com
        Centre of mass of the payload in the flange frame [m], if known.
    frame
        Link or frame that carries the payload; None: the flange.
    drive
        Drive terms; None: those usual for the torque source.
    chain
        The signal chain; what it leaves open is chosen from all recordings.
    checked
        Refuse recordings in which a check finds errors other than wrong gains.
    """

    com: ArrayLike | None = None
    frame: str | None = None
    drive: DriveSet | None = None
    chain: SignalChain | None = None
    checked: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelOptions:
    """Configure `identify_channels`.

    Parameters
    ----------
    link_side
        Drive terms behind the sensors; None: viscous, Coulomb and offset.
    motor_side
        Drive terms before the sensors; None: armature, viscous, Coulomb, offset, and the terms of
        coupled motors.
    chain
        The signal chain; what it leaves open is chosen from the recordings of the sensors.
    checked
        Refuse recordings in which `check_recording` finds errors.
    """

    link_side: DriveSet | None = None
    motor_side: DriveSet | None = None
    chain: SignalChain | None = None
    checked: bool = True
