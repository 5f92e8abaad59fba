"""Letters of descriptions: the rule, and that of a robot whose torque another engine computes."""

import numpy as np
import pytest

from asbuilt import load_robot, review
from asbuilt.errors import UsageError
from asbuilt.experiment import Recording
from asbuilt.validation.prediction import LETTERS, choose_letter


def test_each_letter_begins_where_the_one_before_ends() -> None:
    names, limits = zip(*LETTERS, strict=True)
    assert list(limits) == sorted(limits)
    for k, limit in enumerate(limits):
        assert choose_letter(np.nextafter(limit, 0.0)) == names[k]
        assert choose_letter(limit) == (*names, "F")[k + 1]


def test_a_model_as_good_as_none_is_an_f() -> None:
    assert choose_letter(1.0) == "F"


@pytest.mark.parametrize("error", [-0.1, np.nan])
def test_no_letter_without_an_error(error: float) -> None:
    with pytest.raises(UsageError, match="0 or more"):
        choose_letter(error)


@pytest.mark.study
def test_a_review_grades_the_description_by_its_torque_alone() -> None:
    """A scaled torque has the error of the description in closed form: `|s - 1| / s`."""
    pin = pytest.importorskip("pinocchio")
    model = load_robot("two-link")
    t = np.arange(0.0, 20.0, 0.01)
    w = np.array([1.1, 1.7])
    q, qd, qdd = (0.8 * w**k * np.sin(np.outer(t, w) + 0.5 * k * np.pi) for k in (0, 1, 2))
    chain = pinocchio_model(pin, model)
    data = chain.createData()
    tau = np.array([pin.rnea(chain, data, *row) for row in zip(q, qd, qdd, strict=True)])
    for factor, letter in ((1.02, "A"), (1.10, "C"), (1.3, "D")):
        log = Recording(t=t, q=q, tau=factor * tau, joint_names=model.joint_names)
        found = review(model, log)
        assert found.error == pytest.approx((factor - 1.0) / factor, abs=2e-3)
        assert found.letter == letter


def pinocchio_model(pin, model):
    """The robot as Pinocchio reads its URDF, gravity as described."""
    from asbuilt.writers.models.urdf import format_urdf

    built = pin.buildModelFromXML(format_urdf(model))
    built.gravity.linear = np.array(model.gravity)
    return built
