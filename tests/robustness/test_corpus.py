"""Every malformed input ends in one error of one line on stderr: no traceback, crash or hang."""

from __future__ import annotations

import random
import signal
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from command_line import call
from robustness import corpus
from robustness.corpus import Case

HANG = 60
"""CPU time [s] after which a case counts as hung; the slowest takes about one."""


@pytest.fixture(autouse=True)
def alarm() -> Iterator[None]:
    """Turn a hang into a failure."""
    signal.setitimer(signal.ITIMER_PROF, HANG)
    yield
    signal.setitimer(signal.ITIMER_PROF, 0.0)


@pytest.fixture(scope="module")
def stored_result(tmp_path_factory: pytest.TempPathFactory) -> str:
    from asbuilt.description import bundled_robot
    from asbuilt.dynamics import inverse_dynamics
    from asbuilt.excitation import random_fourier
    from asbuilt.workflow import StudyOptions, identify

    model = bundled_robot("two-link")
    motion = random_fourier(model, 1, duration=15.0).sample(100.0)
    tau = inverse_dynamics(model, motion.q, motion.qd, motion.qdd) + 0.5 * motion.qd
    noise = 0.01 * random_normal(tau.shape)
    log = {"t": motion.t, "q": motion.q, "tau": tau + noise}
    return identify(model, log, options=StudyOptions(method="wls")).to_json()


def random_normal(shape: tuple[int, ...]):  # type: ignore[no-untyped-def]
    import numpy as np

    return np.random.default_rng(1).normal(size=shape)


def checked(capsys: pytest.CaptureFixture[str], folder: Path, case: Case) -> None:
    status, out, err = call(capsys, *case.written(folder))
    assert "unexpected" not in err, (case.name, err)
    assert "Traceback" not in err, (case.name, err)
    assert status in ((1, 2) if case.strict else (0, 1, 2)), (case.name, status, err)
    if status:
        reported = case.arguments[0] == "check" and out.strip()
        assert err.count("asbuilt: ") == 1 or reported, (case.name, err)
        assert len(err) < 4000, (case.name, err)


GROUPS = (
    *(f"robot {suffix}" for suffix in corpus.ROBOTS),
    *("deep sheets", "csv logs", "motions", "options"),
    *("deep", "logs", "sheets"),
)
SLOW = ("csv logs", "deep", "logs", "sheets")
"""Groups that take seconds."""


@cache
def groups() -> dict[str, list[Case]]:
    rng = random.Random(1)
    found: dict[str, list[Case]] = {}
    for suffix, text in corpus.ROBOTS.items():
        show = [*corpus.texts(text, suffix, lambda name: ("show", f"@{name}"), rng)]
        found[f"robot {suffix}"] = show
    found["deep"] = [
        Case(f"{suffix} {what}", ("show", f"@case{suffix}"), {f"case{suffix}": data})
        for what, suffix, data in corpus.deep()
    ]
    found["deep sheets"] = [
        Case(what, ("check", "two-link", "@log.csv", "--sheet", "@s.toml"),
             {"log.csv": corpus.csv_log().encode(), "s.toml": data})
        for what, suffix, data in corpus.deep() if suffix == ".toml"
    ]  # fmt: skip
    found["logs"] = [
        Case(f"{suffix} {what}", ("check", "two-link", f"@case{suffix}"), {f"case{suffix}": data})
        for what, suffix, data in corpus.hostile_logs()
    ]
    found["csv logs"] = [
        Case(what, ("check", "two-link", "@case.csv"), {"case.csv": data}, strict=False)
        for what, data in corpus.damaged(corpus.csv_log().encode(), rng, 40)
    ]
    found["sheets"] = [
        Case(what, ("check", "two-link", "@log.csv", "--sheet", "@s.toml"),
             {"log.csv": corpus.csv_log().encode(), "s.toml": text.encode()}, strict=False)
        for what, text in corpus.sheets()
    ]  # fmt: skip
    found["motions"] = [
        Case(
            what,
            ("program", "two-link", "@m.csv", "--format", "csv", "-o", "p"),
            {"m.csv": data},
            strict=False,
        )
        for what, data in corpus.damaged(corpus.MOTION.encode(), rng, 25)
    ]
    found["options"] = [Case(" ".join(words)[:60], words, {}) for words in corpus.OPTIONS]
    return found


@pytest.mark.parametrize(
    "group",
    [pytest.param(group, marks=pytest.mark.study if group in SLOW else ()) for group in GROUPS],
)
def test_text_and_options(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    group: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    cases = groups()[group]
    failed = {}
    for case in cases:
        try:
            checked(capsys, tmp_path, case)
        except AssertionError as problem:
            failed[case.name] = str(problem).splitlines()[0][:600]
    assert not failed, f"{len(failed)} of {len(cases)}: {failed}"


@pytest.mark.parametrize(
    "suffix",
    [
        ".h5",
        *(
            pytest.param(suffix, marks=pytest.mark.study)
            for suffix in (".npz", ".mat", ".parquet", ".db3")
        ),
    ],
)
def test_damaged_binary_logs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, suffix: str
) -> None:
    good = corpus.binary_logs()[suffix]
    rng = random.Random(suffix)
    for what, data in corpus.damaged(good, rng, 10):
        name = f"case{suffix}"
        case = Case(what, ("check", "two-link", f"@{name}"), {name: data}, strict=False)
        checked(capsys, tmp_path, case)


@pytest.mark.study
def test_results_edited_by_hand(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, stored_result: str
) -> None:
    failed = {}
    for what, text, strict in corpus.results(stored_result):
        case = Case(what, ("show", "@r.json"), {"r.json": text.encode()}, strict)
        try:
            checked(capsys, tmp_path, case)
        except AssertionError as problem:
            failed[what] = str(problem).splitlines()[0][:600]
    assert not failed, failed


def test_there_are_at_least_500_cases(stored_result: str) -> None:
    assert set(groups()) == set(GROUPS)
    texts = sum(len(cases) for cases in groups().values())
    assert texts + 50 + len([*corpus.results(stored_result)]) >= 500
