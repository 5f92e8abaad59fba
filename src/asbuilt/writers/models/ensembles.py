"""An ensemble as a folder: model files, one table, ranges and a module that loads them."""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification.ensembles.ensemble import QUANTILES, Ensemble
from asbuilt.tables import Column, Shown, Table, round_significant
from asbuilt.writers.files import file_lines, path_texts
from asbuilt.writers.models.as_built import (
    keep_described_drives,
    with_standard_parameters,
)
from asbuilt.writers.models.control import note_missing_gains, with_gains
from asbuilt.writers.models.export import find_urdf_to_edit, note_held_base
from asbuilt.writers.models.mjcf import note_mjcf_limits, write_mjcf
from asbuilt.writers.models.urdf import write_urdf
from asbuilt.writers.models.urdf_edit import note_urdf_limits
from asbuilt.writers.tables.tabular import write_json
from asbuilt.writing import atomic_write, file_set


def encode_parquet(ensemble: Ensemble) -> bytes:
    """Return the table as Parquet: a row for every robot, units in the metadata of the file.

    The column `draw` is the number of the model file, the others are named as in a result.
    """
    import polars  # noqa: PLC0415 - slow

    columns = dict(zip(ensemble.names, ensemble.table.T, strict=True))
    frame = polars.DataFrame({"draw": np.arange(len(ensemble), dtype=np.int64), **columns})
    content = io.BytesIO()
    units = {"draw": "", **dict(zip(ensemble.names, ensemble.units, strict=True))}
    frame.write_parquet(
        content, metadata={"units": json.dumps(units), "robot": ensemble.result.robot}
    )
    return content.getvalue()


def summarise_ranges(ensemble: Ensemble) -> list[dict[str, Any]]:
    """Return name, unit, owner, value, spread and quantiles of every column."""
    spread = ensemble.table.std(axis=0)
    keys = [f"q{round(100 * quantile):02d}" for quantile in QUANTILES]
    return [
        {
            "name": name,
            "unit": unit,
            **owner,
            "value": value,
            "std": std,
            **dict(zip(keys, column, strict=True)),
        }
        for name, unit, owner, value, std, column in zip(
            ensemble.names,
            ensemble.units,
            _list_owners(ensemble),
            ensemble.middle.tolist(),
            spread.tolist(),
            ensemble.quantiles.T.tolist(),
            strict=True,
        )
    ]


def summarise_correlation(ensemble: Ensemble) -> dict[str, Any]:
    """Return the correlation matrix of the columns that vary, with their names."""
    table = ensemble.table
    spread = table.std(axis=0)
    size = np.abs(table).mean(axis=0)
    # Spread relative to the value below which a column is constant (rounding of the fits).
    varies = np.flatnonzero((spread > 1e-9 * size) & (spread > np.finfo(np.float64).tiny))
    names = [ensemble.names[k] for k in varies]
    # One robot has no correlation.
    if len(ensemble) < 2 or not names:
        return {"names": [], "matrix": []}
    matrix = np.atleast_2d(np.corrcoef(table[:, varies].T))
    return {"names": names, "matrix": np.round(matrix, 6).tolist()}


def _list_owners(ensemble: Ensemble) -> list[dict[str, str]]:
    """Return the link or joint that each column belongs to."""
    model = ensemble.result.model
    drive = ensemble.result.base.drive
    links = [{"link": name} for name in model.link_names for _ in PARAMETER_NAMES]
    joints = [{"joint": name} for name in model.joint_names for _ in range(drive.columns_per_joint)]
    return [*links, *joints, *({"joint": name} for name in ensemble.gains.joints)]


def ensemble_model(ensemble: Ensemble, draw: int) -> RobotModel:
    """Return one robot of an ensemble, counted from 0, with its drive terms and gains."""
    result = ensemble.result
    law = ensemble.gains.law(draw)
    robot = with_standard_parameters(
        result.model, result.base.drive, ensemble.parameters[draw].copy()
    )
    # What was not drawn is as described.
    kept, _ = keep_described_drives(with_gains(robot, law), result.model)
    note = f"draw {draw} of {len(ensemble)} from the uncertainty of the identified parameters"
    if law is not None:
        note += f"; delay of the servo {law.delay!r} s"
    return replace(kept, notes=(*result.model.notes, note))


ModelFormat = Literal["mjcf", "urdf"]
SUFFIXES: dict[str, str] = {"mjcf": ".xml", "urdf": ".urdf"}
MARK = "ensemble.json"


@dataclass(frozen=True, slots=True, eq=False)
class EnsembleFiles:
    """Hold the files of an ensemble by kind, with notes and the `document` of `ensemble.json`."""

    ensemble: Ensemble
    files: dict[str, Path]
    models: tuple[Path, ...]
    notes: tuple[str, ...]
    document: dict[str, Any]

    def as_document(self) -> dict[str, Any]:
        """Return what `ensemble.json` holds, with the paths of the files."""
        return {
            **self.document,
            "files": {**path_texts(self.files), "models": [str(path) for path in self.models]},
        }

    def as_text(self, full: bool = False) -> str:
        """Return the ranges of drives and gains, `full` of the links too, the files and notes."""
        head = f"{self.ensemble.result.robot}: {len(self.ensemble)} robots, equally probable"
        columns = tuple(Column(name) for name in ("parameter", "of", "unit", "5 %", "50 %", "95 %"))
        rows = tuple(
            (
                row["name"],
                row.get("joint", row.get("link", "")),
                row["unit"],
                *(Shown(row[key], round_significant(row[key], 4)) for key in ("q05", "q50", "q95")),
            )
            for row in self.document["parameters"]
            if full or "joint" in row
        )
        files = {"models": Path(f"{self.models[0]} ... {self.models[-1].name}"), **self.files}
        listed = file_lines(files, {}, 10) + [f"  note: {note}" for note in self.notes]
        return "\n".join([head, "", Table(columns, rows).as_text().strip(), "", *listed])


def write_ensemble(
    folder: str | os.PathLike[str],
    ensemble: Ensemble,
    *,
    models: ModelFormat = "mjcf",
    seed: int | None = None,
) -> EnsembleFiles:
    """Write `model_000.xml ...`, `parameters.parquet`, `ensemble.json` and `load_ensemble.py`.

    Members of an earlier ensemble in the folder are replaced.

    Parameters
    ----------
    folder
        Where to write.
    ensemble
        The robots.
    models
        Format of the model files: `"mjcf"` or `"urdf"` (the original URDF edited, if there is one).
    seed
        Seed that `ensemble.json` names.

    Raises
    ------
    UsageError
        If there is no such format, or the folder is not writable.
    """
    if models not in SUFFIXES:
        raise UsageError(
            f"there is no model format {models!r}", cure=Cure(f"take one of {', '.join(SUFFIXES)}")
        )
    # At least three digits, and as many as the last number has.
    place = Path(folder)
    digits = max(3, len(str(len(ensemble) - 1)))
    names = [f"model_{draw:0{digits}d}{SUFFIXES[models]}" for draw in range(len(ensemble))]
    notes = (*ensemble.notes, *_format_notes(ensemble, models))
    document = _build_document(ensemble, seed, names, notes)
    # Members of an earlier ensemble of either format would be loaded with the new ones.
    older = [path.name for ends in SUFFIXES.values() for path in place.glob(f"model_*{ends}")]
    with file_set(place, MARK, [*older, "parameters.parquet", "load_ensemble.py", MARK]):
        written = [_write_model(place / name, ensemble, k, models) for k, name in enumerate(names)]
        files = {
            "parameters": atomic_write(place / "parameters.parquet", encode_parquet(ensemble)),
            "loader": atomic_write(
                place / "load_ensemble.py", LOADER.replace("@SUFFIX@", SUFFIXES[models])
            ),
            "ensemble": write_json(place / MARK, document),
        }
    return EnsembleFiles(ensemble, files, tuple(written), notes, document)


def _build_document(
    ensemble: Ensemble, seed: int | None, names: list[str], notes: tuple[str, ...]
) -> dict[str, Any]:
    result = ensemble.result
    return {
        "robot": result.robot,
        "draws": len(ensemble),
        "seed": seed,
        "method": result.method,
        "sources": list(result.sources),
        "moved": ensemble.moved,
        "models": names,
        "parameters": summarise_ranges(ensemble),
        "correlation": summarise_correlation(ensemble),
        "notes": list(notes),
    }


def _write_model(path: Path, ensemble: Ensemble, draw: int, models: ModelFormat) -> Path:
    robot = ensemble_model(ensemble, draw)
    if models == "mjcf":
        return write_mjcf(path, robot)[0]
    original, _ = find_urdf_to_edit(ensemble.result.model)
    return write_urdf(path, robot, original=original)[0]


def _format_notes(ensemble: Ensemble, models: ModelFormat) -> tuple[str, ...]:
    """Return what files of this format cannot hold."""
    # Limits of a format are the same for all draws: one stands for them.
    first = ensemble_model(ensemble, 0)
    _, kept = keep_described_drives(first, ensemble.result.model)
    notes = note_mjcf_limits(first) if models == "mjcf" else note_urdf_limits(first)
    return (
        *([f"numbers are from draw 0: {'; '.join(notes)}"] if notes else []),
        *kept,
        *note_missing_gains(ensemble.result, models),
        *(note_held_base(ensemble.result.model) if models == "mjcf" else ()),
    )


LOADER = '''"""Load the ensemble of this folder in MuJoCo, or one robot of it per world in mjlab.

Needs mujoco; `table` needs polars, `randomize` needs mjlab. Written by asbuilt; change it freely.
"""

import json
from pathlib import Path

import mujoco
import numpy as np

FOLDER = Path(__file__).resolve().parent
FILES = sorted(FOLDER.glob("model_*@SUFFIX@"))
FIELDS = (
    "body_mass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "actuator_gainprm",
    "actuator_biasprm",
)


def models():
    """Yield every robot as a MuJoCo model."""
    for file in FILES:
        yield mujoco.MjModel.from_xml_path(str(file))


def ranges():
    """Return (lowest, highest) of every parameter: its 5 and 95 % quantiles."""
    document = json.loads((FOLDER / "ensemble.json").read_text(encoding="utf-8"))
    return {each["name"]: (each["q05"], each["q95"]) for each in document["parameters"]}


def table():
    """Return parameters.parquet as a data frame, a row for every robot."""
    import polars

    return polars.read_parquet(FOLDER / "parameters.parquet")


def spec():
    """Return the first robot for mjlab: EntityCfg(spec_fn=spec)."""
    return mujoco.MjSpec.from_file(str(FILES[0]))


def event():
    """Return the mjlab event that gives each world one robot: events={"robot": event()}.

    The parameters of one robot stay together, so that their correlations hold, which ranges of
    single parameters do not keep.
    """
    import torch
    from mjlab.managers.event_manager import (
        EventTermCfg,
        RecomputeLevel,
        requires_model_fields,
    )
    from mjlab.managers.scene_entity_config import SceneEntityCfg

    robots = list(models())

    @requires_model_fields(*FIELDS, recompute=RecomputeLevel.set_const)
    def randomize(env, env_ids, asset_cfg):
        if env_ids is None:
            env_ids = torch.arange(env.num_envs, device=env.device)
        own = env.scene[asset_cfg.name].indexing
        chosen = torch.randint(len(robots), (len(env_ids),)).tolist()
        for field in FIELDS:
            kind = field.split("_")[0]
            ids = {"body": own.body_ids, "dof": own.joint_v_adr, "actuator": own.ctrl_ids}[kind]
            first = 1 if kind == "body" else 0
            values = [getattr(robots[draw], field)[first : first + len(ids)] for draw in chosen]
            target = getattr(env.sim.model, field)
            target[env_ids[:, None], ids] = torch.as_tensor(
                np.stack(values), dtype=target.dtype, device=env.device
            )

    return EventTermCfg(
        func=randomize, mode="startup", params={"asset_cfg": SceneEntityCfg("robot")}
    )


if __name__ == "__main__":
    for number, robot in enumerate(models()):
        print(number, "total mass [kg]", mujoco.mj_getTotalmass(robot))
'''
