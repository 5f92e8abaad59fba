"""Virtual fleets in which some robots change: false alarms, and changes found within two days.

    python benchmarks/fleet_drift.py [--robots 200] [--days 60] [--seeds 1] [--first-seed 1]
        [--types ur10e kuka-iiwa7-r800 franka-panda]

The rules were set on seed 1 of the default types; other seeds and types test them. Types are names
of bundled robots or paths, an odd number of them, so that robots of every type change.

Every robot has mass properties and friction of its own; every day it makes one of many motions of
15 s at 25 Hz at a random time of the day. The temperature, which is not logged, moves its viscous
friction by 15 % (sine over the day) and its Coulomb friction by 3 %. A quarter of the robots
changes two days before the end, in four ways. The noise of a joint is 2 % of its torque RMS.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from asbuilt.apps.fleet.drift.columns import Day, FleetColumns
from asbuilt.apps.fleet.drift.drift import FleetDrift, conclude_drift, scan_type
from asbuilt.apps.fleet.options import FleetDriftOptions
from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.rotation import find_axes_across
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.newton_euler import gravity_torque
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.excitation.motions.fourier import random_fourier

TYPES = ("ur10e", "kuka-iiwa7-r800", "franka-panda")
CHANGES = ("payload", "friction", "gain", "tilt")
MOTIONS, SECONDS, RATE = 24, 15.0, 25.0
NOISE = 0.02
FRICTION = 0.03
"""Coulomb friction in the torque range of the joint; viscous the same at 1 rad/s."""
CYCLE, COULOMB_CYCLE = 0.15, 0.03
SPREAD = 0.05
START = datetime(2026, 1, 1, tzinfo=UTC)
LATE = 2
"""Days of the ledger after a change."""
RAMP = 5


@dataclass(frozen=True, eq=False)
class VirtualType:
    """Hold columns of the motions of a robot type, so that a day is a few matrix products."""

    name: str
    columns: FleetColumns
    rows: list[list[Array]]
    tilts: list[list[Array]]
    design: Array
    torque: Array

    @classmethod
    def of(cls, name: str, seed: int = 0) -> VirtualType:
        """Evaluate the motions of a type."""
        model = load_robot(name)
        drive = DriveSet.parse("viscous,coulomb,offset,armature")
        base = find_base_parameters(model, drive)
        plan = RegressorPlan.of(model, drive, base.columns, spare_rows=1)
        n = model.n_joints
        columns = FleetColumns(
            base, tuple(plan.support), model.joint_names, ("N m",) * n, model.tool_link
        )
        tilted = [
            model.with_gravity(np.cross(model.gravity, a)) for a in find_axes_across(model.gravity)
        ]
        chi = np.nan_to_num(parameter_values(model, drive), nan=0.0)
        effort = np.array([min(joint.limits.torque, 500.0) for joint in model.joints])
        per = drive.columns_per_joint
        for k in range(n):
            first = 10 * n + per * k
            names = drive.names(k + 1)
            for i, symbol in enumerate(names):
                share = {"Fv": FRICTION, "Fc": FRICTION}.get(symbol.rstrip("0123456789"), 0.0)
                chi[first + i] = share * effort[k]
                if symbol.startswith("Ia"):
                    chi[first + i] = 0.002 * effort[k]
        rows, tilts = [], []
        for m in range(MOTIONS):
            motion = random_fourier(model, rng=1000 * seed + m, duration=SECONDS)
            path = motion.sample(RATE)
            q, qd, qdd = path.q, path.qd, path.qdd
            buffer = plan.buffer(len(q))
            rows.append([each[:-1].T.copy() for each in plan.evaluate(q, qd, qdd, buffer)])
            gravity = [gravity_torque(each, q) for each in tilted]
            tilts.append([np.column_stack([g[:, k] for g in gravity]) for k in range(n)])
        beta = base.values(chi)
        torque = np.sqrt(
            np.mean(
                [
                    [np.mean((W @ beta[s]) ** 2) for W, s in zip(each, plan.support, strict=True)]
                    for each in rows
                ],
                axis=0,
            )
        )
        return cls(name, columns, rows, tilts, chi, torque)


@dataclass(frozen=True, eq=False)
class VirtualMember:
    """Make the days of one robot of a fleet."""

    kind: VirtualType
    seed: int
    change: str | None
    when: int
    n_days: int

    def days(self) -> tuple[Day, ...]:
        """Return its days, the same ones for the same seed."""
        rng = np.random.default_rng(self.seed)
        kind, base = self.kind, self.kind.columns.base
        n = kind.columns.n_joints
        chi = kind.design * (1.0 + SPREAD * rng.standard_normal(len(kind.design)))
        names = list(base.standard_names)
        viscous = [names.index(f"Fv{k + 1}") for k in range(n)]
        coulomb = [names.index(f"Fc{k + 1}") for k in range(n)]
        joint, axis = int(rng.integers(n)), rng.standard_normal(2)
        axis /= np.linalg.norm(axis)
        sign = rng.choice([-1.0, 1.0])
        found = []
        for day in range(self.n_days):
            hour = rng.uniform(0.0, 24.0)
            warmth = np.sin(2.0 * np.pi * hour / 24.0)
            here, gains, tilt = chi.copy(), np.ones(n), np.zeros(2)
            here[viscous] *= 1.0 - CYCLE * warmth
            here[coulomb] *= 1.0 - COULOMB_CYCLE * warmth
            if self.change == "friction" and day >= self.when - RAMP + 1:
                grown = 0.3 * min(1.0, (day - (self.when - RAMP)) / RAMP)
                here[[viscous[joint], coulomb[joint]]] *= 1.0 + grown
            elif self.change is not None and day >= self.when:
                if self.change == "payload":
                    tool = LinkInertia.from_com(0.5, TOOL, 5e-4 * np.eye(3))
                    here[10 * (n - 1) : 10 * n] += tool.parameters
                elif self.change == "gain":
                    gains[joint] = 1.0 + 0.05 * sign
                elif self.change == "tilt":
                    tilt = np.deg2rad(0.3) * axis
            beta = base.values(here)
            m = int(rng.integers(MOTIONS))
            grams = []
            for k, places in enumerate(kind.columns.support):
                W, T = kind.rows[m][k], kind.tilts[m][k]
                tau = gains[k] * (W @ beta[places] + T @ tilt)
                tau += NOISE * kind.torque[k] * rng.standard_normal(len(tau))
                X = np.column_stack([W, tau, T])
                grams.append(X.T @ X)
            date = START + timedelta(days=day, hours=hour)
            found.append(Day(date, date, 1, len(kind.rows[m][0]), tuple(grams), {}))
        return tuple(found)


TOOL = np.array([0.02, 0.01, 0.05])
"""Centre of the payload in the last link [m]."""


def fleet(
    kinds: list[VirtualType], n_robots: int, n_days: int, seed: int
) -> dict[str, VirtualMember]:
    """Return the robots of a fleet; each fourth changes."""
    members = {}
    for i in range(n_robots):
        change = CHANGES[(i // 4) % len(CHANGES)] if i % 4 == 0 else None
        kind = kinds[i % len(kinds)]
        members[f"r{i:03d}"] = VirtualMember(kind, 10_000 * seed + i, change, n_days - LATE, n_days)
    return members


def found_in(members: dict[str, VirtualMember]) -> FleetDrift:
    """Return what the drift of a virtual fleet is."""
    rows, types = [], []
    for kind in {id(each.kind): each.kind for each in members.values()}.values():
        ids = [name for name, each in members.items() if each.kind is kind]
        some, variation = scan_type(kind.name, kind.columns, ids, lambda name: members[name].days())
        rows += some
        types.append(variation)
    return conclude_drift("virtual", None, rows, types, FleetDriftOptions())


def measured(members: dict[str, VirtualMember], drift: FleetDrift) -> dict[str, object]:
    """Return rates of false alarms, changes found, dated and named."""
    by_id = {each.id: each for each in drift.robots}
    alarms = len(drift.changed)
    false = [each for each in drift.changed if members[each.id].change is None]
    found: dict[str, object] = {
        "alarms": alarms,
        "false": len(false),
        "null_p": sorted(
            round(by_id[name].p_value or 0.0, 4)
            for name, each in members.items()
            if each.change is None
        )[:5],
        "directions": [each.n_directions for each in drift.types],
        "autocorrelation": [round(each.autocorrelation, 3) for each in drift.types],
    }
    for change in CHANGES:
        ids = [name for name, each in members.items() if each.change == change]
        hit = [by_id[name] for name in ids if by_id[name].changed]
        named = Counter(each.what[0].effect for each in hit if each.what)
        late = [
            abs((datetime.fromisoformat(str(each.when)) - START).days - members[each.id].when)
            for each in hit
        ]
        sizes = [
            each.what[0].estimate for each in hit if each.what and each.what[0].effect == change
        ]
        found[change] = {
            "robots": len(ids),
            "found": len(hit),
            "named": dict(named),
            "days_off": max(late, default=None),
            "median_size": round(float(np.median(np.abs(sizes))), 3)
            if sizes and None not in sizes
            else None,
        }
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--days", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--types", nargs="+", default=TYPES)
    given = parser.parse_args()
    if len(given.types) % 2 == 0:
        parser.error("the number of types must be odd")
    kinds = [VirtualType.of(name) for name in given.types]
    for seed in range(given.first_seed, given.first_seed + given.seeds):
        began = time.monotonic()
        members = fleet(kinds, given.robots, given.days, seed)
        result = measured(members, found_in(members))
        seconds = round(time.monotonic() - began, 1)
        print(json.dumps({"seed": seed} | result | {"seconds": seconds}), flush=True)
