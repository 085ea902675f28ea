# SPDX-License-Identifier: Apache-2.0
"""The fetched schema: what it imports comes along, another one than the pinned is refused."""

import pytest

from tools import dcc_schema

INNER = (
    '<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" '
    'targetNamespace="urn:{}">{}</xs:schema>'
)
IMPORT = '<xs:import namespace="urn:b" schemaLocation="{}"/>'


@pytest.fixture
def published(tmp_path, monkeypatch):
    """Return the URL of a schema that imports another, both pinned."""
    texts = {
        "a.xsd": INNER.format(
            "a", IMPORT.format("in/b.xsd") + '<xs:element name="e"/>'
        ),
        "in/b.xsd": INNER.format("b", ""),
    }
    (tmp_path / "in").mkdir()
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(
        dcc_schema,
        "PINNED",
        dict(dcc_schema.digest(text.encode()) for text in texts.values()),
    )
    return (tmp_path / "a.xsd").as_uri()


def test_what_a_schema_imports_lies_beside_it(published, tmp_path):
    dcc_schema.fetch(published, tmp_path / "out")
    text = (tmp_path / "out/dcc.xsd").read_text()
    assert 'schemaLocation="1.xsd"' in text
    assert dcc_schema.digest(text.encode())[0] == "urn:a"
    assert 'targetNamespace="urn:b"' in (tmp_path / "out/1.xsd").read_text()


@pytest.mark.parametrize(
    ("before", "after"),
    [('name="e"', 'name="f"'), ("in/b.xsd", "no.xsd"), ("</xs:schema>", "")],
)
def test_another_schema_is_one_line_and_nothing_is_written(
    published, tmp_path, capsys, monkeypatch, before, after
):
    path = tmp_path / "a.xsd"
    path.write_text(path.read_text().replace(before, after))
    monkeypatch.setattr("sys.argv", ["dcc_schema", str(tmp_path / "out"), published])
    assert dcc_schema.main() == 1
    printed = capsys.readouterr().out
    assert printed.startswith("test: the schema of certificates is left out: ")
    assert printed.count("\n") == 1 and not (tmp_path / "out").exists()


def test_places_notes_and_spaces_do_not_count():
    noted = INNER.format(
        "b",
        "\n  <!-- c --><xs:annotation><xs:documentation>text</xs:documentation></xs:annotation>\n",
    )
    assert dcc_schema.digest(noted.encode()) == dcc_schema.digest(
        INNER.format("b", "").encode()
    )
