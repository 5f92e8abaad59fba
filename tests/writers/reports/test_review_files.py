"""Page, tables and document of a review say the same as the review."""

import csv
import json

import polars as pl
import pytest

from asbuilt import load_robot, review, simulate_recording
from asbuilt.codec import make_plain
from asbuilt.excitation import random_fourier
from asbuilt.writers import review_document, with_files, write_review
from asbuilt.writers.reports.review_files import review_table


@pytest.fixture(scope="module")
def found():
    model = load_robot("two-link")
    log = simulate_recording(model, random_fourier(model, rng=1, duration=20.0), rng=1)
    return review(model, log)


@pytest.fixture(scope="module")
def files(found, tmp_path_factory):
    return write_review(tmp_path_factory.mktemp("review") / "out", found)


def test_tables_have_every_claim_unrounded(found, files):
    frame = pl.read_parquet(files["parquet"])
    assert frame.to_dicts() == make_plain(found.claims)
    with files["table"].open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["what"] for row in rows] == [claim.what for claim in found.claims]
    assert [float(row["claimed"]) for row in rows] == [claim.claimed for claim in found.claims]
    assert rows[0]["alias_of"] == "; ".join(found.claims[0].alias_of)


def test_document_is_that_of_the_command(found, files):
    assert json.loads(files["review"].read_text()) == json.loads(json.dumps(review_document(found)))
    assert with_files(review_document(found), files)["files"]["report"].endswith("review.html")


def test_page_names_verdicts_and_claims_and_asks_nothing_of_the_network(found, files):
    text = files["report"].read_text()
    for claim in found.claims:
        assert claim.what in text
    for verdict in ("contradicted", "supported", "undetermined"):
        assert verdict in text
    assert "http" not in text.replace("http-equiv", "").replace("http://www.w3.org", "")
    assert files["figure"].read_bytes().startswith(b"\x89PNG")


def test_torques_of_a_robot_with_a_sliding_joint_are_forces_too(found):
    model = load_robot("scara")
    log = simulate_recording(model, random_fourier(model, rng=1, duration=20.0), rng=1)
    units = [
        {column.header: column.unit for column in review_table(reviewed).columns}["torque"]
        for reviewed in (found, review(model, log))
    ]
    assert units == ["N m", "N m, N"]
