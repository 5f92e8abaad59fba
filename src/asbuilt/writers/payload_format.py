"""What robot makers take: payloads in their words, and programs that run a motion."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, RobotModel
from asbuilt.errors import IdentifiabilityError, ResultError, UsageError
from asbuilt.excitation import Motion
from asbuilt.findings import Cure, join_names
from asbuilt.identification import Payload
from asbuilt.registry import Registry
from asbuilt.untrusted import parse_json, read_text
from asbuilt.writers.tables.payload_tables import payload_document
from asbuilt.writing import atomic_write

LARGEST = 1_000_000
"""Bytes of a stored payload; one of seven joints and ten logs has 10 kB."""


@dataclass(frozen=True, eq=False)
class CarriedBody:
    """Hold a payload as a controller takes it.

    Parameters
    ----------
    robot, frame
        The robot, and the frame whose origin and axes the numbers have.
    mass, mass_error
        Mass and its standard error [kg].
    centre, inertia
        Centre of mass (3,) [m], and inertia about it (3, 3) [kg m^2]. What the recording does not
        determine is zero; the inertia of a point where the rest is no body's.
    left_out
        Names of what is not determined, in the axes of the frame of the recording.
    frames
        Placement (4, 4) of other frames of the same link, by name.
    """

    robot: str
    frame: str
    mass: float
    mass_error: float
    centre: Array
    inertia: Array
    left_out: tuple[str, ...] = ()
    frames: Mapping[str, Array] = field(default_factory=dict)

    @property
    def is_point(self) -> bool:
        """Whether it is a point, without inertia about its centre."""
        return not np.any(self.inertia)

    def moved_to(self, words: tuple[str, ...]) -> CarriedBody:
        """Return the body in the first frame whose name ends in one of these words, else itself."""
        for word in words:
            for name, placement in ({self.frame: np.eye(4)} | dict(self.frames)).items():
                if _ends_in(name, word):
                    R = placement[:3, :3]
                    return replace(
                        self,
                        frame=name,
                        centre=R.T @ (self.centre - placement[:3, 3]),
                        inertia=R.T @ self.inertia @ R,
                    )
        return self


def read_carried_body(document: Mapping[str, Any], source: str = "payload") -> CarriedBody:
    """Return the body of a payload's document, as `asbuilt payload --json` prints it.

    Raises
    ------
    ResultError
        If it is no such document.
    IdentifiabilityError
        If its mass is not determined.
    """
    try:
        left_out = tuple(map(str, document["not_determined"]))
        mass = document["mass"]
        centre = np.array(document["com"]["estimate"], dtype=float)
        inertia = np.array(document["inertia_about_com"], dtype=float)
        frames = {
            str(name): np.array(each, dtype=float).reshape(4, 4)
            for name, each in document.get("frames", {}).items()
        }
        body = CarriedBody(
            robot=str(document["robot"]),
            frame=str(document["frame"]),
            mass=float(mass["estimate"]),
            mass_error=float(mass["std_error"]),
            centre=centre.reshape(3),
            inertia=inertia.reshape(3, 3),
            left_out=left_out,
            frames=frames,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        raise ResultError(
            f"{source} is no payload: {type(problem).__name__} {problem}",
            cure=Cure("give a payload.json that asbuilt payload wrote"),
            file=source,
        ) from None
    if "mass" in left_out or not body.mass > 0.0:
        raise IdentifiabilityError(
            f"the mass of the payload at {body.frame} is not determined"
            f" ({body.mass:.3g} kg), and no controller takes a payload without one",
            cure=Cure("record a motion through different poses under load"),
            value=body.mass,
        )
    return _leave_out_undetermined(body)


def _leave_out_undetermined(body: CarriedBody) -> CarriedBody:
    """Return the body with zeros for what is not determined, a point where that leaves no body.

    A moment of zero about one axis beside two others, say, belongs to no body.
    """
    centre = body.centre.copy()
    inertia = body.inertia.copy()
    for name in body.left_out:
        first, *rest = ("xyz".index(letter) for letter in name[-2:] if letter in "xyz")
        if name.startswith("com_"):
            centre[first] = 0.0
        elif rest:
            inertia[first, rest[0]] = inertia[rest[0], first] = 0.0
    possible = np.all(np.diagonal(inertia) > 0.0) and (
        LinkInertia.from_com(body.mass, centre, inertia).is_consistent
    )
    return replace(body, centre=centre, inertia=inertia if possible else np.zeros((3, 3)))


def read_stored_payload(path: Path) -> CarriedBody | None:
    """Return the body of a `payload.json`, None where a file is none, such as a stored result."""
    text = read_text(path, "payload", ResultError, LARGEST) if path.stat().st_size < LARGEST else ""
    try:
        document = parse_json(text)
    except ValueError:
        return None
    if not isinstance(document, dict) or "inertia_about_com" not in document:
        return None
    return read_carried_body(document, str(path))


class PayloadFormat(ABC):
    """The words of one maker; a subclass registers an instance in `PAYLOAD_FORMATS`.

    `key` and `title` name it. `frames` are words that end the name of the frame in which the maker
    takes the numbers, the surest first. `has_products` says whether it takes products of inertia,
    or principal axes in their place. `comment` starts a line that the controller does not read.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    frames: ClassVar[tuple[str, ...]] = ("tool0", "flange")
    has_products: ClassVar[bool] = True
    comment: ClassVar[str] = "#"

    @abstractmethod
    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the text of the file, without remarks; `body` has the axes of the flange."""

    def remark(self, body: CarriedBody, notes: tuple[str, ...], path: Path) -> str:
        """Return what the file says first of the body, and what a person has to know."""
        lines = (make_plain(line) for line in (_describe(body), *notes))
        return "".join(f"{self.comment} {line}\n" for line in lines)

    def notes(self, body: CarriedBody) -> tuple[str, ...]:
        """Return what the file leaves at the maker's default, and what it cannot hold."""
        known = any(_ends_in(body.frame, word) for word in self.frames)
        lost = body.inertia - np.diag(np.diagonal(body.inertia))
        cases = {
            f"not determined and left at the maker's default: {join_names(body.left_out)}": bool(
                body.left_out
            ),
            "the whole inertia is left at the maker's default: what is determined of it belongs to"
            " no body": body.is_point and not _names_all_inertia(body.left_out),
            f"the maker takes the numbers in the frame of the flange; make sure that {body.frame}"
            " is that frame": not known,
            "the maker takes no products of inertia: up to"
            f" {_share(lost, body.inertia):.0f} % of the largest moment is left out": (
                not self.has_products and _share(lost, body.inertia) >= 0.5
            ),
        }
        return tuple(note for note, holds in cases.items() if holds)


def make_plain(text: str) -> str:
    r"""Return a text on one line of plain characters, which ends no comment and continues none.

    >>> make_plain("a\n\\b\u540d")
    'a /b?'
    """
    return " ".join(re.sub(r"[^ -~\s]", "?", text).replace("\\", "/").split())


def _ends_in(name: str, word: str) -> bool:
    return name == word or name.endswith((f"_{word}", f"/{word}", f"-{word}"))


def _describe(body: CarriedBody) -> str:
    return (
        f"payload of {body.mass:.4g} +- {body.mass_error:.2g} kg in the axes of {body.frame},"
        " inertia about its centre of mass, identified by asbuilt"
    )


def _names_all_inertia(names: tuple[str, ...]) -> bool:
    return sum(name.startswith("I") for name in names) == 6


def _share(part: Array, whole: Array) -> float:
    """Return the largest entry of a part in percent of the largest of the whole."""
    largest = np.abs(whole).max()
    return float(100.0 * np.abs(part).max() / largest) if largest else 0.0


PAYLOAD_FORMATS: Registry[PayloadFormat] = Registry(
    "payload format", None, "asbuilt.payload_formats"
)
"""Words of robot makers for a payload, by key."""


def write_payload(
    payload: Payload | CarriedBody, places: Mapping[str, Path]
) -> tuple[dict[str, Path], dict[str, tuple[str, ...]]]:
    """Write a payload in the words of makers.

    Parameters
    ----------
    payload
        What `identify_payload` found, or the body of a stored one.
    places
        File of each format, such as `{"ur": Path("payload.script")}`.

    Returns
    -------
    files, notes
        Path, and notes on what is left at the maker's default, by format.

    Raises
    ------
    UsageError
        If there is no such format.
    IdentifiabilityError
        If the mass is not determined; nothing is written then.
    """
    formats = {PAYLOAD_FORMATS.find(key): Path(place) for key, place in places.items()}
    if len(set(formats.values())) < len(formats):
        raise UsageError("two formats name the same file", value=[*map(str, places)])
    body = (
        payload
        if isinstance(payload, CarriedBody)
        else read_carried_body(payload_document(payload))
    )
    files = {}
    notes = {}
    for form, place in formats.items():
        seen = body.moved_to(form.frames)
        notes[form.key] = form.notes(seen)
        text = form.remark(seen, notes[form.key], place) + form.document(seen, place)
        files[form.key] = atomic_write(place, text)
    return files, {key: remarks for key, remarks in notes.items() if remarks}


class ProgramWriter(ABC):
    """Write controller programs; a subclass registers an instance in `PROGRAM_WRITERS`."""

    @abstractmethod
    def check(self, form: str, model: RobotModel, parametrisation: str | None = None) -> None:
        """Raise an error if there is no such format, or it cannot move the robot so."""

    @abstractmethod
    def write(
        self,
        folder: Path,
        model: RobotModel,
        motion: Motion,
        form: str,
        *,
        name: str,
        collision: str | None,
    ) -> dict[str, Path]:
        """Write the program of a motion into a folder; return its files by role."""


PROGRAM_WRITERS: Registry[ProgramWriter] = Registry(
    "writer of controller programs", None, "asbuilt.program_writers"
)
"""Writers of programs by name."""
