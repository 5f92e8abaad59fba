"""Which families of effects can be registered."""

from __future__ import annotations

import pytest

from asbuilt.errors import UsageError
from asbuilt.identification import EFFECTS
from asbuilt.identification.effects.effect import Effect, effect


def test_an_effect_with_columns_of_its_own_is_only_named() -> None:
    """A model has places for drive terms, bodies and what can be taken out of the robot."""

    class Ripple(Effect):
        key = "ripple"
        title = "ripple"
        in_model = True

        def variants(self, robot):
            yield from ()

        def columns(self, variant, motion):
            return []

    with pytest.raises(UsageError, match=r"effect 'ripple' .* register a drive term instead"):
        effect(Ripple)
    assert "ripple" not in EFFECTS
