"""The Python module beside an ensemble that loads it."""

from __future__ import annotations

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


def loader_text(suffix: str) -> str:
    """Return the module for model files that end so."""
    return LOADER.replace("@SUFFIX@", suffix)
