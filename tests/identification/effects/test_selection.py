"""Each number of the selection of effects against dense least squares on the rows themselves.

The rows of three joints in twelve blocks are drawn at random: four parameters of the model, one
effect of joint 1, two columns of joint 2, two of the whole robot, and one of the log at joint 2.
Parameters count as [model 0..3 | 4 | 5 6 | 7 8 | 9].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from asbuilt.identification import MODEL, TimeBlock, evaluate_worth
from asbuilt.identification.effects.effect import Effect
from asbuilt.identification.effects.gathering import EFFECT_COLUMNS, Candidate
from asbuilt.identification.effects.selection import Selection, _find_best_form
from asbuilt.identification.effects.trials import RULES, Prior, Trial
from asbuilt.identification.information.equations import BlockRows

BASE, ALL, BLOCKS, SAMPLES = 4, 10, 12, 30
SUPPORT = (np.array([0, 1, 2, 4, 7, 8]), np.array([1, 2, 3, 5, 6, 7, 8, 9]), np.array([3, 7, 8]))
GROUPS = [np.arange(k, BLOCKS, 4) for k in range(4)]
ROBOT = SimpleNamespace(model=SimpleNamespace(has_masses=True))
MEAN = np.array([1.0, -2.0, 0.5, 3.0])
EFFECT = 2.5
"""Samples that count as one."""


class Family(Effect):
    """An effect with a name, whose values are below 100."""

    farthest = 100.0

    def __init__(self, key, *, kind=None, of_log=False, imitators=()):
        self.key, self.kind, self.of_log = key, kind or key, of_log
        self.imitators = imitators

    def variants(self, robot):
        raise NotImplementedError

    def columns(self, variant, motion):
        raise NotImplementedError


def candidate(key, joint, *places, **more):
    own = {name: more.pop(name) for name in ("kind", "of_log", "imitators") if name in more}
    return Candidate(Family(key, **own), joint, np.array(places), **more)


CANDIDATES = (
    candidate("one", 0, 4),
    candidate("two", 1, 5, 6),
    candidate("whole", None, 7, 8),
    candidate("log", 1, 9, of_log=True),
)


@dataclass(frozen=True)
class Rows:
    """Rows `[W | E | tau]` of each joint, (blocks, samples, parameters + 1), and the prior."""

    joints: list
    weights: np.ndarray
    root: np.ndarray

    def selection(self, candidates=CANDIDATES, applied=("one", "two", "whole")):
        own = [rows[:, :, np.append(s, ALL)] for rows, s in zip(self.joints, SUPPORT, strict=True)]
        rows = BlockRows(
            {MODEL: BASE, EFFECT_COLUMNS: ALL - BASE},
            SUPPORT,
            tuple(own),
            (TimeBlock("log", 0.0, 1.0, SAMPLES),) * BLOCKS,
        )
        prior = Prior(MEAN, self.root.T @ self.root, EFFECT)
        return Selection(rows, candidates, ROBOT, prior, self.weights, GROUPS, applied)

    def data(self, inside, blocks=range(BLOCKS)):
        """Weighted rows of all joints and their torque."""
        every = np.vstack(
            [
                w * rows[list(blocks)].reshape(-1, ALL + 1)
                for w, rows in zip(self.weights, self.joints, strict=True)
            ]
        )
        return every[:, inside], every[:, -1]

    def fit(self, inside, blocks=range(BLOCKS)):
        """Values (ALL,) of least squares with the prior."""
        A, b = self.data(inside, blocks)
        own = np.zeros((BASE, len(inside)))
        for j, place in enumerate(inside):
            if place < BASE:
                own[:, j] = self.root[:, place]
        values = np.zeros(ALL)
        values[inside] = np.linalg.lstsq(
            np.vstack([A, own]), np.append(b, self.root @ MEAN), rcond=None
        )[0]
        return values

    def squares(self, values, blocks=range(BLOCKS)):
        """Squared error (n,) of each joint, without weights."""
        ends = np.append(-values, 1.0)
        return np.array([np.sum((rows[list(blocks)] @ ends) ** 2) for rows in self.joints])

    def distance(self, values):
        return float(np.sum((self.root @ (values[:BASE] - MEAN)) ** 2))

    def cost(self, values):
        return float(self.weights**2 @ self.squares(values)) + self.distance(values)

    def covariance(self, inside, of):
        """Covariance of some values by the scores of blocks, from all columns at once."""
        values = self.fit(inside)
        A, _ = self.data(inside)
        own = np.zeros((BASE, len(inside)))
        own[:, [j for j, place in enumerate(inside) if place < BASE]] = self.root[
            :, [place for place in inside if place < BASE]
        ]
        H = A.T @ A + own.T @ own
        scores = []
        for block in range(BLOCKS):
            A, b = self.data(inside, [block])
            scores.append(np.linalg.solve(H, A.T @ (b - A @ values[inside])))
        spread = np.array(scores)
        places = [list(inside).index(place) for place in of]
        return (spread.T @ spread * BLOCKS / (BLOCKS - 1))[np.ix_(places, places)]


@pytest.fixture(scope="module")
def rows():
    return drawn({4: 0.5, 7: 0.5, 8: -0.3})


def drawn(effects, seed=3, columns=None):
    """Rows with these values of effects; `columns(rows, k)` changes those of a joint."""
    rng = np.random.default_rng(seed)
    joints = []
    for k, support in enumerate(SUPPORT):
        own = np.zeros((BLOCKS, SAMPLES, ALL + 1))
        own[:, :, support] = rng.normal(size=(BLOCKS, SAMPLES, len(support))) * 3.0 ** (
            support % 3 - 1
        )
        if columns is not None:
            columns(own, k)
        values = np.append(MEAN + 0.2, np.zeros(ALL - BASE))
        for place, value in effects.items():
            values[place] = value
        own[:, :, -1] = own[:, :, :-1] @ values + 0.4 * rng.normal(size=own.shape[:2])
        joints.append(own)
    return Rows(joints, np.array([1.0, 0.5, 2.0]), rng.normal(size=(BASE, BASE)) * 2.0)


def trial_of(rows, own, taken=(), selection=None):
    selection = selection or rows.selection()
    selection.taken = list(taken)
    (trial,) = selection.trials([own])
    return trial


def test_values_are_those_of_least_squares_with_the_prior(rows) -> None:
    selection = rows.selection()
    selection.taken = [CANDIDATES[0], CANDIDATES[2]]
    np.testing.assert_allclose(
        selection.values(), rows.fit([0, 1, 2, 3, 4, 7, 8]), rtol=1e-6, atol=1e-9
    )
    assert selection.own(("whole", None)) is CANDIDATES[2]
    np.testing.assert_array_equal(selection.candidate(("two", 1)).places, [5, 6])
    np.testing.assert_array_equal(selection.every_place(CANDIDATES[1]).tolist(), [5, 6])


def test_the_held_out_error_is_that_of_fits_to_the_other_groups(rows) -> None:
    inside = [0, 1, 2, 3, 4]
    shares = []
    for group in GROUPS:
        others = np.setdiff1d(np.arange(BLOCKS), group)
        error = rows.squares(rows.fit(inside, others), group).sum()
        shares.append(error / rows.squares(np.zeros(ALL), group).sum())
    expected = np.sqrt(stats.gmean(shares))
    assert rows.selection().held_out_error([CANDIDATES[0]]) == pytest.approx(expected, rel=1e-6)


def test_the_held_out_error_is_relative_and_none_without_torque(rows) -> None:
    small = Rows([1e-4 * each for each in rows.joints], rows.weights, 1e-4 * rows.root)
    bare = [each.copy() for each in rows.joints]
    for each in bare:
        each[:, :, -1] = 0.0
    own = [CANDIDATES[0]]
    assert small.selection().held_out_error(own) == pytest.approx(
        rows.selection().held_out_error(own), rel=1e-9
    )
    assert replace(rows, joints=bare).selection().held_out_error(own) == 0.0


@pytest.mark.parametrize("weights", [(1.0, 0.5, 2.0), (1.0, 0.5, 0.0)])
@pytest.mark.parametrize("which", [0, 2])
def test_a_trial_holds_what_the_fit_with_the_effect_would_change(rows, weights, which) -> None:
    rows, own = replace(rows, weights=np.array(weights)), CANDIDATES[which]
    before, after = [0, 1, 2, 3], [0, 1, 2, 3, *own.places]
    trial = trial_of(rows, own)
    old, new = rows.fit(before), rows.fit(after)
    np.testing.assert_allclose(trial.values, new[own.places], rtol=1e-6)
    covariance = rows.covariance(after, own.places)
    np.testing.assert_allclose(trial.covariance, covariance, rtol=1e-5)
    m = len(own.places)
    square = trial.values @ np.linalg.solve(covariance, trial.values)
    freedom = BLOCKS - m
    expected = stats.f.sf(square * freedom / (m * (BLOCKS - 1)), m, freedom)
    assert trial.p_value == pytest.approx(expected, rel=1e-4)
    relief = []
    for group in GROUPS:
        others = np.setdiff1d(np.arange(BLOCKS), group)
        ratio = rows.squares(rows.fit(before, others), group) / rows.squares(
            rows.fit(after, others), group
        )
        relief.append(np.log(ratio[rows.weights > 0.0]).mean())
    np.testing.assert_allclose(trial.relief, relief, rtol=1e-5, atol=1e-8)
    error = np.std(relief, ddof=1) / 2.0
    assert trial.relief_error == pytest.approx(error, rel=1e-5)
    cost = rows.cost(old)
    gain = -0.5 * cost / EFFECT * np.log(rows.cost(new) / cost)
    assert trial.gain == pytest.approx(gain, rel=1e-6)
    assert trial.worth == evaluate_worth(trial.gain, m) == pytest.approx(gain - m * np.log(gain))
    nearer = (rows.distance(old) - rows.distance(new)) / (2.0 * EFFECT)
    assert trial.nearer == pytest.approx(nearer, rel=1e-5)
    torque = [np.sqrt(np.mean((j[:, :, own.places] @ trial.values) ** 2)) for j in rows.joints]
    rms = [np.sqrt(np.mean(j[:, :, -1] ** 2)) for j in rows.joints]
    assert trial.felt == pytest.approx(np.max(np.divide(torque, rms)), rel=1e-6)
    assert rows.selection().torque_of(trial) == pytest.approx(np.linalg.norm(torque), rel=1e-6)


def test_an_effect_in_place_of_a_parameter_is_tried_without_it() -> None:
    rows = drawn({1: 0.0, 2: 3.0, 4: 1.0})
    own = candidate("one", 0, 4, 7, replaces=np.array([1]))
    worse = candidate("one", 0, 4, 7, replaces=np.array([2]))
    old, new = rows.fit([0, 1, 2, 3]), rows.fit([0, 2, 3, 4, 7])
    gain = -0.5 * rows.cost(old) / EFFECT * np.log(rows.cost(new) / rows.cost(old))
    assert rows.cost(rows.fit([0, 1, 3, 4, 7])) > rows.cost(old)
    (trial,) = rows.selection((own, worse)).trials([own, worse])
    assert trial.candidate.at == own.at
    assert trial.gain == pytest.approx(gain, rel=1e-6)
    assert trial.p_value == pytest.approx(stats.chi2.sf(2.0 * gain, 2), rel=1e-4)
    energy = float(rows.weights**2 @ rows.squares(np.zeros(ALL)))
    assert trial.felt == pytest.approx(np.sqrt(2.0 * EFFECT * gain / energy), rel=1e-6)
    selection = rows.selection((own, worse))
    selection.taken = [own]
    np.testing.assert_allclose(selection.values(), new, rtol=1e-6, atol=1e-9)


def test_values_beside_those_taken_and_their_covariance(rows) -> None:
    one, _, whole, _ = CANDIDATES
    selection = rows.selection()
    selection.taken = [one, whole]
    inside = [0, 1, 2, 3, 4, 7, 8]
    for own in ([one], [one, whole]):
        places = np.concatenate([each.places for each in own])
        values, covariance = selection.values_of(own)
        np.testing.assert_allclose(values, rows.fit(inside)[places], rtol=1e-6)
        np.testing.assert_allclose(covariance, rows.covariance(inside, places), rtol=1e-5)


@pytest.mark.parametrize(("weights", "n"), [((1.0, 0.5, 2.0), 3), ((9.0, 9.0, 0.0), 2)])
def test_the_smallest_value_that_would_be_sure_has_the_fall_that_is_asked_for(
    rows, weights, n
) -> None:
    """A column times x in the torque costs x^2 times its part outside all others.

    The mean over joints of the logarithm must rise by `named`, by the one joint that has it.
    """
    rows, inside = replace(rows, weights=np.array(weights)), [0, 1, 2, 3]
    A, column = rows.data(inside)[0], rows.data([4])[0][:, 0]
    outside = np.linalg.lstsq(
        np.vstack([A, rows.root]), np.append(column, np.zeros(BASE)), rcond=None
    )[1][0]
    of_joint = float(rows.weights**2 @ rows.squares(rows.fit(inside))) / n
    asked = max(2.0 * EFFECT * RULES.imitated, of_joint * np.expm1(n * RULES.named))
    smallest = rows.selection().smallest_seen(CANDIDATES[0])
    assert smallest**2 * outside == pytest.approx(asked, rel=1e-6)


def hide_log(own, k):
    """Make the column of the log nearly that of a parameter, which acts on no other joint then."""
    if k == 0:
        own[:, :, 2] = 0.0
    if k == 1:
        own[:, :, 9] = own[:, :, 2] + 1e-2 * own[:, :, 5]


def test_what_does_not_act_or_is_hidden_is_told_apart() -> None:
    def columns(own, k):
        own[:, :, 4] = 0.0
        # Rounding of its own effect: effects have different units.
        own[:, :, 6] *= 1e-11
        hide_log(own, k)

    rows = drawn({5: 1.0}, columns=columns)
    selection = rows.selection()
    assert selection.smallest_seen(CANDIDATES[0]) == 0.0
    assert selection.candidate(("two", 1)).places.tolist() == [5]
    assert selection.trials([CANDIDATES[0]]) == []
    assert len(selection.trials([CANDIDATES[1]])[0].values) == 1
    A = rows.data([0, 1, 2, 3])[0]
    log = rows.data([9])[0][:, 0]
    part = np.linalg.lstsq(A, log, rcond=None)[1][0] / (log @ log)
    assert RULES.separate < part < RULES.shown
    assert selection.smallest_seen(CANDIDATES[3]) == np.inf
    assert np.isfinite(selection.smallest_seen(CANDIDATES[1]))


def test_columns_that_no_log_tells_apart_have_no_trial_and_do_no_harm() -> None:
    def columns(own, k):
        own[:, :, 6] = own[:, :, 5] + 1e-4 * own[:, :, 9]

    rows = drawn({5: 1.0}, columns=columns)
    assert rows.selection().trials([CANDIDATES[1]]) == []

    def same(own, k):
        own[:, :, 6] = own[:, :, 5]

    rows = drawn({5: 1.0}, columns=same)
    selection = rows.selection()
    selection.taken = [CANDIDATES[1]]
    values = selection.values()
    assert values[5] + values[6] == pytest.approx(rows.fit([0, 1, 2, 3, 5])[5], rel=1e-6)


def held(relief, *, worth=60.0, key="one", joint=0, columns=1, **more):
    """A trial with these held-out reliefs and this worth."""
    gain = worth + columns * np.log(worth)
    for _ in range(50):
        gain = worth + columns * np.log(gain)
    return Trial(
        candidate(key, joint, *range(4, 4 + columns)),
        np.ones(columns),
        np.eye(columns),
        relief=np.array(relief),
        **({"felt": 1.0, "gain": gain} | more),
    )


@pytest.mark.parametrize(
    ("trial", "taken", "without_cad"),
    [
        pytest.param(held([0.3, 0.5, 0.4, 0.4]), True, True, id="other motion"),
        pytest.param(held([0.0, 0.3, 0.0, 0.3]), True, False, id="hardly sure of other motion"),
        pytest.param(held([0.0, 0.9, 0.0, 0.0]), False, False, id="one group"),
        pytest.param(held([0.018, 0.019, 0.019, 0.018]), False, False, id="worth too little"),
        pytest.param(held([0.021, 0.022, 0.021, 0.022]), True, True, id="worth enough"),
        pytest.param(held([-0.1, 0.2, -0.1, 0.1], nearer=11.0), True, False, id="imitated"),
        pytest.param(held([-0.1, 0.2, -0.1, 0.1], nearer=9.0), False, False, id="hardly nearer"),
        pytest.param(held([-0.1, -0.2, -0.1, -0.1], nearer=11.0), False, False, id="worse"),
        pytest.param(held([0.4] * 4, felt=0.9e-3), False, False, id="not felt"),
        pytest.param(held([0.4] * 4, felt=1.1e-3), True, True, id="felt"),
        pytest.param(held([0.4] * 4, p_value=0.006), False, False, id="chance"),
        pytest.param(held([0.4] * 4, p_value=0.004), True, True, id="no chance"),
    ],
)
def test_what_is_taken_follows_the_rules(trial, taken, without_cad) -> None:
    """Where CAD holds no bodies, that they come nearer to it is no reason."""
    assert trial.is_taken(10, ROBOT, held=True) is taken
    assert trial.is_taken(10, ROBOT, held=False) is without_cad


@pytest.mark.parametrize(
    ("relief", "joint", "key", "preferred"),
    [
        pytest.param([0.6, 0.7, 0.6, 0.7], 0, "one", True, id="another form"),
        pytest.param([0.2, 0.7, 0.3, 0.6], 0, "one", False, id="hardly better"),
        pytest.param([0.6, 0.7, 0.6, 0.7], 1, "one", False, id="another joint"),
        pytest.param([0.6, 0.7, 0.6, 0.7], 0, "two", False, id="another kind"),
    ],
)
def test_of_one_kind_the_form_that_predicts_other_motion_is_taken(
    relief, joint, key, preferred
) -> None:
    plain = held([0.3, 0.5, 0.4, 0.4])
    other = held(relief, worth=40.0, key=key, joint=joint, columns=3)
    assert (_find_best_form(plain, [plain, other]) is other) is preferred


def test_a_size_that_no_robot_has_is_not_sure() -> None:
    trial = held([0.4] * 4)
    assert trial.is_sure(1, ROBOT)
    assert not replace(trial, values=np.array([101.0])).is_sure(1, ROBOT)


def test_effects_are_taken_one_after_another_by_worth() -> None:
    rows = drawn({4: 2.0, 5: 0.7})
    selection = rows.selection()
    path = selection.run()
    assert [each.candidate.effect.key for each in path] == ["one", "two"]
    assert selection.taken == [each.candidate for each in path]
    assert path[0].worth > path[1].worth
    np.testing.assert_allclose(path[1].values[0], 0.7, atol=0.1)
    assert [each.alternatives for each in path] == [(), ()]


def test_one_effect_of_a_kind_at_a_joint() -> None:
    """The second column of the kind explains half of what is left, but a joint has one."""
    rows = drawn({7: 2.0, 8: 0.3})
    same = [candidate(key, 0, place, kind="friction") for key, place in (("a", 7), ("b", 8))]
    assert [each.candidate.at for each in rows.selection(same).run()] == [("a", 0)]
    other = [same[0], candidate("b", 0, 8, kind="position")]
    assert [each.candidate.at for each in rows.selection(other).run()] == [("a", 0), ("b", 0)]
    elsewhere = [same[0], candidate("b", 1, 8, kind="friction")]
    assert [each.candidate.at for each in rows.selection(elsewhere).run()] == [("a", 0), ("b", 1)]


def test_what_is_impossible_or_hidden_from_the_log_is_not_tried() -> None:
    rows = drawn({4: 2.0})
    selection = rows.selection()
    selection.impossible = {("one", 0)}
    assert "one" not in {each.candidate.effect.key for each in selection.run()}
    rows = drawn({9: 8.0}, columns=hide_log)
    own = candidate("log", 1, 9)
    assert [each.candidate.at for each in rows.selection((own,)).run()] == [("log", 1)]
    assert rows.selection((CANDIDATES[3],)).run() == []


def alike():
    """An effect and one that is nearly the same at another joint's key."""

    def columns(own, k):
        if k == 0:
            own[:, :, 7] = own[:, :, 4] + 0.005 * own[:, :, 8]
        elif k:
            own[:, :, 7] = 0.0

    return drawn({4: 1.0}, columns=columns), (candidate("a", 0, 4), candidate("b", 1, 7))


def test_a_look_alike_is_named_beside_what_is_taken() -> None:
    rows, both = alike()
    for applied in (("a", "b"), ("a",), ()):
        (found,) = rows.selection(both, applied=applied).run()
        assert found.candidate.at == ("a", 0)
        assert [each.at for each in found.alternatives] == [("b", 1)]


def test_a_look_alike_that_the_model_may_have_is_taken_first() -> None:
    rows, both = alike()
    (found,) = rows.selection(both, applied=("b",)).run()
    assert found.candidate.at == ("b", 1)
    assert [each.at for each in found.alternatives] == [("a", 0)]


def test_another_effect_that_explains_less_than_half_is_no_look_alike() -> None:
    def columns(own, k):
        if k == 0:
            own[:, :, 7] = own[:, :, 4] + 1.2 * own[:, :, 7]
        elif k:
            own[:, :, 7] = 0.0

    rows = drawn({4: 1.0}, columns=columns)
    both = candidate("a", 0, 4), candidate("b", 1, 7)
    (found,) = rows.selection(both, applied=("b",)).run()
    assert found.candidate.at == ("a", 0)
    assert found.alternatives == ()


def test_what_is_sure_but_no_better_on_other_motion_is_kept_aside() -> None:
    """An effect in one group of blocks alone: sure there, no use for the others."""
    rows = drawn({})
    rows.joints[0][GROUPS[0], :, -1] += 1.5 * rows.joints[0][GROUPS[0], :, 4]
    selection = rows.selection()
    assert selection.run() == []
    assert {each.candidate.at for each in selection.unsure} <= {("one", 0)}


@pytest.mark.parametrize(
    ("worth", "relief", "alike"),
    [
        pytest.param(40.0, [0.5, 0.4, 0.5, 0.4], True, id="as good"),
        pytest.param(20.0, [0.5, 0.4, 0.5, 0.4], False, id="less than half the fall"),
        pytest.param(40.0, [0.4, 0.3, 0.4, 0.3], False, id="worse on other motion"),
        pytest.param(40.0, [0.3, 0.55, 0.3, 0.55], True, id="worse by less than its error"),
    ],
)
def test_what_counts_as_a_look_alike(rows, worth, relief, alike) -> None:
    best, other = held([0.5, 0.4, 0.5, 0.4]), held(relief, worth=worth, key="other", joint=1)
    for applied in (("one", "other"), ("other",)):
        selection = rows.selection(applied=applied)
        rounds = iter([[best, other], []])
        selection.trials = lambda _, rounds=rounds: next(rounds)
        (found,) = selection.run()
        first, second = (other, best) if alike and applied == ("other",) else (best, other)
        assert found.candidate is first.candidate
        assert found.alternatives == ((second.candidate,) if alike else ())


@pytest.mark.parametrize(("joint", "alike"), [(0, True), (1, False)])
def test_another_form_is_an_alternative_unless_it_surely_predicts_worse(rows, joint, alike) -> None:
    """It predicts other motion worse by 1.2 standard errors of the differences."""
    kind = {"kind": "position"}
    name = replace(held([0.5, 0.4, 0.5, 0.4]), candidate=candidate("cable", 0, 4, **kind))
    other = held([0.4, 0.42, 0.38, 0.42], worth=50.0)
    other = replace(other, candidate=candidate("balancer", joint, 5, **kind))
    selection = rows.selection(applied=("balancer",))
    rounds = iter([[name, other], []])
    selection.trials = lambda _: next(rounds)
    (found,) = selection.run()
    assert found.candidate is name.candidate
    assert found.alternatives == ((other.candidate,) if alike else ())


@pytest.mark.parametrize("imitators", [(), ("friction",)])
def test_what_imitates_the_rest_of_an_effect_is_not_asked_for_near_it(imitators) -> None:
    coupling = candidate("coupling", 1, 4, imitators=imitators)
    friction = candidate("stribeck", 1, 5, kind="friction")
    path = drawn({4: 2.0, 5: 0.7}).selection((coupling, friction)).run()
    assert len(path) == 1 + (not imitators)
    assert path[0].candidate.at == coupling.at
    near = {("friction", 1), ("friction", 0)} if imitators else set()
    assert coupling.busy == {("coupling", 1)} | near


def test_what_came_later_exchanges_an_effect_for_a_better_one_of_its_kind() -> None:
    """What hides the second column of joint 2 is taken later."""

    def hiding(own, k):
        if k == 1:
            own[:, :, 7] = 0.1 * own[:, :, 7] - own[:, :, 6]

    rows = drawn({5: 1.5, 6: 0.5, 7: 0.5, 8: -0.3}, columns=hiding)
    plain = candidate("spring", 1, 5, kind="position")
    wider = candidate("balancer", 1, 5, 6, kind="position")
    candidates = (plain, wider, CANDIDATES[2])
    selection = rows.selection(candidates, applied=("spring", "balancer", "whole"))
    first = max(selection.trials([plain, wider]), key=lambda each: each.worth)
    assert first.candidate.at == plain.at
    path = selection.run()
    assert {each.candidate.effect.key for each in path} == {"balancer", "whole"}
    assert {each.effect.key for each in selection.taken} == {"balancer", "whole"}

    def held_out(inside):
        return sum(
            rows.squares(rows.fit(inside, np.setdiff1d(np.arange(BLOCKS), group)), group).sum()
            for group in GROUPS
        )

    assert held_out([0, 1, 2, 3, 5, 6, 7, 8]) < held_out([0, 1, 2, 3, 5, 7, 8])
    for applied, better in ((("spring", "balancer"), "balancer"), (("spring",), None)):
        other = rows.selection(candidates, applied=(*applied, "whole"))
        other.taken = [plain, CANDIDATES[2]]
        found = other._find_best_of_kind(plain)
        assert (found and found.candidate.effect.key) == better
