"""What a ledger fixes for a robot type, so that the information of all its logs merges."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.metadata import version as version_of
from typing import Any
from urllib.parse import quote

from asbuilt.codec import format_json, make_plain, restore_dataclass
from asbuilt.description import RobotModel, model_document, model_from_document
from asbuilt.dynamics import BaseParameters, DriveSet, RegressorPlan, find_base_parameters
from asbuilt.errors import AsbuiltError, ResultError
from asbuilt.experiment import SignalChain, TorqueSource
from asbuilt.findings import Cure
from asbuilt.untrusted import parse_json

FORMAT = "asbuilt fleet settings"
FORMAT_VERSION = 1
"""Of all files of a ledger."""
SOFTWARE = version_of("asbuilt")
DESCRIBED = ("source", "citation", "notes")
"""Fields of a robot that say where it is from; the same robot may come from two places."""


@dataclass(frozen=True, eq=False)
class TypeSettings:
    """Hold what all logs of a robot type are reduced with.

    Parameters
    ----------
    robot_type
        Name and digest of the robot as described: robots of one description are one type.
    generation
        Number of times that the type was made again.
    described
        The robot as described.
    model
        The robot as recorded: joints that are not logged are locked.
    drive
        Drive terms, every nonlinear parameter stated.
    chain
        The signal chain, every choice settled.
    torque_source
        What measured the torque.
    asked_drive, asked_chain
        What was asked for: the drive terms, None for the usual ones, and the chain with its open
        choices.
    chosen
        What was chosen, and from which log, as sentences.
    """

    robot_type: str
    generation: int
    described: RobotModel
    model: RobotModel
    drive: DriveSet
    chain: SignalChain
    torque_source: TorqueSource
    asked_drive: str | None = None
    asked_chain: SignalChain = field(default_factory=SignalChain)
    chosen: tuple[str, ...] = ()

    @cached_property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return find_base_parameters(self.model, self.drive)

    @cached_property
    def plan(self) -> RegressorPlan:
        """The columns of each joint."""
        return RegressorPlan.of(self.model, self.drive, self.base.columns, spare_rows=1)

    @cached_property
    def content(self) -> bytes:
        """The settings as a JSON document, which `from_content` reads back to the last bit."""
        return format_json(self._document | {"digest": self.digest}).encode()

    @cached_property
    def digest(self) -> str:
        """Digest of all that the information depends on."""
        document = self._document
        model = {key: value for key, value in document["model"].items() if key not in DESCRIBED}
        kept = ("robot_type", "generation", "torque_source", "drive", "chain", "parameters")
        return _hash_document({key: document[key] for key in kept} | {"model": model})

    @cached_property
    def _document(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "software": SOFTWARE,
            "robot_type": self.robot_type,
            "generation": self.generation,
            "torque_source": self.torque_source,
            "drive": list(self.drive.specifications),
            "chain": make_plain(self.chain),
            "parameters": list(self.base.names),
            "columns": [support.tolist() for support in self.plan.support],
            "joints": list(self.model.joint_names),
            "asked_drive": self.asked_drive,
            "asked_chain": make_plain(self.asked_chain),
            "chosen": list(self.chosen),
            "model": model_document(self.model),
            "described": model_document(self.described),
        }

    @property
    def path(self) -> str:
        """Where the ledger keeps the settings."""
        return f"types/{self.robot_type}/{self.generation:04d}.json"

    @property
    def pending_path(self) -> str:
        """Where the ledger keeps them until they are valid."""
        return f"pending/{self.robot_type}-{self.generation:04d}-{self.digest}.json"

    @classmethod
    @lru_cache(maxsize=64)
    def from_content(cls, content: bytes, path: str) -> TypeSettings:
        """Read settings.

        Raises
        ------
        ResultError
            If they are damaged, or of another format.
        """
        try:
            document = parse_json(content)
            check_version(
                path, document["format_version"] if document["format"] == FORMAT else None
            )
            found = cls(
                robot_type=str(document["robot_type"]),
                generation=int(document["generation"]),
                described=model_from_document(document["described"]),
                model=model_from_document(document["model"]),
                drive=DriveSet.parse(document["drive"]),
                chain=restore_dataclass(SignalChain, document["chain"]),
                torque_source=document["torque_source"],
                asked_drive=document["asked_drive"],
                asked_chain=restore_dataclass(SignalChain, document["asked_chain"]),
                chosen=tuple(map(str, document["chosen"])),
            )
        except ResultError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, AsbuiltError) as problem:
            raise _make_damage_error(path, str(problem) or type(problem).__name__) from problem
        if found.digest != document.get("digest", path.rpartition("-")[2].removesuffix(".json")):
            raise _make_damage_error(path, "its content is not what its digest says")
        if path.startswith("types/") and not path.startswith(f"types/{found.robot_type}/"):
            raise _make_damage_error(path, f"it belongs to the type {found.robot_type}")
        if list(found.base.names) != document["parameters"]:
            raise ResultError(
                f"{path} has other base parameters than its robot has today",
                cure=Cure("rebuild the ledger from its logs"),
                file=path,
            )
        return found


def check_version(path: str, version: object) -> None:
    """Raise `ResultError` unless a file of a ledger has the format version of this program."""
    if version != FORMAT_VERSION:
        raise ResultError(
            f"{path} has format version {version}, this program reads {FORMAT_VERSION}",
            cure=Cure("use the version of asbuilt that wrote the ledger, or rebuild it"),
            file=path,
        )


def name_robot_type(described: RobotModel) -> str:
    """Return the name of a robot type: the description's name and a digest of its content."""
    document = model_document(described)
    what = {key: value for key, value in document.items() if key not in DESCRIBED}
    return f"{quote(described.name, safe='')[:60]}-{_hash_document(what)}"


def _hash_document(document: Mapping[str, Any]) -> str:
    """Return the hexadecimal digits of a digest in names."""
    text = json.dumps(make_plain(document), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _make_damage_error(path: str, why: str) -> ResultError:
    return ResultError(
        f"{path} is damaged: {why[:200]}",
        cure=Cure("restore it from a copy, or rebuild the ledger from its logs"),
        file=path,
    )
