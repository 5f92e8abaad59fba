"""An entry of a ledger: the information of one log, as one Parquet file, and its merging.

A row is a joint and a time block; block -1 is the whole log. `schema` has the columns.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from asbuilt.apps.fleet.ledger.settings import (
    FORMAT_VERSION,
    SCHEMA,
    SOFTWARE,
    DateSource,
    TypeSettings,
    check_schema,
    check_version,
    make_damage_error,
)
from asbuilt.apps.fleet.ledger.store import name_entry_folder, unpack_table
from asbuilt.arrays import Array
from asbuilt.children import open_scratch
from asbuilt.dynamics import use_one_blas_thread
from asbuilt.errors import AsbuiltError, RecordingError, ResultError
from asbuilt.experiment import read_isolated
from asbuilt.findings import Cure
from asbuilt.identification import (
    SquareRootInformation,
    TimeBlock,
    is_triangular,
    triangular_factor,
)

DIGITS = 16
"""Hexadecimal digits of a hash in the name of a file."""
ADD_AGAIN = Cure("remove it and add its log again")
WHOLE = -1
"""Block number of the whole log."""
_NAME = re.compile(
    r"(?P<date>\d{8}T\d{6}Z)-(?P<source>[0-9a-f]{16})-(?P<settings>[0-9a-f]{12})"
    r"-(?P<content>[0-9a-f]{16})\.parquet"
)


@dataclass(frozen=True, slots=True, order=True)
class EntryName:
    """Hold what the name of an entry's file says; entries sort by robot and date.

    Parameters
    ----------
    robot_id
        Identity of the robot.
    date
        When the log began, in seconds.
    source, settings, content
        Digests of the log, of the settings of its type, and of the entry's own file.
    """

    robot_id: str
    date: datetime
    source: str
    settings: str
    content: str

    @property
    def path(self) -> str:
        """Path of the file in the ledger."""
        stamp = self.date.strftime("%Y%m%dT%H%M%SZ")
        return (
            f"{name_entry_folder(self.robot_id)}/{stamp}-{self.source}-{self.settings}"
            f"-{self.content}.parquet"
        )

    @classmethod
    def parse(cls, robot_id: str, name: str) -> EntryName | None:
        """Read the name of a file of a robot's folder; None if it is no entry's."""
        found = _NAME.fullmatch(name)
        if found is None:
            return None
        try:
            date = datetime.strptime(found["date"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
        except ValueError:
            return None
        return cls(robot_id, date, found["source"], found["settings"], found["content"])


@dataclass(frozen=True, eq=False)
class Entry:
    """Hold the information of one log, and where it is from.

    Parameters
    ----------
    robot_id
        Identity of the robot.
    settings
        What the log was reduced with.
    information
        Factors of its time blocks.
    log
        Name of the log's file.
    source_sha256
        Hash of the log's content.
    date, date_from
        When it began, and what says so.
    duration
        Time that the log covers [s].
    rate
        Rate of the samples used [Hz].
    covariates
        Mean by block of other quantities that were logged, such as temperatures, (n_blocks, n) by
        name, NaN where there is none.
    warnings
        Codes of findings of the log.
    tilt
        Inner products `[W_k | tau_k | T_k]^T T_k` (p_k + 3, 2) of each joint k, with the torques T
        of two base tilts by a radian (`FurtherColumns`); empty if the entry has none.
    """

    robot_id: str
    settings: TypeSettings
    information: SquareRootInformation
    log: str
    source_sha256: str
    date: datetime
    date_from: DateSource
    duration: float
    rate: float
    covariates: Mapping[str, Array]
    warnings: tuple[str, ...] = ()
    tilt: tuple[Array, ...] = ()

    @cached_property
    def whole(self) -> SquareRootInformation:
        """The information of the whole log as one block."""
        return merge_blocks(self.information, 1)

    @cached_property
    def content(self) -> bytes:
        """The content of the Parquet file: the same bytes wherever it is made."""
        stream = io.BytesIO()
        _build_frame(self).write_parquet(stream, compression="zstd", compression_level=1)
        return stream.getvalue()

    @property
    def name(self) -> EntryName:
        """What the file is named."""
        return EntryName(
            self.robot_id,
            self.date.astimezone(UTC).replace(microsecond=0),
            self.source_sha256[:DIGITS],
            self.settings.digest,
            digest_content(self.content),
        )


def digest_content(content: bytes) -> str:
    """Return the digest of a file in its name."""
    return hashlib.sha256(content).hexdigest()[:DIGITS]


def read_entry(content: bytes, name: EntryName, settings: TypeSettings) -> Entry:
    """Read an entry.

    Raises
    ------
    ResultError
        If the file is damaged, is of another format, or is not what its name says.
    """
    if digest_content(content) != name.content:
        raise make_damage_error(name.path, "its content is not what was written", ADD_AGAIN)
    try:
        frame = _unpack_frame(content)
        check_version(name.path, frame["format_version"][0])
        check_schema(frame)
        return _rebuild_entry(frame, name, settings)
    except ResultError:
        raise
    except (pl.exceptions.PolarsError, ValueError, KeyError, TypeError, IndexError) as problem:
        why = f"{type(problem).__name__} {problem}"
        raise make_damage_error(name.path, why, ADD_AGAIN) from problem
    except AsbuiltError as problem:
        raise make_damage_error(name.path, problem.message, ADD_AGAIN) from problem


def _build_frame(entry: Entry) -> pl.DataFrame:
    fixed = {
        "robot_id": entry.robot_id,
        "robot_type": entry.settings.robot_type,
        "settings": entry.settings.digest,
        "log": entry.log,
        "source_sha256": entry.source_sha256,
        "date": entry.date.astimezone(UTC),
        "date_from": entry.date_from,
        "duration": entry.duration,
        "rate": entry.rate,
        "warnings": list(entry.warnings),
        "software": SOFTWARE,
        "format_version": FORMAT_VERSION,
    }
    rows: list[dict[str, Any]] = []
    for information, first in ((entry.whole, WHOLE), (entry.information, 0)):
        for b, block in enumerate(information.blocks):
            for k, joint in enumerate(information.joint_names):
                factor = merge_factors(information.factors[k][b][None])
                tilted = first == WHOLE and entry.tilt
                own = {
                    "block": first + b,
                    "start": block.start,
                    "stop": block.stop,
                    "n_samples": block.n_samples,
                    "joint": joint,
                    "torque_sum": information.torque_sum[b, k],
                    "columns": information.support[k].tolist(),
                    "factor": factor[np.triu_indices(len(factor))].tolist(),
                    "tilt": entry.tilt[k].ravel().tolist() if tilted else None,
                    "covariates": _list_covariates(entry, first, b, k),
                }
                rows.append(fixed | own)
    return pl.DataFrame({key: [row[key] for row in rows] for key in SCHEMA}, schema=SCHEMA)


def _list_covariates(entry: Entry, first: int, block: int, joint: int) -> list[dict[str, Any]]:
    """Return the covariates of a block and joint; of the whole log, weighted by samples."""
    listed = []
    for name, values in sorted(entry.covariates.items()):
        at = values[:, joint]
        if first == WHOLE:
            counts = np.array([block.n_samples for block in entry.information.blocks], dtype=float)
            known = np.isfinite(at)
            value = float(np.average(at[known], weights=counts[known])) if known.any() else np.nan
        else:
            value = float(at[block])
        if np.isfinite(value):
            listed.append({"name": name, "value": value})
    return listed


def _unpack_frame(content: bytes) -> pl.DataFrame:
    """Return the table of an entry, unpacked by another process with limits."""
    with open_scratch() as folder:
        file = Path(folder, "entry.parquet")
        file.write_bytes(content)
        try:
            table = read_isolated(unpack_table, file)
        except RecordingError as problem:
            raise ValueError(problem.message.replace(str(file), "it")) from None
    return pl.read_ipc_stream(io.BytesIO(table.columns["arrow"].tobytes()))


def _rebuild_entry(frame: pl.DataFrame, name: EntryName, settings: TypeSettings) -> Entry:
    row = frame.row(0, named=True)
    stored = EntryName(
        row["robot_id"],
        row["date"].replace(microsecond=0),
        row["source_sha256"][:DIGITS],
        row["settings"],
        name.content,
    )
    if stored != name:
        raise ValueError(f"it is the entry {stored.path}")
    if row["settings"] != settings.digest:
        raise ValueError(f"it belongs to the settings {row['settings']}")
    source = f"{row['log']} ({row['source_sha256'][:DIGITS]})"
    n = settings.model.n_joints
    if frame["block"].to_list() != [WHOLE + k // n for k in range(len(frame))]:
        raise ValueError("its rows are not in order")
    information = _rebuild_information(frame[n:], settings, source)
    entry = Entry(
        robot_id=row["robot_id"],
        settings=settings,
        information=information,
        log=row["log"],
        source_sha256=row["source_sha256"],
        date=row["date"],
        date_from=row["date_from"],
        duration=row["duration"],
        rate=row["rate"],
        covariates=_read_covariates(frame[n:], information),
        warnings=tuple(row["warnings"]),
        tilt=_read_tilt(frame[:n], settings),
    )
    entry.__dict__["whole"] = _rebuild_information(frame[:n], settings, source)
    return entry


def _rebuild_information(
    frame: pl.DataFrame, settings: TypeSettings, source: str
) -> SquareRootInformation:
    """Rebuild the information of rows that go block by block, and joint by joint in each."""
    joints = settings.model.joint_names
    support = settings.plan.support
    n_blocks = len(frame) // len(joints)
    if frame["joint"].to_list() != [*joints] * n_blocks:
        raise ValueError("its joints differ from its type's")
    sizes = [(len(columns) + 1) * (len(columns) + 2) // 2 for columns in support]
    if frame["factor"].list.len().to_list() != sizes * n_blocks:
        raise ValueError("its factors have other columns than its type")
    packed = frame["factor"].explode().to_numpy().reshape(n_blocks, -1)
    factors = []
    for columns, part in zip(support, np.split(packed, np.cumsum(sizes)[:-1], axis=1), strict=True):
        q = len(columns) + 1
        triangles = np.zeros((n_blocks, q, q))
        triangles[(slice(None), *np.triu_indices(q))] = part
        factors.append(triangles)
    times = frame.select("start", "stop", "n_samples").rows()[:: len(joints)]
    return SquareRootInformation(
        settings.base,
        joints,
        tuple(support),
        tuple(factors),
        frame["torque_sum"].to_numpy().reshape(n_blocks, len(joints)).copy(),
        tuple(TimeBlock(source, *time) for time in times),
    )


def _read_tilt(frame: pl.DataFrame, settings: TypeSettings) -> tuple[Array, ...]:
    stored = frame["tilt"].to_list() if "tilt" in frame.columns else []
    if not stored or any(products is None for products in stored):
        return ()
    return tuple(
        np.array(products, dtype=np.float64).reshape(len(columns) + 3, 2)
        for products, columns in zip(stored, settings.plan.support, strict=True)
    )


def _read_covariates(frame: pl.DataFrame, information: SquareRootInformation) -> dict[str, Array]:
    shape = (information.n_blocks, information.n_joints)
    found: dict[str, Array] = {}
    for row, covariates in enumerate(frame["covariates"].to_list()):
        for covariate in covariates or ():
            values = found.setdefault(covariate["name"], np.full(shape, np.nan))
            values[divmod(row, information.n_joints)] = covariate["value"]
    return found


def join_entries(entries: Sequence[Entry], most: int) -> SquareRootInformation:
    """Return the information of entries of one type, about `most` blocks in all.

    Each log keeps the same number of blocks, one at least.
    """
    each = most // len(entries)
    first, *others = (
        merge_blocks(entry.information, each) if each > 1 else entry.whole for entry in entries
    )
    return first.merge(*others)


def merge_factors(factors: Array) -> Array:
    """Return one triangular factor (q, q) of several (m, r, q), merged pair by pair.

    The tree depends on m alone, so the result is the same to the last bit wherever it is made; an
    entry takes part in log2(m) mergers, not in m. Short blocks are fewer rows than columns.
    """
    factors = np.array(
        [rows if is_triangular(rows) else triangular_factor(rows) for rows in factors]
    )
    while len(factors) > 1:
        pairs = factors[: len(factors) // 2 * 2].reshape(-1, 2 * factors.shape[1], factors.shape[2])
        merged = np.array([triangular_factor(pair) for pair in pairs])
        factors = np.concatenate([merged, factors[2 * len(pairs) :]])
    return np.asarray(factors[0])


def merge_blocks(information: SquareRootInformation, most: int) -> SquareRootInformation:
    """Return the information with at most `most` blocks, equal numbers of neighbours merged.

    Blocks of different recordings are merged too where there are more recordings than `most`.
    """
    n = information.n_blocks
    if n <= most:
        return information
    edges = np.linspace(0, n, most + 1).round().astype(int).tolist()
    groups = list(pairwise(edges))
    with use_one_blas_thread():
        factors = tuple(
            np.array([merge_factors(factor[first:last]) for first, last in groups])
            for factor in information.factors
        )
    sums = [information.torque_sum[first:last].sum(axis=0) for first, last in groups]
    times = [TimeBlock.spanning(information.blocks[first:last]) for first, last in groups]
    return replace(information, factors=factors, torque_sum=np.array(sums), blocks=tuple(times))
