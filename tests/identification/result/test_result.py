"""The result as an object: what it says, what it stores, what it predicts."""

from __future__ import annotations

import html
import json
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import (
    DriveSet,
    find_base_parameters,
    inverse_dynamics,
    observation_matrix,
    parameter_values,
)
from asbuilt.errors import IdentifiabilityError, ResultError, UsageError
from asbuilt.experiment import Samples
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.findings import Cure, Finding
from asbuilt.identification import (
    IdentificationResult,
    IdentifiedParameter,
    conclude,
    design_values,
    fit_least_squares,
    identify_samples,
    summarise,
    torque_metrics,
)
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.identification.uncertainty.block_scatter import BlockScatter
from asbuilt.statistics import confidence_intervals

DRIVE = DriveSet.parse("viscous,coulomb,offset")
GOLDEN = Path(__file__).parent / "summary.txt"


@pytest.fixture(scope="module")
def arm():
    model = load_robot("two-link")
    return model, find_base_parameters(model, DRIVE)


def recorded(model, base, noise=0.05, n_samples=1200, seed=0, still=(), **given):
    rng = np.random.default_rng(seed)
    n, rate = model.n_joints, 100.0
    t = np.arange(n_samples) / rate
    frequency, phase = rng.uniform(0.2, 2.0, (4, 1, n)), rng.uniform(0, 6.0, (4, 1, n))
    angle = 2 * np.pi * frequency * t[:, None] + phase
    q = np.sum(0.5 * np.sin(angle), axis=0)
    qd = np.sum(np.pi * frequency * np.cos(angle), axis=0)
    qdd = -np.sum(2 * np.pi**2 * frequency**2 * np.sin(angle), axis=0)
    for joint in still:
        q[:, joint], qd[:, joint], qdd[:, joint] = 0.5, 0.0, 0.0
    chi = parameter_values(model, base.drive)
    chi[10 * n :] = np.resize([0.8, 1.5, -0.2], len(chi) - 10 * n)
    w = observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)
    tau = (w @ base.values(chi)).reshape(q.shape) + noise * rng.normal(size=q.shape)
    whole = {
        "rate": rate,
        "joint_names": model.joint_names,
        "source": f"bench {seed}",
        "provenance": ("made up for a test",),
    }
    return Samples(t, q, qd, qdd, tau, **(whole | given))


def invented(arm, **changes):
    """A result with round numbers, the same on every machine."""
    model, base = arm
    p, n = base.n_base, model.n_joints
    design = design_values(model, base)
    errors = 0.002 * 1.7 ** np.arange(p)
    parameters = tuple(
        IdentifiedParameter(
            id=int(base.ids[j]),
            name=base.names[j],
            expression=base.expressions[j],
            symbolic=base.symbolic[j],
            unit=base.units[j],
            cad=float(design[j]),
            estimate=float(0.1 + 0.25 * j + (0 if np.isnan(design[j]) else design[j])),
            std_error=float(errors[j]),
            textbook_std_error=float(errors[j] / 2),
            determined=j != p - 1,
            poorly_determined=j == p - 2,
        )
        for j in range(p)
    )
    measured = np.column_stack([np.linspace(-3, 3, 101), np.linspace(-2, 5, 101)])[:, :n]
    wave = np.sin(np.arange(101.0))[:, None] * [0.1, 0.2]
    values = {
        "model": model,
        "base": base,
        "method": "wls",
        "sources": ("log.csv",),
        "n_samples": 5312,
        "rate": 20.0,
        "duration": 265.6,
        "parameters": parameters,
        "covariance": np.diag(errors**2),
        "textbook_covariance": np.diag(errors**2 / 4),
        "sigma": np.array([0.11, 0.22]),
        "effective_samples": 412.3,
        "rank": p - 1,
        "singular_values": np.linspace(2.0, 0.1, p),
        "condition_number": 61.31,
        "scaled_condition_number": 12.44,
        "undetermined": (f"{base.names[-1]}",),
        "train": torque_metrics(measured, measured + wave, "log.csv", model.joint_names),
        "validation": (
            torque_metrics(measured, measured + 1.5 * wave, "other.csv", model.joint_names),
        ),
        "cad": torque_metrics(measured, 0.7 * measured, "other.csv", model.joint_names),
        "physically_consistent": True,
        "consistency_margin": 8.4e-4,
        "findings": (
            Finding(
                "not_excited",
                "warning",
                f"Not excited by this recording, kept at CAD: {base.names[-1]}",
                Cure("move these joints more"),
            ),
            Finding(
                "poorly_determined",
                "warning",
                f"Poorly determined: {base.names[-2]}",
                Cure("record longer, or enrich the motion"),
            ),
        ),
        "provenance": ("made up for a test",),
    }
    return IdentificationResult(**(values | changes))


def test_summary_reads_as_agreed(arm):
    text = summarise(invented(arm)).as_text()
    assert text == GOLDEN.read_text()
    assert all(line == line.rstrip() for line in text.splitlines())
    assert str(summarise(invented(arm))) == text


def test_bad_news_is_shouted(arm):
    result = invented(
        arm,
        condition_number=np.inf,
        scaled_condition_number=np.inf,
        physically_consistent=False,
        consistency_margin=-0.099,
    )
    text = summarise(result).as_text(full=True)
    for words in (
        "PHYSICALLY INCONSISTENT",
        "infinite",
        " UNDETERMINED\n",
    ):
        assert words in text
    good = replace(result.parameters[0], determined=True, poorly_determined=False)
    calm = replace(
        result,
        parameters=tuple(
            replace(p, determined=True, poorly_determined=False) for p in result.parameters
        ),
        undetermined=(),
        findings=(),
        physically_consistent=None,
        consistency_margin=None,
    )
    assert good == calm.parameters[0]
    heading = dict(summarise(calm).heading)
    assert heading["consistency"] == "not checked"


def test_html_is_well_formed_and_escaped_and_csv_has_numbers_in_full(arm):
    result = invented(arm, findings=(Finding("x", "warning", "a < b & c"),))
    page = summarise(result).as_html()
    opened = []

    class Nesting(HTMLParser):
        def handle_starttag(self, tag, attrs):
            opened.append(tag)

        def handle_endtag(self, tag):
            assert opened.pop() == tag

    Nesting().feed(page)
    assert opened == []
    assert "a &lt; b &amp; c" in page
    rows = summarise(result).as_csv().splitlines()
    assert len(rows) == result.n_base + 1
    assert repr(result.parameters[0].estimate) in rows[1]


def test_json_round_trip_to_the_last_bit(arm):
    model, base = arm
    for result in (
        invented(arm),
        identify_samples(model, recorded(model, base, still=(1,)), drive=DRIVE),
    ):
        text = result.to_json()
        again = IdentificationResult.from_json(text)
        assert again.to_json() == text
        for item in fields(IdentificationResult):
            one, other = getattr(result, item.name), getattr(again, item.name)
            if isinstance(one, np.ndarray):
                assert np.array_equal(one, other)
            elif item.name == "scatter":
                assert one is other is None or np.array_equal(one.moves, other.moves)
            elif item.name not in ("model", "base", "parameters", "train", "validation", "cad"):
                assert one == other, item.name
        assert np.array_equal(again.base.regrouping, result.base.regrouping)
        assert np.array_equal(again.estimates, result.estimates)
        assert summarise(again).as_text() == summarise(result).as_text()


def test_json_has_the_fields_that_others_rely_on(arm):
    document = json.loads(invented(arm).to_json())
    assert {
        "robot",
        "method",
        "n_samples",
        "n_standard",
        "n_base",
        "rank",
        "condition_number",
        "scaled_condition_number",
    } <= set(document)
    assert {
        "joints",
        "parameters",
        "train",
        "validation",
        "cad",
        "physically_consistent",
        "warnings",
    } <= set(document)
    assert {"id", "name", "expression", "unit", "cad", "estimate", "std_error"} <= set(
        document["parameters"][0]
    )
    assert {"source", "rms", "max_abs", "r_squared", "relative_error"} <= set(document["train"])
    assert document["parameters"][-1]["cad"] is None
    assert set(document["warnings"][0]) == {"code", "message"}


def test_damaged_results_are_refused(arm):
    text = invented(arm).to_json()
    whole = json.loads(text)

    def damaged(**changes):
        return json.dumps(whole | changes)

    for bad, words in (
        ("", "not a stored result: Expecting value"),
        (text[:1000], "not a stored result: Unterminated string"),
        ("[1, 2]", "not a stored result"),
        ('{"format": "something else"}', "not a stored result"),
        (damaged(version=99), "format version 99"),
        (json.dumps({k: v for k, v in whole.items() if k != "rank"}), "rank: it is missing"),
        (damaged(covariance=[[1.0]]), "covariance must have shape"),
        (damaged(parameters=whole["parameters"][:-1]), "base parameters"),
        (damaged(parameters=[{"id": 1}]), "damaged"),
        (
            damaged(parameters=[each | {"std_error": None} for each in whole["parameters"]]),
            "std_error must be at least 0",
        ),
        (damaged(drive=["nonsense"]), "unknown drive term"),
        (damaged(model={}), "robot document"),
        (damaged(train=None), "damaged|metrics"),
    ):
        with pytest.raises(ResultError, match=words):
            IdentificationResult.from_json(bad)


def test_prediction_is_the_observation_matrix_times_the_estimates(arm):
    model, base = arm
    parallel = design_parallel_filter(6.0, 100.0, 4)
    samples = recorded(model, base, parallel=parallel, segments=((0, 600), (650, 1200)))
    result = identify_samples(model, samples, drive=DRIVE)
    prediction = result.predict(samples)
    w = observation_matrix(
        model, samples.q, samples.qd, samples.qdd, drive=DRIVE, columns=base.columns
    )
    assert np.allclose(
        prediction.predicted,
        samples.filtered((w @ result.estimates).reshape(samples.q.shape)),
        atol=1e-11,
    )
    assert np.array_equal(prediction.measured, samples.filtered_torque)
    assert np.array_equal(prediction.t, samples.filtered_times)
    metrics = torque_metrics(prediction.measured, prediction.predicted, "x", model.joint_names)
    assert np.allclose(metrics.rms, result.train.rms)
    cad = result.predict_cad(samples)
    assert np.allclose(np.sqrt(np.mean(cad.error**2, axis=0)), result.cad.rms)
    assert result.n_samples == samples.n_filtered
    assert result.rate == pytest.approx(25.0)


def test_prediction_of_another_robots_samples_is_refused(arm):
    model, base = arm
    result = identify_samples(model, recorded(model, base), drive=DRIVE)
    iiwa = load_robot("kuka-iiwa7-r800")
    with pytest.raises(ResultError, match="has"):
        result.predict(recorded(iiwa, find_base_parameters(iiwa, DRIVE), n_samples=20))


def test_identify_recovers_the_truth_within_its_errors(arm):
    model, base = arm
    chi = parameter_values(model, DRIVE)
    chi[10 * model.n_joints :] = np.resize([0.8, 1.5, -0.2], 3 * model.n_joints)
    truth = base.values(chi)
    result = identify_samples(
        model, [recorded(model, base, seed=s) for s in range(3)], drive=DRIVE, method="wls"
    )
    assert np.all(np.abs(result.estimates - truth) < 4.5 * result.std_errors)
    assert result.sources == ("bench 0", "bench 1", "bench 2")
    assert result.rank == result.n_base
    assert result.physically_consistent is True
    assert np.allclose(result.sigma, 0.05, rtol=0.1)
    assert result.provenance == ("made up for a test",)
    assert np.isnan(result.cad_values[-1])
    assert 0 < result.effective_samples <= result.n_samples


def test_what_is_not_excited_is_kept_at_cad_and_said(arm):
    model, base = arm
    samples = recorded(model, base, still=(1,))
    result = identify_samples(model, samples, drive=DRIVE)
    assert result.rank < result.n_base == result.rank + len(result.undetermined)
    assert "not_excited" in [warning.code for warning in result.findings]
    assert "Fv2" in result.undetermined
    assert np.isinf(result.condition_number)
    with pytest.raises(IdentifiabilityError, match="Fv2"):
        identify_samples(model, samples, drive=DRIVE, undetermined="refuse")


def test_a_conclusion_from_the_information_alone_says_the_same_but_the_largest_error(arm):
    model, base = arm
    samples = recorded(model, base)
    whole = identify_samples(model, samples, drive=DRIVE)
    information = accumulate(model, base, samples)
    estimate = fit_least_squares(information, weights="joint", prior=design_values(model, base))
    alone = conclude(model, information, estimate, rate=100.0)
    assert np.allclose(alone.estimates, whole.estimates)
    for one, other in ((alone.train, whole.train), (alone.cad, whole.cad)):
        assert np.allclose(one.rms, other.rms)
        assert np.allclose(one.r_squared, other.r_squared)
        assert one.relative_error == pytest.approx(other.relative_error)
        assert np.isnan(one.max_abs).all()
    assert json.loads(alone.to_json())["train"]["max_abs"] == [None, None]


def test_links_without_mass_properties_have_no_cad_value(arm):
    model, base = arm
    silent = replace(model, links=(model.links[0], replace(model.links[1], inertia_known=False)))
    values = design_values(silent, base)
    assert np.isnan(values[base.names.index("Fv2")])
    involved = np.any(base.regrouping[:, 10:20] != 0, axis=1)
    assert np.isnan(values[involved]).all()


def test_a_result_says_how_its_errors_were_judged(arm):
    model, base = arm
    result = identify_samples(model, recorded(model, base), base=base)
    assert result.errors.kind == "blocks"
    assert result.errors.n_blocks >= 8
    assert "Standard errors (blocks): by formula from" in summarise(result).as_text(full=True)
    whole = json.loads(result.to_json())
    assert whole["errors"]["kind"] == "blocks"
    assert IdentificationResult.from_json(result.to_json()).errors == result.errors


def test_a_result_of_a_version_that_did_not_say_how_is_read(arm):
    whole = json.loads(invented(arm).to_json())
    del whole["errors"]
    for parameter in whole["parameters"]:
        del parameter["dropped"]
    old = IdentificationResult.from_json(json.dumps(whole))
    assert old.errors.kind == "unstated"
    assert not old.dropped.any()
    assert str(summarise(old)) == str(summarise(invented(arm)))


@pytest.mark.parametrize(
    "drive", ["viscous,coulomb,offset", "armature,viscous,load_friction", "none"]
)
def test_torque_is_the_observation_matrix_times_the_estimates(drive):
    model, drives = load_robot("kuka-iiwa7-r800"), DriveSet.parse(drive)
    base = find_base_parameters(model, drives)
    result = invented_of(model, base)
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.normal(size=(3, 5, 7))
    loaded = set_link_parameters(model, base, result.estimates)
    w = observation_matrix(loaded, q, qd, qdd, drive=drives, columns=base.columns)
    torque = result.torque(q, qd, qdd)
    np.testing.assert_allclose(torque.ravel(), w @ result.estimates, atol=1e-9)
    for k in range(5):
        np.testing.assert_allclose(result.torque(q[k], qd[k], qdd[k]), torque[k], atol=1e-10)
    matrix, gravity = result.mass_matrix(q), result.gravity(q)
    links = result.torque_model.parameters
    assert matrix.shape == (5, 7, 7)
    for j in range(7):
        unit = np.zeros_like(q)
        unit[:, j] = 1.0
        column = inverse_dynamics(model, q, 0 * q, unit, parameters=links) - gravity
        np.testing.assert_allclose(matrix[:, :, j], column, atol=1e-9)
    np.testing.assert_allclose(
        result.friction(qd, q),
        result.torque(q, qd, 0 * q) - inverse_dynamics(model, q, qd, 0 * q, parameters=links),
        atol=1e-9,
    )
    if "load" in drive:
        with pytest.raises(UsageError, match="give q too"):
            result.friction(qd)
    else:
        np.testing.assert_allclose(result.friction(qd), result.friction(qd, q), atol=1e-12)
    assert result.friction(qd[0], q[0]).shape == (7,)


def invented_of(model, base):
    """A result of this robot whose values are random."""
    rng, p, n = np.random.default_rng(1), base.n_base, model.n_joints
    values = rng.normal(size=p)
    metrics = torque_metrics(np.eye(n), 0.9 * np.eye(n), "log.csv", model.joint_names)
    parameters = tuple(
        IdentifiedParameter(
            int(base.ids[j]), base.names[j], "", "", "", 0.0, values[j], 1.0, 1.0, True, False
        )
        for j in range(p)
    )
    return IdentificationResult(
        model=model,
        base=base,
        method="wls",
        sources=("log.csv",),
        n_samples=10,
        rate=1.0,
        duration=10.0,
        parameters=parameters,
        covariance=np.eye(p),
        textbook_covariance=np.eye(p),
        sigma=np.ones(n),
        effective_samples=5.0,
        rank=p,
        singular_values=np.ones(p),
        condition_number=1.0,
        scaled_condition_number=1.0,
        undetermined=(),
        train=metrics,
        validation=(),
        cad=metrics,
        physically_consistent=None,
        consistency_margin=None,
        findings=(),
        provenance=(),
    )


def test_a_result_shows_itself_in_one_screen(arm):
    result = invented(arm)
    assert repr(result) == (
        "<IdentificationResult of two-link: wls, 14 base parameters (rank 13) from 5312 samples;"
        " relative torque error 5.1 %, held out 7.7 %>"
    )
    lines = html.unescape(re.sub("<.*?>", "", result._repr_html_())).splitlines()
    assert len(lines) <= 48
    assert max(map(len, lines)) <= 80
    assert lines[0] == str(summarise(result)).splitlines()[0]


def test_a_statistician_reads_the_result(arm):
    """Intervals by the tabulated quantiles of the normal and of Student's distribution."""
    result = invented(arm)
    assert np.array_equal(result.params, [each.estimate for each in result.parameters])
    assert np.array_equal(result.bse, result.std_errors)
    known = result.bse > 0
    np.testing.assert_allclose((result.tvalues * result.bse)[known], result.params[known])
    interval = result.conf_int()
    np.testing.assert_allclose(interval.mean(axis=1)[known], result.params[known], atol=1e-12)
    np.testing.assert_allclose(np.ptp(interval, axis=1), 2 * 1.959964 * result.bse, rtol=1e-6)
    few = confidence_intervals(np.zeros(1), np.ones(1), np.array([4.0]), 0.05)
    np.testing.assert_allclose(few, [[-2.776445, 2.776445]], rtol=1e-6)
    for alpha in (0.0, 0.5, 0.95, 95.0):
        with pytest.raises(UsageError, match=r"alpha=0\.05 for an interval of 95 %"):
            result.conf_int(alpha)
    frame = result.to_frame(0.1)
    assert frame["name"].to_list() == list(result.names)
    assert frame["lower"].to_numpy() == pytest.approx(result.conf_int(0.1)[:, 0], nan_ok=True)
    assert frame.height == result.n_base


def test_intervals_count_few_time_blocks_once(arm):
    """Standard errors are widened by t / 1.96 of 97.5 %; an interval of 90 % needs t of 95 %."""
    plain = invented(arm)
    scatter = BlockScatter(np.ones((9, plain.n_base)), np.full(plain.n_base, 5.0))
    result = replace(plain, scatter=scatter)
    half = np.ptp(result.conf_int(), axis=1) / 2.0
    np.testing.assert_allclose(half, 1.959964 * result.bse, rtol=1e-6)
    half = np.ptp(result.conf_int(0.1), axis=1) / 2.0
    np.testing.assert_allclose(half, 1.959964 * 2.015048 / 2.570582 * result.bse, rtol=1e-6)


def test_a_result_predicts_states_and_samples(arm):
    result = invented(arm)
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.normal(size=(3, 5, 2))
    assert np.array_equal(result.predict(q, qd, qdd), result.torque(q, qd, qdd))
    with pytest.raises(UsageError, match="got a str alone"):
        result.predict("log.csv")
