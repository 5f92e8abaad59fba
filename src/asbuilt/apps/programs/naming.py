"""Names that people chose, made safe for the languages of controllers."""

from __future__ import annotations

import re
import unicodedata


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
