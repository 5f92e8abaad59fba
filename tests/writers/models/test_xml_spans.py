import codecs

import pytest

from asbuilt.errors import DescriptionError
from asbuilt.writers.models.xml_spans import Edit, XmlFile, list_attribute_edits

TEXT = """<?xml version="1.0"?>\r
<!-- <mass value="9"/> é -->\r
<u:robot xmlns:u="urn:x" note='a > b &#60;' >\r
\t<u:link  name = "one"\r
\t\tkind='x'/>\r
\t<u:link name="two"><![CDATA[<mass/>]]>\r
\t\t<u:mass value="1" />\r
\t</u:link >\r
\t<u:link name="three"></u:link>\r
</u:robot>\r
<!-- the end -->"""


def test_places_are_those_of_the_text() -> None:
    file = XmlFile.of(TEXT.encode(), "x")
    text = file.text.decode()
    assert file.root.attributes["note"] == "a > b <"
    one, two, three = file.root.all("link")
    cut = file.text
    assert cut[one.start : one.stop].decode() == "<u:link  name = \"one\"\r\n\t\tkind='x'/>"
    assert cut[slice(*one.values["kind"])] == b"x"
    assert one.close is None
    mass = two.first("mass")
    assert mass is not None
    assert cut[mass.start : mass.stop] == b'<u:mass value="1" />'
    assert cut[two.close : two.stop] == b"</u:link >"
    assert cut[three.inner : three.close] == b""
    assert text[0] == "<"


@pytest.mark.parametrize(
    ("codec", "mark", "declared"),
    [
        ("utf-8", b"", ""),
        ("utf-8", codecs.BOM_UTF8, ""),
        ("utf-16-le", codecs.BOM_UTF16_LE, ""),
        ("utf-16-be", codecs.BOM_UTF16_BE, ""),
        ("latin-1", b"", ' encoding="ISO-8859-1"'),
        ("cp1252", b"", " encoding='windows-1252'"),
    ],
)
def test_edits_keep_every_other_byte_in_every_encoding(
    codec: str, mark: bytes, declared: str
) -> None:
    text = TEXT.replace('version="1.0"', f'version="1.0"{declared}')
    content = mark + text.encode(codec)
    file = XmlFile.of(content, "x")
    assert file.edited([]) == content
    one, two, three = file.root.all("link")
    mass = two.first("mass")
    assert mass is not None
    edits = [
        *list_attribute_edits(mass, {"value": "2.5", "unit": "kg"}),
        *list_attribute_edits(one, {"name": "one"}),
        file.prepended(one, "<u:a/>"),
        file.appended(two, "<u:b/>"),
        file.prepended(three, "<u:c/>"),
    ]
    expected = (
        text.replace('value="1" />', 'value="2.5" unit="kg" />\r\n\t\t<u:b/>')
        .replace("kind='x'/>", "kind='x'>\r\n\t  <u:a/>\r\n\t</u:link>")
        .replace('"three"></', '"three">\r\n\t  <u:c/></')
    )
    assert file.edited(edits) == mark + expected.encode(codec)


def test_overlapping_edits_are_a_mistake() -> None:
    file = XmlFile.of(b"<a><b/></a>", "x")
    with pytest.raises(ValueError, match="overlap"):
        file.edited([Edit(0, 5, ""), Edit(3, 7, "")])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"<a><b></a>", "edited"),
        (b'<?xml version="1.0" encoding="utf-8"?><a b="\xff"/>', "decoded"),
        (b'<?xml version="1.0" encoding="nonsense"?><a/>', "decoded"),
        (b'<!DOCTYPE a [<!ENTITY e "x">]><a b="&e;"/>', "edited"),
    ],
)
def test_what_cannot_be_edited_is_refused(content: bytes, reason: str) -> None:
    with pytest.raises(DescriptionError, match=reason):
        XmlFile.of(content, "file.urdf")
