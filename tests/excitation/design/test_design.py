from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics, observation_matrix
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import (
    PARAMETRISATIONS,
    DesignOptions,
    MotionBounds,
    SearchProgress,
    design_motion,
    information_efficiency,
    random_fourier,
)
from asbuilt.excitation.design.design import choose_size
from asbuilt.excitation.design.designed_motion import locate_base_parameter
from asbuilt.excitation.design.interior_point import Optimum
from asbuilt.excitation.design.multistart import Deadline, search_all
from asbuilt.excitation.design.search import Task, share_iterations
from asbuilt.writers import design_text

DRIVE = DriveSet.parse("viscous,coulomb,offset")
QUICK = DesignOptions(duration=8.0, size=4, starts=2)


def log_det_of(model, motion, drive=DRIVE) -> float:
    """log det of the information per sample, from the observation matrix."""
    base = find_base_parameters(model, drive)
    states = motion.at((np.arange(2000) + 0.5) * motion.duration / 2000)
    w = observation_matrix(model, *states, drive=drive, columns=base.columns)
    return 2 * float(np.log(np.linalg.svd(w, compute_uv=False)).sum()) - base.n_base * np.log(2000)


@pytest.fixture(scope="module")
def arm():
    model = load_robot("two-link")
    return model, design_motion(model, QUICK)


@pytest.fixture(scope="module")
def alone(arm):
    """The design of a whole population on one core."""
    model, _ = arm
    options = replace(QUICK, starts=24)
    return design_motion(model, options, cores=1, with_bound=False)


@pytest.mark.study
def test_a_design_beats_fifty_random_motions(arm) -> None:
    model, design = arm
    found = log_det_of(model, design.motion)
    assert design.log_det == pytest.approx(found + design.base.n_base * np.log(800), abs=1e-2)
    best = max(
        log_det_of(model, random_fourier(model, rng=k, duration=8.0, n_harmonics=4, fraction=0.95))
        for k in range(50)
    )
    assert found > best + 0.1 * design.base.n_base


@pytest.mark.parametrize(
    "robot",
    [*(pytest.param(name, marks=pytest.mark.study) for name in ("two-link", "ur10e")), "scara"],
)
def test_limits_hold_on_a_finer_grid_with_torques_by_pinocchio(robot: str) -> None:
    model = load_robot(robot)
    options = DesignOptions(duration=8.0, size=4, starts=1)
    motion = design_motion(model, options, with_bound=False).motion
    bounds = MotionBounds.assumed(model, 0.95)
    t = np.linspace(0, motion.duration, 13001)
    q, qd, qdd = motion.at(t)
    slack = 1e-5
    assert np.all(q <= bounds.upper + slack)
    assert np.all(q >= bounds.lower - slack)
    assert np.all(np.abs(qd) <= bounds.velocity * (1 + slack))
    assert np.all(np.abs(qdd) <= bounds.acceleration * (1 + slack))
    peer = pin.Model()
    peer.gravity.linear = np.array(model.gravity)
    for i, joint in enumerate(model.joints):
        after = (
            pin.SE3.Identity()
            if joint.parent < 0
            else pin.SE3(np.array(model.joints[joint.parent].after))
        )
        kind = pin.JointModelRZ() if joint.is_revolute else pin.JointModelPZ()
        number = peer.addJoint(
            joint.parent + 1, kind, after * pin.SE3(np.array(joint.before)), joint.name
        )
        inertia = model.links[i].inertia
        body = pin.Inertia(
            max(inertia.mass, 1e-12),
            inertia.com if inertia.mass else np.zeros(3),
            inertia.inertia_about_com if inertia.mass else np.zeros((3, 3)),
        )
        peer.appendBodyToJoint(number, body, pin.SE3(np.array(joint.after)))
    data = peer.createData()
    friction = [
        np.array([value or 0.0 for value in (joint.drive.viscous, joint.drive.coulomb)])
        for joint in model.joints
    ]
    if not any(f.any() for f in friction):
        torque = np.array([pin.rnea(peer, data, q[k], qd[k], qdd[k]) for k in range(0, len(t), 10)])
        assert np.all(np.abs(torque) <= 0.8 * MotionBounds.of(model).torque * (1 + 1e-4))


@pytest.mark.study
def test_the_same_seed_gives_the_same_motion_on_any_number_of_cores(arm, alone) -> None:
    model, design = arm
    helped = design_motion(model, alone.options, cores=3, with_bound=False)
    assert np.array_equal(alone.motion.coefficients, helped.motion.coefficients)
    other = design_motion(model, replace(QUICK, seed=1), with_bound=False)
    assert not np.array_equal(other.motion.coefficients, design.motion.coefficients)


@pytest.mark.study
def test_a_cluster_finds_the_same_motion(arm, alone) -> None:
    distributed = pytest.importorskip("distributed")
    model, options = arm[0], alone.options
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        helped = design_motion(model, options, with_bound=False, scheduler=address)
    assert np.array_equal(alone.motion.coefficients, helped.motion.coefficients)


@pytest.mark.parametrize(
    ("parametrisation", "size"),
    [
        ("point-to-point", 7),
        *(
            pytest.param(*family, marks=pytest.mark.study)
            for family in (("bspline", 9), ("quintic", 6))
        ),
    ],
)
def test_other_families_respect_the_limits_too(parametrisation: str, size: int) -> None:
    model = load_robot("two-link")
    design = design_motion(
        model, replace(QUICK, parametrisation=parametrisation, size=size), with_bound=False
    )
    assert design.limits.is_respected
    assert np.isfinite(design.log_det)
    assert np.allclose(design.motion.derivative([0.0, design.motion.duration], 1), 0)
    assert design.motion.duration <= 8.0 + 1e-9


@pytest.mark.study
def test_a_focus_lowers_the_error_of_what_it_names(arm) -> None:
    model, design = arm
    focused = design_motion(model, replace(QUICK, focus=("Izz2", "11")), with_bound=False)
    places = [locate_base_parameter(design.base, name) for name in ("Izz2", "11")]
    det = [
        np.linalg.det(np.linalg.inv(d.information)[np.ix_(places, places)])
        for d in (focused, design)
    ]
    assert det[0] < det[1]
    with pytest.raises(UsageError, match="no base parameter 'Izz9'"):
        design_motion(model, replace(QUICK, focus=("Izz9",)))
    lines = design_text(focused).splitlines()
    heads = next(k for k, line in enumerate(lines) if line.startswith("parameters in focus, then"))
    assert [line.split()[0] for line in lines[heads + 4 : heads + 6]] == ["16", "11"]
    assert any(line.split() == ["criterion", "d,", "for", "Izz2", "and", "11"] for line in lines)


def test_what_a_motion_cannot_tell_has_an_infinite_error(arm) -> None:
    _, design = arm
    pair = [locate_base_parameter(design.base, name) for name in ("Fv1", "Fc1")]
    alike = np.eye(design.base.n_base)
    alike[:, pair[1]] = 3.0 * alike[:, pair[0]]
    blind = replace(design, mean_information=alike.T @ design.mean_information @ alike)
    assert np.all(np.isinf(blind.std_errors[pair]))
    rest = np.setdiff1d(np.arange(design.base.n_base), pair)
    one = np.append(rest, pair[0])
    expected = np.sqrt(np.diag(np.linalg.inv(design.information[np.ix_(one, one)])))[:-1]
    np.testing.assert_allclose(blind.std_errors[rest], expected, rtol=1e-6)
    written = design_text(blind)
    assert written.count("  undetermined") == 2
    assert "2 parameters UNDETERMINED" in written
    assert "above 1e+07" in written


def test_what_is_known_already_need_not_be_told_again(arm) -> None:
    model, design = arm
    weak = locate_base_parameter(design.base, "Fo1")
    known = 1e6 * np.diag(np.diag(design.information))
    known[weak] = known[:, weak] = 0.0
    follow = design_motion(model, QUICK, prior=known, with_bound=False)
    alone = 1 / np.sqrt(follow.information[weak, weak])
    assert follow.std_errors[weak] == pytest.approx(alone, rel=1e-2)
    assert np.all(follow.std_errors <= design.std_errors * (1 + 1e-6))
    with pytest.raises(UsageError, match="same drive terms"):
        design_motion(model, QUICK, prior=np.eye(3))


@pytest.mark.study
def test_criteria_win_at_their_own_game(arm) -> None:
    model, design = arm
    even = design_motion(model, replace(QUICK, criterion="condition"), with_bound=False)
    assert even.log_det < design.log_det
    assert even.scaled_condition_number < design.scaled_condition_number * 1.05


@pytest.mark.study
def test_power_and_other_robots_tighten_a_design(arm) -> None:
    model, design = arm
    t = np.linspace(0, 8, 4001)

    def power(found) -> float:
        state = found.motion.at(t)
        return float(np.abs(inverse_dynamics(model, *state) * state[1]).max())

    limit = 0.5 * power(design)
    weak = design_motion(model, replace(QUICK, power=(limit,)), with_bound=False)
    assert power(weak) <= limit * (1 + 1e-6)
    assert f"power at most {power(weak):.3g} W of the {limit:g} W allowed" in weak.notes[0]
    assert weak.log_det < design.log_det
    careful = design_motion(
        model, replace(QUICK, perturbed=2, spread=0.3, torque_fraction=0.3), with_bound=False
    )
    assert careful.limits.worst["torque"].margin >= 0.7 - 1e-6


def test_an_interrupt_keeps_the_best_so_far(arm) -> None:
    model, _ = arm

    def stop(state) -> None:
        if state.finished >= 2:
            raise KeyboardInterrupt

    kept = design_motion(model, replace(QUICK, starts=40), progress=stop, with_bound=False, cores=1)
    assert kept.interrupted
    assert kept.limits.is_respected


def test_a_robot_too_weak_for_its_weight_is_told_so() -> None:
    model = load_robot("two-link")
    weak = model.with_limits([replace(joint.limits, torque=1e-3) for joint in model.joints])
    with pytest.raises(MotionError, match="no motion within the constraints"):
        design_motion(weak, replace(QUICK, starts=1), with_bound=False)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("precision", 0.0),
        ("duration", -1.0),
        ("fraction", 1.5),
        ("starts", 0),
        ("size", 1),
        ("time_limit", np.nan),
    ],
)
def test_senseless_options_are_refused(field: str, value) -> None:
    with pytest.raises(UsageError, match=f"{field} is "):
        DesignOptions(**{field: value})


@pytest.mark.study
def test_a_wanted_precision_finds_its_duration(arm) -> None:
    model, design = arm
    reached = design.precision
    wanted = replace(QUICK, size=None, starts=2, duration="auto", precision=reached / 1.5)
    longer = design_motion(model, wanted)
    assert longer.motion.duration > 8
    assert longer.precision <= reached / 1.5
    assert [trial.duration for trial in longer.trials] == sorted(
        trial.duration for trial in longer.trials
    )


def test_an_interrupt_ends_the_search_for_a_duration(arm) -> None:
    model, _ = arm

    def stop(_) -> None:
        raise KeyboardInterrupt

    wanted = replace(QUICK, size=None, duration="auto", precision=1e-4)
    design = design_motion(model, wanted, progress=stop)
    assert design.interrupted
    assert [trial.duration for trial in design.trials] == [10.0]


def test_a_search_that_does_worse_with_more_time_is_told_so(arm, monkeypatch) -> None:
    model, design = arm
    found = iter([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08])

    class Found:
        interrupted, size, size_name, options = False, 4, "harmonics", design.options

        @property
        def precision(self) -> float:
            return next(found)

    monkeypatch.setattr("asbuilt.excitation.design.design.design_fixed", lambda *_, **__: Found())
    with pytest.raises(
        MotionError,
        match=r"0\.01 with 10 s and 4 harmonics, .* the search finds nothing better",
    ):
        design_motion(model, replace(QUICK, duration="auto", precision=0.005))


def test_a_recording_is_told_how_much_it_carries(arm) -> None:
    model, design = arm
    good = information_efficiency(model, DRIVE, design.motion.sample(100))
    poor = information_efficiency(model, DRIVE, design.motion.slowed(4.0).sample(100))
    assert 1 > good.d_efficiency > 2 * poor.d_efficiency > 0
    frozen = design.motion.sample(100)
    held = type(frozen)(frozen.t, frozen.q * [1, 0], frozen.qd * [1, 0], frozen.qdd * [1, 0])
    still = information_efficiency(model, DRIVE, held)
    assert still.d_efficiency == 0
    assert still.by_joint[1] == 0


@pytest.mark.study
def test_the_time_limit_covers_bounds_search_and_refinement(arm, monkeypatch) -> None:
    """A clock that only goes on when looked at makes the time spent a number of looks, whatever the
    machine.
    """
    model, _ = arm
    clock = itertools.count(step=0.01)
    monkeypatch.setattr("asbuilt.excitation.design.multistart.time.monotonic", lambda: next(clock))
    told: list[SearchProgress] = []
    design = design_motion(
        model, replace(QUICK, starts=500, time_limit=10.0), progress=told.append, cores=1
    )
    assert [phase for phase, _ in itertools.groupby(state.phase for state in told)] == [
        "bound",
        "search",
        "refinement",
    ]
    assert 8.0 < design.solve_seconds < 10.5
    assert design.bound is not None
    assert all(0 <= state.share <= 1 for state in told)
    assert not design.interrupted
    assert design.limits.is_respected


def test_a_slow_machine_finds_the_same_motion(arm, monkeypatch) -> None:
    """Minutes pass whenever the search looks at the clock: counts end it, no time does."""
    model, design = arm
    clock = itertools.count(step=100.0)
    monkeypatch.setattr("asbuilt.excitation.design.multistart.time.monotonic", lambda: next(clock))
    late = design_motion(model, QUICK, with_bound=False, cores=1)
    assert late.solve_seconds > 1000.0
    assert late.candidates == design.candidates
    t = np.linspace(0.0, 8.0, 50)
    assert np.array_equal(late.motion.at(t), design.motion.at(t))


def test_large_robots_get_fewer_searches_of_the_same_work() -> None:
    tasks = [Task(number) for number in range(8)]
    assert [task.iterations for task in share_iterations(tasks, 10**6)] == [400] * 8
    assert [task.iterations for task in share_iterations(tasks, 800)] == [100] * 8
    assert [task.iterations for task in share_iterations(tasks, 200)] == [66] * 3
    # Something must be found.
    assert [task.number for task in share_iterations(tasks, 0)] == [0]


@pytest.mark.study
def test_a_new_population_begins_where_one_brings_nothing_more(arm, alone) -> None:
    """Searches are numbered through all populations, and the best of all is kept."""
    model, design = arm
    most = design_motion(model, replace(QUICK, starts=26), with_bound=False)
    assert set(alone.candidates) < set(most.candidates)
    assert most.candidates[0] >= alone.candidates[0] >= design.candidates[0] - 1.0


def test_an_interrupt_of_the_refinement_keeps_its_best(arm) -> None:
    model, _ = arm

    def stop(state: SearchProgress) -> None:
        if state.phase == "refinement":
            raise KeyboardInterrupt

    kept = design_motion(model, QUICK, progress=stop, with_bound=False, cores=1)
    assert kept.interrupted
    assert kept.limits.is_respected


def test_a_search_whose_time_is_up_still_has_an_answer() -> None:
    """The first search runs, no other does.

    A deadline that has been reached by then is the searches' own to look at.
    """
    ran: list[int] = []

    def search(number: int) -> Optimum:
        ran.append(number)
        return Optimum(np.zeros((1, 1)), float(number), number=number)

    found = search_all(range(5), search, Deadline(0.0))
    assert ran == [0]
    assert [candidate.number for candidate in found] == [0]


def test_quick_robots_get_more_harmonics_where_none_are_asked_for() -> None:
    """A tenth of a / v: 0.25 Hz for limits that were assumed, more where the description allows
    more acceleration.
    """
    slow = MotionBounds.assumed(load_robot("kuka-iiwa7-r800"))
    quick = replace(slow, acceleration=6.0 * slow.velocity)

    def size(bounds, **options):
        return choose_size(DesignOptions(**{"duration": 20.0, **options}), bounds)[0].size

    def size_and_periods(bounds, **options):
        found = choose_size(DesignOptions(duration=100.0, **options), bounds)[0]
        return found.size, found.periods

    assert size(slow) == 5
    assert size(quick) == 12
    assert size_and_periods(slow) == (25, 1)
    assert size_and_periods(quick) == (15, 4)
    assert size_and_periods(quick, periods=1) == (25, 1)
    assert size(quick, size=7) == 7
    for family, few, many in (("bspline", 17, 39), ("quintic", 17, 20), ("point-to-point", 17, 17)):
        assert PARAMETRISATIONS[family].usual_size(20.0, None)[0] == few
        assert size(slow, parametrisation=family) == few
        assert size(quick, parametrisation=family) == many
    assert size(quick, duration=60.0, parametrisation="bspline") == 49


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(UsageError, match=r"available: .*fourier"):
        design_motion("two-link", DesignOptions(parametrisation="spline"))


@pytest.mark.study
def test_no_motion_is_nearer_to_the_bound_of_all_states_than_to_that_of_its_own(arm) -> None:
    model, _ = arm
    for limit in (0.5, 4.0):
        design = design_motion(model, replace(QUICK, time_limit=limit))
        assert design.family_efficiency >= design.d_efficiency
