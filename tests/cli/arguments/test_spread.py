"""Options generated from option classes: one default, one spelling, errors that name the option."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import typer

from asbuilt.cli import name_option
from asbuilt.cli.arguments.spread import Common, spread
from asbuilt.errors import UsageError


def numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


@dataclass(frozen=True)
class Mixing:
    """Options of a kitchen."""

    rate: float = field(default=2.5, metadata={"help": "turns per second", "metavar": "HZ"})
    size: int | None = field(default=None, metadata={"help": "bowls"})
    checked: bool = field(default=True, metadata={"help": "do not look"})
    gain: tuple[float, ...] = field(default=(), metadata={"help": "a list", "parse": numbers})
    style: Literal["in_clockwise", "against"] = field(
        default="against",
        metadata={"help": "sense", "choices": {"with": "in_clockwise", "against": "against"}},
    )
    recipe: Path | None = field(default=None, metadata={"help": "file"})
    hidden: int = 7


def run(*arguments: str) -> Any:
    """Call a command that takes the options of a kitchen."""
    seen: list[Any] = []

    def command(
        name: Annotated[str, typer.Argument()],
        *,
        mixing: Mixing,
        out: Annotated[str, typer.Option("--out", "-o", "-o")] = "",
    ) -> None:
        """Mix."""
        seen.append((name, mixing, out))

    def called(common: Common, call: Any) -> None:
        seen.append(common)
        call()

    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command()(spread(command, called))
    typer.main.get_command(app).main(args=[*arguments], standalone_mode=False)
    return seen


def test_defaults_belong_to_the_class_alone() -> None:
    common, (name, mixing, out) = run("dough")
    assert (name, mixing, out) == ("dough", Mixing(), "")
    assert (common.quiet, common.verbose) == (False, False)


def test_every_kind_of_field_is_read() -> None:
    common, (_, mixing, out) = run(
        "dough", "--rate", "4", "--harmonics", "3", "--unchecked", "--gain", "1,2", "--style",
        "with", "--recipe", "a.toml", "-o", "x", "-q",
    )  # fmt: skip
    assert mixing == Mixing(
        rate=4.0,
        size=3,
        checked=False,
        gain=(1.0, 2.0),
        style="in_clockwise",
        recipe=Path("a.toml"),
    )
    assert (common.quiet, out) == (True, "x")


def test_wrong_values_name_the_option_and_what_is_available() -> None:
    with pytest.raises(UsageError, match=r"--style 'up' is not one of with, against"):
        run("dough", "--style", "up")
    with pytest.raises(UsageError, match=r"--gain takes .*, got 'a'"):
        run("dough", "--gain", "a")


def test_spelling() -> None:
    assert name_option("torque_source") == "--torque-source"
    assert name_option("checked") == "--unchecked"
