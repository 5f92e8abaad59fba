def test_a_brief_finding_says_more_than_the_name_of_its_recording() -> None:
    finding = Finding(
        "stuck", "warning", "run.csv: in the last half second joint 3 stands; see row 9"
    )
    assert finding.brief(60) == "run.csv: in the last half second joint 3 stands."
