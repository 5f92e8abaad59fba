"""Inverse dynamics, gravity torque and regressor of a robot as C99 with its numbers folded in."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import format_number
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import (
    BaseParameters,
    DriveSet,
    TorqueModel,
    described_drive,
    drive_torque,
    find_base_parameters,
    gravity_torque,
    inverse_dynamics,
    parameter_values,
)
from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.c.c_dynamics import Mechanism, add_drives, list_drive_entries
from asbuilt.writers.models.c.c_expressions import ZERO, StraightLine, Term
from asbuilt.writing import atomic_write

CHECKED_STATES = 3
"""States in the self-test of the C file."""


@dataclass(frozen=True, slots=True)
class CCode:
    """Hold the header and the source of a robot, or what its observer adds to them.

    All names begin with `prefix`.
    """

    prefix: str
    header: str
    source: str


def generate_c_code(
    model: RobotModel,
    *,
    drive: DriveSet | None = None,
    drive_values: ArrayLike | None = None,
    stem: str = "robot",
    prefix: str | None = None,
    observer: Callable[[str], CCode] | None = None,
) -> CCode:
    """Write a robot as C99; the source includes `<stem>.h`.

    `PREFIX_inverse_dynamics(q, qd, qdd, tau)` and `PREFIX_gravity_torque(q, tau)` use base
    parameters, which give the torques of the standard ones with fewer operations.
    `PREFIX_regressor(q, qd, qdd, Y)` fills the (n, p) regressor of the base parameters row by row;
    `PREFIX_base_values` and `PREFIX_base_parameters` hold their values, names and units: `tau = Y
    beta`. For controllers, `PREFIX_mass_matrix(q, M)` with the armatures of the drives,
    `PREFIX_coriolis(q, qd, tau)`, `PREFIX_friction(q, qd, tau)`, the drive terms at constant
    velocity, and `PREFIX_momentum(q, qd, p, gradient)`, which gives `M qd` and `C^T qd`.
    `observer` returns the momentum observer for a prefix. Drive terms add to inverse dynamics and
    regressor; `drive` and `drive_values` (joint by
    joint) default to the model's. The code allocates nothing and calls libm only.

    Raises
    ------
    UsageError
        For drive terms that C code does not have.
    """
    terms, known = described_drive(model)
    if drive is not None:
        terms = drive
        # Parameters that the description does not state act as zero.
        known = np.nan_to_num(parameter_values(model, drive)[len(model.parameters) :], nan=0.0)
    values = np.asarray(known if drive_values is None else drive_values, dtype=np.float64)
    base = find_base_parameters(model, terms)
    beta = base.values(np.concatenate([model.parameters, values]))
    name = prefix or _make_identifier(model.name)
    n = model.n_joints
    forward = Mechanism(model)
    still = Mechanism(model, at_rest=True)
    linear = Mechanism(model)
    # Standard parameters that have no torque of their own are zero, and cost no operation.
    chi = _derive_fewest_parameters(model)
    torques = add_drives(forward, forward.torques(chi), terms, values, chi)
    motion = ", ".join(f"const double {array}[{n}]" for array in ("q", "qd", "qdd"))
    functions = [
        _write_function(
            f"void {name}_inverse_dynamics({motion}, double tau[{n}])",
            forward.code,
            _assign_entries("tau", torques),
        ),
        _write_function(
            f"void {name}_gravity_torque(const double q[{n}], double tau[{n}])",
            still.code,
            _assign_entries("tau", still.torques(chi)),
        ),
        _write_function(
            f"void {name}_regressor({motion}, double Y[{n * base.n_base}])",
            linear.code,
            {
                f"Y[{j * base.n_base + k}]": entry
                for (j, k), entry in sorted(_derive_regressor(linear, base, terms, chi).items())
            },
            # Entries that are always zero are not written one by one.
            opening=(f"for (int k = 0; k < {n * base.n_base}; k++) Y[k] = 0.0;",),
        ),
        *_write_controller_functions(model, terms, values, chi, name),
    ]
    watching = CCode(name, "", "") if observer is None else observer(name)
    parts = [
        _write_comment(
            f"{model.name}: inverse dynamics, gravity torque, regressor and what controllers"
            f" need; see {stem}.h for units and conventions."
        ),
        f'#include "{stem}.h"\n\n#include <math.h>',
        _write_tables(base, beta, name),
        *functions,
        *filter(None, [watching.source]),
        _write_self_test(model, terms, values, base, name),
    ]
    return CCode(
        name,
        _write_header(model, base, terms, name, stem, watching.header),
        "\n\n".join(parts) + "\n",
    )


def write_c(
    path: str | os.PathLike[str],
    model: RobotModel,
    *,
    drive: DriveSet | None = None,
    drive_values: ArrayLike | None = None,
    observer: Callable[[str], CCode] | None = None,
) -> tuple[Path, Path]:
    """Write `NAME.c` and `NAME.h` with the functions of `generate_c_code`; return both paths."""
    target = Path(path)
    if target.suffix != ".c":
        raise UsageError(f"C code is written to NAME.c and its header NAME.h, got {target.name!r}")
    stem = re.sub(r"[^A-Za-z0-9_.+-]", "_", target.stem)
    if stem != target.stem:
        raise UsageError(
            f"the name of a C file must have plain characters, got {target.name!r}",
            cure=Cure(f"name it {stem}.c"),
        )
    code = generate_c_code(
        model, drive=drive, drive_values=drive_values, stem=stem, observer=observer
    )
    return atomic_write(target, code.source), atomic_write(target.with_suffix(".h"), code.header)


def _write_controller_functions(
    model: RobotModel, terms: DriveSet, values: Array, chi: Array, name: str
) -> list[str]:
    """Return mass matrix, Coriolis torque, friction and momentum as functions."""
    n = model.n_joints
    # The armature belongs to the mass matrix, as controllers invert it.
    armature = TorqueModel(model, terms, values).armature()
    still = Mechanism(model, at_rest=True)
    moving = Mechanism(model, steady=True)
    rubbing = Mechanism(model, steady=True)
    # Without gravity and acceleration, what is left of the torque is Coriolis'.
    weightless = Mechanism(replace(model, gravity=np.zeros(3)), steady=True)
    friction = add_drives(rubbing, [ZERO] * n, terms, values, chi)
    p, gradient = moving.momentum(chi, armature)
    masses = still.mass_matrix(chi, armature)
    q = f"const double q[{n}]"
    qd = f"const double qd[{n}]"
    return [
        _write_function(
            f"void {name}_mass_matrix({q}, double M[{n * n}])",
            still.code,
            {f"M[{j * n + k}]": masses[j, k] for j in range(n) for k in range(n)},
        ),
        _write_function(
            f"void {name}_coriolis({q}, {qd}, double tau[{n}])",
            weightless.code,
            _assign_entries("tau", weightless.torques(chi)),
        ),
        _write_function(
            f"void {name}_friction({q}, {qd}, double tau[{n}])",
            rubbing.code,
            # Drives at constant velocity: armatures have no torque there.
            _assign_entries("tau", friction),
        ),
        _write_function(
            f"void {name}_momentum({q}, {qd}, double p[{n}], double gradient[{n}])",
            moving.code,
            _assign_entries("p", p) | _assign_entries("gradient", gradient),
        ),
    ]


def _derive_fewest_parameters(model: RobotModel) -> Array:
    """Return standard parameters with the torques of the model, zero but at base columns.

    They are the parameters of the model if the torques differ by more than rounding, as for
    lengths of almost zero.
    """
    rigid = find_base_parameters(model)
    chi = np.zeros(10 * model.n_links)
    chi[rigid.columns] = rigid.values(model.parameters)
    states = draw_sample_states(model, 100)
    torques = inverse_dynamics(model, *states)
    apart = np.abs(inverse_dynamics(model, *states, parameters=chi) - torques).max()
    # Relative torque difference that is rounding.
    # Lengths of almost zero leave a regrouping that is not exact.
    return chi if apart <= 1e-12 * np.abs(torques).max() else model.parameters


def _derive_regressor(
    mechanism: Mechanism, base: BaseParameters, terms: DriveSet, parameters: Array
) -> dict[tuple[int, int], Term]:
    inertial = 10 * mechanism.model.n_links
    columns = [int(column) for column in base.columns if column < inertial]
    # Base columns of links come first, drives after them.
    entries = mechanism.regressor(columns)
    drives = list_drive_entries(mechanism, terms, parameters)
    return entries | {
        (j, position): entry
        for position, column in enumerate(base.columns[len(columns) :], start=len(columns))
        for j, entry in drives[int(column) - inertial].items()
    }


def _assign_entries(array: str, values: Sequence[Term]) -> dict[str, Term]:
    return {f"{array}[{j}]": value for j, value in enumerate(values)}


def _write_function(
    head: str, code: StraightLine, answers: dict[str, Term], *, opening: Sequence[str] = ()
) -> str:
    lines = [
        *code.used(list(answers.values())),
        *opening,
        *[f"{place} = {answer.written()};" for place, answer in answers.items()],
    ]
    read = {array for line in lines for array in re.findall(r"\b(\w+)\[", line)}
    # Compilers warn about arguments that are not read.
    given = re.findall(r"const double (\w+)\[", head)
    unused = [f"(void){array};" for array in given if array not in read]
    return "\n".join([head, "{", *[f"    {line}" for line in [*unused, *lines]], "}"])


def _write_header(
    model: RobotModel,
    base: BaseParameters,
    terms: DriveSet,
    name: str,
    stem: str,
    watching: str,
) -> str:
    n = model.n_joints
    p = base.n_base
    capital = name.upper()
    motion = ", ".join(f"const double {array}[{n}]" for array in ("q", "qd", "qdd"))
    about = "\n".join(
        [
            f"{model.name}: dynamics of {n} joints, written by asbuilt.",
            *[f"Note: {note}" for note in model.notes],
            "",
            "Joints, in the order of all arrays:",
            *(
                f"  {k}  {joint.name} ({'rad, N m' if joint.is_revolute else 'm, N'})"
                for k, joint in enumerate(model.joints)
            ),
            "",
            (
                "Units are SI: q [rad or m], qd, qdd per second, tau [N m or N]. tau is the torque"
                " that the drives exert on the links:"
            ),
            f"tau = rigid bodies + drive terms ({terms}). Coulomb friction is 0 at standstill.",
            f"Gravity in the root frame: {model.gravity.tolist()} m/s^2.",
            (
                f"Base parameters: {p}, names with the number of the link or joint, from 1;"
                " inertias about link origins in link axes."
            ),
            (
                f"Compile {stem}.c as C99 and link with -lm. With -D{capital}_SELF_TEST it is a"
                " program that checks itself."
            ),
            (
                "No function allocates memory or keeps a state of its own; all are safe to call"
                " from any thread."
            ),
            (
                "inverse_dynamics = mass_matrix qdd + coriolis + gravity_torque + friction, unless"
                " friction depends on load, which is then that without acceleration."
            ),
        ]
    )
    return f"""{_write_comment(about)}
#ifndef {capital}_H
#define {capital}_H

#ifdef __cplusplus
extern "C" {{
#endif

#define {capital}_JOINTS {n}
#define {capital}_BASE_PARAMETERS {p}

typedef struct {{
    int id;
    const char *name;
    const char *expression;
    const char *unit;
}} {name}_parameter;

/* What each base parameter is. */
extern const {name}_parameter {name}_base_parameters[{p}];

/* Values of the base parameters: tau = Y beta. */
extern const double {name}_base_values[{p}];

/* tau of a motion, drive terms included. */
void {name}_inverse_dynamics({motion}, double tau[{n}]);

/* tau that holds the links at rest, without drive terms. */
void {name}_gravity_torque(const double q[{n}], double tau[{n}]);

/* Regressor of the base parameters, row by row: Y[joint*{p} + parameter]. */
void {name}_regressor({motion}, double Y[{n * p}]);

/* Mass matrix of links and rotors, row by row: M[row*{n} + column]. */
void {name}_mass_matrix(const double q[{n}], double M[{n * n}]);

/* Centrifugal and Coriolis torque C(q, qd) qd. */
void {name}_coriolis(const double q[{n}], const double qd[{n}], double tau[{n}]);

/* Torque of the drive terms at constant velocity. */
void {name}_friction(const double q[{n}], const double qd[{n}], double tau[{n}]);

/* Generalised momentum p = M qd, and gradient = C(q, qd)^T qd. */
void {name}_momentum(const double q[{n}], const double qd[{n}], double p[{n}],
    double gradient[{n}]);
{watching}
#ifdef __cplusplus
}}
#endif

#endif
"""


def _write_tables(base: BaseParameters, beta: Array, name: str) -> str:
    p = base.n_base
    words = zip(base.names, base.expressions, base.units, strict=True)
    # A table of C literals, so that nothing is initialised at run time.
    rows = ",\n".join(
        f"    {{{number}, {', '.join(map(_write_string, words_of))}}}"
        for number, words_of in zip(base.ids, words, strict=True)
    )
    numbers = ",\n".join(f"    {format_number(value)}" for value in beta)
    return (
        f"const {name}_parameter {name}_base_parameters[{p}] = {{\n{rows}\n}};\n\nconst double"
        f" {name}_base_values[{p}] = {{\n{numbers}\n}};"
    )


def _write_self_test(
    model: RobotModel, terms: DriveSet, values: Array, base: BaseParameters, name: str
) -> str:
    q, qd, qdd = draw_sample_states(model, CHECKED_STATES)
    rigid = inverse_dynamics(model, q, qd, qdd)
    tau = rigid + drive_torque(terms, values, q, qd, qdd, load=rigid, shares=model.motor_shares)
    arrays = {"q": q, "qd": qd, "qdd": qdd, "tau": tau, "gravity": gravity_torque(model, q)}
    n = model.n_joints
    p = base.n_base
    S = CHECKED_STATES
    # Torques of large robots have rounding of their size.
    rounding = max(1e-9, 1e-12 * float(np.abs(tau).max()))
    known = "\n".join(
        f"static const double expected_{key}[{S}][{n}] = {{\n"
        + ",\n".join(f"    {{{', '.join(map(format_number, row))}}}" for row in rows)
        + "\n};"
        for key, rows in arrays.items()
    )
    return f"""#ifdef {name.upper()}_SELF_TEST

#include <stdio.h>

{known}

static double apart(double a, double b)
{{
    return a > b ? a - b : b - a;
}}

int main(void)
{{
    double worst = 0.0;
    for (int s = 0; s < {S}; s++) {{
        double tau[{n}], g[{n}], Y[{n * p}];
        {name}_inverse_dynamics(expected_q[s], expected_qd[s], expected_qdd[s], tau);
        {name}_gravity_torque(expected_q[s], g);
        {name}_regressor(expected_q[s], expected_qd[s], expected_qdd[s], Y);
        for (int j = 0; j < {n}; j++) {{
            double linear = 0.0;
            for (int k = 0; k < {p}; k++) linear += Y[j*{p} + k]*{name}_base_values[k];
            double errors[3] = {{apart(tau[j], expected_tau[s][j]),
                                apart(g[j], expected_gravity[s][j]),
                                apart(linear, expected_tau[s][j])}};
            for (int e = 0; e < 3; e++) if (!(errors[e] <= worst)) worst = errors[e];
        }}
    }}
    printf("largest torque error %.3g\\n", worst);
    return worst <= {rounding!r} ? 0 : 1;
}}

#endif"""


def _write_comment(text: str) -> str:
    lines = [
        # Comments must not end early, continue a line, or hold trigraphs.
        re.sub(r"[^ -~]|\*(?=/)|/(?=\*)|\\$|\?(?=\?)", "_", line)
        for line in text.splitlines()
    ]
    return "\n".join(["/*", *[f" * {line}".rstrip() for line in lines], " */"])


def _write_string(text: str) -> str:
    # Longest string; C99 compilers accept 4095 characters.
    plain = re.sub(r"[^ -~]", "_", text)[:2000]
    # A question mark could begin a trigraph.
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?") + '"'


def _make_identifier(name: str) -> str:
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return plain if plain and not plain[0].isdigit() else f"robot_{plain}".rstrip("_")
