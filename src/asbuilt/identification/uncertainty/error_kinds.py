"""Kinds of standard errors: options name them before anything is computed."""

from __future__ import annotations

from typing import Literal

ErrorKind = Literal["blocks", "bootstrap", "textbook"]
ERROR_KINDS: tuple[ErrorKind, ...] = ("blocks", "bootstrap", "textbook")
