"""Names and numbers as controllers take them: safe identifiers, principal axes, plain decimals."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from itertools import permutations

import numpy as np

from asbuilt.arrays import Array


def make_plain_text(text: str) -> str:
    r"""Return printable ASCII on one line that is safe in comments and strings of any language.

    Backslashes, double quotes, backticks and the marks that end comments become other characters;
    accents are dropped.

    Examples
    --------
    >>> make_plain_text('Müller\u2019s "arm" */ \\u000a')
    "Mullers 'arm' * / /u000a"
    """
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode("ascii")
    printable = "".join(character if character.isprintable() else " " for character in plain)
    return (
        " ".join(printable.split())
        .replace("\\", "/")
        .replace('"', "'")
        .replace("`", "'")
        .replace("*/", "* /")
        .replace("/*", "/ *")
    )


def make_file_stem(name: str) -> str:
    """Return a file name without suffix of characters a-z, A-Z, digits, `_` and `-`, or `motion`.

    Examples
    --------
    >>> make_file_stem("../my robot: run 1"), make_file_stem("///")
    ('my_robot_run_1', 'motion')
    """
    # 60: longest name made here.
    return (
        re.sub(r"[^A-Za-z0-9-]+", "_", make_plain_text(name)).strip("_-")[:60].strip("_-")
        or "motion"
    )


def make_lowercase_identifier(name: str, *, prefix: str) -> str:
    """Return `prefix` and the name as one lower-case identifier.

    The prefix keeps it from being a keyword.

    Examples
    --------
    >>> make_lowercase_identifier("2 fast; halt", prefix="asbuilt_")
    'asbuilt_2_fast_halt'
    """
    return prefix + make_file_stem(name).replace("-", "_").lower()


def make_class_name(name: str, *, suffix: str) -> str:
    """Return the name as a Java class name that ends in `suffix`.

    The suffix keeps it from being the name of a library's class.

    Examples
    --------
    >>> make_class_name("iiwa 7, run-2", suffix="Excitation")
    'Iiwa7Run2Excitation'
    >>> make_class_name("7", suffix="Excitation")
    'Motion7Excitation'
    """
    words = re.findall(r"[A-Za-z0-9]+", make_file_stem(name))
    joined = "".join(word[0].upper() + word[1:] for word in words)
    return ("Motion" + joined if joined[0].isdigit() else joined) + suffix


MILLIMETRES = 1000.0
"""Millimetres in a metre."""
ORDER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Places of the six numbers Ixx, Iyy, Izz, Ixy, Ixz, Iyz in the matrix of inertia."""


def format_decimals(value: float) -> str:
    """Return a number with eight digits and no exponent, which not every language reads.

    Examples
    --------
    >>> format_decimals(1.25e-6), format_decimals(-0.0), format_decimals(2)
    ('0.00000125', '0.0', '2.0')
    """
    return np.format_float_positional(value + 0.0, precision=8, fractional=False, trim="0")


def list_decimals(values: Iterable[float], separator: str = ", ") -> str:
    """Return numbers in a row.

    >>> list_decimals([0.5, -1.0])
    '0.5, -1.0'
    """
    return separator.join(map(format_decimals, values))


def list_inertia(inertia: Array) -> list[float]:
    """Return Ixx, Iyy, Izz, Ixy, Ixz, Iyz of a matrix (3, 3), off its diagonal with its signs."""
    return [float(inertia[place]) for place in ORDER]


def find_principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments (3,) of a matrix (3, 3) and its axes, a rotation (3, 3).

    The columns are the axes. Of the 24 such rotations it is the one that turns least, so that a
    matrix without products has the identity.
    """
    moments, axes = np.linalg.eigh(inertia)
    best = np.eye(3)
    order = [0, 1, 2]
    least = -np.inf
    for chosen in permutations(range(3)):
        turned = axes[:, chosen] * np.where(np.diagonal(axes[:, chosen]) < 0.0, -1.0, 1.0)
        if np.linalg.det(turned) < 0.0:
            turned[:, int(np.argmin(np.diagonal(turned)))] *= -1.0
        if np.trace(turned) > least:
            best = turned
            order = [*chosen]
            least = float(np.trace(turned))
    return moments[order], best
