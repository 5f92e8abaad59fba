"""FloBaRoID is a program of scripts and settings, not a package; its own numbers are cited."""

PACKAGE = "FloBaRoID"
REQUIRES: list[str] = []
TITLE = "FloBaRoID"
ADDRESS = "https://github.com/kjyv/FloBaRoID"
CANNOT = {
    "*": "is not on the package index and could not be fetched where this ran (28 November 2026,"
    " change log up to 0.9.1); what it publishes of these recordings stands under"
    " [lwr4-normalised](#lwr4-normalised)"
}
